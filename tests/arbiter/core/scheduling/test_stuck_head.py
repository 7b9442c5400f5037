"""A head that waits for bytes nobody can be asked for (a stowaway's, a context's) holds back only
those who would be in its way later."""

from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.scenes import give_back
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

STRANGER = ProcessKey(9, 9)


def held_after_peak(
    driver: CoreDriver, name: str, gib: float, *, peak_gib: float = 0, **spec: Any
) -> tuple[Consumer, LeaseId]:
    person = driver.consumer(name)
    lease = person.acquire(int(max(peak_gib, gib) * GIB), int(gib * GIB), **spec)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=3.0)
    person.load(lease)
    driver.advance(0.01)
    return person, lease


def stowaway(driver: CoreDriver, gib: float) -> None:
    """Somebody without a lease holds this much from now on; the next background reading
    shows it."""
    driver.device.set(STRANGER, int(gib * GIB), driver.now)
    driver.advance(1.1)


def stuck(gib: float = 5, by: float = 4, *, lists: bool = True) -> tuple[CoreDriver, LeaseId]:
    """A GPU of 8 GiB (7.6 to give), a stowaway on it, and a head that would fit if it went."""
    driver = CoreDriver(8 * GIB)
    driver.device.lists_processes = lists
    stowaway(driver, by)
    head = driver.consumer("head").acquire(int(gib * GIB))
    driver.advance(0.1)
    assert driver.state(head) == "queued"
    return driver, head


# -- who passes
@pytest.mark.parametrize("lists", [True, False])
def test_small_ones_pass_a_head_that_waits_for_a_stowaway(lists: bool) -> None:
    """Regression: everybody behind it waited until the stowaway had gone, beside 3.6 GiB that were
    free."""
    driver, head = stuck(lists=lists)
    small, lease = held_after_peak(driver, "small", 2)
    small.use_begin(lease)
    assert driver.state(head) == "queued"
    stowaway(driver, 0)
    driver.until(lambda: driver.state(head) == "loading", limit_s=1.0)
    assert driver.state(lease) == "held", "both fit: nobody had to be asked"


def test_what_the_head_will_need_is_kept_for_it() -> None:
    """5 + 2.5 fit the 7.6 GiB, a second one of 2 GiB would not, though there are free bytes for it
    now."""
    driver, head = stuck(by=3)
    held_after_peak(driver, "small", 2.5)
    late = driver.consumer("late").acquire(2 * GIB)
    driver.advance(5.0)
    assert driver.state(late) == "queued"
    stowaway(driver, 0)
    driver.until(lambda: driver.state(head) == "loading", limit_s=1.0)


def test_a_head_that_could_be_served_by_leaves_alone_keeps_its_room(driver: CoreDriver) -> None:
    """It fits beside the stowaway once the holder has gone: what comes back of the stowaway is not
    counted on."""
    busy, lease = held_after_peak(driver, "busy", 4, priority=90)
    busy.use_begin(lease)
    stowaway(driver, 2)
    head = driver.consumer("head").acquire(5 * GIB)
    small = driver.consumer("small").acquire(1 * GIB)
    driver.advance(5.0)
    assert driver.state(small) == "queued", "2 + 5 + 1 do not fit"
    busy.use_end(lease)
    driver.until(lambda: driver.state(lease) == "revoking", limit_s=1.0)
    busy.unload(lease)
    driver.until(lambda: driver.state(head) == "loading", limit_s=1.0)


def test_one_that_can_never_be_asked_to_leave_does_not_pass() -> None:
    """The stowaway may give back a part: enough for the head alone, and then nobody could make room
    for it."""
    driver, head = stuck()
    pinned = driver.consumer("pinned").acquire(2 * GIB, evictable=False)
    _, other = held_after_peak(driver, "other", 1)
    driver.advance(2.0)
    assert (driver.state(pinned), driver.state(head)) == ("queued", "queued")
    assert driver.state(other) == "held", "those behind it pass both"


def test_nobody_passes_an_exclusive_head_that_waits_for_a_stowaway(driver: CoreDriver) -> None:
    stowaway(driver, 4)
    head = driver.consumer("head").acquire(5 * GIB, exclusive=True)
    small = driver.consumer("small").acquire(1 * GIB)
    driver.advance(2.0)
    assert (driver.state(head), driver.state(small)) == ("queued", "queued")


# -- the bound on the head's wait
def test_of_a_stowaway_that_gives_back_a_part_the_head_gets_it_all() -> None:
    """It fits beside what is left of the stowaway, not beside who passed it: that one is asked."""
    driver, head = stuck()
    small, lease = held_after_peak(driver, "small", 2)
    stowaway(driver, 2)
    driver.until(lambda: driver.state(lease) == "revoking", limit_s=1.0)
    later = driver.consumer("later").acquire(GIB)
    driver.advance(1.0)
    assert driver.state(later) == "queued", "nobody passes it any more"
    small.unload(lease)
    driver.until(lambda: driver.state(head) == "loading", limit_s=1.0)


