"""Verdicts. The bytes of a lease stay charged until a reading says that they came back, or whose
they are."""

from dataclasses import replace

import pytest

from tests.support.core_driver import READING_S, CoreDriver
from tests.support.engine_state import state_of
from tests.support.scenes import give_back, held, verdicts
from vram_arbiter.arbiter.core.effects import Note, Sample
from vram_arbiter.arbiter.core.events import MemorySampled, ProbeFailed, Resumed
from vram_arbiter.arbiter.core.learning import Costs
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Verification
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.verification import schedule
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import GpuId, ProcessKey
from vram_arbiter.schemas.wire.notes import About, VerifiedNote

STRANGER = ProcessKey(9, 9)
GPU = GpuId("GPU-0")


def total_only(driver: CoreDriver) -> None:
    driver.device.lists_processes = False
    driver.advance(1.5)


# -- verified
def test_bytes_that_left_are_those_of_a_charge_without_what_its_process_retains() -> None:
    """Others' verdicts may count on so much."""
    driver = CoreDriver(8 * GIB)
    det, lease = held(driver, "det", 5, residue_bytes=450 * MIB)
    det.unload(lease)
    driver.until(lambda: driver.state(lease) == "over")
    (left,) = state_of(driver.arbiter).gpus[GPU].left
    assert left == (pytest.approx(driver.now, abs=0.1), 5 * GIB - 450 * MIB)


@pytest.mark.parametrize("lag_s", [0.0, 0.001, 0.25, 0.7, 1.5, 1.99])
def test_memory_that_comes_back_is_noticed_within_ten_milliseconds(lag_s: float) -> None:
    driver = CoreDriver(8 * GIB)
    driver.device.lag_s = lag_s
    det, lease = held(driver, "det", 5)
    det.unload(lease)
    took = driver.until(lambda: driver.state(lease) == "over", step_s=0.001)
    assert lag_s < took <= lag_s + 0.010 + 2 * READING_S


def under_way(driver: CoreDriver) -> tuple[Core, Gpu, Verification]:
    """A verification whose reading does not come, and its next poll is due now."""
    driver.device.silent = True
    core = state_of(driver.arbiter)
    gpu = core.gpus[GPU]
    (one,) = gpu.verifications.values()
    one.next_poll_at, one.last_used_bytes = core.now, 0
    gpu.asked_at, gpu.dirty = None, False
    return core, gpu, one


@pytest.mark.parametrize(
    ("waited_s", "usual_s", "reading_s", "left_s", "pause_s"),
    [
        # dense for a second, then for 4 s less
        (0.0, 0.0, 0.001, 9.0, 0.005),
        (0.999, 0.0, 0.001, 9.0, 0.005),
        (1.0, 0.0, 0.001, 9.0, 0.020),
        (4.999, 0.0, 0.001, 9.0, 0.020),
        (5.0, 0.0, 0.001, 9.0, 0.050),
        # for half as long again as it usually takes
        (2.999, 2.0, 0.001, 9.0, 0.005),
        (3.0, 2.0, 0.001, 9.0, 0.020),
        (5.999, 4.0, 0.001, 9.0, 0.005),
        (6.0, 4.0, 0.001, 9.0, 0.050),
        # half of the time at most, and twice a second at least
        (0.0, 0.0, 0.025, 9.0, 0.050),
        (6.0, 0.0, 0.025, 9.0, 0.050),
        (0.0, 0.0, 3.0, 9.0, 0.500),
        # at the deadline, and rarely after it
        (6.0, 0.0, 0.001, 0.030, 0.030),
        (6.0, 0.0, 0.001, 0.004, 0.005),
        (0.0, 0.0, 0.001, 0.001, 0.005),
        (0.0, 0.0, 0.001, 0.0, 0.500),
        (9.0, 4.0, 0.025, -1.0, 0.500),
    ],
)
def test_readings_are_dense_while_memory_usually_comes_back_and_rarer_later(
    waited_s: float,
    usual_s: float,
    reading_s: float,
    left_s: float,
    pause_s: float,
) -> None:
    driver = CoreDriver(8 * GIB, settings={"verify_poll_until_s": (1.0, 5.0)})
    det, lease = held(driver, "det", 5)
    det.unload(lease)
    core, gpu, one = under_way(driver)
    one.paced_from, one.deadline_at = core.now - waited_s, core.now + left_s
    gpu.reading_s = reading_s
    core.costs = Costs({"det": {"verify_s": usual_s}} if usual_s else {}, 30.0)
    schedule.on_poll_due(core, GPU)
    assert one.next_poll_at - core.now == pytest.approx(pause_s)
    assert (one.overdue, gpu.dirty) == (left_s <= 0, left_s <= 0)
    assert (gpu.asked_at, core.readings, core.turn.effects) == (core.now, [GPU], [])


