"""The slot that every camera reader is built on: fresh, stale, interrupted, ended, and threads that
meet in it.
"""

import math
import threading
from typing import Any

import pytest

from tests.runner import small_robots
from vram_arbiter.runner.control.clock import Clock, SystemClock
from vram_arbiter.runner.protocols import SensorReader
from vram_arbiter.runner.sensors import Feed, LatestSlot, SlotReader
from vram_arbiter.schemas.errors import FrameStale
from vram_arbiter.schemas.world import SensorFrame


def frame_at(stamp_ns: int, value: int = 0, sensor_id: str = "front") -> SensorFrame:
    return small_robots.frame_at(stamp_ns, sensor_id, data=bytes([value]))


class Pushed(SlotReader):
    """A camera whose pictures come from the test, and which notes what it was told."""

    def __init__(self, clock: Clock, tee: Any = None) -> None:
        super().__init__("front", 100.0, clock, tee)
        self.feeds: list[Feed] = []
        self.ends = 0
        self.broken: Exception | None = None

    def _run_begins(self, feed: Feed) -> None:
        if self.broken is not None:
            raise self.broken
        self.feeds.append(feed)

    def _run_ends(self) -> None:
        self.ends += 1


class Shelf:
    """A tee that keeps what it gets."""

    def __init__(self) -> None:
        self.frames: list[SensorFrame] = []
        self.closed = 0

    def publish(self, frame_at: SensorFrame) -> None:
        self.frames.append(frame_at)

    def close(self) -> None:
        self.closed += 1


def test_nothing_is_served_before_the_first_picture(clock: Any) -> None:
    slot = LatestSlot("front", 100.0, clock)
    with pytest.raises(FrameStale, match="not started"):
        slot.latest()
    slot.open()
    with pytest.raises(FrameStale, match="first picture has not come"):
        slot.latest()


def test_a_frame_is_served_until_it_is_too_old(clock: Any) -> None:
    slot = LatestSlot("front", 100.0, clock)
    slot.open().put(frame_at(clock.now_ns(), 7))
    clock.advance(0.1)
    assert slot.latest().data == b"\x07"
    clock.advance(0.05)
    with pytest.raises(FrameStale, match="150 ms old, 100 ms are accepted") as stale:
        slot.latest()
    assert stale.value.details["age_ms"] == pytest.approx(150.0)
    assert slot.latest(200.0).data == b"\x07"
    with pytest.raises(FrameStale):
        slot.latest(math.nan)


def test_a_stamp_of_the_future_is_not_fresh(clock: Any) -> None:
    slot = LatestSlot("front", 100.0, clock)
    slot.open().put(frame_at(clock.now_ns() + 5_000_000))
    with pytest.raises(FrameStale, match="5 ms in the future"):
        slot.latest()


def test_an_older_frame_never_replaces_a_newer_one(clock: Any) -> None:
    slot = LatestSlot("front", 100.0, clock)
    feed = slot.open()
    assert feed.put(frame_at(clock.now_ns(), 2))
    assert not feed.put(frame_at(clock.now_ns() - 1, 1))
    assert slot.latest().data == b"\x02"


def test_a_frame_of_another_camera_is_refused(clock: Any) -> None:
    with pytest.raises(ValueError, match="wrist"):
        LatestSlot("front", 100.0, clock).open().put(frame_at(1, sensor_id="wrist"))


def test_the_last_frame_of_a_broken_source_is_served_no_more_though_it_is_young(clock: Any) -> None:
    slot = LatestSlot("front", 100.0, clock)
    feed = slot.open()
    feed.put(frame_at(clock.now_ns(), 1))
    assert feed.interrupt("the cable is out")
    with pytest.raises(FrameStale, match="the cable is out") as stale:
        slot.latest()
    assert stale.value.details["ended"] is False
    feed.put(frame_at(clock.now_ns(), 2))
    assert slot.latest().data == b"\x02"
    assert slot.ended is None
    feed.end("the file is over")
    assert not feed.put(frame_at(clock.now_ns(), 3))
    assert not feed.end("another reason")
    assert slot.ended == "the file is over"
    with pytest.raises(FrameStale, match="the file is over"):
        slot.latest()