def test_the_ageing_bound_holds_against_those_who_passed() -> None:
    """In use and of a higher priority, it is asked when the head has aged to it, counted from the
    head's arrival."""
    driver, head = stuck(gib=5)
    asked_at = driver.now - 0.1 + 10 * driver.settings.ageing_s_per_point
    late = driver.consumer("small", priority=60)
    driver.advance(9.0 * driver.settings.ageing_s_per_point)
    lease = late.acquire(2 * GIB)
    assert driver.state(lease) == "loading", "it came too late to be before the head"
    late.load(lease)
    late.use_begin(lease)
    stowaway(driver, 2)
    assert driver.state(lease) == "held"
    driver.until(
        lambda: driver.state(lease) == "revoking", limit_s=2 * driver.settings.ageing_s_per_point
    )
    assert driver.now == pytest.approx(asked_at, abs=0.1)
    late.use_end(lease)
    late.unload(lease)
    driver.until(lambda: driver.state(head) == "loading", limit_s=1.0)


# -- residues
def test_small_ones_pass_a_head_that_waits_for_a_context(driver: CoreDriver) -> None:
    """7.4 GiB do not fit beside the context of a process that lives on; when it ends, both do."""
    old, lease = held_after_peak(driver, "old", 2, residue_bytes=500 * MIB)
    give_back(driver, old, lease)
    head = driver.consumer("head").acquire(int(7.4 * GIB))
    too_big = driver.consumer("big").acquire(GIB)
    held_after_peak(driver, "small", 0.2)
    assert (driver.state(head), driver.state(too_big)) == ("queued", "queued")
    old.die()
    driver.until(lambda: driver.state(head) == "loading", limit_s=2.0)


def test_while_a_dead_process_s_context_is_measured_nobody_passes(driver: CoreDriver) -> None:
    driver.device.lag_s = 1.0
    old, lease = held_after_peak(driver, "old", 2, residue_bytes=500 * MIB)
    give_back(driver, old, lease)
    head = driver.consumer("head").acquire(int(7.4 * GIB))
    old.die()
    small = driver.consumer("small").acquire(200 * MIB)
    driver.until(lambda: driver.state(head) == "loading", limit_s=3.0)
    assert driver.state(small) == "queued"


# -- what was learned
def learned(driver: CoreDriver, gib: float) -> Consumer:
    """A consumer of 3 GiB that once took so much more, and left nothing on the GPU."""
    person = driver.consumer("greedy")
    lease = person.acquire(3 * GIB)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=3.0)
    person.load(lease, int(gib * GIB))
    give_back(driver, person, lease)
    person.die()
    driver.advance(3.0)
    return driver.consumer("greedy")


def test_what_was_learned_never_waits_for_bytes_that_may_stay_for_good(driver: CoreDriver) -> None:
    """Regression: a request of 3 GiB of which 7.4 were learned waited for the context of a live
    process, and the request of that very process waited behind it: neither was ever granted."""
    greedy = learned(driver, 7.4)
    old, lease = held_after_peak(driver, "old", 2, residue_bytes=500 * MIB)
    give_back(driver, old, lease)
    head, behind = greedy.acquire(3 * GIB), old.acquire(2 * GIB)
    driver.until(lambda: driver.state(head) == "loading", limit_s=2.0)
    charged = driver.gpu()["charged_bytes"]
    assert charged == driver.gpu()["capacity_bytes"] - driver.gpu()["reserve_bytes"]
    greedy.load(head, 3 * GIB)
    driver.until(lambda: driver.state(behind) == "loading", limit_s=2.0)


def test_what_holders_will_give_back_is_waited_for_at_the_learned_bytes(driver: CoreDriver) -> None:
    """A pinned holder ends one day: until then the request keeps what was learned of it."""
    greedy = learned(driver, 6)
    old, lease = held_after_peak(driver, "old", 4, evictable=False)
    head = greedy.acquire(3 * GIB)
    driver.advance(1.0)
    assert driver.state(head) == "queued"
    old.unload(lease)
    driver.until(lambda: driver.state(head) == "loading", limit_s=3.0)
    assert driver.gpu()["charged_bytes"] == 6 * GIB


