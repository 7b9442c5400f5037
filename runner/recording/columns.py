"""Columns of a dataset, and its rows as lerobot takes them.

A dataset has either all columns (`full`), or those that lerobot itself records (`lerobot`): the
others are then kept beside it. Must not import lerobot or know files.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, TypedDict

from vram_arbiter.runner.recording.rows import TIMINGS, Row, RowFrame
from vram_arbiter.runner.sensors.pictures import as_rgb
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame

Columns = Literal["full", "lerobot"]
"""All columns in the dataset, or only those that lerobot records, by its names and units."""

STATE, ACTION = "observation.state", "action"
PICTURES = "observation.images."
REWARD = "next.reward"
SUCCESS = "next.success"  # only of worlds that judge: a skill that says "done" does not know

Frame = dict[str, Any]
"""One row as lerobot takes it: arrays and texts by column."""


class Feature(TypedDict):
    """One column of a LeRobotDataset."""

    dtype: str
    shape: tuple[int, ...]
    names: list[str] | None


Features = dict[str, Feature]


def features_of(row: Row) -> Features:
    """Return the dataset's columns, from its first row.

    Only cameras' columns may have `image` in their names: lerobot takes the statistics of all such
    columns for those of pictures. Raises ConfigError for pictures that a video cannot hold.
    """
    features: Features = {ACTION: _vector("float32", row["action_names"])}
    if row["state_names"]:  # a world may show nothing but pictures
        features = {STATE: _vector("float32", row["state_names"])} | features
    for frame in row["frames"]:
        height, width = frame["height"], frame["width"]
        if height % 2 or width % 2:
            raise ConfigError(
                f"camera {frame['camera']} gives {width} × {height} pixels;"
                " a video needs even numbers",
                hint="choose another size for it, or leave it out",
            )
        if camera_column(frame["camera"]) in features:
            raise ConfigError(
                f"two cameras would have the column {camera_column(frame['camera'])}",
                hint="rename one of them",
            )
        features[camera_column(frame["camera"])] = {
            "dtype": "video",
            "shape": (height, width, 3),
            "names": ["height", "width", "channels"],
        }
    if row["base_pose"] is not None:
        features["base_pose"] = _vector("float32", ["x_m", "y_m", "yaw_rad"])
    if row["base_velocity"] is not None:
        features["base_velocity"] = _vector("float32", ["vx", "vy", "wz"])
    if row["reward"] is not None:
        features[REWARD] = _one("float32")
    if row["success"] is not None:  # a column of booleans cannot say "not known": it is left out
        features[SUCCESS] = _one("bool")
    if row["frames"]:
        features["tick.camera_ages_ms"] = _vector(
            "float32", [frame["camera"] for frame in row["frames"]]
        )
    return features | {
        "next.done": _one("bool"),
        "tick.index": _one("int64"),
        "tick.stamp_ns": _one("int64"),
        "tick.timings_ms": _vector("float32", list(TIMINGS)),
        "tick.chunk_index": _one("int64"),
        "tick.action_applied": _one("bool"),
        "tick.deadline_missed": _one("bool"),
        "tick.violations": _one("string"),
        "goal_id": _one("string"),
        "skill": _one("string"),
        "trace_id": _one("string"),
        "span_id": _one("string"),
        "trace_sampled": _one("bool"),
    }


def frame_of(row: Row, pictures: Sequence[bytes], features: Features) -> Frame:
    """Return the row as lerobot takes it.

    Raises ModelError and FrameStale for a picture without colors, ConfigError for one of another
    size than the first.
    """
    import numpy as np

    values: Frame = {
        STATE: row["state"],
        ACTION: row["action"],
        "base_pose": row["base_pose"],
        "base_velocity": row["base_velocity"],
        REWARD: row["reward"],
        "next.done": False,
        SUCCESS: False,
        "tick.index": row["tick_idx"],
        "tick.stamp_ns": row["stamp_ns"],
        "tick.timings_ms": row["timings_ms"],
        "tick.chunk_index": row["chunk_index"],
        "tick.action_applied": row["action_applied"],
        "tick.deadline_missed": row["deadline_missed"],
        "tick.violations": row["violations"],
        "tick.camera_ages_ms": row["ages_ms"],
        "goal_id": row["goal_id"],
        "skill": row["skill"],
        "trace_id": row["trace_id"],
        "span_id": row["span_id"],
        "trace_sampled": row["sampled"],
    }
    frame: Frame = {"task": row["task"]}
    for name, feature in features.items():
        if feature["dtype"] == "video" or name not in values:
            continue
        value = values[name]
        if feature["dtype"] == "string":
            frame[name] = value
        elif value is not None:
            frame[name] = np.atleast_1d(np.asarray(value, dtype=feature["dtype"]))
    for said, data in zip(row["frames"], pictures, strict=True):
        rgb = as_rgb(_picture(said, data))
        column = features.get(camera_column(said["camera"]))
        wanted = None if column is None else tuple(column["shape"])
        if tuple(rgb.shape) != wanted:
            raise ConfigError(
                f"camera {said['camera']} gives pictures of {rgb.shape}, the dataset has {wanted}",
                hint="record into a new folder",
            )
        frame[camera_column(said["camera"])] = rgb
    return frame


def _picture(said: RowFrame, data: bytes) -> SensorFrame:
    return SensorFrame(
        sensor_id=said["camera"],
        stamp_monotonic_ns=0,
        stamp_wall_ns=0,
        encoding=FrameEncoding(said["encoding"]),
        width=said["width"],
        height=said["height"],
        data=data,
    )


def camera_column(name: str) -> str:
    """Return the column of a camera."""
    return f"{PICTURES}{name.replace('/', '_')}"


def _vector(dtype: str, names: Sequence[str]) -> Feature:
    return {"dtype": dtype, "shape": (len(names),), "names": list(names)}


def _one(dtype: str) -> Feature:
    return {"dtype": dtype, "shape": (1,), "names": None}


def own_columns(features: Features) -> set[str]:
    """Return the columns that lerobot does not record."""
    return {
        name for name in features if name not in (STATE, ACTION) and not name.startswith(PICTURES)
    }


def differences(there: Features, wanted: Features, ignored: Sequence[str] = ()) -> list[str]:
    """Return what differs between a dataset's columns and those of a recording, one text each."""
    names = sorted((set(there) | set(wanted)) - set(ignored))
    return [
        f"{name} ({_said(there.get(name))} there, {_said(wanted.get(name))} here)"
        for name in names
        if _essence(there.get(name)) != _essence(wanted.get(name))
    ]


def _essence(feature: Feature | None) -> tuple[str, tuple[int, ...], list[str] | None] | None:
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
