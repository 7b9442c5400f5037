"""Frames of a recorded dataset, with their traces and spans. Needs neither lerobot nor torch.

Reads finished episodes only, also while a runner records into the folder. Datasets of other
programs, and those with lerobot's columns only, are refused: their rows lead to no trace.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypedDict

from pydantic import TypeAdapter

from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording.columns import (
    ACTION,
    DONE,
    NO_CHUNK,
    PICTURES,
    STATE,
    SUCCESS,
    Features,
    camera_column,
)
from vram_arbiter.schemas.errors import BadRequest, ConfigError

ParquetRow = dict[str, Any]
"""One row of a table that lerobot wrote, by column."""

_GOAL: Final = TypeAdapter(commit.GoalNote)


class Info(TypedDict):
    """What is read of lerobot's `meta/info.json`."""

    features: Features
    robot_type: str | None
    video_path: str


class RecordedTick(TypedDict):
    """Facts of one tick; `chunk_index` is None without a chunk, `success` where nothing judged."""

    index: int
    stamp_ns: int
    chunk_index: int | None
    action_applied: bool
    deadline_missed: bool
    violations: str
    done: bool
    success: bool | None


class RecordedPicture(TypedDict):
    """Place of a picture: its video's path, the second in it, and the picture's age (ms)."""

    path: str
    at_s: float
    age_ms: float


@dataclass(frozen=True, slots=True)
class Recorded:
    """One frame.

    `state` and `action` are by joint (rad); `timings_ms` by part of the tick; `pictures` by camera.
    The end of `goal` is that of its episode.
    """

    root: str
    robot: str
    frame: int
    episode: int
    frame_in_episode: int
    at_s: float
    task: str
    goal: commit.GoalNote
    trace_id: str
    span_id: str
    trace_sampled: bool
    tick: RecordedTick
    timings_ms: Mapping[str, float]
    state: Mapping[str, float]
    action: Mapping[str, float]
    base: Mapping[str, Mapping[str, float]]
    pictures: Mapping[str, RecordedPicture]
    complete: bool  # False: a recording is under way, or was cut off


def read_frame(root: Path, frame: int, episode: int | None = None) -> Recorded:
    """Read frame `frame` of the dataset, or of one of its episodes.

    Raises ConfigError for a folder that cannot be read or is not one of ours, BadRequest for a
    frame or an episode that does not exist.
    """
    info = _info(root)
    about = _episode(_rows(root, "meta/episodes"), frame, episode)
    index = about["dataset_from_index"] + frame if episode is not None else frame
    return _frames(root, info, about, ("index", "==", index), 1)[0]


def read_episode(root: Path, episode: int) -> list[Recorded]:
    """Read all frames of an episode, in their order. Raises as `read_frame`."""
    info = _info(root)
    about = _episode(_rows(root, "meta/episodes"), 0, episode)
    where = ("episode_index", "==", episode)
    return sorted(_frames(root, info, about, where, about["length"]), key=lambda one: one.frame)


def _frames(
    root: Path, info: Info, about: ParquetRow, where: tuple[str, str, int], count: int
) -> list[Recorded]:
    rows = _rows(root, "data", where)
    if len(rows) != count:
        raise ConfigError(
            f"{root} has {len(rows)} frames of {count} with {where[0]} {where[2]}",
            hint="restore its files",
        )
    if "trace_id" not in rows[0]:
        raise ConfigError(
            f"{root} has the columns of lerobot only, and no ticks", hint="record it in full"
        )
    noted = {note["episode"]: note for note in commit.notes(root)}
    note = noted.get(about["episode_index"], commit.EpisodeNote())
    return [_recorded(root, info, about, row, note) for row in rows]


def _info(root: Path) -> Info:
    if not commit.is_ours(root):
        raise ConfigError(
            f"{root} is not a dataset that this program recorded",
            hint="name the folder that --record or save_dir named",
        )
    path = root / "meta" / "info.json"
    try:
        info: Info = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path} cannot be read: {error}", hint="the next recording into the folder repairs it"
        ) from error
    return info


