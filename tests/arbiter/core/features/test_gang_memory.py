"""Gangs and the GPU itself: what is kept for a member is charged, but it loads only when the GPU
shows that it is free.
"""

from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer
from tests.support.scenes import held, hidden_gpu
from vram_arbiter.arbiter.core.effects import Sample
from vram_arbiter.arbiter.core.features.gangs import Gangs
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

GIB = d.GIB
MIB = d.MIB
MOMENT_S = 0.0001
SOMEBODY = ProcessKey(9, 9)


def member(who: Consumer, peak: float, steady: float, **spec: object) -> LeaseId:
    spec.setdefault("gang", ("g", 2))
    return who.acquire(int(peak * GIB), int(steady * GIB), **spec)


def to_peak_and_down(who: Consumer, lease: LeaseId) -> None:
    """Readings that began before see nothing of it, those that begin after it see the peak for as
    long as the GPU lags.
    """
    spec = who.specs[lease]
    who.driver.advance(MOMENT_S)
    who.hold(spec.footprint.load_peak_bytes)
    who.driver.advance(MOMENT_S)
    who.hold(spec.footprint.steady_bytes)
    who.ready(lease)


def why(driver: CoreDriver, lease: LeaseId) -> dict[str, Any]:
    """Return why a lease is not running, as codes and values."""
    consumer = (driver.view(lease) or {})["consumer"]
    (explained,) = driver.why(consumer)["leases"]
    return explained


@pytest.mark.parametrize("lists", [True, False])
def test_a_member_does_not_load_into_the_peak_of_the_one_before(lists: bool) -> None:
    """Regression: only the ledger was checked before a member's load, and it ran out of memory
    beside the earlier peak."""
    driver = hidden_gpu(lists=lists, lag_s=0.8)
    a, b = driver.consumer("a"), driver.consumer("b")
    first, second = member(a, 5, 2.5), member(b, 4.5, 2.5)
    to_peak_and_down(a, first)
    assert driver.state(second) == "queued"
    assert why(driver, second)["wait"] == "reading"
    driver.advance(0.1)
    assert why(driver, second)["wait"] == "not_free"
    waited = driver.until(lambda: driver.state(second) == "loading", limit_s=2.0)
    assert 0.6 < waited < 0.8 + 2 * d.LOAD_PROBE_S
    assert sum(driver.device.shown(driver.now).values()) + int(4.5 * GIB) <= 8 * GIB


def test_while_a_member_waits_for_its_memory_the_gpu_is_not_read_without_pause() -> None:
    """Regression: each reading that showed too little asked for the next at once: a thousand
    readings a second."""
    driver = hidden_gpu(lag_s=5.0)
    a, b = driver.consumer("a"), driver.consumer("b")
    first, second = member(a, 5, 2.5), member(b, 4.5, 2.5)
    to_peak_and_down(a, first)
    driver.effects.clear()
    driver.advance(1.0)
    assert driver.state(second) == "queued"
    assert (
        10
        < sum(isinstance(effect, Sample) for effect in driver.effects)
        <= 1.0 / d.LOAD_PROBE_S + 2
    )


def test_memory_that_does_not_come_back_breaks_the_gang_in_time() -> None:
    """It counts from when the GPU first showed too little, not from the last thing that happened
    on it.
    """
    driver = hidden_gpu(lists=False)
    a, b = driver.consumer("a"), driver.consumer("b")
    first, second = member(a, 3, 3), member(b, 4, 4)
    driver.device.set(
        SOMEBODY, 2 * GIB, driver.now
    )  # hidden behind what is kept for the second one
    driver.device.failing = "the driver hangs"
    driver.advance(1.5)
    a.load(first)
    driver.advance(2 * d.VERIFY_TIMEOUT_S)
    driver.device.failing = ""
    driver.until(lambda: why(driver, second).get("wait") == "not_free", limit_s=1.5)
    driver.advance(d.VERIFY_TIMEOUT_S - 0.5)
    assert driver.state(second) == "queued"
    driver.advance(1.0)
    assert (driver.state(first), driver.state(second)) == ("held", "over")
    error = driver.pushes("denied", second)[0]["error"]
    assert (error["code"], error["details"]["why"]) == ("gang_broken", "not_freed")
    assert driver.gpu()["charged_bytes"] == 3 * GIB


def test_a_shortage_that_is_over_is_forgotten() -> None:
    driver = hidden_gpu(lists=False)
    a, b, c = (driver.consumer(name) for name in "abc")
    first = member(a, 2, 2, gang=("g", 3))
    second = member(b, 2, 2, gang=("g", 3))
    third = member(c, 2, 2, gang=("g", 3))
    for who, lease, after in ((a, first, second), (b, second, third)):
        driver.device.set(SOMEBODY, 5 * GIB, driver.now)
        driver.advance(1.5)
        who.load(lease)
        driver.advance(0.7 * d.VERIFY_TIMEOUT_S)
        assert driver.state(after) == "queued"
        driver.device.set(SOMEBODY, 0, driver.now)
        driver.until(lambda lease=after: driver.state(lease) == "loading", limit_s=1.5)


