"""Dataset on disk through lerobot's own class: one episode at a time, in files of its own.

Runs in the writer's process only. lerobot's pictures go through a video encoder with a short queue
that drops what it cannot take, which would shift the pictures against the rows: this module waits
for a full queue and checks the video's length at the end.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypedDict

from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording.rows import TIMINGS, Row, RowFrame
from vram_arbiter.runner.sensors.pictures import as_rgb
from vram_arbiter.schemas.errors import ConfigError, InternalError
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame

REPO_ID = "local/recording"  # lerobot wants a name; nothing is ever pushed or pulled
VIDEO_CODEC = (
    "h264"  # plays everywhere; AV1, lerobot's default, takes several times the processor's time
)
VIDEO_CRF = 20  # visually close to the original
ENCODER_QUEUE = 16  # pictures a camera
ENCODER_WAIT_S = 60.0
ENCODER_POLL_S = 0.002
LENGTH_TOLERANCE = 0.5  # frames

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
    features: Features = {"action": _vector("float32", row["action_names"])}
    if row["state_names"]:  # a world may show nothing but pictures
        features = {"observation.state": _vector("float32", row["state_names"])} | features
    for frame in row["frames"]:
        height, width = frame["height"], frame["width"]
        if height % 2 or width % 2:
            raise ConfigError(
                f"camera {frame['camera']} gives {width} × {height} pixels;"
                " a video needs even numbers",
                hint="choose another size for it, or leave it out",
            )
        if _camera(frame["camera"]) in features:
            raise ConfigError(
                f"two cameras would have the column {_camera(frame['camera'])}",
                hint="rename one of them",
            )
        features[_camera(frame["camera"])] = {
            "dtype": "video",
            "shape": (height, width, 3),
            "names": ["height", "width", "channels"],
        }
    if row["base_pose"] is not None:
        features["base_pose"] = _vector("float32", ["x_m", "y_m", "yaw_rad"])
    if row["base_velocity"] is not None:
        features["base_velocity"] = _vector("float32", ["vx", "vy", "wz"])
    if row["reward"] is not None:
        features["next.reward"] = _one("float32")
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
        "observation.state": row["state"],
        "action": row["action"],
        "base_pose": row["base_pose"],
        "base_velocity": row["base_velocity"],
        "next.reward": row["reward"],
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
        column = features.get(_camera(said["camera"]))
        wanted = None if column is None else tuple(column["shape"])
        if tuple(rgb.shape) != wanted:
            raise ConfigError(
                f"camera {said['camera']} gives pictures of {rgb.shape}, the dataset has {wanted}",
                hint="record into a new folder",
            )
        frame[_camera(said["camera"])] = rgb
    return frame


class LerobotFiles:
    """`begin` → `add`… → `finish` or `abandon`, for each episode.

    In between the folder is committed.
    """

    def __init__(self, root: Path, *, fps: int, robot: str) -> None:
        import av
        from lerobot.configs import RGBEncoderConfig

        av.logging.set_libav_level(av.logging.ERROR)  # the encoder's statistics are noise
        self._root = root
        self._fps = fps
        self._robot = robot
        self._encoder = RGBEncoderConfig(vcodec=VIDEO_CODEC, preset="veryfast", crf=VIDEO_CRF)
        self._dataset: Any = None
        self._rows = 0
        self._pause = threading.Event()

    @property
    def rows(self) -> int:
        """Of the episode that is being written."""
        return self._rows

    def totals(self) -> tuple[int, int]:
        """Finished episodes and frames. Raises ConfigError when the dataset cannot be read."""
        if not (self._root / "meta" / "info.json").exists():
            return 0, 0
        meta = self._meta()
        return meta.total_episodes, meta.total_frames

    def begin(self, features: Features) -> Features:
        """Open an episode and return its columns.

        They are `features`, without the verdict where the folder's dataset has no column for it.
        Raises ConfigError when the folder's dataset has other columns or another rate.
        """
        from lerobot.datasets import LeRobotDataset

        commit.repair(self._root)  # of an episode that could not be abandoned either
        if commit.last(self._root) is None:
            self._create(features)
        meta = self._meta()
        if meta.fps != self._fps:
            raise ConfigError(
                f"{self._root} has {meta.fps} frames a second, this recording {self._fps}",
                hint="record into a new folder",
            )
        if SUCCESS not in meta.features:
            features = {name: feature for name, feature in features.items() if name != SUCCESS}
        if differences := _differences(meta.features, features):
            raise ConfigError(
                f"{self._root} was recorded with other columns: {differences}",
                hint="record into a new folder",
            )
        commit.begin(self._root)
        self._dataset = LeRobotDataset.resume(
            REPO_ID,
            root=self._root,
            video_backend="pyav",
            rgb_encoder=self._encoder,
            streaming_encoding=True,
            encoder_queue_maxsize=ENCODER_QUEUE,
            encoder_threads=1,
        )
        self._rows = 0
        return features

    def add(self, frame: Frame) -> None:
        """Add a row. Raises InternalError when the encoder hangs, ValueError for a row that does
        not fit.
        """
        self._await_encoder()
        self._dataset.add_frame(frame)
        self._rows += 1

    def finish(self, note: commit.EpisodeNote) -> int:
        """Close the episode's files, commit them with `note`, and return the episode's index.

        Raises InternalError for a video that lacks pictures.
        """
        dataset, self._dataset = self._dataset, None
        dataset.save_episode()
        episode = dataset.meta.latest_episode
        for key in dataset.meta.video_keys:
            length_s = (
                episode[f"videos/{key}/to_timestamp"][0]
                - episode[f"videos/{key}/from_timestamp"][0]
            )
            if abs(length_s * self._fps - self._rows) > LENGTH_TOLERANCE:
                raise InternalError(
                    f"the video of {key} has not the {self._rows} pictures of its episode"
                )
        dataset.finalize()
        index = int(episode["episode_index"][0])
        commit.commit(self._root, {**note, "episode": index, "frames": self._rows})
        self._rows = 0
        return index

    def abandon(self) -> None:
        """Forget the episode and what it left on disk; repeatable."""
        dataset, self._dataset = self._dataset, None
        self._rows = 0
        try:
            if dataset is not None:
                dataset.clear_episode_buffer()
                dataset.finalize()
        finally:
            commit.repair(self._root)

    # -- lerobot
    def _meta(self) -> Any:
        from datasets.exceptions import DatasetsError
        from lerobot.datasets import LeRobotDatasetMetadata

        try:
            return LeRobotDatasetMetadata(REPO_ID, root=self._root)
        except (OSError, ValueError, KeyError, DatasetsError) as error:
            raise ConfigError(
                f"the dataset in {self._root} cannot be read: {error.__cause__ or error}",
                hint="record into a new folder",
            ) from error

    def _create(self, features: Features) -> None:
        """Create the dataset beside its place and move it there, so that a crash leaves nothing
        half.
        """
        from lerobot.datasets import LeRobotDatasetMetadata

        creating = self._root / commit.FOLDER / "creating"
        shutil.rmtree(creating, ignore_errors=True)
        meta = LeRobotDatasetMetadata.create(
            REPO_ID, self._fps, features, robot_type=self._robot, root=creating, use_videos=True
        )
        meta.finalize()
        (creating / "meta").replace(self._root / "meta")
        creating.rmdir()
        commit.commit(self._root, None)

    def _await_encoder(self) -> None:
        encoder = self._dataset.writer._streaming_encoder
        if encoder is None:
            return
        waited_s = 0.0
        while any(pictures.full() for pictures in encoder._frame_queues.values()):
            if waited_s >= ENCODER_WAIT_S:
                raise InternalError(
                    f"the video encoder has taken no picture for {ENCODER_WAIT_S:.0f} s"
                )
            self._pause.wait(ENCODER_POLL_S)
            waited_s += ENCODER_POLL_S


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


def _camera(name: str) -> str:
    return f"observation.images.{name.replace('/', '_')}"


def _vector(dtype: str, names: Sequence[str]) -> Feature:
    return {"dtype": dtype, "shape": (len(names),), "names": list(names)}


def _one(dtype: str) -> Feature:
    return {"dtype": dtype, "shape": (1,), "names": None}


def _differences(there: Features, wanted: Features) -> str:
    """Columns that are not the same, but for those that lerobot adds itself."""
    from lerobot.utils.constants import DEFAULT_FEATURES

    def essence(feature: Feature | None) -> Any:
        if feature is None:
            return None
        return feature["dtype"], tuple(feature["shape"]), feature["names"]

    names = sorted((set(there) | set(wanted)) - set(DEFAULT_FEATURES))
    return ", ".join(
        name for name in names if essence(there.get(name)) != essence(wanted.get(name))
    )
