"""A child outlives the process that held the lease, and keeps its bytes as a stowaway."""

import pytest

from tests.support.core_driver import CoreDriver
from tests.support.engine_state import state_of
from tests.support.scenes import held
from vram_arbiter.arbiter.core.events import ProcessDied
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import ProcessKey

CHILD = ProcessKey(4000, 1)


@pytest.mark.parametrize(
    ("read_first", "listed"),
    [(False, False), (True, False), (True, True)],
    ids=["death, reading", "reading, death", "reading without bytes of it, death"],
)
def test_the_verdict_does_not_depend_on_what_is_seen_first(read_first: bool, listed: bool) -> None:
    """Under load a reading that shows the orphan came before the death of its parent, and the
    verdict said `verified` with the 4 GiB still there. They were the orphan's on the ledger, so
    nothing was granted on them; only the note was wrong."""
    driver = CoreDriver()
    driver.device.names[CHILD] = "job"
    parent, _ = held(driver, "job", 4)
    driver.advance(2.0)
    driver.device.set(parent.process, 0, driver.now)
    driver.device.set(CHILD, 4 * GIB, driver.now)
    if listed:
        driver.device.held[parent.process] = 0
    if read_first:
        driver.until(lambda: driver.gpu()["stowaway_bytes"] == 4 * GIB)
        driver.advance(0.5)
    driver.post(ProcessDied(parent.process))
    waiter = driver.consumer("waiter")
    wanted = waiter.acquire(5 * GIB)
    driver.until(lambda: bool(driver.notes("verified")))
    (verdict,) = driver.notes("verified")
    assert (verdict["verdict"], verdict["culprits"]) == (
        "contested",
        [{"pid": CHILD.pid, "name": "job", "bytes": 4 * GIB}],
    )
    driver.advance(5.0)
    assert driver.gpu()["charged_bytes"] == 0
    assert driver.gpu()["stowaway_bytes"] == 4 * GIB, "charged once"
    assert driver.state(wanted) == "queued", "nothing is granted on bytes that are not free"
    driver.device.set(CHILD, 0, driver.now)
    driver.until(lambda: driver.state(wanted) == "loading")


@pytest.mark.parametrize(
    ("after_s", "verdict"),
    [(d.VERIFY_TIMEOUT_S, "contested"), (d.VERIFY_TIMEOUT_S + 0.001, "verified")],
)
def test_bytes_that_were_given_back_long_ago_are_not_looked_for(
    driver: CoreDriver, after_s: float, verdict: str
) -> None:
    """A holder that freed its memory and dies later owes nothing: a program that took the room
    since is a stowaway, and no culprit."""
    holder, _ = held(driver, "holder", 4)
    driver.advance(2.0)
    shown = state_of(driver.arbiter).gpus[driver.device.gpu].sample
    assert shown is not None
    driver.device.set(holder.process, 0, driver.now)
    driver.device.set(CHILD, 4 * GIB, driver.now)
    driver.advance(shown.taken_at + after_s - driver.now)
    driver.post(ProcessDied(holder.process))
    driver.until(lambda: bool(driver.notes("verified")))
    assert driver.notes("verified")[0]["verdict"] == verdict