def test_a_poll_that_was_put_off_reads_nothing(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5)
    det.unload(lease)
    core, gpu, one = under_way(driver)
    one.next_poll_at += 0.001
    before = one.next_poll_at
    gpu.touched = False
    schedule.on_poll_due(core, GPU)
    assert (one.next_poll_at, gpu.asked_at, gpu.touched) == (before, None, True)


def test_a_deadline_without_a_reading_is_stale(driver: CoreDriver) -> None:
    """It is said once, and the poll that follows says nothing more."""
    det, lease = held(driver, "det", 5)
    det.unload(lease)
    core, _, one = under_way(driver)
    one.last_used_bytes, one.deadline_at = None, core.now
    core.now += 1.0
    for _ in range(2):
        schedule.on_poll_due(core, GPU)
        one.next_poll_at = core.now
    stale = VerifiedNote("stale", False, pytest.approx(1000.0), 5 * GIB, None, 0, ())
    assert core.turn.effects == [Note(stale, About(lease, "det", GPU))]


def test_readings_do_not_pile_up_where_one_takes_longer_than_the_pause() -> None:
    driver = CoreDriver(8 * GIB, settings={"probe_period_s": 1000.0})
    det, lease = held(driver, "det", 5)
    driver.device.reading_s = 0.030
    before = len(driver.effects)
    det.unload(lease)
    driver.advance(0.029)
    asked = [effect for effect in driver.effects[before:] if isinstance(effect, Sample)]
    assert len(asked) == 1, "that of the release is still under way, and counts"


@pytest.mark.parametrize(("later_s", "counts"), [(-0.001, False), (0.0, True), (0.001, True)])
@pytest.mark.parametrize("after", ["another reading", "a suspend"])
def test_a_reading_that_began_before_the_newest_or_a_suspend_does_not_count(
    driver: CoreDriver, after: str, later_s: float, counts: bool
) -> None:
    driver.device.silent = True
    gpu = state_of(driver.arbiter).gpus[GPU]
    driver.advance(0.1)
    if after == "a suspend":
        driver.post(Resumed(60.0))
        since = driver.now
    else:
        assert gpu.sample is not None
        since = gpu.sample.taken_at
    driver.now += 0.1
    reading = MemorySampled(GPU, since + later_s, 0, 8 * GIB, ())
    driver.post(reading)
    assert (gpu.sample is reading) == counts


@pytest.mark.parametrize(("later_s", "asked"), [(-0.001, True), (0.0, False), (0.2, False)])
def test_a_reading_answers_what_was_asked_before_it_began(
    driver: CoreDriver, later_s: float, asked: bool
) -> None:
    core = state_of(driver.arbiter)
    gpu = core.gpus[GPU]
    gpu.asked_at = core.now + 0.1
    reading = MemorySampled(GPU, gpu.asked_at + later_s, 0, 8 * GIB, ())
    core.now += 0.2
    schedule.on_reading(core, reading)
    assert gpu.sample is reading
    assert (gpu.asked_at is not None) == asked
    assert gpu.reading_s == pytest.approx(max(0.0, 0.1 - later_s))


