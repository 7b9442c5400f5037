"""Dataset on disk through lerobot's own class: one episode at a time, in files of its own.

Runs in the writer's process only. lerobot's pictures go through a video encoder with a short queue
that drops what it cannot take, which would shift the pictures against the rows: this module waits
for a full queue and checks the video's length at the end.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording.columns import SUCCESS, Features, LerobotFrame, differences
from vram_arbiter.schemas.errors import ConfigError, InternalError

REPO_ID = "local/recording"  # lerobot wants a name; nothing is ever pushed or pulled
# plays everywhere; AV1, lerobot's default, takes several times the processor's time
VIDEO_CODEC = "h264"
VIDEO_CRF = 20  # visually close to the original
ENCODER_QUEUE = 16  # pictures a camera
ENCODER_WAIT_S = 60.0
ENCODER_POLL_S = 0.002
LENGTH_TOLERANCE = 0.5  # frames


class LerobotFiles:
    """`begin` → `add`… → `finish` or `abandon`, for each episode.

    In between the folder is committed. Raises ConfigError for a folder that has a dataset of
    another robot or rate.
    """

    def __init__(self, root: Path, *, fps: int, robot: str, lerobot: bool) -> None:
        import av
        from lerobot.configs import RGBEncoderConfig

        av.logging.set_libav_level(av.logging.ERROR)  # the encoder's statistics are noise
        self.root = root
        self.rows = 0  # of the episode that is being written
        self._fps = fps
        self._robot = robot
        # lerobot merges videos of one codec only: a dataset of its columns has its default one
        self._encoder = (
            RGBEncoderConfig()
            if lerobot
            else RGBEncoderConfig(vcodec=VIDEO_CODEC, preset="veryfast", crf=VIDEO_CRF)
        )
        self._dataset: Any = None
        if self.exists:
            meta = self._meta()
            self._refuse(
                [f"{meta.fps} frames a second there, {fps} here"] * (meta.fps != fps)
                + [f"robot {meta.robot_type!r} there, {robot!r} here"] * (meta.robot_type != robot)
            )

    @property
    def exists(self) -> bool:
        return (self.root / "meta" / "info.json").exists()

    def totals(self) -> tuple[int, int]:
        """Finished episodes and frames."""
        if not self.exists:
            return 0, 0
        info = self._info()
        return info.total_episodes, info.total_frames

    def check(self, features: Features) -> None:
        """Compare an existing dataset with the columns of a recording, but for a world's verdict.

        Raises ConfigError that says what differs.
        """
        from lerobot.utils.constants import DEFAULT_FEATURES

        if self.exists:
            there = self._info().features
            self._refuse(differences(there, features, (*DEFAULT_FEATURES, SUCCESS)))

    def _refuse(self, found: list[str]) -> None:
        if found:
            raise ConfigError(
                f"{self.root} was recorded with other columns: {'; '.join(found)}",
                hint="record into a new folder",
                details={"differences": found},
            )

    def begin(self, features: Features) -> Features:
        """Open an episode and return its columns.

        They are `features`, without the verdict where the folder's dataset has no column for it.
        Raises ConfigError when the folder's dataset has other columns.
        """
        from lerobot.datasets import LeRobotDataset

        commit.repair(self.root)  # of an episode that could not be abandoned either
        if not self.exists:
            self._create(features)
        self.check(features)
        there = self._info().features
        if SUCCESS in there and SUCCESS not in features:
            self._refuse([f"{SUCCESS} ({there[SUCCESS]['dtype']} there, none here)"])
        commit.begin(self.root)
        self._dataset = self._read(
            lambda: LeRobotDataset.resume(
                REPO_ID,
                root=self.root,
                video_backend="pyav",
                rgb_encoder=self._encoder,
                streaming_encoding=True,
                encoder_queue_maxsize=ENCODER_QUEUE,
                encoder_threads=1,
            )
        )
        self.rows = 0
        return {name: feature for name, feature in features.items() if name in there}

    def add(self, frame: LerobotFrame) -> None:
        """Add a row. Raises InternalError when the encoder hangs, ValueError for a row that does
        not fit.
        """
        self._await_encoder()
        self._dataset.add_frame(frame)
        self.rows += 1

    def finish(self, note: commit.EpisodeNote) -> int:
        """Close the episode's files, commit them with `note`, and return the episode's index.

        Raises InternalError for a video that lacks pictures.
        """
        dataset, self._dataset = self._dataset, None
        dataset.save_episode()
        episode = dataset.meta.latest_episode
        for key in dataset.meta.video_keys:
            begins_s, ends_s = (
                episode[f"videos/{key}/{end}_timestamp"][0] for end in ("from", "to")
            )
            if abs((ends_s - begins_s) * self._fps - self.rows) > LENGTH_TOLERANCE:
                raise InternalError(
                    f"the video of {key} has not the {self.rows} pictures of its episode"
                )
        dataset.finalize()
        index = int(episode["episode_index"][0])
        commit.commit(self.root, {**note, "episode": index, "frames": self.rows})
        return index

    def abandon(self) -> None:
        """Forget the episode and what it left on disk; repeatable."""
        dataset, self._dataset = self._dataset, None
        self.rows = 0
        try:
            if dataset is not None:
                dataset.clear_episode_buffer()
                dataset.finalize()
        finally:
            commit.repair(self.root)

    # -- lerobot
    def _meta(self) -> Any:
        """Return the columns, totals, tasks and episodes: 0.5 s of a core for 80 columns."""
        from lerobot.datasets import LeRobotDatasetMetadata

        return self._read(lambda: LeRobotDatasetMetadata(REPO_ID, root=self.root))

    def _info(self) -> Any:
        """Return the columns and totals alone."""
        from lerobot.datasets.io_utils import load_info

        return self._read(lambda: load_info(self.root))

    def _read(self, load: Callable[[], Any]) -> Any:
        """Call lerobot; raise ConfigError for files that it cannot read."""
        from datasets.exceptions import DatasetsError

        try:
            return load()
        except (OSError, ValueError, KeyError, DatasetsError) as error:
            raise ConfigError(
                f"the dataset in {self.root} cannot be read: {error.__cause__ or error}",
                hint="record into a new folder",
            ) from error

    def _create(self, features: Features) -> None:
        """Create the dataset beside its place and move it there, so that a crash leaves nothing
        half.
        """
        from lerobot.datasets import LeRobotDatasetMetadata

        creating = self.root / commit.FOLDER / "creating"
        shutil.rmtree(creating, ignore_errors=True)
        meta = LeRobotDatasetMetadata.create(
            REPO_ID, self._fps, features, robot_type=self._robot, root=creating, use_videos=True
        )
        meta.finalize()
        (creating / "meta").replace(self.root / "meta")
        creating.rmdir()

    def _await_encoder(self) -> None:
        encoder = self._dataset.writer._streaming_encoder
        if encoder is None:
            return
        give_up_s = time.monotonic() + ENCODER_WAIT_S
        while any(pictures.full() for pictures in encoder._frame_queues.values()):
            if time.monotonic() > give_up_s:
                raise InternalError(
                    f"the video encoder has taken no picture for {ENCODER_WAIT_S:.0f} s"
                )
            time.sleep(ENCODER_POLL_S)
