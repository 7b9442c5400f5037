"""Recorder of a runner's goals: hands ticks from the control thread to the writer process.

The control thread only appends to a bounded queue. When the writer is slower than the robot, ticks
are dropped, counted and logged; when it dies, the robot continues and the loss is logged. Must not
import lerobot: that lives in the writer's process.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import socket
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.runner.protocols import Goal, GoalData, GoalTick, SkillEnded
from vram_arbiter.runner.recording import commit, wire
from vram_arbiter.runner.recording.rows import Incomplete, row_of
from vram_arbiter.schemas.errors import Cancelled, ConfigError, InternalError, VramError, from_wire

log = logging.getLogger("vram_arbiter.runner.recording")

QUEUE_TICKS = 90  # three seconds at 30 Hz
QUEUE_BYTES = 96 << 20
PATIENCE_S = 10.0  # without a rate nothing is late: the loop may wait so long for room
START_S = 180.0  # the writer imports torch; a minute on a busy machine
CLOSE_S = 120.0
REASONS_KEPT = 8
PACKAGES = ("lerobot", "datasets", "pyarrow", "pandas", "av")


@dataclass(frozen=True, slots=True)
class _End:
    goal: Goal
    ended: SkillEnded | None
    dropped: int


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


class DatasetRecorder:
    """`start()`, then `tick` and `goal_ended` on the control thread, then `close()`.

    Everything else may be read at any time. `cameras` is called for every tick, on a thread of its
    own: some worlds know theirs only after their first reset. `patient` waits for room instead of
    dropping; only where no tick has a deadline.
    """

    def __init__(
        self,
        root: Path,
        *,
        rate_hz: float,
        cameras: Callable[[], Sequence[str]],
        robot: str,
        patient: bool = False,
    ) -> None:
        self.root = root.absolute()
        self._fps = whole_rate(rate_hz)
        self._cameras = cameras
        self._robot = robot
        self._patient = patient
        self._room = threading.Condition()
        self._queue: deque[GoalTick | _End | None] = deque()  # None: the end of all
        self._queued = 0  # ticks in it
        self._queued_bytes = 0
        self._dropped_now = 0  # of the goal that runs
        self._process: subprocess.Popen[bytes] | None = None
        self._peer: socket.socket | None = None
        self._feeding: threading.Thread | None = None
        self._hearing: threading.Thread | None = None
        self._ready = threading.Event()
        self._closing = False
        self._aborted = False
        self._refused: VramError | None = None
        self.pid = 0  # of the writer
        self.dropped = 0
        self.incomplete: Counter[str] = Counter()  # ticks without a row, by reason
        self.episodes = 0  # of this run
        self.frames = 0
        self.skipped = 0  # goals of too few ticks to be an episode
        self.error: VramError | None = None  # the last thing that was not recorded

    # -- life
    def start(self) -> None:
        """Start the writer; return when it can take rows.

        Raises ConfigError for a folder that cannot be recorded into or missing packages,
        AlreadyRunning when another program records there, InternalError when the writer does not
        start.
        """
        if absent := [name for name in PACKAGES if importlib.util.find_spec(name) is None]:
            raise ConfigError(
                f"recording needs the packages {', '.join(absent)}",
                hint="pip install 'vram-arbiter[dataset]'",
            )
        commit.check_folder(self.root)
        ours, theirs = socket.socketpair()
        try:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-P",
                    "-m",
                    "vram_arbiter.runner.recording.writer",
                    str(theirs.fileno()),
                ],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=_environment(self.root),
                start_new_session=True,  # a Ctrl-C for the runner must not cut the episode off
            )
        finally:
            theirs.close()
        self._peer = ours
        self.pid = self._process.pid
        opening = {"root": str(self.root), "fps": self._fps, "robot": self._robot}
        wire.send(ours, opening)
        self._hearing = threading.Thread(target=self._hear, name="dataset-hear", daemon=True)
        self._hearing.start()
        came_up = self._ready.wait(START_S)
        if not came_up or self._aborted or self._refused is not None:
            self.abort()
            if self._refused is not None:
                raise self._refused
            if self._aborted and came_up:
                raise Cancelled("the recording was to end before it had begun")
            raise InternalError(f"the dataset's writer did not come up within {START_S:.0f} s")
        self._feeding = threading.Thread(target=self._feed, name="dataset-feed", daemon=True)
        self._feeding.start()

    def abort(self) -> None:
        """End a `start` that runs, from any thread before the first row; nothing is written."""
        self._aborted = True
        if self._peer is not None:
            with contextlib.suppress(OSError):  # it is gone already
                self._peer.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Finish the open episode and wait for the disk, at most CLOSE_S. Repeatable.

        The writer then ends by itself.
        """
        if self._feeding is None or self._process is None or self._closing:
            return
        with self._room:
            self._closing = True
            self._queue.append(None)
            self._room.notify_all()
        try:
            code = self._process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            log.warning(
                "the dataset is still being written, by process %d; it ends by itself", self.pid
            )
            return
        self._feeding.join()
        if self._hearing is not None:
            self._hearing.join()
        if self._peer is not None:
            self._peer.close()
        if code != 0:
            log.error("the dataset's writer ended with status %d", code)
        log.info("%s", self.summary())

    def facts(self) -> GoalData:
        """Return the facts of `runner.protocols.TickSink`: `dropped` and `left_out` count ticks,
        `skipped` goals.
        """
        return {
            "episodes": self.episodes,
            "frames": self.frames,
            "skipped": self.skipped,
            "dropped": self.dropped,
            "left_out": sum(self.incomplete.values()),
            "error": self.error.message if self.error is not None else None,
        }

    def summary(self) -> str:
        """Describe what was recorded, and what was not, in one line."""
        parts = [f"recorded {self.episodes} episodes, {self.frames} frames into {self.root}"]
        if self.skipped:
            parts.append(f"{self.skipped} goals were too short for an episode")
        if self.dropped:
            parts.append(f"{self.dropped} ticks were dropped: the writer was too slow")
        parts += [f"{count} ticks left out: {reason}" for reason, count in self.incomplete.items()]
        if self.error is not None:
            parts.append(f"NOT ALL WAS RECORDED: {self.error}")
        return "; ".join(parts)

    # -- control thread
    def tick(self, tick: GoalTick) -> None:
        """See `runner.protocols.TickSink`."""
        size = sum(len(frame.data or b"") for frame in (tick.world.image_frames or {}).values())
        with self._room:
            if self._patient:
                self._room.wait_for(lambda: self._fits(size) or self._lost, PATIENCE_S)
            if self._closing or self._lost:
                return
            if self._fits(size):
                self._queue.append(tick)
                self._queued += 1
                self._queued_bytes += size
                self._room.notify_all()
                return
            self.dropped += 1
            self._dropped_now += 1
            first = self._dropped_now == 1
        if first:
            log.warning(
                "goal %s: the dataset's writer is too slow; ticks are dropped from now on",
                tick.goal.goal_id,
            )

    def goal_ended(self, goal: Goal, ended: SkillEnded | None) -> None:
        """See `runner.protocols.TickSink`. Never dropped."""
        with self._room:
            if not self._closing:
                self._queue.append(_End(goal, ended, self._dropped_now))
                self._dropped_now = 0
                self._room.notify_all()

    def _fits(self, size: int) -> bool:
        return self._queued < QUEUE_TICKS and (
            self._queued_bytes + size <= QUEUE_BYTES or not self._queued
        )

    @property
    def _lost(self) -> bool:
        return self._process is not None and self._process.returncode is not None

    # -- the queue's other end
    def _feed(self) -> None:
        peer = self._peer
        assert peer is not None
        reasons: Counter[str] = Counter()
        while (item := self._next()) is not None:
            try:
                if isinstance(item, GoalTick):
                    row, pictures = row_of(item, self._cameras())
                    wire.send(peer, {"kind": "row", **row}, pictures)
                else:
                    wire.send(peer, {"kind": "end", **self._note(item, reasons)})
                    reasons = Counter()
            except Incomplete as error:
                if not reasons[str(error)]:
                    log.warning("ticks are left out of the dataset: %s", error)
                if str(error) in reasons or len(reasons) < REASONS_KEPT:
                    reasons[str(error)] += 1
                    self.incomplete[str(error)] += 1
            except (OSError, ValueError) as error:
                self._note_loss(InternalError(f"the dataset's writer does not take rows: {error}"))
        try:
            wire.send(peer, {"kind": "close"})
        except OSError:
            log.debug("the dataset's writer is gone")

    def _next(self) -> GoalTick | _End | None:
        with self._room:
            self._room.wait_for(lambda: bool(self._queue))
            item = self._queue.popleft()
            if isinstance(item, GoalTick):
                self._queued -= 1
                frames = (item.world.image_frames or {}).values()
                self._queued_bytes -= sum(len(frame.data or b"") for frame in frames)
                self._room.notify_all()
            return item

    @staticmethod
    def _note(end: _End, reasons: Counter[str]) -> commit.EpisodeNote:
        error = end.ended.error if end.ended is not None else None
        status = (
            "taken_back" if end.ended is None else "failed" if error is not None else "succeeded"
        )
        return {
            "goal_id": end.goal.goal_id,
            "status": status,
            "code": error.code if error is not None else "",
            "message": error.message if error is not None else "",
            "dropped": end.dropped,
            "incomplete": sum(reasons.values()),
            "reasons": dict(reasons),
        }

    # -- what the writer says
    def _hear(self) -> None:
        peer, process = self._peer, self._process
        assert peer is not None
        assert process is not None
        while (message := wire.receive(peer)) is not None:
            self._heard(message[0])
        if self._aborted:
            self._ready.set()
            return
        code = process.wait()
        if code != 0 and self._refused is None:
            self._note_loss(InternalError(f"the dataset's writer died (status {code})"))
            self._refused = self.error
        self._ready.set()
        with self._room:
            self._room.notify_all()

    def _heard(self, said: wire.Header) -> None:
        match said["kind"]:
            case "ready":
                for text in said["repaired"]:
                    log.warning("%s: an earlier recording was cut off: %s", self.root, text)
                if said["episodes"]:
                    log.info(
                        "%s has %d episodes, %d frames; more are added",
                        self.root,
                        said["episodes"],
                        said["frames"],
                    )
                self._ready.set()
            case "refused":
                self._refused = from_wire(said["error"])
                self._ready.set()
            case "episode":
                self.episodes += 1
                self.frames += said["frames"]
                log.info(
                    "goal %s is episode %d, %d frames",
                    said["goal_id"],
                    said["episode"],
                    said["frames"],
                )
            case "skipped":
                self.skipped += 1
                log.warning("goal %s is not recorded: %s", said["goal_id"], said["reason"])
            case "failed":
                self._note_loss(from_wire(said["error"]))

    def _note_loss(self, error: VramError) -> None:
        if self.error is None or self.error.message != error.message:
            log.error("not recorded: %s", error)
        self.error = error


def _environment(root: Path) -> dict[str, str]:
    """Return the writer's environment: no network look-ups, no user caches, no core of the loop."""
    return {
        **os.environ,
        "HF_HUB_OFFLINE": "1",
        "HF_DATASETS_OFFLINE": "1",
        "HF_DATASETS_CACHE": str(root / commit.FOLDER / commit.CACHE),
        "HF_DATASETS_DISABLE_PROGRESS_BARS": "1",
        "OMP_NUM_THREADS": "1",
    }
