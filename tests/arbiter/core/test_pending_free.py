"""What was given up a moment ago is still on the GPU, and is nobody's: it must not hide what the
next one gives back."""

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.scenes import held, hidden_gpu
from vram_arbiter.arbiter.core.events import MemorySampled, ProcessUse
from vram_arbiter.arbiter.core.ledger import GpuLedger
from vram_arbiter.arbiter.core.model.gpu import PendingFree
from vram_arbiter.arbiter.core.settings import GpuInfo
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey

GPU = GpuId("GPU-0")
A, B = ProcessKey(1, 7), ProcessKey(2, 14)
STRANGER = ProcessKey(9, 9)


def reading(at: float, used: int, *uses: tuple[ProcessKey, int | None]) -> MemorySampled:
    listed = tuple(ProcessUse(process, "", count) for process, count in uses)
    return MemorySampled(GPU, at, used, 1000, listed)


# -- what is watched
def test_what_was_given_up_counts_for_as_long_as_it_is_asked_for() -> None:
    pending = PendingFree()
    pending.give_up(A, 300, 10.0)
    pending.give_up(B, 50, 12.0)
    assert pending.since(9.0) == 350
    assert pending.since(10.0) == 50
    assert pending.since(9.0) == 50, "what is over is forgotten"


def test_what_a_process_takes_again_is_not_on_its_way() -> None:
    pending = PendingFree()
    pending.give_up(A, 300, 10.0)
    pending.give_up(A, -100, 11.0)
    pending.give_up(B, -100, 11.0)
    assert pending.since(9.0) == 200
    assert pending.since(10.5) == 0, "it was given up at 10"
    pending.give_up(A, 300, 10.0)
    pending.give_up(A, -300, 11.0)
    assert pending.since(9.0) == 0
    pending.give_up(B, 1, 12.0)
    pending.give_up(B, 1, 13.0)
    assert pending.since(12.5) == 2, "the newest counts for all"


def test_two_readings_say_what_was_given_up_between_them() -> None:
    pending = PendingFree()
    before = reading(1.0, 900, (A, 500), (B, 300), (STRANGER, 100))
    pending.watch(None, before, (), lambda _: 0)
    pending.watch(before, reading(2.0, 900, (A, 400), (B, 200)), {B}, lambda _: 0)
    assert pending.since(1.0) == 200, "100 of A's and the stranger's; B is being measured"
    hidden = MemorySampled(GPU, 3.0, 900, 1000, None)
    pending.watch(before, hidden, (), lambda _: 0)
    pending.watch(hidden, before, (), lambda _: 0)
    assert pending.since(1.0) == 200, "such a reading says nothing of anybody"


def test_a_holder_that_leaves_the_list_still_explains_what_it_is_booked() -> None:
    pending = PendingFree()
    pending.watch(reading(1.0, 500, (A, 500)), reading(2.0, 500), (), {A: 450}.__getitem__)
    assert pending.since(1.0) == 50


# -- what it means for the rest that nobody explains
@pytest.mark.parametrize("lists", [True, False])
def test_a_rest_that_may_be_going_is_believed_as_far_as_it_was_there_before(lists: bool) -> None:
    books = GpuLedger(GpuInfo(GPU, 0, "gpu", 1000, 100), 10)

    def observe(at: float, used: int, pending_bytes: int) -> tuple[int, int | None]:
        sample = reading(at, used) if lists else MemorySampled(GPU, at, used, 1000, None)
        books.observe(sample, quiet=True, pending_bytes=pending_bytes)
        seen = books.driver_bytes if books.driver_seen else None
        return books.unattributed_bytes, seen

    assert observe(1.0, 400, 400) == (0, None), (
        "all of it may be going, and the driver's own was never seen"
    )
    assert observe(2.0, 400, 250) == (50, 100), "150 stay"
    assert observe(3.0, 400, 400) == (50, 100)
    assert observe(4.0, 120, 400) == (20, 100), "more than there is cannot be anybody's"
    assert observe(5.0, 30, 10) == (0, 30)
    assert observe(6.0, 60, 40) == (0, 30)
    assert observe(7.0, 400, 0) == (300, 100)