def test_what_a_process_keeps_is_part_of_what_its_member_needs() -> None:
    """Where readings do not list processes, the residue that the ledger knows is not asked for
    twice.
    """
    driver = hidden_gpu(lists=False)
    who = driver.consumer("who")
    before = who.acquire(GIB, residue_bytes=GIB)
    who.load(before)
    driver.advance(0.01)
    who.unload(before)
    driver.until(lambda: driver.state(before) == "over")
    assert driver.gpu()["charged_bytes"] == GIB
    lease = member(who, 7.6, 7.6, residue_bytes=GIB)
    member(driver.consumer("small"), 0.05, 0.05)
    driver.advance(0.01)
    assert driver.state(lease) == "loading"


def test_bytes_kept_for_a_gang_do_not_verify_what_its_process_gives_back() -> None:
    """A process lets go of a lease while it waits for its turn in a gang: what it still holds is
    not its member's.
    """
    driver = hidden_gpu(lag_s=0.8)
    a, b = driver.consumer("a"), driver.consumer("b")
    own = b.acquire(GIB)
    b.load(own)
    driver.advance(0.01)
    member(a, 3, 3)
    second = member(b, 3, 3)
    b.unloading(own)
    b.hold(0)
    b.release(own)
    driver.advance(0.5)
    assert driver.state(own) == "verifying", "a gigabyte is still there"
    waited = driver.until(lambda: driver.state(own) == "over", limit_s=1.0)
    assert waited < 0.5
    assert driver.state(second) == "queued"


def test_a_member_whose_process_is_still_giving_back_needs_all_its_bytes() -> None:
    """What its process holds of a lease that is over is no context of the next one."""
    driver = hidden_gpu(lag_s=0.8)
    a, b = driver.consumer("a"), driver.consumer("b")
    own = b.acquire(2 * GIB)
    b.load(own)
    driver.advance(0.01)
    first, second = member(a, 2.5, 1), member(b, 4, 3)
    b.unloading(own)
    b.hold(0)
    b.release(own)
    to_peak_and_down(a, first)
    driver.advance(0.01)
    assert driver.state(own) == "verifying"
    driver.until(lambda: driver.state(second) == "loading", limit_s=2.0)
    assert sum(driver.device.shown(driver.now).values()) + 4 * GIB <= 8 * GIB


@pytest.mark.parametrize("asked", [False, True])
def test_a_gang_that_broke_is_not_waited_for_after_a_restart(asked: bool) -> None:
    """Regression: the members' records were rewritten only when the gang was complete."""
    driver = hidden_gpu()
    a, b = driver.consumer("a"), driver.consumer("b")
    first, second = member(a, 3, 3), member(b, 4, 4)
    a.load(first)
    if asked:
        a.unloading(first)
    b.die()
    assert driver.state(second) == "over"
    assert driver.journal[f"lease:{first}"].get("gang") is None
    token = a.token(first)
    driver.restart()
    a.connect()
    answer(a.reattach(first, token))
    assert not driver.arbiter.inspect().feature(Gangs).by_name


def test_bytes_kept_for_the_next_member_hide_no_context_of_the_one_before() -> None:
    """Regression: bytes reserved for the next member's load covered the context of an earlier
    member's process; moving them counted both and broke an invariant."""
    driver = hidden_gpu(lag_s=0.8)
    first, lease = held(driver, "first", 1, residue_bytes=GIB)
    first.unload(lease)  # its context stays
    driver.until(lambda: driver.state(lease) == "over")
    other = driver.consumer("other")
    loaded = other.acquire(3 * GIB, int(1.5 * GIB))
    driver.until(lambda: driver.state(loaded) == "loading")
    other.hold(3 * GIB)
    driver.advance(0.1)
    other.load(loaded)  # the GPU shows its peak for a moment more
    began = driver.now
    one = member(first, 0.5, 0.5)
    last = driver.consumer("last")
    two = member(last, 4, 2)
    driver.until(lambda: driver.state(one) == "loading")
    first.ready(one)
    driver.until(lambda: driver.state(two) == "loading")
    assert driver.now - began >= 0.8, (
        "with the peak of the other one it would be more than the budget"
    )


def test_who_came_and_died_since_the_reading_may_still_be_on_the_gpu() -> None:
    """Regression: a reading from before a process came cannot show its bytes; only living processes
    were added to it."""
    driver = CoreDriver(8 * GIB)
    driver.device.lists_processes = False
    driver.device.lag_s = 0.03
    driver.device.reading_s = 0.5  # one from before may still count
    short = driver.consumer("short")
    lease = short.acquire(5 * GIB, 1 * GIB)
    assert driver.state(lease) == "loading"
    short.hold(5 * GIB)
    short.load(lease)
    short.die()
    wanted = driver.consumer("next").acquire(6 * GIB)
    shown = sum(driver.device.shown(driver.now).values())
    assert shown == 5 * GIB
    assert driver.state(wanted) == "queued"
    driver.until(lambda: driver.state(wanted) == "loading")
    assert not driver.device.shown(driver.now)
