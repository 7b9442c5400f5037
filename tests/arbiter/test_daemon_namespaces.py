"""Pid namespaces: below the arbiter's a client is known by the pid that the arbiter sees, beside or
above it cannot be known and is refused."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.process import Make
from tests.support.processes import children
from tests.support.waiting import PATIENCE_S, until
from tests.support.wire import WireClient

pytestmark = pytest.mark.e2e
UNSHARE = ["unshare", "--pid", "--fork", "--kill-child", "--mount-proc"]
INSIDE = """
import os, sys
from tests.support.wire import WireClient
with WireClient(sys.argv[1]) as client:
    client.hello("inside").granted("inside", 1 << 30)
    print(os.getpid(), flush=True)
    sys.stdin.read()
"""


def can_unshare() -> bool:
    if shutil.which("unshare") is None:
        return False
    done = subprocess.run([*UNSHARE, "true"], capture_output=True, timeout=60)
    return done.returncode == 0


pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(
        not can_unshare(), reason="pid namespaces cannot be made here (unshare, root)"
    ),
]


def test_a_client_in_a_namespace_below_is_known_by_its_pid_out_here(make_arbiter: Make) -> None:
    arbiter = make_arbiter().start()
    command = [*UNSHARE, sys.executable, "-c", INSIDE, arbiter.endpoint]
    with WireClient(arbiter.endpoint) as watcher:
        watcher.hello("watcher", role="observer").ask("subscribe")
        inside = subprocess.Popen(
            command, env=arbiter.environ, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        try:
            assert inside.stdout.readline().strip() == "1", "in there it is the first of all"
            (lease,) = watcher.ask("status")["leases"]
            children = Path(f"/proc/{inside.pid}/task/{inside.pid}/children").read_text().split()
            assert [lease["pid"]] == [int(pid) for pid in children]
            os.kill(lease["pid"], 9)
            gone = watcher.push("event", where=lambda push: push["event"]["kind"] == "lost")
            assert gone["event"]["lease_id"] == lease["lease_id"]
        finally:
            inside.kill()
            inside.wait(PATIENCE_S)


def test_a_client_that_cannot_be_seen_is_refused_and_told_why(make_arbiter: Make) -> None:
    arbiter = make_arbiter()
    arbiter.program = [*UNSHARE, *arbiter.program]
    arbiter.start()
    with WireClient(arbiter.endpoint) as client:
        refused = client.ask("hello", name="outside", instance="o")
        assert not refused["ok"]
        assert refused["error"]["code"] == "not_permitted"
        assert "pid namespace" in refused["error"]["message"]
        assert "--pid=host" in refused["error"]["hint"]
        assert client.ask("status")["error"]["code"] == "unknown_session", "and stays a stranger"


def test_as_the_first_process_it_leaves_no_zombies(make_arbiter: Make) -> None:
    """Regression: in a container without an init process the daemon inherits the orphans of other
    programs, and those that had ended stayed in its process table until its own end."""
    arbiter = make_arbiter()
    arbiter.program = [*UNSHARE, *arbiter.program]
    arbiter.start()
    (daemon,) = children(arbiter.pid)
    lasting, end = os.pipe()
    shell = "exec 3<&0; cat <&3 &"  # cat lasts until the pipe is closed, its parent does not
    enter = ["nsenter", "--target", str(daemon), "--pid", "--", "sh", "-c", shell]
    try:
        subprocess.run(enter, stdin=lasting, check=True, timeout=PATIENCE_S)
        until(lambda: len(children(daemon)) == 1)
    finally:
        os.close(end)
        os.close(lasting)
    until(lambda: not children(daemon))
