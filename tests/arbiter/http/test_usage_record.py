"""The last minutes of the GPUs: when a sample is taken, and what bounds the samples."""

import asyncio
from collections.abc import Callable
from dataclasses import replace

from tests.support.core_driver import CoreDriver
from vram_arbiter.arbiter.core.report.usage import GpuUsage
from vram_arbiter.arbiter.http import usage_record
from vram_arbiter.arbiter.http.messages import OTHERS, PENDING_FREE, RETAINED, STOWAWAYS
from vram_arbiter.arbiter.http.usage_record import KEPT_S, PARTS_MAX, PERIOD_S, UsageRecord
from vram_arbiter.schemas.defaults import GIB, MIB

EMPTY = GpuUsage(0, {}, 0, 0, 0, 0)


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def record_of(shown: Callable[[], list[GpuUsage]], clock: Clock) -> UsageRecord:
    return UsageRecord(shown, 100.0, clock)


def test_samples_come_at_changes_and_twice_a_second_at_most() -> None:
    """A storm of events takes one sample at once and one when PERIOD_S is over, whatever came
    between."""
    clock, taken = Clock(), list[float]()

    def shown() -> list[GpuUsage]:
        taken.append(clock.now)
        return [replace(EMPTY, used_bytes=len(taken))]

    async def storm() -> UsageRecord:
        record = record_of(shown, clock)
        for _ in range(100):
            record.changed()
        (timer,) = asyncio.get_running_loop()._scheduled  # type: ignore[attr-defined]
        clock.now += PERIOD_S
        timer._run()
        record.close()
        return record

    record = asyncio.run(storm())
    assert taken == [100.0, 100.0 + PERIOD_S]
    assert [sample.at_s for sample in record.since(0).samples] == [0.0, PERIOD_S]
    assert [sample.at_s for sample in record.since(1).samples] == [PERIOD_S]


def test_what_stays_the_same_is_recorded_once_and_kept() -> None:
    """The newest sample still holds, however old it is; older ones go with their time."""
    clock, shown = Clock(), [EMPTY]
    record = record_of(lambda: shown, clock)
    for used in (0, 0, 1, 1, 0):
        shown = [replace(EMPTY, used_bytes=used)]
        clock.now += 1.0
        record.changed()
    assert [sample.used_bytes for sample in record.since(0).samples] == [0, 1, 0]
    clock.now += 2 * KEPT_S
    record.changed()
    assert record.since(0).samples[-1].at_s == 5.0
    shown = [replace(EMPTY, used_bytes=7)]
    clock.now += 1.0
    record.changed()
    assert [sample.used_bytes for sample in record.since(0).samples] == [0, 7]


def test_many_consumers_are_bounded() -> None:
    """Of many consumers the largest are named; all samples together have at most PARTS_MAX
    parts."""
    clock, round_ = Clock(), 0

    def shown() -> list[GpuUsage]:
        sizes = {f"c{n}": n + round_ for n in range(1, 101)}
        return [GpuUsage(0, sizes, 5, 6, 7, None), replace(EMPTY, index=1)]

    record = record_of(shown, clock)
    for round_ in range(1200):  # noqa: B007  # `shown` reads it
        clock.now += 0.5
        record.changed()
    told = record.since(0)
    assert sum(1 + len(sample.parts) for sample in told.samples) <= PARTS_MAX
    last = told.samples[-1]
    names = [told.consumers[part] for part, _ in last.parts if part >= 0]
    assert names == sorted(f"c{n}" for n in range(100 - usage_record.CONSUMERS_MAX + 1, 101))
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
    (held,) = driver.arbiter.usage()
    assert (held.consumers, held.pending_free_bytes, held.used_bytes) == ({"det": 2 * GIB}, 0, 0)
    det.unloading(lease)
    det.hold(450 * MIB)
    det.release(lease)
    (leaving,) = driver.arbiter.usage()
    assert (leaving.consumers, leaving.pending_free_bytes) == ({}, 2 * GIB)
    driver.advance(5.0)
    (left,) = driver.arbiter.usage()
    assert (left.consumers, left.pending_free_bytes, left.retained_bytes) == ({}, 0, 450 * MIB)
    assert left.used_bytes == 450 * MIB
