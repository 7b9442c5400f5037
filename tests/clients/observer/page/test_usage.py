"""The last hour of the GPUs: what a sample holds, and what bounds the samples."""

from dataclasses import replace

from tests.support.core_driver import CoreDriver
from vram_arbiter.clients.observer.figures import GpuUsage, usage
from vram_arbiter.clients.observer.page.messages import OTHERS, PENDING_FREE, RETAINED, STOWAWAYS
from vram_arbiter.clients.observer.page.usage import CONSUMERS_MAX, KEPT_S, PARTS_MAX, UsageRecord
from vram_arbiter.schemas.defaults import GIB, MIB

EMPTY = GpuUsage(0, {}, 0, 0, 0, 0)


def test_what_stays_the_same_is_recorded_once_and_kept() -> None:
    """The newest sample still holds, however old it is; older ones go with their time."""
    record = UsageRecord()
    for at, used in enumerate((0, 0, 1, 1, 0), 101):
        record.take([replace(EMPTY, used_bytes=used)], float(at))
    assert [sample.used_bytes for sample in record.since(0, 100.0).samples] == [0, 1, 0]
    assert [sample.at_s for sample in record.since(0, 100.0).samples] == [1.0, 3.0, 5.0]
    assert [sample.at_s for sample in record.since(2, 100.0).samples] == [5.0]
    later = 105.0 + 2 * KEPT_S
    record.take([replace(EMPTY, used_bytes=0)], later)
    assert record.since(0, 100.0).samples[-1].at_s == 5.0
    record.take([replace(EMPTY, used_bytes=7)], later + 1)
    assert [sample.used_bytes for sample in record.since(0, 100.0).samples] == [0, 7]


def test_samples_of_an_earlier_daemon_are_before_its_successors_start() -> None:
    record = UsageRecord()
    record.take([replace(EMPTY, used_bytes=1)], 50.0)
    record.take([replace(EMPTY, used_bytes=2)], 150.0)
    assert [sample.at_s for sample in record.since(0, 100.0).samples] == [-50.0, 50.0]


def test_many_consumers_are_bounded() -> None:
    """Of many consumers the largest are named; all samples together have at most PARTS_MAX
    parts."""
    record = UsageRecord()
    for turn in range(1200):
        sizes = {f"c{n}": n + turn for n in range(1, 101)}
        record.take([GpuUsage(0, sizes, 5, 6, 7, None), replace(EMPTY, index=1)], turn / 2)
    told = record.since(0, 0.0)
    assert sum(1 + len(sample.parts) for sample in told.samples) <= PARTS_MAX
    last = told.samples[-1]
    names = [told.consumers[part] for part, _ in last.parts if part >= 0]
    assert names == sorted(f"c{n}" for n in range(100 - CONSUMERS_MAX + 1, 101))
    assert dict(last.parts)[OTHERS] + sum(count for part, count in last.parts if part >= 0) == sum(
        n + 1199 for n in range(1, 101)
    )
    assert [part for part, _ in last.parts][-4:] == [OTHERS, PENDING_FREE, RETAINED, STOWAWAYS]


def test_the_parts_of_a_gpu_add_up(driver: CoreDriver) -> None:
    """A charge is its consumer's until the holder releases, then pending free, then gone but for
    what the process retains. The parts are what the ledger charges, each time."""
    driver.device.lag_s = 0.5
    det = driver.consumer("det")
    lease = det.acquire(2 * GIB, residue_bytes=450 * MIB)
    det.load(lease)

    def shown() -> GpuUsage:
        (one,) = usage(driver.arbiter.status(driver.now))
        return one

    assert (shown().consumers, shown().pending_free_bytes, shown().used_bytes) == (
        {"det": 2 * GIB}, 0, 0,
    )  # fmt: skip
    det.unloading(lease)
    det.hold(450 * MIB)
    det.release(lease)
    assert (shown().consumers, shown().pending_free_bytes) == ({}, 2 * GIB)
    driver.advance(5.0)
    left = shown()
    assert (left.consumers, left.pending_free_bytes, left.retained_bytes) == ({}, 0, 450 * MIB)
    assert left.used_bytes == 450 * MIB


def test_bytes_of_a_dead_process_are_pending(driver: CoreDriver) -> None:
    """Its lease is over at once; what was charged for it is charged until a verdict."""
    driver.device.lag_s = 5.0
    det = driver.consumer("det")
    det.load(det.acquire(2 * GIB))
    det.die()
    (left,) = usage(driver.arbiter.status(driver.now))
    assert (left.consumers, left.pending_free_bytes, left.retained_bytes) == ({}, 2 * GIB, 0)
