"""Ticks as a runner hands them to its recorder, made by hand: two joints, cameras of one color, a
trace.
"""

from collections.abc import Mapping
from typing import Any

from vram_arbiter.runner.protocols import Goal, GoalTick, SkillEnded
from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.world import (
    FrameEncoding,
    JointState,
    Pose,
    SensorFrame,
    TickResult,
    WorldState,
)

JOINTS = ("pan", "grip")
TRACE = "0af7651916cd43dd8448eb211c80319c"
WIDTH, HEIGHT = 32, 24
DONE = SkillEnded({})
FAILED = SkillEnded({}, ModelError("lost the cube"))


def goal(goal_id: str = "g1", prompt: str = "grab the cube", rskill_id: str = "test/grab") -> Goal:
    return Goal(goal_id, rskill_id, revision="abc", prompt=prompt)


def span_of(index: int) -> str:
    return f"{index + 1:016x}"


def picture(camera: str, level: int, **changes: Any) -> SensorFrame:
    given: dict[str, Any] = {
        "sensor_id": camera,
        "stamp_monotonic_ns": 1_000_000_000,
        "stamp_wall_ns": 0,
        "encoding": FrameEncoding.RGB8,
        "width": WIDTH,
        "height": HEIGHT,
        "data": bytes([level, level, level]) * (WIDTH * HEIGHT),
    }
    return SensorFrame(**given | changes)


def tick(
    index: int,
    *,
    of: Goal | None = None,
    frames: Mapping[str, SensorFrame] | None = None,
    targets: Mapping[str, float] | None = None,
    **result: Any,
) -> GoalTick:
    """Tick `index` of a goal; its numbers all follow from the index."""
    world = WorldState(
        stamp_ns=1_002_000_000,
        joint_state=JointState(name=JOINTS, position=(0.1 * index, 0.5), stamp_ns=1_002_000_000),
        base_pose=Pose(xyz=(1.0, 2.0, 0.0), quat_xyzw=(0.0, 0.0, 1.0, 0.0), frame_id="map"),
        image_frames=dict(frames)
        if frames is not None
        else {"front": picture("front", 10 * (index % 20))},
    )
    given: dict[str, Any] = {
        "stamp_ns": 1_003_000_000 + 33_333_333 * index,
        "tick_idx": 100 + index,
        "tick_ms": 12.5,
        "inference_ms": 3.0,
        "trace_context": {"traceparent": f"00-{TRACE}-{span_of(index)}-01"},
    }
    told = targets if targets is not None else {"pan": 0.1 * index + 0.05, "grip": 0.4}
    return GoalTick(of or goal(), world, TickResult(**given | result), told, (0.0, 0.1, 0.2))
