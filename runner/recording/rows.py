"""Ticks as rows on their way to the dataset: plain values and the pictures' bytes.

Nothing is filled in: a tick that lacks a part of the row is refused with the reason. Units are
those of `schemas.world` (rad, m, s, and ms where a name says so), or the world's own where it is
not a robot. Must not import lerobot or numpy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypedDict

from vram_arbiter.runner.protocols import GoalTick, Transition
from vram_arbiter.runner.robots.units import LerobotUnits
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame

TIMINGS = ("tick", "sensors", "world_state", "inference", "safety", "hal")
# units of state and action: a robot's, whatever its world has, or lerobot's for this robot
ROBOT, OWN, LEROBOT = "rad", "own", "lerobot"
NUMBERS_MAX = 4096  # of a state; beyond that it is a picture of some kind
LARGEST = 3.4028234663852886e38  # of the columns' float32
NO_CHUNK = -1  # chunk_index of a tick that was not played from a chunk
COLOURS = frozenset(
    {
        FrameEncoding.RGB8,
        FrameEncoding.BGR8,
        FrameEncoding.MONO8,
        FrameEncoding.JPEG,
        FrameEncoding.PNG,
    }
)


class RowFrame(TypedDict):
    """One camera's picture of a row; its bytes follow the row."""

    camera: str
    encoding: str
    width: int
    height: int


class Row(TypedDict):
    """One tick on its way to the dataset."""

    goal_id: str
    skill: str
    task: str
    units: str
    state_names: list[str]
    state: list[float]
    action_names: list[str]
    action: list[float]
    base_pose: list[float] | None
    base_velocity: list[float] | None
    frames: list[RowFrame]
    ages_ms: list[float]
    timings_ms: list[float]
    tick_idx: int
    stamp_ns: int
    chunk_index: int
    action_applied: bool
    deadline_missed: bool
    violations: str
    reward: float | None
    success: bool | None
    trace_id: str
    span_id: str
    sampled: bool


class Incomplete(Exception):
    """This tick cannot become a row of the dataset; the message names what it lacks."""


def whole_rate(rate_hz: float) -> int:
    """Return the dataset's frames per second.

    Raises ConfigError for a rate that is not a whole number.
    """
    if rate_hz < 1 or rate_hz != round(rate_hz):
        raise ConfigError(
            f"a recording needs a whole number of ticks a second, not {rate_hz:g}",
            hint="change the rate",
        )
    return round(rate_hz)


def row_of(
    tick: GoalTick, cameras: Sequence[str], lerobot: LerobotUnits | None = None
) -> tuple[Row, list[bytes]]:
    """Return the row and its pictures, in the order of `cameras`. Raises Incomplete.

    `lerobot` records a robot by lerobot's names, in its units.
    """
    world, result, goal = tick.world, tick.result, tick.goal
    state, action = _joints(tick) if tick.transition is None else _step(tick.transition)
    units = ROBOT if tick.transition is None else OWN
    if lerobot is not None:
        state, action, units = lerobot.named(state), lerobot.named(action), LEROBOT
    frames = [_colours(world.image_frames or {}, camera) for camera in cameras]
    trace_id, span_id, sampled = trace_of((result.trace_context or {}).get("traceparent"))
    row: Row = {
        "goal_id": goal.goal_id,
        "skill": f"{goal.rskill_id}@{goal.revision}" if goal.revision else goal.rskill_id,
        "task": goal.prompt or goal.rskill_id,
        "units": units,
        "state_names": list(state),
        "state": list(state.values()),
        "action_names": list(action),
        "action": list(action.values()),
        "base_pose": _base_pose(tick),
        "base_velocity": list(tick.base_velocity) if tick.base_velocity is not None else None,
        "frames": [
            {
                "camera": camera,
                "encoding": str(frame.encoding),
                "width": frame.width,
                "height": frame.height,
            }
            for camera, frame in zip(cameras, frames, strict=True)
        ],
        "ages_ms": [
            max(0.0, (world.stamp_ns - frame.stamp_monotonic_ns) / 1e6) for frame in frames
        ],
        "timings_ms": [getattr(result, f"{name}_ms") for name in TIMINGS],
        "tick_idx": result.tick_idx,
        "stamp_ns": result.stamp_ns,
        "chunk_index": NO_CHUNK if result.chunk_index is None else result.chunk_index,
        "action_applied": result.action_applied,
        "deadline_missed": result.deadline_missed,
        "violations": "; ".join(result.safety_violations),
        "reward": result.reward,
        "success": result.success,
        "trace_id": trace_id,
        "span_id": span_id,
        "sampled": sampled,
    }
    return row, [frame.data or b"" for frame in frames]


def _joints(tick: GoalTick) -> tuple[dict[str, float], dict[str, float]]:
    """Measured joints and their targets (rad)."""
    joints = tick.world.joint_state
    if not joints.name:
        raise Incomplete("the robot has no joints")
    if missing := [name for name in joints.name if name not in tick.targets]:
        raise Incomplete(f"joint {missing[0]} has no target yet")
    state = dict(zip(joints.name, joints.position, strict=True))
    return state, {name: tick.targets[name] for name in state}


def _step(step: Transition) -> tuple[dict[str, float], dict[str, float]]:
    """Return the observation and the action of a world that is not a robot."""
    if not step.sent:
        raise Incomplete("nothing was sent: the world stood still")
    if len(step.shown) > NUMBERS_MAX:
        raise Incomplete(
            f"the world shows {len(step.shown)} numbers, at most {NUMBERS_MAX} are recorded:"
            " name some as `joints`"
        )
    for name, value in (*step.shown.items(), *step.sent.items()):
        if not abs(value) <= LARGEST:  # nor for NaN
            raise Incomplete(f"{name} is {value:g}, which no column can hold")
    return dict(step.shown), dict(step.sent)


def trace_of(traceparent: str | None) -> tuple[str, str, bool]:
    """Return trace id, span id (hex) and whether the trace is kept, of a W3C traceparent; else
    empty texts.
    """
    parts = (traceparent or "").split("-")
    if len(parts) < 4 or len(parts[1]) != 32 or len(parts[2]) != 16:
        return "", "", False
    try:
        return parts[1], parts[2], bool(int(parts[3], 16) & 1)
    except ValueError:
        return "", "", False


def _colours(frames: dict[str, SensorFrame], camera: str) -> SensorFrame:
    frame = frames.get(camera)
    if frame is None:
        raise Incomplete(f"camera {camera} has no picture")
    if frame.data is None or frame.encoding not in COLOURS:
        raise Incomplete(f"the pictures of camera {camera} ({frame.encoding}) have no colors here")
    return frame


def _base_pose(tick: GoalTick) -> list[float] | None:
    """x, y (m) and yaw (rad) of the base on its plane."""
    pose = tick.world.base_pose
    if pose is None:
        return None
    qx, qy, qz, qw = pose.quat_xyzw
    yaw = math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
    return [pose.xyz[0], pose.xyz[1], yaw]