@pytest.mark.parametrize(
    ("sample_s", "failed_s", "stale"),
    [
        (2.0, None, False),
        (2.001, None, True),
        (2.001, 2.0, False),
        (2.001, 2.001, True),
        (2.0, 2.001, False),
        (None, None, True),
        (None, 2.0, False),
    ],
)
def test_a_gpu_is_stale_when_its_newest_reading_may_gate_no_grant(
    driver: CoreDriver, sample_s: float | None, failed_s: float | None, stale: bool
) -> None:
    """A failed reading is news as well. `sample_s`, `failed_s`: their age."""
    gpu = state_of(driver.arbiter).gpus[GPU]
    assert gpu.sample is not None
    now = driver.now + 100.0
    gpu.sample = None if sample_s is None else replace(gpu.sample, taken_at=now - sample_s)
    gpu.failed_at = None if failed_s is None else now - failed_s
    assert driver.arbiter.stale(now) == ([GPU] if stale else [])


def test_no_reading_from_before_the_release_counts() -> None:
    driver = CoreDriver(8 * GIB, settings={"probe_period_s": 1000.0})
    det, lease = held(driver, "det", 5)
    det.unloading(lease)
    det.hold(0)
    driver.post(MemorySampled(GPU, driver.now, 0, 8 * GIB, ()))
    det.release(lease)
    driver.device.silent = True
    for _ in range(3):
        driver.post(MemorySampled(GPU, driver.now, 0, 8 * GIB, ()))
    assert driver.state(lease) == "verifying"
    driver.advance(0.001)
    driver.post(MemorySampled(GPU, driver.now, 0, 8 * GIB, ()))
    assert driver.state(lease) == "verifying", "the first that counts"
    driver.post(MemorySampled(GPU, driver.now, 0, 8 * GIB, ()))
    assert driver.state(lease) == "over"


def test_a_death_under_measurement_starts_the_dense_readings_anew() -> None:
    driver = CoreDriver(8 * GIB, settings={"probe_period_s": 1000.0})
    driver.device.lag_s = 1.0
    det, lease = held(driver, "det", 5, residue_bytes=450 * MIB)
    det.unloading(lease)
    det.hold(450 * MIB)
    det.release(lease, exiting=True)
    driver.advance(6.0)
    det.die()
    took = driver.until(lambda: driver.state(lease) == "over", step_s=0.001)
    assert 1.0 < took <= 1.012


def test_a_process_that_exits_has_to_give_back_even_its_context(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5, residue_bytes=450 * MIB)
    det.unloading(lease)
    det.hold(450 * MIB)
    det.release(lease, exiting=True)
    driver.advance(1.0)
    assert driver.state(lease) == "verifying"
    det.die()
    driver.until(lambda: driver.state(lease) == "over", limit_s=1.0)
    assert driver.gpu()["charged_bytes"] == 0


def test_another_holder_may_grow_up_to_its_charge_meanwhile(driver: CoreDriver) -> None:
    a, first = held(driver, "a", 2)
    a.hold(1 * GIB)
    b, second = held(driver, "b", 4)
    b.unloading(second)
    a.hold(2 * GIB)
    b.hold(0)
    b.release(second)
    driver.until(lambda: driver.state(second) == "over", limit_s=1.0)
    assert verdicts(driver) == [("verified", True)]
    assert driver.state(first) == "held"


def test_totals_alone_verify_by_what_the_lease_was_charged(driver: CoreDriver) -> None:
    total_only(driver)
    a, first = held(driver, "a", 2)
    b, second = held(driver, "b", 4)
    driver.advance(1.0)
    b.unloading(second)
    c = driver.consumer("c")
    third = c.acquire(
        1 * GIB
    )  # loads while b is measured: what it may take is allowed for once it has it
    assert driver.state(third) == "loading"
    c.hold(1 * GIB)
    b.hold(0)
    b.release(second)
    driver.advance(15.0)
    assert (driver.state(second), verdicts(driver)) == ("verifying", [])
    c.ready(third)
    driver.until(lambda: driver.state(second) == "over", limit_s=1.0)
    assert verdicts(driver) == [("verified", True)]
    assert a.driver.state(first) == "held"


