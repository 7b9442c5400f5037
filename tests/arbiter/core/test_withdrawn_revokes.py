"""A holder is revoked for someone: a revoke that nothing wants any more is withdrawn, and a grant
names only the evictions that were asked for it."""

from collections.abc import Callable

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.scenes import give_back, held, in_use, order
from vram_arbiter.arbiter.core.effects import Push
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.pushes import RevokePush, RevokeWithdrawnPush


def revoked_in_use(
    driver: CoreDriver, **spec: object
) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    """A holder in use that was revoked, and the waiter that it was revoked for."""
    holder, lease = in_use(driver, "train", 5, **spec)
    waiter = driver.consumer("waiter")
    wanted = waiter.acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    holder.ack(lease)
    return holder, lease, waiter, wanted


LEAVES: dict[str, Callable[[CoreDriver, Consumer, LeaseId], object]] = {
    "cancel": lambda driver, waiter, wanted: waiter.cancel(wanted),
    "process died": lambda driver, waiter, wanted: waiter.die(),
    "client left": lambda driver, waiter, wanted: waiter.leave("hung up"),
}


@pytest.mark.parametrize("how", LEAVES)
def test_a_revoke_is_withdrawn_with_its_waiter(driver: CoreDriver, how: str) -> None:
    """A holder in use stayed `revoking` for a waiter that was ended, unloaded at the end of its
    use, and the GPU stood empty with no waiter."""
    holder, lease, waiter, wanted = revoked_in_use(driver)
    LEAVES[how](driver, waiter, wanted)
    assert driver.state(lease) == "held"
    assert [push["lease_id"] for push in driver.pushes("revoke_withdrawn")] == [lease]
    (note,) = driver.notes("revoke_withdrawn")
    assert (note["lease_id"], note["wanted_by"]) == (lease, "waiter")
    holder.use_end(lease)
    holder.use_begin(lease)
    driver.advance(60.0)
    assert driver.state(lease) == "held"
    assert not driver.notes("deadline_passed")
    assert not driver.notes("reminded")


def test_a_revoke_is_withdrawn_where_the_wait_times_out(driver: CoreDriver) -> None:
    _, lease = in_use(driver, "train", 5)
    driver.consumer("hasty").acquire(5 * GIB, wait_timeout_s=3.0)
    driver.until(lambda: driver.state(lease) == "revoking")
    driver.until(lambda: bool(driver.notes("denied")))
    assert driver.state(lease) == "held"
    (note,) = driver.notes("revoke_withdrawn")
    assert note["ms"] == pytest.approx(3000.0), "that long it was asked in vain"


def test_a_revoke_is_withdrawn_where_other_room_came_first() -> None:
    """Of two GPUs the other one was emptied by its holder: the grant there needs no eviction."""
    driver = CoreDriver(gpus=2)
    one, first = held(driver, "one", 5, gpu="0")
    two, second = held(driver, "two", 5, gpu="1")
    one.use_begin(first)
    two.use_begin(second)
    waiter = driver.consumer("waiter")
    wanted = waiter.acquire(5 * GIB)
    driver.until(lambda: "revoking" in (driver.state(first), driver.state(second)))
    revoked = first if driver.state(first) == "revoking" else second
    other, leaving = (two, second) if revoked == first else (one, first)
    other.use_end(leaving)
    other.unload(leaving)
    driver.until(lambda: driver.state(wanted) == "loading")
    assert driver.state(revoked) == "held"
    (granted,) = [note for note in driver.notes("granted") if note["lease_id"] == wanted]
    assert not granted["evicted"]


def test_an_unload_that_has_begun_completes(driver: CoreDriver) -> None:
    holder, lease, waiter, wanted = revoked_in_use(driver)
    holder.use_end(lease)
    holder.unloading(lease)
    waiter.cancel(wanted)
    assert driver.state(lease) == "unloading"
    assert not driver.pushes("revoke_withdrawn")
    give_back(driver, holder, lease)


def test_another_waiter_takes_the_eviction_over(driver: CoreDriver) -> None:
    """No withdrawal and no second acknowledgement: the holder is asked on, for the next in the
    queue, and its eviction is that one's."""
    holder, lease, waiter, wanted = revoked_in_use(driver)
    later = driver.consumer("later")
    next_one = later.acquire(5 * GIB)
    waiter.cancel(wanted)
    assert driver.state(lease) == "revoking"
    assert not driver.pushes("revoke_withdrawn")
    assert driver.pushes("revoke", lease)[-1]["wanted_by"] == "later"
    pushes = len(driver.pushes("revoke", lease))
    driver.advance(5.0)
    assert len(driver.pushes("revoke", lease)) == pushes, "it is acknowledged already"
    holder.use_end(lease)
    holder.unload(lease)
    driver.until(lambda: driver.state(next_one) == "loading")
    (granted,) = [note for note in driver.notes("granted") if note["lease_id"] == next_one]
    assert granted["evicted"] == ["train"]


