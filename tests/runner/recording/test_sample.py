"""What rows will look like is known before a goal moves the robot."""

import asyncio
from typing import Any

import pytest

pytest.importorskip("cv2", reason="needs the runner extra")

from tests.runner.small_robots import FedCamera, Twin, frame_at, hardware_runner
from vram_arbiter.runner.cli.recording import check_recording
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.recording.columns import row_of
from vram_arbiter.runner.recording.sample import sample_of
from vram_arbiter.runner.robots.hardware import HardwareRunner
from vram_arbiter.runner.safety.ranges import JointRanges
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.world import FrameEncoding


def runner_with(camera: FedCamera) -> HardwareRunner:
    clock = camera.clock
    return hardware_runner(
        Twin(clock), [(camera, 1e6)], lambda skill: JointRanges({}), clock=clock, rate_hz=200.0
    )


def test_a_sample_has_the_robots_columns_and_the_pictures_sizes() -> None:
    runner = runner_with(FedCamera("front", SystemClock()))
    runner.activate()
    sample = sample_of(runner)
    assert sample is not None
    row = row_of(sample, runner.camera_names())
    joints = list(runner.robot.hal.description.joint_names)
    assert row.columns["observation.state"].names == row.columns["action"].names == joints
    seen = [(frame.sensor_id, frame.width, frame.height, frame.data) for frame in row.frames]
    assert [(*shape, len(data or b"")) for *shape, data in seen] == [("front", 2, 1, 6)]
    runner.deactivate()


def test_a_camera_without_colors_is_refused_before_a_goal() -> None:
    """Regression: every tick of the session was left out of the dataset, one warning a goal."""

    class Depth(FedCamera):
        def show(self) -> None:
            if self.feed is not None:
                depth = {"encoding": FrameEncoding.DEPTH16, "data": bytes(2)}
                self.deliver(self.feed, frame_at(self.clock.now_ns(), self.sensor_id, **depth))

    async def start() -> None:
        runner = runner_with(Depth("depth", SystemClock()))
        unasked: Any = None  # the sample fails before the writer is asked
        async with ControlThread(runner) as control:
            await check_recording(unasked, control)

    with pytest.raises(ConfigError, match=r"nothing could be recorded: .*depth16"):
        asyncio.run(start())