def test_what_a_load_has_not_taken_yet_hides_nobodys_bytes(driver: CoreDriver) -> None:
    """Regression (storm, seed 3): a dead holder's 500 MiB were measured gone behind the 500 that
    somebody was about to load."""
    total_only(driver)
    a, _ = held(driver, "a", 1)
    driver.advance(1.5)
    second = driver.consumer("b").acquire(2 * GIB)
    driver.until(lambda: driver.state(second) == "loading")
    driver.device.lag_s = 3.0
    a.die()
    assert driver.until(lambda: bool(driver.notes("verified")), step_s=0.001) == pytest.approx(
        3.0, abs=0.05
    )
    assert (driver.state(second), verdicts(driver)) == ("loading", [("verified", True)])


def test_while_a_load_hides_what_has_gone_the_deadline_is_put_off(driver: CoreDriver) -> None:
    """Nothing could be granted anyway before the load ends."""
    total_only(driver)
    det, lease = held(driver, "det", 2)
    loads = driver.consumer("loads")
    loading = loads.acquire(3 * GIB)
    loads.hold(2 * GIB)
    det.unload(lease)
    driver.advance(2 * d.VERIFY_TIMEOUT_S)
    (one,) = state_of(driver.arbiter).gpus[GPU].verifications.values()
    assert one.deadline_at == pytest.approx(driver.now + d.VERIFY_TIMEOUT_S, abs=0.1)
    loads.load(loading)
    driver.until(lambda: driver.state(lease) == "over", limit_s=0.1)


def test_lists_tell_a_load_from_what_has_not_gone_though_there_is_no_list_of_before() -> None:
    driver = CoreDriver(8 * GIB)
    driver.device.lists_processes = False
    driver.advance(1.5)
    a, first = held(driver, "a", 1)
    driver.advance(1.5)
    b = driver.consumer("b")
    second = b.acquire(2 * GIB)
    driver.until(lambda: driver.state(second) == "loading")
    a.unloading(first)
    driver.device.lists_processes = True
    a.hold(0)
    b.hold(2 * GIB)
    a.release(first)
    driver.until(lambda: driver.state(first) == "over", limit_s=1.0)
    assert (driver.state(second), verdicts(driver)) == ("loading", [("verified", True)])


def test_without_a_comparable_reading_the_ledger_bound_decides() -> None:
    driver = CoreDriver(8 * GIB, settings={"probe_period_s": 1000.0})
    driver.device.lists_processes = False
    det = driver.consumer("det")
    driver.advance(2.5)
    lease = det.acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "loading")
    det.hold(1 * GIB)
    det.release(lease)
    driver.advance(11.0)
    assert verdicts(driver) == [("unverifiable", False)]
    assert driver.state(lease) == "verifying", "nothing dropped"
    det.hold(0)
    driver.until(lambda: driver.state(lease) == "over", limit_s=2.0)
    assert verdicts(driver)[-1] == ("verified", True)


# -- residue
def test_a_living_process_that_keeps_too_much_is_charged_for_it(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5, residue_bytes=450 * MIB)
    waiter = driver.consumer("w").acquire(6 * GIB)
    small = driver.consumer("small").acquire(4 * GIB)
    det.unloading(lease)
    det.hold(2 * GIB)
    det.release(lease)
    driver.advance(11.0)
    assert verdicts(driver) == [("residue", True)]
    (culprit,) = driver.notes("verified")[0]["culprits"]
    assert culprit == {"pid": det.process.pid, "name": "det", "bytes": 2 * GIB}
    assert driver.gpu()["charged_bytes"] == 2 * GIB
    assert driver.journal[f"residue:{det.process}:GPU-0"]["residue_bytes"] == 2 * GIB
    assert driver.state(waiter) == "queued", "only what fits now is granted"
    assert driver.state(small) == "queued", "and it would delay the head"
    det.hold(450 * MIB)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=3.0)
    assert driver.gpu()["charged_bytes"] == 6 * GIB + 450 * MIB, "it came back later: noticed"