def test_only_what_another_waiter_needs_stays_revoked(driver: CoreDriver) -> None:
    one, first = held(driver, "one", 3)
    two, second = held(driver, "two", 4)
    one.use_begin(first)
    two.use_begin(second)
    waiter = driver.consumer("waiter")
    wanted = waiter.acquire(7 * GIB)
    driver.until(lambda: {driver.state(first), driver.state(second)} == {"revoking"})
    small = driver.consumer("small")
    driver.advance(0.1)
    little = small.acquire(3 * GIB)
    waiter.cancel(wanted)
    states = {driver.state(first), driver.state(second)}
    assert states == {"revoking", "held"}
    assert len(driver.pushes("revoke_withdrawn")) == 1
    holder, lease = (one, first) if driver.state(first) == "revoking" else (two, second)
    holder.use_end(lease)
    holder.unload(lease)
    driver.until(lambda: driver.state(little) == "loading")


def test_a_release_that_crosses_the_withdrawal_is_that_of_an_eviction() -> None:
    """The holder acted on the revoke before it heard of the withdrawal: a lease on standby comes
    back, and its weights stay in host RAM."""
    driver = CoreDriver(settings={"host_ram_budget_bytes": 8 * GIB})
    holder, lease, waiter, wanted = revoked_in_use(driver, standby=True, park_bytes=4 * GIB)
    holder.use_end(lease)
    waiter.cancel(wanted)
    assert driver.state(lease) == "held"
    assert driver.status()["host_ram"]["parked_bytes"] == 0, "booked for nothing"
    holder.unload(lease, parked=True)
    driver.until(lambda: driver.state(lease) == "loading")
    (parked,) = driver.notes("parked")
    assert parked["comes_back"]


def test_a_release_long_after_the_withdrawal_is_the_holders_own(driver: CoreDriver) -> None:
    """A holder that used its lease since has heard that it may stay. What it releases then is not
    granted again by itself: a holder without a client library of ours does not expect that."""
    holder, lease, waiter, wanted = revoked_in_use(driver, standby=True)
    waiter.cancel(wanted)
    holder.use_end(lease)
    holder.use_begin(lease)
    holder.use_end(lease)
    driver.advance(60.0)
    give_back(driver, holder, lease)


