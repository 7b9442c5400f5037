"""Forked programs: one server for the processes of a run, outputs, exit codes, waiting threads."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.support.prepared import run, start
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S

pytestmark = pytest.mark.e2e
ANOTHER = """
from tests.support.process import ArbiterProcess
from tests.support.test_prepared import server_of
daemon = ArbiterProcess(prepared=True).start()
print(server_of(daemon))
daemon.close()
"""


def server_of(daemon: ArbiterProcess) -> int:
    """Return the pid of the process that the daemon was forked from."""
    return int(Path(f"/proc/{daemon.pid}/stat").read_text().rpartition(")")[2].split()[1])


def test_the_processes_of_a_run_share_a_server(arbiter_daemon: ArbiterProcess) -> None:
    """Each worker imported everything once more: 8 s of a core for lerobot alone."""
    other = subprocess.run(
        [sys.executable, "-c", ANOTHER],
        check=True,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert int(other.stdout) == server_of(arbiter_daemon)


def test_outputs_and_the_exit_code_are_its_own() -> None:
    done = run("vramctl", ["--version"], os.environ, PATIENCE_S)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("vram-arbiter ")
    wrong = run("vramctl", ["no-such-command"], os.environ, PATIENCE_S)
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert "no-such-command" in wrong.stderr


def test_threads_that_wait_for_the_same_program_all_hear_of_its_end(
    arbiter_daemon: ArbiterProcess,
) -> None:
    """A recorder waits for its writer on two threads."""
    process = start("vramctl", ["history", "-f"], arbiter_daemon.environ)
    codes: list[int] = []
    waiting = [
        threading.Thread(target=lambda: codes.append(process.wait(PATIENCE_S))) for _ in "ab"
    ]
    for one in waiting:
        one.start()
    assert process.poll() is None
    process.kill()
    for one in waiting:
        one.join(PATIENCE_S)
    assert codes == [-9, -9]
