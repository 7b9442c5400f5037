"""A held lease that shrinks when the GPU agrees, and grows when it is its turn."""

import pytest

from tests.support.core_driver import CoreDriver, answer, refusal
from tests.support.engine_state import state_of
from tests.support.scenes import charge, held, shown
from vram_arbiter.arbiter.core import invariants
from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.features.resizing import Resizing
from vram_arbiter.arbiter.core.invariants import InvariantViolation
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import GpuId, LeaseId

GIB, MIB = d.GIB, d.MIB


# -- shrinking
@pytest.mark.parametrize("lists", [True, False])
def test_a_shrink_is_believed_when_the_gpu_agrees(lists: bool) -> None:
    driver = CoreDriver(8 * GIB)
    driver.device.lists_processes = lists
    vlm, lease = held(driver, "vlm", 6, evictable=False)
    vlm.use_begin(lease)
    vlm.hold(4 * GIB)
    told = answer(vlm.resize(lease, 4 * GIB))
    assert (told["state"], told["lease"]["charge_bytes"], told["lease"]["resizing"]) == (
        "shrinking",
        6 * GIB,
        "shrinking",
    )
    driver.until(lambda: charge(driver, lease) == 4 * GIB, limit_s=1.0)
    (pushed,) = driver.pushes("resized", lease)
    assert pushed["charge_bytes"] == 4 * GIB
    assert pushed["token"] == told["lease"]["token"], "the same grant"
    assert driver.journal[f"lease:{lease}"]["charge_bytes"] == 4 * GIB
    view = driver.view(lease)
    assert view is not None
    assert (view["state"], view["uses"]) == ("held", 1)
    driver.until(
        lambda: driver.state(driver.consumer("d").acquire(3 * GIB)) == "loading", limit_s=1.0
    )


@pytest.mark.parametrize("lists", [True, False])
def test_a_shrink_that_did_not_happen_changes_nothing(lists: bool) -> None:
    """Triton, vLLM: unload frees 82 of 4,764 MiB."""
    driver = CoreDriver(8 * GIB)
    driver.device.lists_processes = lists
    vlm, lease = held(driver, "vlm", 6)
    vlm.resize(lease, 4 * GIB)
    driver.advance(9.9)
    assert charge(driver, lease) == 6 * GIB
    driver.advance(0.2)
    assert charge(driver, lease) == 6 * GIB
    (pushed,) = driver.pushes("resized", lease)
    assert pushed["charge_bytes"] == 6 * GIB
    assert driver.notes("resized")[-1]["changed_bytes"] == 0, "they did not come back in time"


def test_a_shrink_on_a_lagging_gpu_waits_for_it() -> None:
    driver = CoreDriver(8 * GIB)
    driver.device.lag_s = 1.5
    vlm, lease = held(driver, "vlm", 6)
    vlm.hold(4 * GIB)
    vlm.resize(lease, 4 * GIB)
    driver.advance(1.4)
    assert charge(driver, lease) == 6 * GIB
    driver.until(lambda: charge(driver, lease) == 4 * GIB, limit_s=0.5)


def test_a_failing_probe_shrinks_nobody() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 6)
    driver.device.failing = "NVML_ERROR_UNKNOWN"
    vlm.hold(4 * GIB)
    vlm.resize(lease, 4 * GIB)
    driver.advance(20.0)
    assert charge(driver, lease) == 6 * GIB
    driver.post(MemorySampled(GpuId("nowhere"), driver.now, 0, 1, None))


