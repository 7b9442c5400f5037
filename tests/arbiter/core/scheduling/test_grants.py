"""Who gets the GPU next: serial loads, head and backfill, the measurement as second gate,
pressure, several GPUs."""

import pytest

from tests.support.core_driver import CoreDriver, answer
from tests.support.scenes import held, in_use
from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey

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


# -- pressure
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
