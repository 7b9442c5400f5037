"""Who gets the GPU next: serial loads, head and backfill, the measurement as second gate,
pressure, several GPUs."""

from dataclasses import replace
from typing import Any

import pytest

from tests.support.core_driver import CoreDriver, answer
from tests.support.engine_state import state_of
from tests.support.scenes import give_back, held, in_use
from vram_arbiter.arbiter.core.effects import Note
from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.scheduling import grants
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.notes import About, GrantedNote

STRANGER = ProcessKey(9, 9)


# -- order and backfill
def test_a_higher_priority_passes_and_equals_keep_their_order(driver: CoreDriver) -> None:
    det, lease = driver.consumer("det"), LeaseId("")
    lease = det.acquire(6 * GIB)
    low = driver.consumer("low").acquire(6 * GIB)
    high = driver.consumer("high").acquire(6 * GIB, priority=60)
    assert answer(driver.consumer("late").try_acquire(6 * GIB))["lease"]["position"] == 3
    det.release(lease)
    driver.until(lambda: driver.state(high) == "loading")
    assert driver.state(low) == "queued"


def test_nobody_passes_an_exclusive_head_or_when_its_room_is_about_to_come() -> None:
    driver = CoreDriver(8 * GIB)
    in_use(driver, "busy", 4)
    alone = driver.consumer("alone")
    head = alone.acquire(1 * GIB, exclusive=True)
    small = driver.consumer("small").acquire(1 * GIB)
    driver.advance(0.5)
    assert driver.state(small) == "queued"
    alone.cancel(head)
    head = alone.acquire(5 * GIB)
    driver.advance(0.01)
    assert driver.state(small) == "loading", (
        "the newcomer came later, so the small one is the head now"
    )


def test_while_the_head_s_victim_unloads_nobody_starts_a_load_in_between() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease = held(driver, "det", 5)
    head = driver.consumer("head").acquire(5 * GIB)
    det.unloading(lease)
    small = driver.consumer("small").acquire(1 * GIB)
    driver.advance(0.1)
    assert (driver.state(head), driver.state(small)) == ("queued", "queued")
    det.hold(0)
    det.release(lease)
    driver.until(lambda: driver.state(head) == "loading")


def test_an_exclusive_waiter_never_passes(driver: CoreDriver) -> None:
    in_use(driver, "busy", 4, priority=90)
    head = driver.consumer("head").acquire(5 * GIB)
    alone = driver.consumer("alone").acquire(1 * GIB, exclusive=True)
    third = driver.consumer("third").acquire(2 * GIB)
    driver.advance(0.1)
    assert [driver.state(lease) for lease in (head, alone, third)] == [
        "queued",
        "queued",
        "loading",
    ]


# -- exclusive
@pytest.mark.parametrize("end", ["death", "expiry"])
def test_the_debt_of_an_exclusive_holder_keeps_the_gpu_to_itself(end: str) -> None:
    """Whoever would fit beside its bytes waits all the same until they are measured gone."""
    driver = CoreDriver(8 * GIB)
    driver.device.lag_s = 1.0
    alone, lease = held(driver, "alone", 2, exclusive=True, ttl_s=5.0)
    waiter = driver.consumer("w").acquire(1 * GIB, priority=d.PRIORITY - 1)
    if end == "death":
        alone.use_begin(lease)
        alone.die()
    else:
        driver.until(lambda: bool(driver.notes("expired")))
        alone.hold(0)
    driver.until(lambda: driver.state(waiter) == "loading")
    assert not driver.device.shown(driver.now)


# -- the second gate
def test_the_gpu_may_say_no_where_the_ledger_says_yes(driver: CoreDriver) -> None:
    """Total-only backend: bytes that appear while somebody loads cannot be explained, but they are
    not free either."""
    driver.device.lists_processes = False
    det, lease = held(driver, "det", 1)
    driver.device.set(STRANGER, 4 * GIB, driver.now)
    det.unloading(lease)
    driver.advance(1.5)
    waiter = driver.consumer("vlm").acquire(5 * GIB)
    driver.advance(1.5)
    assert driver.state(waiter) == "queued"
    assert driver.blocked() == "not_free"
    driver.device.set(STRANGER, 0, driver.now)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=2.0)


def test_a_reading_from_before_the_last_ready_is_not_believed_to_be_full() -> None:
    """It may have seen the bytes of the newcomer or not: they are subtracted, and if that is too
    little a fresh one is read."""
    driver = CoreDriver(8 * GIB)
    det = driver.consumer("det")
    first = det.acquire(4 * GIB)
    det.hold(4 * GIB)
    driver.advance(1.1)
    det.ready(first)
    vlm = driver.consumer("vlm").acquire(3 * GIB)
    assert driver.state(vlm) == "queued", "4 used, 4 perhaps not seen: a fresh reading is needed"
    driver.advance(0.01)
    assert driver.state(vlm) == "loading"