# -- contested
def test_others_that_grew_are_named_and_charged_as_stowaways(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5, residue_bytes=100 * MIB)
    waiter = driver.consumer("w").acquire(7 * GIB)
    det.unloading(lease)
    driver.device.names[STRANGER] = "browser"
    driver.device.set(STRANGER, 1 * GIB, driver.now)
    det.hold(100 * MIB)
    det.release(lease)
    driver.advance(11.0)
    assert verdicts(driver) == [("contested", True)]
    assert driver.notes("verified")[0]["culprits"] == [
        {"pid": 9, "name": "browser", "bytes": 1 * GIB}
    ]
    assert driver.state(waiter) == "queued"
    assert driver.gpu()["stowaway_bytes"] == 1 * GIB
    assert "browser (holds bytes without a lease)" in driver.why("w")["leases"][0]["text"]
    driver.device.set(STRANGER, 0, driver.now)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=3.0)


def test_what_nobody_in_the_list_explains_is_not_charged_to_who_is_in_it() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease = held(driver, "det", 5, residue_bytes=100 * MIB)
    det.unloading(lease)
    driver.device.unlisted.add(STRANGER)
    driver.device.set(STRANGER, 1 * GIB, driver.now)
    det.hold(100 * MIB)
    det.release(lease)
    driver.advance(11.0)
    assert verdicts(driver) == [("contested", True)]
    assert driver.notes("verified")[0]["culprits"] == []
    assert driver.gpu()["charged_bytes"] == 100 * MIB


def test_totals_alone_and_a_dead_process_end_contested_if_the_ledger_explains_the_gpu() -> None:
    driver = CoreDriver(8 * GIB)
    total_only(driver)
    a, first = held(driver, "a", 2)
    a.hold(1 * GIB)
    driver.advance(1.0)
    b, _ = held(driver, "b", 4)
    driver.advance(1.0)
    a.hold(2 * GIB)
    b.die()
    driver.advance(11.0)
    assert verdicts(driver) == [("contested", True)], (
        "a took what it is charged for; b cannot hold anything"
    )
    assert driver.gpu()["charged_bytes"] == 2 * GIB
    assert driver.state(first) == "held"


# -- stale and unverifiable
def test_a_probe_that_never_answers_is_asked_again_and_again(driver: CoreDriver) -> None:
    driver.device.silent = True
    driver.advance(3.0)
    waiter = driver.consumer("w").acquire(5 * GIB)
    driver.advance(5.0)
    assert driver.state(waiter) == "queued"
    driver.device.silent = False
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=3.0)


def test_a_list_without_byte_counts_is_no_evidence(driver: CoreDriver) -> None:
    driver.device.knows_bytes = False
    det, lease = held(driver, "det", 5)
    driver.advance(1.0)
    det.unloading(lease)
    det.hold(1 * GIB)
    det.release(lease)
    driver.advance(11.0)
    assert verdicts(driver) == [("residue", True)]


def test_a_failed_reading_of_an_unknown_gpu_is_ignored(driver: CoreDriver) -> None:
    assert driver.post(ProbeFailed(GpuId("GPU-9"), driver.now, "no")) == []


