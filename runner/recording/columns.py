"""Ticks as rows of a dataset: every column with its type, its names and its value.

Nothing is filled in: a tick that lacks a part of the row is refused with the reason. Units are
those of `schemas.world` (rad, m, s, and ms where a name says so), or lerobot's for this robot. Must
not import lerobot, and numpy only in the writer's process.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict

from vram_arbiter.runner.planar import yaw_of
from vram_arbiter.runner.protocols import GoalTick
from vram_arbiter.runner.robots.units import LerobotUnits
from vram_arbiter.runner.sensors.pictures import COLOURS, as_rgb
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.world import Pose, SensorFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray

TIMINGS = ("tick", "sensors", "world_state", "inference", "safety", "hal")
NO_CHUNK = -1  # chunk_index of a tick that was not played from a chunk
STATE, ACTION = "observation.state", "action"
PICTURES = "observation.images."
DONE = "next.done"
INTERVENTION = "intervention"  # as lerobot's `dagger` strategy of lerobot-rollout calls it
SUCCESS = "next.success"  # only of worlds that judge: a skill that says "done" does not know


class Column(NamedTuple):
    """One value of a row. `names` None: a single one."""

    dtype: str
    names: list[str] | None
    value: Any


class Feature(TypedDict):
    """One column of a LeRobotDataset."""

    dtype: str
    shape: tuple[int, ...]
    names: list[str] | None


Features = dict[str, Feature]
type LerobotFrame = dict[str, str | NDArray[Any]]
"""A row as lerobot takes it: texts and arrays by column."""


@dataclass(frozen=True, slots=True)
class Row:
    """One tick on its way to the dataset. `success` is the world's verdict; None: it gives none."""

    goal_id: str
    skill: str
    task: str
    trace_id: str
    success: bool | None
    columns: Mapping[str, Column]
    frames: Sequence[SensorFrame]


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


def row_of(tick: GoalTick, cameras: Sequence[str], lerobot: LerobotUnits | None = None) -> Row:
    """Return the row. Raises Incomplete.

    `lerobot` records by lerobot's names and units, and only the columns that lerobot records.
    """
    goal, result = tick.goal, tick.result
    frames = [_colours(tick.world.image_frames or {}, camera) for camera in cameras]
    trace = trace_of((result.trace_context or {}).get("traceparent"))
    skill = f"{goal.rskill_id}@{goal.revision}" if goal.revision else goal.rskill_id
    state, action = _joints(tick)
    if lerobot is not None:
        columns = {STATE: _vector(lerobot.named(state)), ACTION: _vector(lerobot.named(action))}
    else:
        columns = {STATE: _vector(state), ACTION: _vector(action), **_own(tick, frames, trace)}
        columns |= {"goal_id": _one("string", goal.goal_id), "skill": _one("string", skill)}
    task = goal.prompt or goal.rskill_id
    return Row(goal.goal_id, skill, task, trace[0], result.success, columns, frames)


def _own(
    tick: GoalTick, frames: Sequence[SensorFrame], trace: tuple[str, str, bool]
) -> dict[str, Column]:
    """Return the columns that lerobot does not record.

    Only cameras' columns may have `image` in their names: lerobot takes the statistics of all such
    columns for those of pictures.
    """
    world, result = tick.world, tick.result
    columns: dict[str, Column] = {}
    if world.base_pose is not None:
        columns["base_pose"] = _vector(_plane(world.base_pose))
    if tick.base_velocity is not None:
        columns["base_velocity"] = _vector(
            dict(zip(("vx", "vy", "wz"), tick.base_velocity, strict=True))
        )
    if result.success is not None:  # a column of booleans cannot say "not known": it is left out
        columns[SUCCESS] = _one("bool", False)
    if frames:
        ages_ms = {
            frame.sensor_id: max(0.0, (world.stamp_ns - frame.stamp_monotonic_ns) / 1e6)
            for frame in frames
        }
        columns["tick.camera_ages_ms"] = _vector(ages_ms)
    chunk = NO_CHUNK if result.chunk_index is None else result.chunk_index
    return columns | {
        DONE: _one("bool", False),
        INTERVENTION: _one("bool", tick.intervention),
        "tick.index": _one("int64", result.tick_idx),
        "tick.stamp_ns": _one("int64", result.stamp_ns),
        "tick.timings_ms": _vector({name: getattr(result, f"{name}_ms") for name in TIMINGS}),
        "tick.chunk_index": _one("int64", chunk),
        "tick.action_applied": _one("bool", result.action_applied),
        "tick.deadline_missed": _one("bool", result.deadline_missed),
        "tick.violations": _one("string", "; ".join(result.safety_violations)),
        "trace_id": _one("string", trace[0]),
        "span_id": _one("string", trace[1]),
        "trace_sampled": _one("bool", trace[2]),
    }


