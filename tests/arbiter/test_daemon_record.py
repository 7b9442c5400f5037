"""A real daemon's event log: what it decided is decided again, byte for byte. Real processes."""

import json
import sys

import pytest

from tests.support.process import ArbiterProcess, Make, vramctl
from tests.support.waiting import until
from vram_arbiter.arbiter.eventlog import replay as runner
from vram_arbiter.arbiter.eventlog.logfile import FOLDER

pytestmark = pytest.mark.e2e


def lease_something(arbiter: ArbiterProcess) -> None:
    done = vramctl("run", "--vram", "5GiB", "--", sys.executable, "-c", "", environ=arbiter.environ)
    assert done.returncode == 0, done.stderr


def on_disk(arbiter: ArbiterProcess, event: str) -> bool:
    """Whether the log on the disk holds an event of this kind."""
    files = (arbiter.state / FOLDER).glob("*")
    return any(f'"event":"{event}"' in file.read_text() for file in files)


def test_a_daemon_replays_identically_also_after_kill_9_and_a_restart(make_arbiter: Make) -> None:
    """The log goes to the disk in batches: a kill before the first of them leaves no file."""
    arbiter = make_arbiter().start()
    lease_something(arbiter)
    until(lambda: on_disk(arbiter, "Asked"))
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

    done = vramctl("replay", str(arbiter.state), environ=arbiter.environ)
    assert (done.returncode, done.stderr) == (0, "")
    assert "events, identical (1 file" in done.stdout
    done = vramctl("replay", str(arbiter.state), "--json", environ=arbiter.environ)
    assert json.loads(done.stdout)["identical"] is True
    assert vramctl("replay", "/nonexistent", environ=arbiter.environ).returncode == 1
    assert vramctl("replay", environ=arbiter.environ).returncode == 2


def test_recording_can_be_switched_off(make_arbiter: Make) -> None:
    arbiter = make_arbiter(config="record:\n  enabled: false\n").start()
    lease_something(arbiter)
    arbiter.stop()
    assert not (arbiter.state / FOLDER).exists()