@pytest.mark.parametrize("lists", [True, False])
def test_what_it_held_before_it_shrank_is_no_drift(lists: bool) -> None:
    """Regression: it was compared with the new size, noted as drift, and the next load was charged
    the old one."""
    driver = CoreDriver(8 * GIB)
    driver.device.lists_processes = lists
    driver.device.lag_s = 0.5
    vlm = driver.consumer("vlm")
    lease = vlm.acquire(6 * GIB)
    vlm.load(lease, None if lists else 6 * GIB)
    driver.advance(2.0)
    vlm.hold(4 * GIB)
    vlm.resize(lease, 4 * GIB)
    driver.advance(0.1)  # a reading that still sees the old bytes
    assert "drift_bytes" not in shown(driver, lease)
    driver.until(lambda: charge(driver, lease) == 4 * GIB, limit_s=2.0)
    driver.advance(2.0)
    assert "drift_bytes" not in shown(driver, lease)
    vlm.unload(lease)
    driver.until(lambda: driver.state(lease) == "over")
    assert not driver.notes("drift")
    steady = driver.arbiter.inspect().footprints.p95_bytes("vlm vlm-model", "steady")
    assert steady in (0, 4 * GIB)


def test_a_holder_that_keeps_what_it_said_to_give_back_drifts() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 6)
    vlm.resize(lease, 4 * GIB)
    driver.advance(9.0)
    assert not driver.notes("drift")
    driver.advance(3.0)
    (note,) = driver.notes("drift")
    assert (note["declared_bytes"], note["measured_bytes"]) == (4 * GIB, 6 * GIB)
    assert shown(driver, lease)["drift_bytes"] == 2 * GIB


@pytest.mark.parametrize("residue", [0, 2 * GIB])
def test_the_holders_own_word_follows_its_size(residue: int) -> None:
    driver = CoreDriver(8 * GIB)
    driver.device.lists_processes = False
    vlm = driver.consumer("vlm")
    lease = vlm.acquire(2 * GIB, residue_bytes=residue)
    vlm.load(lease, GIB if residue else 2 * GIB)
    driver.advance(2.0)
    assert answer(vlm.resize(lease, 3 * GIB))["state"] == "growing"
    assert (
        driver.arbiter.inspect().leases[lease].observed.reported_bytes
        == (2 if residue else 3) * GIB
    )
    vlm.hold(GIB // 2)
    vlm.resize(lease, GIB // 2)
    driver.until(lambda: charge(driver, lease) == GIB // 2, limit_s=2.0)
    assert driver.arbiter.inspect().leases[lease].observed.reported_bytes == (
        0 if residue else GIB // 2
    )


def test_one_reading_that_agrees_is_not_enough() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 6)
    vlm.hold(4 * GIB)
    vlm.resize(lease, 4 * GIB)
    driver.until(
        lambda: driver.arbiter.inspect().feature(Resizing).resizes[lease].agreed, limit_s=1.0
    )
    vlm.hold(6 * GIB)
    driver.advance(5.0)
    assert charge(driver, lease) == 6 * GIB
    vlm.hold(4 * GIB)
    driver.until(lambda: charge(driver, lease) == 4 * GIB, limit_s=1.0)


def test_two_leases_of_a_process_shrink_each_for_itself() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, first = held(driver, "vlm", 3)
    second = vlm.acquire(3 * GIB, key="second")
    driver.until(lambda: driver.state(second) == "loading")
    vlm.hold(6 * GIB)
    vlm.ready(second)
    driver.advance(0.05)
    vlm.hold(5 * GIB)
    vlm.resize(second, 2 * GIB)
    driver.until(lambda: charge(driver, second) == 2 * GIB, limit_s=1.0)
    assert charge(driver, first) == 3 * GIB


def test_a_shrink_ends_with_its_lease() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 6)
    vlm.resize(lease, 4 * GIB)
    vlm.unload(lease)
    driver.until(lambda: driver.state(lease) == "over")
    assert not driver.pushes("resized")
    vlm, lease = held(driver, "again", 6)
    vlm.resize(lease, 4 * GIB)
    vlm.die()
    driver.advance(20.0)
    assert not driver.pushes("resized")


# -- growing
def test_a_growth_with_room_is_granted_at_once() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4)
    vlm.use_begin(lease)
    effects = vlm.resize(lease, 6 * GIB)
    assert answer(effects)["state"] == "growing"
    driver.until(lambda: charge(driver, lease) == 6 * GIB, limit_s=0.1)
    (pushed,) = driver.pushes("resized", lease)
    assert pushed["charge_bytes"] == 6 * GIB
    assert driver.journal[f"lease:{lease}"]["charge_bytes"] == 6 * GIB
    vlm.hold(6 * GIB)
    assert answer(vlm.resize(lease, 6 * GIB))["state"] == "held", "a repeat"
    driver.advance(5.0)
    assert driver.gpu()["pressure_bytes"] == 0


