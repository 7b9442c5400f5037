"""Declared against measured: what is learnt from a lease's life, and who is told."""

import pytest

from tests.support.core_driver import CoreDriver, refusal
from tests.support.scenes import in_use, revoked, shown
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import GpuId, LeaseId

TOLERANCE = d.VERIFY_TOLERANCE_BYTES


def lived(
    driver: CoreDriver, name: str, *, peak: float, steady: float, residue: float = 0.0
) -> None:
    """One life: loads with a peak, serves, unloads, ends. It declared a peak of 2 GiB, 1 GiB then
    and 450 MiB of residue."""
    person = driver.consumer(name)
    lease = person.acquire(2 * GIB, 1 * GIB, residue_bytes=450 * MIB)
    driver.until(lambda: driver.state(lease) == "loading")
    person.hold(int(peak * GIB))
    driver.advance(0.2)
    person.hold(int(steady * GIB))
    person.ready(lease)
    driver.advance(1.5)
    person.unloading(lease)
    person.hold(int(residue * GIB))
    person.release(lease)
    driver.until(lambda: driver.state(lease) == "over", limit_s=20.0)
    person.die()
    driver.advance(0.1)


def charge(driver: CoreDriver, lease: LeaseId) -> float:
    view = shown(driver, lease)
    return float(view["charge_bytes"] / GIB)


def learnt(driver: CoreDriver, consumer: str) -> dict[str, float]:
    (lease,) = driver.why(consumer)["leases"]
    return {part: count / GIB for part, count in lease["footprint"]["learnt_bytes"].items()}


def test_the_next_load_is_charged_what_the_last_ones_took(driver: CoreDriver) -> None:
    lived(driver, "det", peak=4, steady=3, residue=0.5)
    det = driver.consumer("det")
    lease = det.acquire(2 * GIB, residue_bytes=450 * MIB)
    assert learnt(driver, "det") == {"load_peak": 4, "steady": 3, "residue": 0.5}
    assert charge(driver, lease) == 4
    det.hold(3 * GIB)
    det.ready(lease)
    assert charge(driver, lease) == 3, "it did not say what it holds: what it held before counts"


def test_the_holders_own_word_counts_where_the_driver_lists_nobody(driver: CoreDriver) -> None:
    driver.device.lists_processes = False
    driver.advance(1.5)
    det = driver.consumer("det")
    lease = det.acquire(2 * GIB)
    det.load(lease, measured_bytes=3 * GIB)
    (note,) = [note for note in driver.notes("drift") if note["part"] == "steady"]
    assert (note["declared_bytes"], note["measured_bytes"], note["drift_bytes"]) == (
        2 * GIB,
        3 * GIB,
        GIB,
    )
    assert "above" in note["reason"]
    view = shown(driver, lease)
    assert view["drift_bytes"] == GIB
    (why,) = driver.why("det")["leases"]
    assert (why["drifted"], why["footprint"]["held_bytes"]) == (True, 3 * GIB)
    assert why["footprint"]["declared_bytes"]["steady"] == 2 * GIB
    det.unload(lease)
    driver.until(lambda: driver.state(lease) == "over", limit_s=20.0)
    again = driver.consumer("det").acquire(2 * GIB)
    driver.until(lambda: driver.state(again) == "loading", limit_s=20.0)
    assert charge(driver, again) == 3


def test_who_holds_less_than_declared_is_named_when_it_leaves(driver: CoreDriver) -> None:
    """Before, it may still be growing into what it declared."""
    det = driver.consumer("det")
    lease = det.acquire(2 * GIB)
    det.hold(1 * GIB)
    det.ready(lease)
    driver.advance(3.0)
    assert driver.notes("drift") == []
    view = shown(driver, lease)
    assert view["drift_bytes"] == -GIB, "shown all the same"
    det.unload(lease)
    (note,) = driver.notes("drift")
    assert (note["part"], note["drift_bytes"]) == ("steady", -GIB)
    assert "below" in note["reason"]


