"""The service manager's watchdog is fed by the decision loop itself: whatever is stuck in it
starves the watchdog. Real processes.

The defect is planted from outside: a script runs the real daemon around a part that reads from a
pipe into which nobody writes.
"""

import os
import signal
import sys
import textwrap
from pathlib import Path

import pytest

from tests.support.process import ArbiterProcess, Make
from tests.support.waiting import PATIENCE_S
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import GIB

pytestmark = pytest.mark.e2e
WATCHDOG_S = 0.6
SMALL = 200 << 20
"""No bytes are on the GPU here: a larger lease would be void at the restart, because the GPU is
read as empty."""


CORE = """
    class Stuck(daemon.Arbiter):
        def handle(self, event, now):
            if isinstance(event, ClientConnected) and event.name == "trigger":
                wait_for_ever()
            return super().handle(event, now)

    daemon.Arbiter = Stuck
"""
JOURNAL = """
    class Stuck(daemon.Journal):
        def apply(self, changes):
            if any(record and record["spec"]["consumer"] == "trigger" for _, record in changes):
                wait_for_ever()
            super().apply(changes)

    daemon.Journal = Stuck
"""
CHORE = """
    class Failing(daemon.Journal):
        def settle(self):
            raise RuntimeError("the chore fails as told")

    daemon.Journal = Failing
    heartbeat.STATUS_EVERY_S = 0.05
"""
INVARIANT = """
    class Defective(daemon.Arbiter):
        def handle(self, event, now):
            raise InvariantViolation(1, "planted")
    daemon.Arbiter = Defective
"""
EXIT_DEFECT = 70


def planted(arbiter: ArbiterProcess, defect: str) -> Path:
    """Make the daemon's program one with a defect; returns the pipe that it gets stuck on."""
    pipe = arbiter.runtime / "pipe"
    os.mkfifo(pipe)
    script = f"""
    import sys
    import vram_arbiter.arbiter.daemon as daemon
    import vram_arbiter.arbiter.host.heartbeat as heartbeat
    from vram_arbiter.arbiter.__main__ import main
    from vram_arbiter.arbiter.core.events import ClientConnected
    from vram_arbiter.arbiter.core.invariants import InvariantViolation

    def wait_for_ever():
        with open({str(pipe)!r}, "rb") as file:
            file.read(1)
    {defect}
    sys.exit(main())
    """
    path = arbiter.runtime / "planted.py"
    path.write_text(textwrap.dedent(script))
    arbiter.program = [sys.executable, str(path)]
    return pipe


def feed(messages: list[str]) -> list[str]:
    return [message for message in messages if "WATCHDOG=1" in message]


def test_without_a_watchdog_none_is_fed(make_arbiter: Make) -> None:
    arbiter = make_arbiter().start()
    with WireClient(arbiter.endpoint) as client:
        client.hello()
        arbiter.wait_for("1 clients", PATIENCE_S)  # a whole beat has passed
    assert not feed(arbiter.messages)


@pytest.mark.parametrize("defect", [CORE, JOURNAL], ids=["core", "journal"])
def test_a_stuck_part_stops_feeding_it_and_the_manager_learns_where(
    make_arbiter: Make, defect: str
) -> None:
    arbiter = make_arbiter()
    pipe = planted(arbiter, defect)
    arbiter.start({"WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6))})
    arbiter.wait_for("WATCHDOG=1", PATIENCE_S)
    with WireClient(arbiter.endpoint) as holder, WireClient(arbiter.endpoint) as trigger:
        kept = holder.hello("holder").granted("holder", SMALL, ttl_s=60.0)
        trigger.send("hello", name="trigger", instance="t")
        if defect is JOURNAL:
            spec = {
                "consumer": "trigger",
                "model_id": "m",
                "footprint": {"load_peak_bytes": GIB, "steady_bytes": GIB},
            }
            assert holder.ask("ready", lease_id=kept["lease_id"], token=kept["token"])["ok"]
            trigger.send("acquire", nonce="n", spec=spec)
        # returns once the daemon stands at the other end: it is stuck now
        writer = os.open(pipe, os.O_WRONLY)
        assert not feed(arbiter.heard(2 * WATCHDOG_S))
        arbiter.process.send_signal(signal.SIGABRT)  # what systemd does after WatchdogSec
        assert arbiter.process.wait(PATIENCE_S) == -signal.SIGABRT
        os.close(writer)
    assert "in wait_for_ever" in arbiter.log, "the log names the line that was stuck"

    arbiter.program = [sys.executable, "-m", "vram_arbiter.arbiter"]
    arbiter.start()
    with WireClient(arbiter.endpoint) as client:
        leases = client.hello().ask("status")["leases"]
        assert [
            (lease["lease_id"], lease["token"]) for lease in leases if lease["consumer"] == "holder"
        ] == [(kept["lease_id"], kept["token"])]


@pytest.mark.parametrize(
    ("defect", "words"),
    [
        (CHORE, ["stopping: RuntimeError: the chore fails as told"]),
        (INVARIANT, ["invariant 1: planted", "state of the core: {"]),
    ],
    ids=["chore", "engine"],
)
def test_a_part_that_fails_ends_the_daemon(
    make_arbiter: Make, defect: str, words: list[str]
) -> None:
    """Regression: the failure ended the chores alone and was logged nowhere: on a machine without a
    watchdog the daemon served on, with stale sessions and a journal that it did not mend."""
    arbiter = make_arbiter()
    planted(arbiter, defect)
    arbiter.spawn()
    assert arbiter.process.wait(PATIENCE_S) == EXIT_DEFECT
    assert all(said in arbiter.log for said in words)
