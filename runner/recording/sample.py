"""A tick that is not recorded: what rows will look like, before a goal moves the robot."""

from __future__ import annotations

from vram_arbiter.runner.protocols import Goal, GoalTick, InferenceRunner
from vram_arbiter.runner.sensors.pictures import rgb_frame
from vram_arbiter.schemas.world import TickResult

MAX_AGE_S = 60.0  # its size counts, not what it shows


def sample_of(runner: InferenceRunner) -> GoalTick | None:
    """Return a tick with the present state and a picture of each camera; None before any state.

    Control thread. Targets are where the joints are. Raises FrameStale, ModelError for a camera
    without a picture.
    """
    if (world := runner.world) is None:
        return None
    taken = {name: runner.snapshot(name, MAX_AGE_S) for name in runner.camera_names()}
    frames = {name: rgb_frame(name, one.rgb, one.stamp_ns, 0) for name, one in taken.items()}
    joints = world.joint_state
    return GoalTick(
        Goal("", ""),
        world.model_copy(update={"image_frames": frames}),
        TickResult(stamp_ns=world.stamp_ns, tick_idx=0, tick_ms=0.0),
        dict(zip(joints.name, joints.position, strict=True)),
        None if world.base_pose is None else (0.0, 0.0, 0.0),
    )