def test_a_load_peak_that_is_not_back_yet_carries_no_grant() -> None:
    """Regression: the peak that a loader gave up with `ready` was believed free on a reading from
    before it was there."""
    driver = CoreDriver(8 * GIB, settings={"probe_period_s": 1.5})
    driver.device.lag_s = 1.0
    det = driver.consumer("det")
    first = det.acquire(6 * GIB, 2 * GIB)
    driver.advance(0.1)
    vlm = driver.consumer("vlm").acquire(4 * GIB)
    det.hold(6 * GIB)
    det.hold(2 * GIB)  # the driver gives the rest back late
    det.ready(first)
    assert driver.state(vlm) == "queued"
    driver.advance(0.5)
    assert driver.state(vlm) == "queued", "6 GiB are still occupied"
    driver.until(lambda: driver.state(vlm) == "loading", limit_s=3.0)


@pytest.mark.parametrize(("taken_s", "reason"), [(-0.001, "reading"), (0.0, "not_free")])
def test_only_a_reading_since_the_last_change_denies(
    driver: CoreDriver, taken_s: float, reason: str
) -> None:
    core = state_of(driver.arbiter)
    gpu = core.gpus[GpuId("GPU-0")]
    driver.device.silent = True
    waiter = driver.consumer("w").acquire(5 * GIB, exclusive=True)
    core.leases[waiter].request.reason = None
    assert gpu.sample is not None
    gpu.sample = replace(gpu.sample, used_bytes=4 * GIB, taken_at=gpu.changed_at + taken_s)
    grants.grant_if_measured(core, gpu, core.leases[waiter])
    assert core.leases[waiter].request.reason == reason


def test_what_is_noted_of_a_grant(driver: CoreDriver) -> None:
    first, lease = held(driver, "first", 5)
    waiter = driver.consumer("w").acquire(4 * GIB)
    driver.advance(2.0)
    give_back(driver, first, lease)
    granted = [e for e in driver.effects if isinstance(e, Note) and e.kind == "granted"]
    assert granted == [
        Note(GrantedNote(5 * GIB, 0.0, (), False), About(lease, "first", GpuId("GPU-0"))),
        Note(
            GrantedNote(4 * GIB, pytest.approx(2000.0, abs=10.0), ("first",), False),
            About(waiter, "w", GpuId("GPU-0")),
        ),
    ]


def test_a_residency_ends_on_time_while_bytes_are_measured() -> None:
    """What was learned of a waiter is not settled meanwhile."""
    driver = CoreDriver(8 * GIB, settings={"probe_period_s": 1000.0})
    goes, going = held(driver, "goes", 1)
    _, idle = held(driver, "idle", 4, min_residency_s=5.0)
    driver.device.silent = True
    goes.unload(going)
    waiter = driver.arbiter.inspect().leases[driver.consumer("w").acquire(5 * GIB)]
    assert waiter.request.reason == "no_victim"
    driver.advance(5.0)
    assert (driver.state(idle), waiter.request.reason) == ("revoking", "making_room")


def test_room_that_comes_is_a_reason_to_wait(driver: CoreDriver) -> None:
    goes, going = held(driver, "goes", 5)
    goes.unloading(going)
    waiter = driver.consumer("w").acquire(5 * GIB)
    assert driver.arbiter.inspect().leases[waiter].request.reason == "making_room"


def queued_together(driver: CoreDriver, small_gib: float) -> tuple[LeaseId, LeaseId]:
    """While the GPU cannot be read a head and a small request come; then it can be read."""
    driver.device.failing = "the driver hangs"
    driver.advance(1.5)
    head = driver.consumer("head").acquire(5 * GIB)
    small = driver.consumer("small").acquire(int(small_gib * GIB))
    driver.device.failing = ""
    driver.advance(1.5)
    return head, small


def test_no_small_one_takes_the_room_that_the_head_is_promised(driver: CoreDriver) -> None:
    """In the very pass that revokes for it."""
    in_use(driver, "busy", 2, priority=90)
    _, idle = held(driver, "idle", 4)
    _, small = queued_together(driver, 1)
    assert (driver.state(idle), driver.state(small)) == ("revoking", "queued")