def _rows(root: Path, folder: str, where: tuple[str, str, int] | None = None) -> list[ParquetRow]:
    """Return the rows of the tables below a folder."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError(
            f"datasets are read with pyarrow: {error}", hint="pip install 'vram-arbiter[dataset]'"
        ) from error
    found: list[ParquetRow] = []
    for path in commit.finished_files(root, folder):
        try:
            table = pyarrow.parquet.read_table(path, filters=where and [where])
        except (OSError, ValueError, pyarrow.ArrowException) as error:
            raise ConfigError(f"{path} cannot be read: {error}", hint="restore the file") from error
        kept = [name for name in table.column_names if not name.startswith("stats/")]
        found += table.select(kept).to_pylist()
    return found


def _episode(episodes: list[ParquetRow], frame: int, wanted: int | None) -> ParquetRow:
    for about in episodes:
        if wanted is None and about["dataset_from_index"] <= frame < about["dataset_to_index"]:
            return about
        if wanted == about["episode_index"]:
            if frame < about["length"]:
                return about
            hint = f"0 to {about['length'] - 1}"
            raise BadRequest(f"episode {wanted} has no frame {frame}", hint=hint)
    if wanted is not None:
        hint = f"there are {len(episodes)}, from 0 on"
        raise BadRequest(f"unknown episode {wanted}", hint=hint)
    last = max((about["dataset_to_index"] for about in episodes), default=0) - 1
    hint = f"0 to {last}" if last >= 0 else "nothing is recorded yet"
    raise BadRequest(f"unknown frame {frame}", hint=hint)


def _recorded(
    root: Path,
    info: Info,
    about: ParquetRow,
    row: ParquetRow,
    note: commit.EpisodeNote,
) -> Recorded:
    features = info["features"]

    def named(column: str) -> dict[str, float]:
        values = row.get(column, [])  # of a single number lerobot makes a plain one
        listed = values if isinstance(values, list) else [values]
        names = features[column]["names"] if column in features else None
        return dict(zip(names or [], listed, strict=True))

    ages_ms = {camera_column(name): age for name, age in named("tick.camera_ages_ms").items()}
    pictures: dict[str, RecordedPicture] = {}
    for column, feature in features.items():
        if feature["dtype"] == "video":
            video = info["video_path"].format(
                video_key=column,
                chunk_index=about[f"videos/{column}/chunk_index"],
                file_index=about[f"videos/{column}/file_index"],
            )
            at_s = about[f"videos/{column}/from_timestamp"] + row["timestamp"]
            name, path = column.removeprefix(PICTURES), str(root / video)
            pictures[name] = {"path": path, "at_s": at_s, "age_ms": ages_ms[column]}
    chunk_index = row["tick.chunk_index"]
    tick: RecordedTick = {
        "index": row["tick.index"],
        "stamp_ns": row["tick.stamp_ns"],
        "chunk_index": None if chunk_index == NO_CHUNK else chunk_index,
        "action_applied": row["tick.action_applied"],
        "deadline_missed": row["tick.deadline_missed"],
        "violations": row["tick.violations"],
        "done": row[DONE],
        "success": row.get(SUCCESS),
    }
    return Recorded(
        root=str(root),
        robot=info.get("robot_type") or "",
        frame=row["index"],
        episode=row["episode_index"],
        frame_in_episode=row["frame_index"],
        at_s=row["timestamp"],
        task=str(note.get("task", "")),
        goal=_GOAL.validate_python({**note, "goal_id": row["goal_id"], "skill": row["skill"]}),
        trace_id=row["trace_id"],
        span_id=row["span_id"],
        trace_sampled=row["trace_sampled"],
        tick=tick,
        timings_ms=named("tick.timings_ms"),
        state=named(STATE),
        action=named(ACTION),
        base={"pose": named("base_pose"), "velocity": named("base_velocity")},
        pictures=pictures,
        complete=commit.opened(root) is None,
    )
