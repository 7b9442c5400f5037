"""One frame of a recorded dataset, with its trace and span. Needs neither lerobot nor torch.

Reads the last commit, also while a runner records into the folder. Datasets of other programs are
refused: their rows lead to no trace.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording.rows import NO_CHUNK, ROBOT
from vram_arbiter.schemas.errors import BadRequest, ConfigError

if TYPE_CHECKING:
    from vram_arbiter.runner.recording.lerobot_files import Features

EPISODE_COLUMNS = ("episode_index", "length", "dataset_from_index", "dataset_to_index")


ParquetRow = dict[str, Any]
"""One row of a table that lerobot wrote, by column."""


class DatasetInfo(TypedDict):
    """Part of `meta/info.json` that is read here."""

    robot_type: str | None
    data_path: str
    video_path: str
    features: Features


class RecordedGoal(TypedDict, total=False):
    """Goal of a recorded frame; its end is known once the episode is committed."""

    goal_id: str
    skill: str
    status: str
    code: str
    message: str
    dropped: int
    incomplete: int


class RecordedTick(TypedDict):
    """Tick of a recorded frame. `success` None: the world did not judge."""

    index: int
    stamp_ns: int
    chunk_index: int | None
    action_applied: bool
    deadline_missed: bool
    violations: str
    done: bool
    success: bool | None


class RecordedPicture(TypedDict):
    """Place of a picture: its video and the second in it."""

    path: str
    at_s: float


@dataclass(frozen=True, slots=True)
class Recorded:
    """One frame.

    `state` and `action` are by joint (rad), or with `units` "own" by the names of their world;
    `timings_ms` by part of the tick; `pictures` maps a camera to its video's path and the second in
    it.
    """

    root: str
    robot: str
    frame: int
    episode: int
    frame_in_episode: int
    at_s: float
    task: str
    goal: RecordedGoal
    trace_id: str
    span_id: str
    trace_sampled: bool
    tick: RecordedTick
    timings_ms: Mapping[str, float]
    state: Mapping[str, float]
    action: Mapping[str, float]
    units: str
    base: Mapping[str, Mapping[str, float]]
    pictures: Mapping[str, RecordedPicture]
    complete: bool  # False: a recording is under way, or was cut off


def read_frame(root: Path, frame: int, episode: int | None = None) -> Recorded:
    """Read frame `frame` of the dataset, or of one of its episodes.

    Raises ConfigError for a folder that cannot be read or is not one of ours, BadRequest for a
    frame or an episode that does not exist.
    """
    info, record = _open(root)
    names = [name for name in record["files"] if name.startswith("meta/episodes/")]
    about = _episode(_rows(root, names), frame, episode)
    index = about["dataset_from_index"] + frame if episode is not None else frame
    path = info["data_path"].format(
        chunk_index=about["data/chunk_index"], file_index=about["data/file_index"]
    )
    rows = _rows(root, [path], ("index", "==", index))
    if len(rows) != 1:
        raise ConfigError(f"{root / path} does not have frame {index}", hint="restore the file")
    row = rows[0]
    notes = {note["episode"]: note for note in commit.notes(root)}
    return _recorded(root, info, about, row, notes.get(about["episode_index"], {}))


def _open(root: Path) -> tuple[DatasetInfo, commit.Commit]:
    record = commit.last(root)
    if record is None:
        raise ConfigError(
            f"{root} is not a dataset that this program recorded",
            hint="name the folder that --record or save_dir named",
        )
    try:
        info: DatasetInfo = json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{root / 'meta' / 'info.json'} cannot be read: {error}",
            hint="the next recording into the folder repairs it",
        ) from error
    return info, record


def _rows(
    root: Path, names: list[str], where: tuple[str, str, int] | None = None
) -> list[ParquetRow]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError(
            f"datasets are read with pyarrow: {error}", hint="pip install 'vram-arbiter[dataset]'"
        ) from error
    rows: list[ParquetRow] = []
    for name in sorted(names):
        try:
            table = pyarrow.parquet.read_table(
                root / name, filters=[where] if where is not None else None
            )
        except (OSError, ValueError, pyarrow.ArrowException) as error:
            raise ConfigError(
                f"{root / name} cannot be read: {error}", hint="restore the file"
            ) from error
        rows += table.select(
            [each for each in table.column_names if not each.startswith("stats/")]
        ).to_pylist()
    return rows


def _episode(episodes: list[ParquetRow], frame: int, wanted: int | None) -> ParquetRow:
    if wanted is not None:
        for about in episodes:
            if about["episode_index"] == wanted:
                if frame >= about["length"]:
                    raise BadRequest(
                        f"episode {wanted} has no frame {frame}", hint=f"0 to {about['length'] - 1}"
                    )
                return about
        raise BadRequest(
            f"there is no episode {wanted}", hint=f"there are {len(episodes)}, from 0 on"
        )
    for about in episodes:
        if about["dataset_from_index"] <= frame < about["dataset_to_index"]:
            return about
    last = max((about["dataset_to_index"] for about in episodes), default=0) - 1
    raise BadRequest(
        f"there is no frame {frame}",
        hint=f"0 to {last}" if last >= 0 else "nothing is recorded yet",
    )


def _recorded(
    root: Path,
    info: DatasetInfo,
    about: ParquetRow,
    row: ParquetRow,
    note: commit.EpisodeNote,
) -> Recorded:
    features = info["features"]

    def named(column: str) -> dict[str, float]:
        if column not in features:
            return {}
        values = row[column]  # of a single number lerobot makes a column of plain numbers
        return dict(
            zip(
                features[column]["names"] or [],
                values if isinstance(values, list) else [values],
                strict=True,
            )
        )

    pictures: dict[str, RecordedPicture] = {}
    for name, feature in features.items():
        if feature["dtype"] == "video":
            video = info["video_path"].format(
                video_key=name,
                chunk_index=about[f"videos/{name}/chunk_index"],
                file_index=about[f"videos/{name}/file_index"],
            )
            at_s = about[f"videos/{name}/from_timestamp"] + row["timestamp"]
            pictures[name.removeprefix("observation.images.")] = {
                "path": str(root / video),
                "at_s": at_s,
            }
    return Recorded(
        root=str(root),
        robot=info.get("robot_type") or "",
        frame=row["index"],
        episode=row["episode_index"],
        frame_in_episode=row["frame_index"],
        at_s=row["timestamp"],
        task=_task(root, row["task_index"]),
        goal=_goal(row, note),
        trace_id=row["trace_id"],
        span_id=row["span_id"],
        trace_sampled=row["trace_sampled"],
        tick={
            "index": row["tick.index"],
            "stamp_ns": row["tick.stamp_ns"],
            "chunk_index": None if row["tick.chunk_index"] == NO_CHUNK else row["tick.chunk_index"],
            "action_applied": row["tick.action_applied"],
            "deadline_missed": row["tick.deadline_missed"],
            "violations": row["tick.violations"],
            "done": row["next.done"],
            "success": row.get("next.success"),  # None: no world judged
        },
        timings_ms=named("tick.timings_ms"),
        state=named("observation.state"),
        action=named("action"),
        units=str(note.get("units", ROBOT)),
        base={"pose": named("base_pose"), "velocity": named("base_velocity")},
        pictures=pictures,
        complete=not (root / commit.FOLDER / commit.OPEN).exists(),
    )


def _goal(row: ParquetRow, note: commit.EpisodeNote) -> RecordedGoal:
    goal: RecordedGoal = {"goal_id": row["goal_id"], "skill": row["skill"]}
    for key in ("status", "code", "message", "dropped", "incomplete"):
        if key in note:
            goal[key] = note[key]
    return goal


def _task(root: Path, index: int) -> str:
    for row in _rows(root, ["meta/tasks.parquet"]):
        if row["task_index"] == index:
            return str(next((value for name, value in row.items() if name != "task_index"), ""))
    return ""