def _vector(values: Mapping[str, float]) -> Column:
    return Column("float32", list(values), list(values.values()))


def _one(dtype: str, value: Any) -> Column:
    return Column(dtype, None, value)


def _joints(tick: GoalTick) -> tuple[dict[str, float], dict[str, float]]:
    """Measured joints and their targets (rad)."""
    joints = tick.world.joint_state
    if not joints.name:
        raise Incomplete("the robot has no joints")
    if missing := [name for name in joints.name if name not in tick.targets]:
        raise Incomplete(f"joint {missing[0]} has no target yet")
    state = dict(zip(joints.name, joints.position, strict=True))
    return state, {name: tick.targets[name] for name in state}


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


def _colours(frames: Mapping[str, SensorFrame], camera: str) -> SensorFrame:
    frame = frames.get(camera)
    if frame is None:
        raise Incomplete(f"camera {camera} has no picture")
    if frame.data is None or frame.encoding not in COLOURS:
        raise Incomplete(f"the pictures of camera {camera} ({frame.encoding}) have no colors here")
    return frame


def _plane(pose: Pose) -> dict[str, float]:
    """x, y (m) and yaw (rad) of the base on its plane."""
    return {"x_m": pose.xyz[0], "y_m": pose.xyz[1], "yaw_rad": yaw_of(pose.quat_xyzw)}


# -- as lerobot takes them
def camera_column(name: str) -> str:
    """Return the column of a camera."""
    return f"{PICTURES}{name.replace('/', '_')}"


def features_of(row: Row) -> Features:
    """Return the dataset's columns. Raises ConfigError for pictures that a video cannot hold."""
    features: Features = {
        name: {"dtype": one.dtype, "shape": (len(one.names or "1"),), "names": one.names}
        for name, one in row.columns.items()
    }
    for frame in row.frames:
        if frame.height % 2 or frame.width % 2:
            raise ConfigError(
                f"camera {frame.sensor_id} gives {frame.width} × {frame.height} pixels;"
                " a video needs even numbers",
                hint="choose another size for it, or leave it out",
            )
        if (column := camera_column(frame.sensor_id)) in features:
            raise ConfigError(f"two cameras would have the column {column}", hint="rename one")
        shape, names = (frame.height, frame.width, 3), ["height", "width", "channels"]
        features[column] = {"dtype": "video", "shape": shape, "names": names}
    return features


def frame_of(row: Row, features: Features) -> LerobotFrame:
    """Return the row as lerobot takes it.

    Raises ModelError and FrameStale for a picture without colors, ConfigError for one of another
    size than the first.
    """
    import numpy as np

    made: LerobotFrame = {"task": row.task}
    for name, one in row.columns.items():
        if name in features:
            text = one.dtype == "string"
            made[name] = one.value if text else np.atleast_1d(np.asarray(one.value, one.dtype))
    for frame in row.frames:
        rgb, column = as_rgb(frame), camera_column(frame.sensor_id)
        wanted = tuple(features[column]["shape"]) if column in features else None
        if tuple(rgb.shape) != wanted:
            raise ConfigError(
                f"camera {frame.sensor_id} gives pictures of {rgb.shape}, the dataset has {wanted}",
                hint="record into a new folder",
            )
        made[column] = rgb
    return made


def differences(there: Features, wanted: Features, ignored: Sequence[str] = ()) -> list[str]:
    """Return what differs between a dataset's columns and those of a recording, one text each."""
    names = sorted((set(there) | set(wanted)) - set(ignored))
    return [
        f"{name} ({_said(there.get(name))} there, {_said(wanted.get(name))} here)"
        for name in names
        if _essence(there.get(name)) != _essence(wanted.get(name))
    ]


def _essence(feature: Feature | None) -> object:
    if feature is None:
        return None
    return feature["dtype"], tuple(feature["shape"]), feature["names"]


def _said(feature: Feature | None) -> str:
    if feature is None:
        return "none"
    if feature["dtype"] == "video":
        height, width, _ = feature["shape"]
        return f"{width} × {height} pixels"
    return ", ".join(feature["names"] or []) or feature["dtype"]