def test_a_growth_makes_others_leave_and_is_a_waiter_like_any_other() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4)
    det, other = held(driver, "det", 3)
    vlm.use_begin(lease)
    vlm.resize(lease, 6 * GIB)
    view = driver.view(lease)
    assert view is not None
    assert view["resizing"] == "growing"
    (growth,) = [v for v in driver.status()["leases"] if v.get("grows") == lease]
    assert (growth["state"], growth["charge_bytes"], growth["position"]) == ("queued", 2 * GIB, 1)
    driver.until(lambda: driver.state(other) == "revoking", limit_s=0.1)
    assert driver.state(lease) == "held", "it never makes itself leave"
    det.unload(other)
    driver.until(lambda: charge(driver, lease) == 6 * GIB)
    assert not [v for v in driver.status()["leases"] if "grows" in v]
    assert driver.arbiter.inspect().gpus[GpuId("GPU-0")].evictions == []


def test_the_reading_that_did_not_see_a_growth_carries_no_grant() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 3)
    vlm.resize(lease, 5 * GIB)
    waiter = driver.consumer("det").acquire(2 * GIB)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=1.0)
    assert charge(driver, lease) == 5 * GIB


def test_an_exclusive_lease_grows_alone() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4, exclusive=True)
    vlm.resize(lease, 7 * GIB)
    driver.until(lambda: charge(driver, lease) == 7 * GIB, limit_s=0.1)
    assert shown(driver, lease)["state"] == "held"
    small = driver.consumer("small").acquire(100 * MIB)
    assert driver.state(small) == "queued", "it is exclusive still"


def test_what_can_never_fit_is_refused_at_once() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4)
    pinner, pinned = held(driver, "pinned", 2, evictable=False)
    refused = refusal(vlm.resize(lease, 8 * GIB))
    assert refused.code == "vram_insufficient"
    assert charge(driver, lease) == 4 * GIB
    assert answer(vlm.resize(lease, 7 * GIB))["state"] == "growing"
    pinner.unload(pinned)
    driver.until(lambda: charge(driver, lease) == 7 * GIB)


def test_a_growth_has_a_bound_and_the_lease_stays() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4)
    det, other = held(driver, "det", 3)
    det.use_begin(other)
    vlm.resize(lease, 6 * GIB, wait_timeout_s=5.0)
    driver.advance(5.1)
    (denied,) = driver.pushes("denied", lease)
    assert denied["error"]["code"] == "wait_timeout"
    assert (driver.state(lease), charge(driver, lease)) == ("held", 4 * GIB)
    view = driver.view(lease)
    assert view is not None
    assert "resizing" not in view
    assert answer(vlm.resize(lease, 5 * GIB))["state"] == "growing", "it may ask again"


def test_another_size_replaces_the_one_before() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4)
    det, other = held(driver, "det", 3)
    det.use_begin(other)
    vlm.resize(lease, 6 * GIB)
    before = driver.arbiter.inspect().feature(Resizing).resizes[lease].growth
    assert answer(vlm.resize(lease, 6 * GIB))["state"] == "growing"
    assert driver.arbiter.inspect().feature(Resizing).resizes[lease].growth == before, (
        "a repeat keeps its place"
    )
    vlm.resize(lease, 5 * GIB)
    assert driver.state(before) == "over"
    assert answer(vlm.resize(lease, 4 * GIB))["state"] == "held"
    assert len(driver.arbiter.inspect().waiting) == 0
    vlm.hold(3 * GIB)
    assert answer(vlm.resize(lease, 3 * GIB))["state"] == "shrinking"
    assert answer(vlm.resize(lease, 3 * GIB))["state"] == "shrinking"
    assert answer(vlm.resize(lease, 4 * GIB))["state"] == "held"