def test_a_withdrawn_holder_keeps_its_place_among_residents() -> None:
    """Residents are listed by when they became ready; a verdict looks at the newest of them."""
    driver = CoreDriver(16 * GIB)
    holder, lease = held(driver, "old", 5)
    held(driver, "new", 1)
    holder.use_begin(lease)
    waiter = driver.consumer("waiter")
    wanted = waiter.acquire(14 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    waiter.cancel(wanted)
    residents = driver.arbiter.inspect().gpus[driver.device.gpu].residents
    ready = [one.ready_at for one in residents.by_state[LeaseState.HELD].values()]
    assert ready == sorted(ready)


def test_a_grant_names_only_evictions_that_were_asked_for_it(driver: CoreDriver) -> None:
    """134 s after an eviction for a waiter that had gone, a grant on the empty GPU said «fits after
    train left» and a switch of 762 s."""
    holder, lease, waiter, wanted = revoked_in_use(driver)
    holder.use_end(lease)
    holder.unloading(lease)
    waiter.cancel(wanted)
    give_back(driver, holder, lease)
    driver.advance(134.0)
    _, latecomer = held(driver, "late", 5)
    (granted,) = [note for note in driver.notes("granted") if note["lease_id"] == latecomer]
    assert not granted["evicted"]
    (switch,) = [note for note in driver.notes("switch") if note["lease_id"] == latecomer]
    assert (switch["switched"], switch["drain_ms"]) == (False, 0.0)
    assert not driver.arbiter.inspect().gpus[driver.device.gpu].evictions


def test_a_waiter_that_leaves_before_its_grant_leaves_no_eviction_behind() -> None:
    """The next lease on the GPU would have been told that it made room."""
    driver = CoreDriver()
    holder, lease, waiter, wanted = revoked_in_use(driver)
    driver.device.failing = "the driver hangs"
    driver.consumer("third").acquire(GIB, priority=90)  # a head that keeps the waiter waiting
    holder.use_end(lease)
    holder.unload(lease)
    driver.device.failing = ""
    gpu = driver.arbiter.inspect().gpus[driver.device.gpu]
    driver.until(lambda: any(one.verdict for one in gpu.evictions) or not gpu.evictions)
    if driver.state(wanted) == "queued":
        waiter.cancel(wanted)
    assert not gpu.evictions


def test_an_operators_eviction_makes_no_switch(driver: CoreDriver) -> None:
    holder, lease = held(driver, "train", 5)
    order(driver, "evict", lease)
    give_back(driver, holder, lease)
    _, later = held(driver, "later", 5)
    (granted,) = [note for note in driver.notes("granted") if note["lease_id"] == later]
    assert not granted["evicted"]


def test_of_two_gpus_emptied_for_one_waiter_each_holder_is_told_once() -> None:
    """The one holder was told to stay, and revoked again for the next waiter, in one event: each
    GPU was decided by itself, and counted on the room of the other."""
    driver = CoreDriver(gpus=2)
    leases: list[LeaseId] = []
    for name, gpu in (("one", "0"), ("two", "1")):
        _, lease = in_use(driver, name, 5, gpu=gpu)
        leases.append(lease)
    waiter, later = driver.consumer("waiter"), driver.consumer("later")
    wanted = waiter.acquire(5 * GIB)
    driver.advance(31.0)
    assert [driver.state(lease) for lease in leases] == ["revoking", "revoking"]
    later.acquire(5 * GIB)
    before = len(driver.effects)
    waiter.cancel(wanted)
    told = [
        (str(effect.body.TAG[1]), effect.body.lease_id)
        for effect in driver.effects[before:]
        if isinstance(effect, Push) and isinstance(effect.body, RevokePush | RevokeWithdrawnPush)
    ]
    assert told == [("revoke", leases[0]), ("revoke_withdrawn", leases[1])]
    assert [driver.state(lease) for lease in leases] == ["revoking", "held"]


def test_on_a_gpu_that_grants_nothing_a_revoke_is_withdrawn_too(driver: CoreDriver) -> None:
    """A drain lasts as long as its operator wants."""
    _, lease, waiter, wanted = revoked_in_use(driver)
    small = driver.consumer("small").acquire(GIB)
    assert driver.state(small) == "loading", "backfilled"
    driver.consumer("ops").order("drain")
    waiter.cancel(wanted)
    assert driver.state(lease) == "held"


def test_on_a_gpu_that_grants_nothing_the_next_waiter_takes_over(driver: CoreDriver) -> None:
    """It kept the name of the waiter that was gone."""
    _, lease, waiter, wanted = revoked_in_use(driver)
    driver.consumer("later").acquire(5 * GIB)
    driver.consumer("ops").order("drain")
    waiter.cancel(wanted)
    assert driver.state(lease) == "revoking"
    assert not driver.pushes("revoke_withdrawn")
    assert driver.pushes("revoke", lease)[-1]["wanted_by"] == "later"


def test_on_a_gpu_that_grants_nothing_a_waiter_placed_elsewhere_takes_nothing_over() -> None:
    driver = CoreDriver(gpus=2)
    _, first = in_use(driver, "one", 5, gpu="0", priority=10)
    _, second = in_use(driver, "two", 5, gpu="1", priority=20)
    driver.consumer("anywhere").acquire(5 * GIB)
    waiter = driver.consumer("waiter")
    wanted = waiter.acquire(5 * GIB, gpu="1")
    driver.until(lambda: driver.state(second) == "revoking")
    driver.consumer("ops").order("drain")
    waiter.cancel(wanted)
    assert (driver.state(first), driver.state(second)) == ("revoking", "held")


def test_a_lease_that_waits_again_does_not_inherit_its_earlier_evictions() -> None:
    """A lease on standby waits under one id again and again. What was revoked for one wait, and
    hung in its unload, was booked to the grant of the next one."""
    driver = CoreDriver()
    det, lease = held(driver, "det", 3, standby=True)
    hanging, stuck = in_use(driver, "hanging", 3, priority=40)
    evictor = driver.consumer("evictor")
    first = evictor.acquire(3 * GIB, priority=30)
    driver.until(lambda: driver.state(lease) == "revoking")
    det.unload(lease)
    driver.until(lambda: driver.state(first) == "loading")
    evictor.load(first)
    hanging.use_end(stuck)
    det.reacquire(lease)
    driver.until(lambda: driver.state(stuck) == "revoking")
    hanging.unloading(stuck)  # and hangs
    evictor.unload(first)
    driver.until(lambda: driver.state(lease) == "loading")
    det.load(lease)
    driver.advance(31.0)
    second = evictor.acquire(3 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    det.unload(lease)
    driver.until(lambda: driver.state(second) == "loading")
    evictor.load(second)
    det.reacquire(lease)
    hanging.unload(stuck)
    driver.until(lambda: driver.state(lease) == "loading")
    granted = [note for note in driver.notes("granted") if note["lease_id"] == lease]
    assert [note["evicted"] for note in granted] == [[], ["evictor"], []]
