"""Frames and ends of camera readers, waited for with a limit."""

import contextlib

from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.sensors.slot import SlotReader
from vram_arbiter.schemas.errors import FrameStale
from vram_arbiter.schemas.world import SensorFrame

CLOCK = SystemClock()
WAIT_S = 60.0


def soon() -> int:
    """Return the instant by which anything must have happened."""
    return CLOCK.now_ns() + round(WAIT_S * 1e9)


def frame_of(reader: SlotReader) -> SensorFrame:
    """Return the next whole frame. Raises FrameStale after a minute."""
    return reader.read_synced(soon())


def end_of(reader: SlotReader) -> str:
    """Wait until the source ends, and return why."""
    deadline_ns = soon()
    while reader.slot.ended is None:
        with contextlib.suppress(FrameStale):  # of the end, or of the deadline
            reader.read_synced(deadline_ns)
        assert CLOCK.now_ns() < deadline_ns, "the source does not end"
    return reader.slot.ended
