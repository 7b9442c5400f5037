"""Dataset on disk through lerobot's own class: one episode at a time, in files of its own.

Runs in the writer's process only. lerobot's pictures go through a video encoder with a short queue
that drops what it cannot take, which would shift the pictures against the rows: this module waits
for a full queue and checks the video's length at the end.
"""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path
from typing import Any

from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording.columns import (
    ACTION,
    PICTURES,
    REWARD,
    STATE,
    SUCCESS,
    Columns,
    Features,
    Frame,
    camera_column,
    differences,
    own_columns,
)
from vram_arbiter.runner.recording.reader import TICKS_FILE
from vram_arbiter.schemas.errors import ConfigError, InternalError

REPO_ID = "local/recording"  # lerobot wants a name; nothing is ever pushed or pulled
VIDEO_CODEC = (
    "h264"  # plays everywhere; AV1, lerobot's default, takes several times the processor's time
)
VIDEO_CRF = 20  # visually close to the original
ENCODER_QUEUE = 16  # pictures a camera
ENCODER_WAIT_S = 60.0
ENCODER_POLL_S = 0.002
LENGTH_TOLERANCE = 0.5  # frames


class LerobotFiles:
    """`begin` → `add`… → `finish` or `abandon`, for each episode.

    In between the folder is committed.
    """

    def __init__(self, root: Path, *, fps: int, robot: str, columns: Columns = "full") -> None:
        import av
        from lerobot.configs import RGBEncoderConfig

        av.logging.set_libav_level(av.logging.ERROR)  # the encoder's statistics are noise
        self._root = root
        self._fps = fps
        self._robot = robot
        # lerobot merges videos of one codec only: a dataset of its columns has its default one
        self._encoder = (
            RGBEncoderConfig()
            if columns == "lerobot"
            else RGBEncoderConfig(vcodec=VIDEO_CODEC, preset="veryfast", crf=VIDEO_CRF)
        )
        self._columns: Columns = columns
        self._beside: Features = {}  # columns that the dataset does not have
        self._beside_rows: list[Frame] = []
        self._dataset: Any = None
        self._rows = 0
        self._pause = threading.Event()

    @property
    def root(self) -> Path:
        return self._root

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

    def check(self, units: str, joints: list[str], cameras: list[str] | None) -> None:
        """Compare an existing dataset with a recording, as far as it is known before a robot moves.

        Args: `joints` are the names of state and action. `units` and `joints` empty, `cameras`
        None: not known yet. Raises ConfigError that says what differs.
        """
        if commit.last(self._root) is None:
            return
        meta = self._meta()
        found = []
        if meta.fps != self._fps:
            found.append(f"{meta.fps} frames a second there, {self._fps} here")
        if meta.robot_type != self._robot:
            found.append(f"robot {meta.robot_type!r} there, {self._robot!r} here")
        known = [note.get("units", units) for note in commit.notes(self._root)[-1:]]
        if units and known and known[0] != units:
            found.append(f"units {known[0]!r} there, {units!r} here")
        if joints:
            for name in (STATE, ACTION):
                there = (meta.features.get(name) or {}).get("names") or []
                if there != joints:
                    found.append(f"{name} ({', '.join(there)} there, {', '.join(joints)} here)")
        seen = {name for name in meta.features if name.startswith(PICTURES)}
        if cameras is not None and seen != {camera_column(name) for name in cameras}:
            said = ", ".join(sorted(name.removeprefix(PICTURES) for name in seen))
            found.append(f"cameras ({said or 'none'} there, {', '.join(cameras) or 'none'} here)")
        self._refuse(found)

    def check_columns(self, features: Features) -> None:
        """Compare an existing dataset with the columns of a first row, but for a world's verdicts.

        Raises ConfigError that says what differs.
        """
        if commit.last(self._root) is not None:
            self._refuse(self._misfits(self._meta(), features, REWARD, SUCCESS))

    def _misfits(self, meta: Any, features: Features, *ignored: str) -> list[str]:
        from lerobot.utils.constants import DEFAULT_FEATURES

        if self._columns == "lerobot":
            features = {name: features[name] for name in features.keys() - own_columns(features)}
        return differences(meta.features, features, (*DEFAULT_FEATURES, *ignored))

    def _refuse(self, found: list[str]) -> None:
        if found:
            raise ConfigError(
                f"{self._root} was recorded with other columns: {'; '.join(found)}",
                hint="record into a new folder",
                details={"differences": found},
            )

    def begin(self, features: Features) -> Features:
        """Open an episode and return its columns.

        They are `features`, without the verdict where the folder's dataset has no column for it.
        Raises ConfigError when the folder's dataset has other columns or another rate.
        """
        from lerobot.datasets import LeRobotDataset

        commit.repair(self._root)  # of an episode that could not be abandoned either
        beside = own_columns(features) if self._columns == "lerobot" else set()
        if commit.last(self._root) is None:
            self._create({name: features[name] for name in features if name not in beside})
        meta = self._meta()
        if meta.fps != self._fps:
            self._refuse([f"{meta.fps} frames a second there, {self._fps} here"])
        if SUCCESS not in meta.features and SUCCESS not in beside:
            features = {name: feature for name, feature in features.items() if name != SUCCESS}
        self._refuse(self._misfits(meta, features))
        self._beside = {name: features[name] for name in features if name in beside}
        self._beside_rows = []
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
        if self._beside:
            self._beside_rows.append({name: frame[name] for name in self._beside})
            frame = {name: frame[name] for name in frame if name not in self._beside}
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
        self._write_beside(index)
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

    def _write_beside(self, episode: int) -> None:
        """Write the columns that the dataset does not have, with their names for the reader."""
        if not self._beside:
            return
        import pyarrow
        import pyarrow.parquet

        columns = {}
        for name, feature in self._beside.items():
            values = [row[name] for row in self._beside_rows]
            if feature["dtype"] != "string":
                lists = [value.tolist() for value in values]
                values = [value[0] for value in lists] if feature["names"] is None else lists
            columns[name] = values
        table = pyarrow.table(columns).replace_schema_metadata(
            {"features": json.dumps(self._beside)}
        )
        path = self._root / TICKS_FILE.format(episode)
        path.parent.mkdir(exist_ok=True)
        pyarrow.parquet.write_table(table, path)
        self._beside_rows = []

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