@pytest.mark.parametrize(("more", "state"), [(0, "loading"), (1, "queued")])
def test_a_small_one_may_have_all_that_the_head_leaves(
    driver: CoreDriver, more: int, state: str
) -> None:
    in_use(driver, "busy", 3, priority=90)
    driver.consumer("head").acquire(5 * GIB)
    free = 8 * GIB - d.RESERVE_BYTES - 5 * GIB
    small = driver.consumer("small").acquire(free + more)
    assert driver.state(small) == state


def test_while_a_context_is_measured_small_ones_pass_a_head_that_waits_for_a_holder(
    driver: CoreDriver,
) -> None:
    gone, lease = held(driver, "gone", 1, residue_bytes=GIB // 2)
    give_back(driver, gone, lease)
    in_use(driver, "busy", 3, priority=90)
    driver.device.lag_s = 5.0
    driver.device.silent = True
    gone.die()
    head = driver.consumer("head").acquire(5 * GIB)
    small = driver.consumer("small").acquire(1 * GIB)
    assert state_of(driver.arbiter).leases[head].request.reason == "residue"
    assert driver.state(small) == "loading"


def test_bytes_whose_verdict_is_late_are_counted_on_no_longer(driver: CoreDriver) -> None:
    goes, going = held(driver, "goes", 3.6, priority=10)
    _, idle = held(driver, "idle", 3.7)
    driver.consumer("w").acquire(int(3.9 * GIB))
    driver.device.silent = True
    goes.unload(going)
    driver.advance(d.VERIFY_TIMEOUT_S - 0.001)
    assert (driver.state(going), driver.state(idle)) == ("verifying", "held")
    driver.advance(0.001)
    assert driver.state(idle) == "revoking"


@pytest.mark.parametrize("late", [False, True])
def test_a_small_one_waits_for_an_unload_that_is_not_late(driver: CoreDriver, late: bool) -> None:
    in_use(driver, "busy", 3, priority=90)
    goes, going = held(driver, "goes", 1)
    driver.consumer("head").acquire(5 * GIB)
    goes.unloading(going)
    driver.advance(d.REVOKE_DEADLINE_S + (0.0 if late else -0.1))
    small = driver.consumer("small").acquire(1 * GIB)
    assert driver.state(small) == ("loading" if late else "queued")


# -- pressure
@pytest.mark.parametrize(("more", "asked"), [(0, False), (1, True)])
def test_pressure_asks_nobody_for_what_a_leaving_holder_brings(
    driver: CoreDriver, more: int, asked: bool
) -> None:
    """It asks for what is missing then, as soon as a residency is over."""
    _, idle = held(driver, "idle", 2, min_residency_s=5.0)
    goes, going = held(driver, "goes", 3)
    driver.advance(1.0)
    goes.unloading(going)
    driver.device.set(STRANGER, 3 * GIB - d.RESERVE_BYTES + 3 * GIB + more, driver.now)
    driver.advance(2.0)
    assert driver.gpu()["pressure_bytes"] == 3 * GIB + more
    assert driver.state(idle) == "held"
    driver.advance(driver.arbiter.inspect().leases[idle].ready_at + 5.0 - driver.now)
    assert (driver.state(idle) == "revoking") == asked


def test_pressure_stops_grants_and_asks_the_cheapest_idle_holder(driver: CoreDriver) -> None:
    calm, calm_lease = held(driver, "calm", 2)
    _, other_lease = held(driver, "other", 4)
    _, busy_lease = in_use(driver, "busy", 1)
    driver.device.set(STRANGER, 2 * GIB, driver.now)
    waiter = driver.consumer("w")
    driver.until(lambda: bool(driver.notes("pressure")), limit_s=2.0)
    assert driver.notes("stowaway")[-1]["used_bytes"] == 2 * GIB
    assert "pressure" in driver.gpu()["blocked"]["text"]
    assert [driver.state(lease) for lease in (calm_lease, other_lease, busy_lease)] == [
        "revoking",
        "held",
        "held",
    ]
    (push,) = driver.pushes("revoke", calm_lease)[:1]
    assert (push["wanted_by"], push["cause"]) == ("", "pressure")
    queued = waiter.acquire(100 * MIB)
    assert driver.state(queued) == "queued"
    calm.unload(calm_lease)
    driver.until(lambda: driver.state(queued) == "loading")
    assert driver.notes("pressure")[-1]["pressure_bytes"] == 0


def test_pressure_that_cannot_be_covered_asks_every_idle_holder(driver: CoreDriver) -> None:
    _, small = held(driver, "small", 1)
    _, busy_lease = in_use(driver, "busy", 6)
    driver.device.set(STRANGER, 3 * GIB, driver.now)
    driver.until(lambda: driver.state(small) == "revoking", limit_s=2.0)
    assert driver.state(busy_lease) == "held"
    driver.device.total_bytes = 16 * GIB


def test_a_holder_above_its_charge_is_pressure(driver: CoreDriver) -> None:
    liar, _ = in_use(driver, "liar", 3)
    _, idle = held(driver, "idle", 4, min_residency_s=5.0)
    liar.hold(5 * GIB)
    driver.until(lambda: bool(driver.notes("pressure")), limit_s=2.0)
    (note,) = driver.notes("pressure")
    assert note["holders"] == [{"pid": liar.process.pid, "over_bytes": 2 * GIB}]
    assert not driver.notes("stowaway")
    assert driver.state(idle) == "held", "its residency is not over"
    driver.until(lambda: driver.state(idle) == "revoking", limit_s=6.0)


def test_ready_with_more_than_granted_is_pressure_and_no_violation(driver: CoreDriver) -> None:
    a, first = in_use(driver, "a", 4)
    b = driver.consumer("b")
    second = b.acquire(3 * GIB)
    driver.until(lambda: driver.state(second) == "loading")
    b.use_begin(first, token=a.token(first))
    b.load(second, 5 * GIB)
    assert driver.gpu()["pressure_bytes"] > 0
    assert driver.state(second) == "revoking", "it is idle, and the GPU is too full"


# -- several GPUs


def test_any_waits_for_room_that_comes_on_another_gpu() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    _, stays = held(driver, "stays", 5, gpu="0", min_residency_s=1.0)
    goes, going = held(driver, "goes", 5, gpu="1")
    goes.unloading(going)
    driver.advance(1.5)
    waiter = driver.consumer("w").acquire(5 * GIB)
    assert driver.state(stays) == "held"
    goes.hold(0, gpu=GpuId("GPU-1"))
    goes.release(going)
    driver.until(lambda: driver.state(waiter) == "loading")
    assert driver.state(stays) == "held"


PLACES: dict[str, tuple[list[dict[str, Any]], list[dict[str, Any]]]] = {
    "fewer in use": ([{"gib": 6, "used": True}], [{"gib": 6, "priority": 51}]),
    "a lower priority": ([{"gib": 6}], [{"gib": 3, "priority": 49}, {"gib": 3, "priority": 48}]),
    "fewer holders": ([{"gib": 3}, {"gib": 3}], [{"gib": 7}]),
    "fewer bytes": ([{"gib": 6.5}], [{"gib": 6}]),
}


@pytest.mark.parametrize("places", [("0", "2"), ("2", "0")], ids="->".join)
@pytest.mark.parametrize("case", [*PLACES, "the first of equals"])
def test_the_gpu_that_is_cheapest_to_empty_is_emptied(case: str, places: tuple[str, str]) -> None:
    """One between them cannot be read."""
    driver = CoreDriver(8 * GIB, gpus=3)
    dear, cheap = PLACES.get(case, ([{"gib": 6}], [{"gib": 6}]))
    groups = dict(zip(places, (dear, cheap), strict=True))
    on: dict[str, list[LeaseId]] = {index: [] for index in places}
    for index in sorted(groups):
        for number, holder in enumerate(groups[index]):
            spec = {key: value for key, value in holder.items() if key != "used"}
            person, lease = held(driver, f"h{index}{number}", gpu=index, **spec)
            on[index].append(lease)
            if "used" in holder:
                person.use_begin(lease)
    driver.devices[GpuId("GPU-1")].failing = "it is lost"
    driver.advance(1.5)
    driver.consumer("w").acquire(6 * GIB)
    chosen = places[1] if case in PLACES else "0"
    assert {
        index for index in places if all(driver.pushes("revoke", one) for one in on[index])
    } == {chosen}


def test_the_dearer_gpu_is_emptied_if_the_cheaper_one_is_not_its_turn() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    _, dear = held(driver, "dear", 5, priority=80, gpu="0")
    in_use(driver, "cheap", 5, priority=20, gpu="1")
    driver.consumer("first").acquire(5 * GIB, gpu="1", priority=60)
    waiter = driver.consumer("w").acquire(5 * GIB)
    assert driver.state(dear) == "revoking"
    assert driver.state(waiter) == "queued"


def test_readings_of_unknown_gpus_and_late_ones_are_dropped(driver: CoreDriver) -> None:
    assert driver.post(MemorySampled(GpuId("GPU-9"), driver.now, 0, 1, None)) == []
    driver.post(MemorySampled(GpuId("GPU-0"), driver.now, 123, 8 * GIB, ()))
    driver.post(MemorySampled(GpuId("GPU-0"), driver.now - 5.0, 456, 8 * GIB, ()))
    assert driver.gpu()["measured_used_bytes"] == 123