@pytest.mark.parametrize(
    ("drift_bytes", "parts"),
    [
        (-TOLERANCE - 1, ["steady"]),
        (-TOLERANCE, []),
        (TOLERANCE, []),
        (TOLERANCE + 1, ["load_peak", "steady"]),
    ],
)
def test_within_the_tolerance_nobody_drifts(
    driver: CoreDriver, drift_bytes: int, parts: list[str]
) -> None:
    det = driver.consumer("det")
    lease = det.acquire(2 * GIB)
    det.load(lease, measured_bytes=2 * GIB + drift_bytes)
    assert shown(driver, lease).get("drift_bytes", 0) == (drift_bytes if parts else 0)
    driver.advance(2.0)
    det.unload(lease)
    assert [note["part"] for note in driver.notes("drift")] == parts


def test_a_load_that_is_cut_off_teaches_only_that_it_was_too_much(driver: CoreDriver) -> None:
    for peak in (1, 2, 5):
        det = driver.consumer("det")
        lease = det.acquire(2 * GIB)
        driver.until(lambda lease=lease: driver.state(lease) == "loading", limit_s=20.0)
        det.hold(peak * GIB)
        driver.advance(0.2)
        det.die()
        driver.advance(0.2)
    assert driver.arbiter.footprints() == {"det det-model": {"load_peak": [5 * GIB]}}
    assert [note["part"] for note in driver.notes("drift")] == ["load_peak"]


def test_what_one_life_showed_is_not_learned_from_the_next(driver: CoreDriver) -> None:
    """A lease that comes back from standby loads again."""
    det, lease, policy, _ = revoked(driver)
    driver.advance(1.0)
    det.unload(lease)
    learned = {"steady": [5 * GIB]}
    assert driver.arbiter.footprints()["det det-model"] == learned
    policy.leave()
    driver.until(lambda: driver.state(lease) == "loading")
    driver.device.lists_processes = False
    det.ready(lease)
    det.release(lease)
    assert driver.arbiter.footprints()["det det-model"] == learned


def test_a_process_with_two_leases_teaches_nothing(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    first = det.acquire(1 * GIB)
    det.hold(1 * GIB)
    det.ready(first)
    driver.advance(0.01)
    second = det.acquire(2 * GIB)
    driver.until(lambda: driver.state(second) == "loading")
    det.hold(5 * GIB)
    driver.advance(1.0)
    det.ready(second)
    driver.advance(1.5)
    det.release(first)
    driver.advance(15.0)
    det.release(second)
    driver.advance(15.0)
    footprints = driver.arbiter.footprints()
    assert max(footprints["det det-model"].get("load_peak", [1 * GIB])) == 1 * GIB


def test_what_was_learnt_never_asks_for_more_than_a_whole_gpu() -> None:
    driver = CoreDriver(
        8 * GIB, settings={"footprints": {"det det-model": {"load_peak": [9 * GIB]}}}
    )
    lease = driver.consumer("det").acquire(2 * GIB)
    assert driver.state(lease) == "loading"
    assert charge(driver, lease) == (8 * GIB - d.RESERVE_BYTES) / GIB


def test_a_refusal_says_that_the_figure_was_learnt() -> None:
    settings = {"footprints": {"det det-model": {"steady": [6 * GIB]}}}
    driver = CoreDriver(8 * GIB, gpus=2, settings=settings)
    driver.shrink(GpuId("GPU-1"), 4 * GIB)
    driver.restart(keep_journal=False)
    refused = refusal(driver.consumer("det").try_acquire(2 * GIB, gpu="1"))
    assert (refused.details["needed_bytes"], refused.details["declared_bytes"]) == (
        6 * GIB,
        2 * GIB,
    )


def test_why_says_that_a_waiter_needs_more_than_it_declared() -> None:
    driver = CoreDriver(8 * GIB, settings={"footprints": {"w w-model": {"load_peak": [5 * GIB]}}})
    in_use(driver, "det", 4)
    driver.consumer("w").acquire(2 * GIB)
    (why,) = driver.why("w")["leases"]
    assert why["expected_bytes"] == 5 * GIB
    assert why["footprint"]["declared_bytes"]["load_peak"] == 2 * GIB


def test_a_lease_that_comes_back_after_a_restart_is_measured_on(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    lease = det.acquire(2 * GIB)
    token = det.token(lease)
    det.load(lease)
    driver.restart()
    det.connect()
    det.reattach(lease, token)
    det.hold(3 * GIB)
    driver.advance(2.0)
    det.unload(lease)
    driver.until(lambda: driver.state(lease) == "over", limit_s=20.0)
    assert driver.arbiter.footprints()["det det-model"]["steady"] == [3 * GIB]