# -- verdicts
@pytest.mark.parametrize("restarts", [False, True])
def test_a_load_peak_on_its_way_back_hides_nobodys_bytes(restarts: bool) -> None:
    """Regression (storm, seed 7): a release counted as measured while all its bytes were on the
    GPU, behind a peak that had ended."""
    driver = hidden_gpu(lists=False)
    small, lease = held(driver, "small", 0.7)
    driver.advance(2.0)
    big = driver.consumer("big")
    other = big.acquire(4 * GIB, 3 * GIB)
    driver.until(lambda: driver.state(other) == "loading")
    driver.device.lag_s = 2.0
    big.hold(4 * GIB)
    big.hold(3 * GIB)
    big.ready(other)
    if restarts:
        tokens = small.token(lease), big.token(other)
        driver.restart()
        for person, mine, token in zip((small, big), (lease, other), tokens, strict=True):
            person.connect()
            person.reattach(mine, token)
    driver.advance(1.5)  # readings while nobody loads or leaves
    driver.device.lag_s = 5.0
    small.unload(lease)
    assert driver.until(lambda: driver.state(lease) == "over") == pytest.approx(5.0, abs=0.1)
    assert driver.gpu()["stowaway_bytes"] == 0


def test_a_stowaway_that_has_gone_hides_nobodys_bytes(driver: CoreDriver) -> None:
    """Its process is off the list before its bytes are off the GPU, which then nobody in the list
    explains."""
    small, lease = held(driver, "small", 1)
    driver.device.set(STRANGER, 2 * GIB, driver.now)
    driver.advance(2.0)
    driver.device.unlisted.add(STRANGER)
    driver.advance(1.5)
    assert driver.gpu()["stowaway_bytes"] == 0
    driver.device.lag_s = 3.0
    small.unload(lease)
    driver.device.set(STRANGER, 0, driver.now - 2.9)
    assert driver.until(lambda: driver.state(lease) == "over") == pytest.approx(3.0, abs=0.1)


# -- somebody unnamed leaves while a lease is measured
def without_lists(
    stranger_gib: float, *leases_gib: float
) -> tuple[CoreDriver, list[tuple[Consumer, LeaseId]]]:
    """A GPU that tells totals only: a stowaway that was there first, and leases that are held."""
    driver = hidden_gpu(lists=False)
    driver.device.set(STRANGER, int(stranger_gib * GIB), driver.now)
    driver.advance(2.0)
    found = [held(driver, f"holder-{index}", gib) for index, gib in enumerate(leases_gib)]
    driver.advance(2.0)
    return driver, found


def test_an_unnamed_stowaway_that_leaves_hides_no_release() -> None:
    """Regression (storm, seed 11): 2.4 GiB of two stowaways went, and so 750 MiB of a lease counted
    as measured while all were there."""
    driver, [(small, lease)] = without_lists(3, 0.75)
    driver.device.lag_s = 3.0
    small.unload(lease)
    driver.device.set(STRANGER, 0, driver.now - 2.9)
    assert driver.until(lambda: driver.state(lease) == "over") == pytest.approx(3.0, abs=0.1)


def test_the_doubt_ends_with_the_time_for_a_verdict() -> None:
    """All that is known is a total: who holds what is left, a stowaway or the one that was to
    leave, it cannot say."""
    driver, [(small, lease)] = without_lists(3, 0.75)
    driver.device.lag_s = 60.0
    small.unload(lease)
    driver.device.set(STRANGER, 0, driver.now - 59.9)
    assert driver.until(lambda: driver.state(lease) == "over") == pytest.approx(
        d.VERIFY_TIMEOUT_S, abs=0.6
    )


def test_when_all_that_nobody_named_is_gone_there_is_no_doubt() -> None:
    driver, [(small, lease)] = without_lists(3, 0.75)
    small.unload(lease)
    driver.device.set(STRANGER, 0, driver.now)
    assert driver.until(lambda: driver.state(lease) == "over") < 0.2


@pytest.mark.parametrize("apart_s", [0.0, 0.004, 0.05])
def test_releases_beside_a_desktop_that_nobody_lists_explain_each_other(apart_s: float) -> None:
    """WSL2: the desktop is in no list. Two models that leave together are gone as fast as they
    would be alone."""
    driver, [(one, first), (two, second)] = without_lists(2, 1, 1.5)
    one.unload(first)
    driver.advance(apart_s)
    two.unload(second)
    assert driver.until(lambda: {driver.state(first), driver.state(second)} == {"over"}) < 0.2


def test_a_stowaway_that_takes_less_than_the_tolerance_with_it_raises_no_doubt() -> None:
    driver, [(small, lease)] = without_lists(3, 0.75)
    small.unload(lease)
    driver.device.set(STRANGER, 3 * GIB - d.VERIFY_TOLERANCE_BYTES, driver.now)
    assert driver.until(lambda: driver.state(lease) == "over") < 0.2


def test_a_stowaway_that_takes_a_byte_more_raises_the_doubt() -> None:
    driver, [(small, lease)] = without_lists(3, 0.75)
    small.unload(lease)
    driver.device.set(STRANGER, 3 * GIB - d.VERIFY_TOLERANCE_BYTES - 1, driver.now)
    driver.advance(1.0)
    assert driver.state(lease) != "over"