@pytest.mark.parametrize("end", ["unloading", "release", "bye", "death", "expiry"])
def test_a_growth_ends_with_its_lease(end: str) -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4, ttl_s=10.0)
    det, other = held(driver, "det", 3)
    det.use_begin(other)
    vlm.resize(lease, 6 * GIB)
    if end == "unloading":
        vlm.unloading(lease)
    elif end == "release":
        vlm.release(lease)
    elif end == "bye":
        vlm.leave()
    elif end == "death":
        vlm.die()
    else:
        driver.advance(10.1)
    assert not driver.arbiter.inspect().waiting
    driver.advance(20.0)
    assert not driver.pushes("resized")


def test_who_was_asked_to_leave_or_holds_nothing_is_not_resized() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4)
    driver.consumer("det").acquire(7 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    assert refusal(vlm.resize(lease, 5 * GIB)).code == "lease_revoking"
    driver = CoreDriver(8 * GIB)
    loading = driver.consumer("x")
    one = loading.acquire(1 * GIB)
    assert refusal(loading.resize(one, 2 * GIB)).code == "bad_state"


def test_a_full_queue_refuses_growth_too() -> None:
    driver = CoreDriver(8 * GIB, settings={"waiters_max": 1})
    vlm, lease = held(driver, "vlm", 4)
    vlm.use_begin(lease)
    driver.consumer("det").acquire(5 * GIB, priority=40)
    assert refusal(vlm.resize(lease, 5 * GIB)).code == "limit_exceeded"


def test_after_a_restart_the_holder_asks_again_and_gets_it_once() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4)
    vlm.resize(lease, 6 * GIB)
    driver.until(lambda: charge(driver, lease) == 6 * GIB, limit_s=0.1)
    token = vlm.token(lease)
    vlm.hold(6 * GIB)
    driver.restart()
    vlm.connect()
    vlm.reattach(lease, token)
    assert answer(vlm.resize(lease, 6 * GIB))["state"] == "held"
    assert driver.gpu()["charged_bytes"] == 6 * GIB


def test_the_invariant_of_a_growth() -> None:
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4)
    det, other = held(driver, "det", 3)
    det.use_begin(other)
    vlm.resize(lease, 6 * GIB)
    core = state_of(driver.arbiter)
    growth = core.leases[driver.arbiter.inspect().feature(Resizing).resizes[lease].growth]
    growth.request.extends = LeaseId("gone")
    core.turn.touched[0] = core.gpus[GpuId("GPU-0")]
    with pytest.raises(InvariantViolation, match="which is not there"):
        invariants.check(core)


@pytest.mark.parametrize("end", ["canceled", "connection lost"])
def test_a_lease_outlives_its_growth(end: str) -> None:
    """A growth that ended without a denial was still named by its lease, and the next request on
    that lease stopped the daemon."""
    driver = CoreDriver(8 * GIB)
    vlm, lease = held(driver, "vlm", 4)
    det, other = held(driver, "det", 3)
    det.use_begin(other)
    vlm.resize(lease, 6 * GIB)
    views = driver.status()["leases"]
    (growth,) = (view["lease_id"] for view in views if view.get("grows") == lease)
    if end == "canceled":
        vlm.cancel(growth)
    else:
        vlm.leave("connection lost")
        vlm.connect()
    view = driver.view(lease)
    assert view is not None
    assert "resizing" not in view
    assert answer(vlm.resize(lease, 5 * GIB))["state"] == "growing"
    assert vlm.unloading(lease)
