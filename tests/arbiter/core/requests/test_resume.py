"""A laptop's lid: the monotonic clock stood still, so nobody expires, but everything measured is of
yesterday."""

from collections.abc import Mapping
from typing import Any

from tests.support.core_driver import CoreDriver
from tests.support.scenes import held, in_use
from vram_arbiter.arbiter.core.effects import Note, Sample
from vram_arbiter.arbiter.core.events import MemorySampled, ProcessDied, Resumed
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.defaults import GIB

NIGHT_S = 8 * 3600.0


def test_every_holder_gets_its_full_ttl_anew_and_none_expires(driver: CoreDriver) -> None:
    """They wake up in any order, behind a driver that takes its time: the first to be late must not
    lose its lease for it."""
    holders = [held(driver, name, 1, ttl_s=10.0) for name in ("a", "b", "c")]
    driver.advance(8.0)  # of ten
    driver.post(Resumed(NIGHT_S))
    assert [driver.notes("resumed")[0]["slept_s"]] == [NIGHT_S]
    driver.advance(9.5)
    assert [driver.state(lease) for _, lease in holders] == ["held"] * 3
    driver.advance(1.0)
    assert [driver.state(lease) for _, lease in holders] == ["over"] * 3, (
        "who stays silent expires all the same"
    )


def test_nothing_is_granted_on_a_reading_from_before(driver: CoreDriver) -> None:
    """Regression: by the monotonic clock yesterday's reading is a second old."""
    person = driver.consumer("a")
    driver.advance(0.01)
    driver.device.failing = "the driver wakes up too"
    effects = driver.post(Resumed(NIGHT_S))
    assert Sample(driver.device.gpu) in effects
    lease = person.acquire(2 * GIB)
    assert driver.state(lease) == "queued"
    assert driver.gpu()["blocked"]
    driver.device.failing = ""
    driver.until(lambda: driver.state(lease) == "loading")


def test_a_reading_that_began_before_the_night_does_not_count(driver: CoreDriver) -> None:
    began = driver.now
    driver.advance(0.5)
    driver.device.silent = True
    driver.post(Resumed(NIGHT_S))
    driver.post(MemorySampled(driver.device.gpu, began, 0, 8 * GIB, ()))
    assert driver.gpu()["measured_used_bytes"] is None
    waiter = driver.consumer("a").acquire(GIB)
    assert driver.state(waiter) == "queued"
    driver.post(MemorySampled(driver.device.gpu, driver.now, 0, 8 * GIB, ()))
    assert driver.state(waiter) == "loading"


def newest(driver: CoreDriver, kind: str) -> Mapping[str, Any]:
    """The last note of a kind, found from the end: there are many after half an hour."""
    notes = (effect for effect in reversed(driver.effects) if isinstance(effect, Note))
    return next(to_map(note.body) for note in notes if note.kind == kind)


def test_a_verification_begins_again(driver: CoreDriver) -> None:
    """Its time is up by what it waited for before; the readings of a new day decide, with the whole
    time for them."""
    driver.device.lag_s = 1000.0
    person, lease = held(driver, "a", 5, ttl_s=10.0)
    person.unload(lease)
    driver.advance(driver.settings.verify_timeout_s + 1)
    assert [note["verdict"] for note in driver.notes("verified")] == ["residue"]
    other, second = held(driver, "b", 1, ttl_s=10.0)
    driver.advance(1.0)
    driver.post(ProcessDied(other.process))  # its bytes stay
    driver.advance(driver.settings.verify_timeout_s + 1)
    assert driver.notes("verified")[-1]["verdict"] == "contested"
    driver.post(Resumed(NIGHT_S))
    before = len(driver.notes("verified"))
    driver.advance(driver.settings.verify_timeout_s - 1)
    assert len(driver.notes("verified")) == before, "no verdict of yesterday is repeated"
    driver.device.set(other.process, 0, driver.now)
    driver.device.lag_s = 0.0
    driver.until(lambda: newest(driver, "verified")["resolved"], limit_s=2000.0, step_s=0.5)
    assert driver.state(second) == "over"


def test_waiters_and_leases_on_their_way_out_keep_their_place(driver: CoreDriver) -> None:
    holder, lease = in_use(driver, "a", 5, ttl_s=3600.0)
    waiter = driver.consumer("b").acquire(5 * GIB, wait_timeout_s=20.0)
    driver.until(lambda: driver.state(lease) == "revoking")
    effects = driver.post(Resumed(NIGHT_S))
    assert not [
        e for e in effects if isinstance(e, Note) and e.kind in ("denied", "expired", "cancelled")
    ]
    assert (driver.state(lease), driver.state(waiter)) == ("revoking", "queued")
    holder.use_end(lease)
    holder.unload(lease)
    driver.until(lambda: driver.state(waiter) == "loading")


def test_what_was_there_before_the_night_has_to_come_back_before_a_dead_holder_is_gone() -> None:
    """Regression (storm, seed 11): nobody had read the GPU since, so a context that another had
    never made hid what the dead one left."""
    driver = CoreDriver(8 * GIB, start=False)
    driver.device.lists_processes = False
    driver.advance(0.01)
    idle = driver.consumer("idle")
    unused = idle.acquire(GIB, residue_bytes=450 * d.MIB)
    idle.release(unused)
    driver.until(lambda: driver.state(unused) == "over")
    person, lease = held(driver, "a", 0.4, ttl_s=10.0)
    driver.advance(1.5)
    driver.device.lag_s = 3.0
    driver.device.set(person.process, 0, driver.now)
    driver.post(Resumed(NIGHT_S))
    driver.post(ProcessDied(person.process))
    waiter = driver.consumer("b").acquire(GIB, exclusive=True)
    assert driver.until(lambda: driver.state(waiter) == "loading") > 2.9
    assert [note["verdict"] for note in driver.notes("verified") if note["lease_id"] == lease] == [
        "verified"
    ]
