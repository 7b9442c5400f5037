"""A real daemon's event log: what it decided is decided again, byte for byte. Real processes."""

import json
import subprocess
import sys
from collections.abc import Callable

import pytest

from tests.support.process import ArbiterProcess
from vram_arbiter.arbiter.eventlog import replay as runner
from vram_arbiter.arbiter.eventlog.logfile import FOLDER

pytestmark = pytest.mark.e2e
PATIENCE_S = 60

Make = Callable[..., ArbiterProcess]


def vramctl(arbiter: ArbiterProcess, *arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-m", "vram_arbiter.clients", *arguments],
        env=arbiter.environ,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


def lease_something(arbiter: ArbiterProcess) -> None:
    done = vramctl(arbiter, "run", "--vram", "5GiB", "--", sys.executable, "-c", "")
    assert done.returncode == 0, done.stderr


def test_a_daemon_replays_identically_also_after_kill_9_and_a_restart(make_arbiter: Make) -> None:
    arbiter = make_arbiter().start()
    lease_something(arbiter)
    arbiter.kill()
    arbiter.start()
    lease_something(arbiter)
    arbiter.stop()
    logs = sorted((arbiter.state / FOLDER).iterdir())
    assert len(logs) == 2
    for log in logs:
        found = runner.replay(runner.load(log))
        assert found.identical
        assert found.events > 0

    done = vramctl(arbiter, "replay", str(arbiter.state))
    assert (done.returncode, done.stderr) == (0, "")
    assert "events, identical (1 file" in done.stdout
    done = vramctl(arbiter, "replay", str(arbiter.state), "--json")
    assert json.loads(done.stdout)["identical"] is True
    assert vramctl(arbiter, "replay", "/nonexistent").returncode == 1
    assert vramctl(arbiter, "replay").returncode == 2


def test_recording_can_be_switched_off(make_arbiter: Make) -> None:
    arbiter = make_arbiter(config="record:\n  enabled: false\n").start()
    lease_something(arbiter)
    arbiter.stop()
    assert not (arbiter.state / FOLDER).exists()
