"""Cameras that run freely, read together: frames of one moment, or none with the reason."""

import pytest

from tests.runner.manual_clock import ManualClock
from tests.runner.small_robots import FedCamera, Twin, frame_at, hardware_runner
from tests.support.waiting import until
from vram_arbiter.runner.safety.ranges import JointRanges
from vram_arbiter.runner.sensors.synced import read_together
from vram_arbiter.schemas.config.robot import SyncConfig
from vram_arbiter.schemas.errors import FrameStale
from vram_arbiter.schemas.world import SensorFrame

MS = 1_000_000


class Film:
    """A camera whose pictures are known beforehand, by the times (ms) they are taken at."""

    def __init__(self, sensor_id: str, *taken_ms: float) -> None:
        self.sensor_id = sensor_id
        self.taken_ns = [round(taken * MS) for taken in taken_ms]

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def read_latest(self, max_age_ms: float | None = None) -> SensorFrame:
        raise NotImplementedError

    def read_synced(self, deadline_ns: int, after_ns: int | None = None) -> SensorFrame:
        for taken_ns in self.taken_ns:
            if (after_ns or 0) < taken_ns <= deadline_ns:
                return frame_at(taken_ns, self.sensor_id)
        raise FrameStale(f"{self.sensor_id} took no new picture")


def together(*films: Film, spread_ms: float = 10.0, wait_ms: float = 200.0) -> list[float]:
    clock = ManualClock()
    clock.time_s = 1.0
    readers = {film.sensor_id: film for film in films}
    deadline_ns = clock.now_ns() + round(wait_ms * MS)
    frames = read_together(readers, round(spread_ms * MS), deadline_ns, clock)
    return [frames[name].stamp_monotonic_ns / MS for name in readers]


def test_the_oldest_picture_is_replaced_until_all_are_of_one_moment() -> None:
    front = Film("front", 990, 1001, 1034, 1068)
    wrist = Film("wrist", 985, 1030, 1063)
    slow = Film("slow", 900, 1066)
    assert together(front, wrist) == [1034, 1030]  # nothing from before the call: not 990 and 985
    assert together(front, wrist, slow) == [1068, 1063, 1066]
    assert together(front, wrist, spread_ms=30.0) == [1001, 1030]


def test_cameras_that_never_meet_are_refused_with_their_distance() -> None:
    even = Film("front", *range(1010, 1200, 20))
    odd = Film("wrist", *range(1020, 1200, 20))
    with pytest.raises(FrameStale, match=r"within 5 ms of each other; the nearest were 10 ms"):
        together(even, odd, spread_ms=5.0)


def test_the_world_state_has_both_pictures_of_a_moment_or_none(clock: ManualClock) -> None:
    front, wrist = FedCamera("front", clock), FedCamera("wrist", clock)
    runner = hardware_runner(
        Twin(clock),
        [(front, 100.0), (wrist, 100.0)],
        lambda skill: JointRanges({}),
        clock=clock,
        sync=SyncConfig(sensor_ids=("front", "wrist"), max_spread_ms=5.0),
    )
    runner.activate()
    front.always = wrist.always = False

    def seen() -> list[int]:
        clock.advance(0.034)
        wrist.show()
        clock.advance(0.004)
        front.show()
        runner.tick()
        assert runner.world is not None
        frames = (runner.world.image_frames or {}).values()
        return sorted(frame.stamp_monotonic_ns for frame in frames)

    until(lambda: len(seen()) == 2)  # its thread has to come to it
    first, second = until(lambda: len(found := seen()) == 2 and found)
    assert second - first <= 5 * MS
    for _ in range(5):  # the wrist's camera hangs: the front's new pictures have no partner
        clock.advance(0.034)
        front.show()
        runner.tick()
    assert runner.world is not None
    assert runner.world.stale == ("front", "wrist")
    runner.deactivate()