# -- expiry
def test_expired_bytes_stay_charged_until_measured_gone_after_the_holder_fenced_itself() -> None:
    driver = CoreDriver(8 * GIB)
    hung, lease = held(driver, "hung", 5, ttl_s=10.0, residue_bytes=450 * MIB)
    waiter = driver.consumer("w").acquire(5 * GIB)
    driver.advance(10.1)
    assert driver.state(lease) == "over"
    assert driver.notes("expired")[0]["consumer"] == "hung"
    assert (
        driver.pushes("lost", lease)[0]["error"]["message"] == f"{lease} was not renewed for 10 s"
    )
    hung.hold(450 * MIB)
    driver.advance(4.5)
    assert driver.state(waiter) == "queued", "it may still be loading until it fences itself"
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=1.0)
    assert driver.gpu()["charged_bytes"] == 5 * GIB + 450 * MIB


@pytest.mark.parametrize("released_first", [True, False])
def test_the_end_of_a_ttl_and_an_unload_do_not_block_each_other(
    driver: CoreDriver, released_first: bool
) -> None:
    """llama-swap#946: a ttl that runs out while the model unloads deadlocks both."""
    policy, lease = held(driver, "policy", 5, ttl_s=2.0)
    waiter = driver.consumer("w").acquire(5 * GIB)
    policy.unloading(lease)
    if released_first:
        policy.release(lease)
    driver.advance(3.0)
    policy.hold(0)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=20.0)
    assert driver.state(lease) == "over"


# -- residues and their processes
def test_the_residue_of_a_process_that_left_unseen_is_forgotten(driver: CoreDriver) -> None:
    """A process that said bye and is neither connected nor on the GPU any more keeps nothing."""
    det, lease = held(driver, "det", 5, residue_bytes=450 * MIB)
    give_back(driver, det, lease)
    det.hold(0)
    driver.advance(2.0)
    assert driver.gpu()["charged_bytes"] == 450 * MIB, "connected: it may use its context again"
    driver.consumer("other")
    det.leave()
    driver.advance(2.0)
    assert driver.gpu()["charged_bytes"] == 0


def test_a_residue_of_a_process_listed_without_bytes_stays_until_a_reading_shows_it_gone() -> None:
    """Regression: WSL2 lists processes without their bytes, and the next reading after the verdict
    took that for none."""
    driver = CoreDriver(8 * GIB)
    driver.device.knows_bytes = False
    det, lease = held(driver, "det", 5, residue_bytes=450 * MIB)
    det.unloading(lease)
    det.hold(2 * GIB)
    det.release(lease)
    driver.advance(d.VERIFY_TIMEOUT_S + 0.1)
    assert verdicts(driver) == [("residue", True)]
    driver.advance(10.0)
    gpu = driver.gpu()
    assert (gpu["charged_bytes"], gpu["stowaway_bytes"]) == (2 * GIB, 0), (
        "charged once, to who let go"
    )
    det.hold(GIB)
    driver.advance(2.0)
    assert driver.gpu()["charged_bytes"] == GIB, "what came back later is free"
    det.hold(0)
    driver.advance(2.0)
    assert driver.gpu()["charged_bytes"] == 450 * MIB, "connected: it may use its context again"


def test_two_debts_of_one_dead_process_are_measured_together(driver: CoreDriver) -> None:
    det, _ = held(driver, "det", 2)
    second = det.acquire(3 * GIB)
    det.hold(5 * GIB)
    det.ready(second)
    driver.advance(1.0)
    det.die()
    driver.until(lambda: driver.gpu()["charged_bytes"] == 0, limit_s=1.0)
    assert verdicts(driver) == [("verified", True), ("verified", True)]


def test_two_releases_at_different_times_are_polled_each_at_its_own_pace() -> None:
    driver = CoreDriver(8 * GIB, settings={"probe_period_s": 1000.0})
    driver.device.lag_s = 0.2
    a, first = held(driver, "a", 2)
    b, second = held(driver, "b", 3)
    a.unload(first)
    driver.advance(0.03)
    b.unload(second)
    driver.until(lambda: driver.state(first) == "over", limit_s=1.0)
    assert driver.state(second) == "verifying"
    driver.until(lambda: driver.state(second) == "over", limit_s=1.0)
    assert verdicts(driver) == [("verified", True), ("verified", True)]
