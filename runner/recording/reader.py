"""One frame of a recorded dataset, with its trace and span. Needs neither lerobot nor torch.

Reads the last commit, also while a runner records into the folder. Datasets of other programs are
refused: their rows lead to no trace.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording.rows import NO_CHUNK, ROBOT
from vram_arbiter.schemas.errors import BadRequest, ConfigError

if TYPE_CHECKING:
    from vram_arbiter.runner.recording.columns import Features

TICKS_FILE = commit.TICKS + "/episode-{:06}.parquet"  # of a dataset with lerobot's columns only


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
    marked: str


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

    `state` and `action` are by joint (rad), or with `units` "own" by the names of their world, with
    "lerobot" by lerobot's;
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
    beside = TICKS_FILE.format(about["episode_index"])
    if beside in record["files"]:
        more, columns = _beside(root, beside)
        info = {**info, "features": {**info["features"], **columns}}
        row |= more[row["frame_index"]]
    notes = {note["episode"]: note for note in commit.notes(root)}
    return _recorded(root, info, about, row, notes.get(about["episode_index"], {}))


@dataclass(frozen=True, slots=True)
class EpisodeRows:
    """All rows of one episode, with the columns beside the dataset; `videos` by camera."""

    index: int
    note: commit.EpisodeNote
    features: Features
    rows: list[ParquetRow]
    videos: Mapping[str, Path]

    def named(self, row: ParquetRow, column: str) -> dict[str, float]:
        """Return the values of a column by name; empty without such a column."""
        return _named(self.features, row, column)


def read_episodes(root: Path, wanted: int | None = None) -> Iterator[EpisodeRows]:
    """Yield the committed episodes, or one of them.

    Raises ConfigError for a folder that cannot be read or is not one of ours, BadRequest for an
    episode that does not exist.
    """
    info, record = _open(root)
    names = [name for name in record["files"] if name.startswith("meta/episodes/")]
    episodes = _rows(root, names)
    if wanted is not None:
        episodes = [_episode(episodes, 0, wanted)]
    notes = {note["episode"]: note for note in commit.notes(root)}
    for about in episodes:
        index = about["episode_index"]
        path = info["data_path"].format(
            chunk_index=about["data/chunk_index"], file_index=about["data/file_index"]
        )
        rows = _rows(root, [path], ("episode_index", "==", index))
        features = info["features"]
        if (beside := TICKS_FILE.format(index)) in record["files"]:
            more, columns = _beside(root, beside)
            features = {**features, **columns}
            rows = [{**row, **extra} for row, extra in zip(rows, more, strict=True)]
        yield EpisodeRows(index, notes.get(index, {}), features, rows, _videos(root, info, about))


def _videos(root: Path, info: DatasetInfo, about: ParquetRow) -> dict[str, Path]:
    return {
        name.removeprefix("observation.images."): root
        / info["video_path"].format(
            video_key=name,
            chunk_index=about[f"videos/{name}/chunk_index"],
            file_index=about[f"videos/{name}/file_index"],
        )
        for name, feature in info["features"].items()
        if feature["dtype"] == "video"
    }


def _named(features: Features, row: ParquetRow, column: str) -> dict[str, float]:
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


def _beside(root: Path, name: str) -> tuple[list[ParquetRow], Features]:
    """Return an episode's rows of the columns that the dataset does not have, and those columns."""
    import pyarrow.parquet

    rows = _rows(root, [name])
    features: Features = json.loads(pyarrow.parquet.read_schema(root / name).metadata[b"features"])
    return rows, features


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
        return _named(features, row, column)

    pictures: dict[str, RecordedPicture] = {}
    for camera, video in _videos(root, info, about).items():
        begins_s = about[f"videos/observation.images.{camera}/from_timestamp"]
        pictures[camera] = {"path": str(video), "at_s": begins_s + row["timestamp"]}
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
    for key in ("status", "code", "message", "dropped", "incomplete", "marked"):
        if key in note:
            goal[key] = note[key]
    return goal


def _task(root: Path, index: int) -> str:
    for row in _rows(root, ["meta/tasks.parquet"]):
        if row["task_index"] == index:
            return str(next((value for name, value in row.items() if name != "task_index"), ""))
    return ""