def test_a_replaced_feed_is_deaf(clock: Any) -> None:
    slot = LatestSlot("front", 100.0, clock)
    old = slot.open()
    new = slot.open()
    assert not old.put(frame_at(clock.now_ns(), 1))
    assert not old.end("late")
    assert new.put(frame_at(clock.now_ns(), 2))
    assert slot.latest().data == b"\x02"


def test_synced_waits_for_a_picture_taken_after_the_call() -> None:
    clock = SystemClock()
    asked = threading.Event()

    class Told(SystemClock):
        """Says when the waiting side has begun: its first look at the clock is the time of the
        call.
        """

        def now_ns(self) -> int:
            now = super().now_ns()
            asked.set()
            return now

    slot = LatestSlot("front", 100.0, Told())
    feed = slot.open()
    feed.put(frame_at(clock.now_ns(), 1))

    def take() -> None:
        asked.wait(60)
        feed.put(frame_at(clock.now_ns(), 2))

    thread = threading.Thread(target=take)
    thread.start()
    got = slot.synced(clock.now_ns() + 60 * 10**9)
    thread.join(60)
    assert got.data == b"\x02"


def test_synced_gives_up_at_its_deadline_and_says_so() -> None:
    clock = SystemClock()
    slot = LatestSlot("front", 100.0, clock)
    feed = slot.open()
    with pytest.raises(FrameStale, match="first picture has not come"):
        slot.synced(clock.now_ns())
    feed.put(frame_at(clock.now_ns(), 1))
    with pytest.raises(FrameStale, match="no new picture within"):
        slot.synced(clock.now_ns() + 1_000_000)


def test_stopping_wakes_who_waits_for_a_picture() -> None:
    clock = SystemClock()
    reader = Pushed(clock)
    reader.start()
    problems: list[FrameStale] = []

    def wait() -> None:
        try:
            reader.read_synced(clock.now_ns() + 60 * 10**9)
        except FrameStale as problem:
            problems.append(problem)

    thread = threading.Thread(target=wait)
    thread.start()
    reader.stop()
    thread.join(30)
    assert not thread.is_alive()
    assert "stopped" in str(problems[0])


def test_a_reader_conforms_starts_again_and_tells_its_tee(clock: Any) -> None:
    shelf = Shelf()
    reader = Pushed(clock, shelf)
    as_protocol: SensorReader = reader
    as_protocol.start()
    as_protocol.start()
    assert len(reader.feeds) == 1
    reader.deliver(reader.feeds[0], frame_at(clock.now_ns(), 1))
    assert as_protocol.read_latest().data == b"\x01"
    as_protocol.stop()
    as_protocol.stop()
    assert (reader.ends, shelf.closed) == (1, 1)
    with pytest.raises(FrameStale, match="stopped"):
        as_protocol.read_latest()
    as_protocol.start()
    # the thread of the first run, late
    reader.deliver(reader.feeds[0], frame_at(clock.now_ns(), 2))
    with pytest.raises(FrameStale):
        as_protocol.read_latest()
    reader.deliver(reader.feeds[1], frame_at(clock.now_ns(), 3))
    assert [kept.data for kept in shelf.frames] == [b"\x01", b"\x03"]


def test_a_source_that_cannot_be_opened_leaves_a_reader_that_can_be_started_again(
    clock: Any,
) -> None:
    reader = Pushed(clock)
    reader.broken = OSError("no such device")
    with pytest.raises(OSError, match="no such device"):
        reader.start()
    with pytest.raises(FrameStale, match="could not be started"):
        reader.read_latest()
    reader.broken = None
    reader.start()
    reader.deliver(reader.feeds[0], frame_at(clock.now_ns(), 1))
    assert reader.read_latest().data == b"\x01"