@pytest.mark.parametrize(("more", "state"), [(0, "loading"), (1, "queued")])
def test_nothing_is_settled_below_the_declaration(
    driver: CoreDriver, more: int, state: str
) -> None:
    greedy = learned(driver, 7.4)
    old, lease = held_after_peak(driver, "old", 2, residue_bytes=500 * MIB)
    give_back(driver, old, lease)
    room = 8 * GIB - d.RESERVE_BYTES - 500 * MIB
    head = greedy.acquire(room + more)
    driver.advance(2.0)
    charge = int(7.4 * GIB) if more else room
    assert (driver.state(head), driver.view(head)["charge_bytes"]) == (state, charge)
    old.die()
    driver.until(lambda: driver.state(head) == "loading", limit_s=3.0)


# -- whose bytes
def test_bytes_that_the_head_s_own_process_holds_already_do_not_leave(driver: CoreDriver) -> None:
    """It loaded 3 GiB before it asked: they are a part of its 6. Only the other one's bytes are
    counted on."""
    eager = driver.consumer("eager")
    eager.hold(3 * GIB)
    stowaway(driver, 2)
    head = eager.acquire(6 * GIB)
    driver.advance(0.1)
    assert driver.state(head) == "queued"
    too_big = driver.consumer("big").acquire(2 * GIB)
    _, small = held_after_peak(driver, "small", 1.5)
    driver.advance(1.0)
    assert (driver.state(too_big), driver.state(small)) == ("queued", "held")
    stowaway(driver, 0)
    driver.until(lambda: driver.state(head) == "loading", limit_s=1.0)


def away() -> tuple[CoreDriver, list[tuple[Consumer, LeaseId]]]:
    """Three are on standby, the one that loads with 5 GiB left first, and a stowaway of 4 GiB came
    as the one went that they left for."""
    driver = CoreDriver(8 * GIB)
    people = [held_after_peak(driver, "large", 4.5, peak_gib=5, standby=True)]
    people += [held_after_peak(driver, name, 1.5, standby=True) for name in ("small", "late")]
    policy = driver.consumer("policy")
    wanted = policy.acquire(int(7.5 * GIB))
    for person, lease in people:
        driver.until(lambda lease=lease: driver.state(lease) == "revoking")  # type: ignore[misc]
        person.unload(lease)
        driver.until(lambda lease=lease: driver.state(lease) == "standby")  # type: ignore[misc]
    driver.until(lambda: driver.state(wanted) == "loading")
    policy.load(wanted)
    driver.advance(0.1)
    driver.device.set(STRANGER, 4 * GIB, driver.now)
    policy.unload(wanted)  # contested: the stowaway's bytes came as its own went
    driver.until(lambda: driver.state(wanted) == "over", limit_s=15.0)
    return driver, people


def test_standby_returns_beside_one_that_waits_for_a_stowaway() -> None:
    """The largest left first. The next returns beside the room that it will have; the last would
    take that away, for good."""
    driver, ((large, first), (small, second), (late, third)) = away()
    driver.until(lambda: driver.state(second) == "loading", limit_s=2.0)
    small.load(second)
    small.use_begin(second)
    driver.advance(3.0)
    assert (driver.state(first), driver.state(third)) == ("standby", "standby")
    stowaway(driver, 0)
    driver.until(lambda: driver.state(first) == "loading", limit_s=2.0)
    assert (large.driver, late.driver) == (driver, driver)


# -- those who passed stay
def unplanned() -> tuple[CoreDriver, Consumer, LeaseId, LeaseId]:
    """A head of 5 GiB that may not ask the only holder, of 3: in use, of a higher priority."""
    driver = CoreDriver(8 * GIB)
    busy, lease = held_after_peak(driver, "busy", 3, priority=90)
    busy.use_begin(lease)
    head = driver.consumer("head").acquire(5 * GIB)
    return driver, busy, lease, head


def test_those_who_passed_are_no_room_for_the_next_to_pass() -> None:
    """Regression: each fitted beside the head, both together did not, and the head had to
    ask them."""
    driver, busy, lease, head = unplanned()
    held_after_peak(driver, "first", 2)
    second = driver.consumer("second").acquire(2 * GIB)
    driver.advance(3.0)
    assert driver.state(second) == "queued", "5 + 2 + 2 do not fit"
    busy.use_end(lease)
    busy.unload(lease)
    driver.until(lambda: driver.state(head) == "loading", limit_s=1.0)
    assert {note["lease_id"] for note in driver.notes("revoke_asked")} == {lease}


def test_one_that_was_there_before_the_head_did_not_pass_it(driver: CoreDriver) -> None:
    _, low = held_after_peak(driver, "low", 2, priority=10, min_residency_s=10.0)
    driver.advance(0.1)
    head = driver.consumer("head").acquire(6 * GIB)
    _, small = held_after_peak(driver, "small", 1.5)
    assert (driver.state(low), driver.state(head), driver.state(small)) == (
        "held",
        "queued",
        "held",
    )
