"""Recorder of a runner's goals: hands ticks from the control thread to the writer process.

The control thread only appends to a bounded queue. When the writer is slower than the robot, ticks
are dropped, counted and logged. A writer that dies costs the episode in its hands and ends the
recording, which is logged. Must not import lerobot: that lives in the writer's process.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import queue
import socket
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, TypedDict

from vram_arbiter.runner.protocols import Goal, GoalData, GoalTick, SkillEnded
from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording.columns import Incomplete, row_of, whole_rate
from vram_arbiter.runner.recording.counts import Counts
from vram_arbiter.runner.robots.units import LerobotUnits
from vram_arbiter.schemas.errors import (
    BadState,
    Cancelled,
    ConfigError,
    InternalError,
    VramError,
    from_wire,
)
from vram_arbiter.schemas.plain import JsonObject

log = logging.getLogger("vram_arbiter.runner.recording")

QUEUE_TICKS = 90  # three seconds at 30 Hz
QUEUE_BYTES = 96 << 20
PATIENCE_S = 10.0  # without a rate nothing is late: the loop may wait so long for room
START_S = 180.0  # the writer imports torch; a minute on a busy machine
CLOSE_S = 120.0
LOOK_S = 1.0  # between two looks at a writer that has nothing to do
ANSWER_S = 60.0  # of a writer that may be closing an episode's files
REASONS_KEPT = 8
PACKAGES = ("lerobot", "datasets", "pyarrow", "pandas", "av")
UNITS, LEROBOT_UNITS = "rad", "lerobot"

Verdict = Literal["success", "failure", "discard"]


class Marked(TypedDict):
    """An operator's verdict in force. `episode` None: the goal is still being recorded."""

    goal_id: str
    episode: int | None
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class _Tick:
    tick: GoalTick
    size: int  # bytes of its pictures


@dataclass(frozen=True, slots=True)
class _End:
    goal: Goal
    ended: SkillEnded | None
    dropped: int


@dataclass(frozen=True, slots=True)
class _Ask:
    """A message to the writer, and the future of its answer."""

    message: tuple[Any, ...]
    answer: Future[JsonObject] = field(default_factory=Future)


class _Room:
    """Room of the queue for ticks; an empty one takes any."""

    def __init__(self) -> None:
        self._ticks = self._bytes = 0
        self._changed = threading.Condition()

    def take(self, size: int, wait_s: float) -> bool:
        """Take a place, waiting for one as long as that. Return whether there was one."""

        def free() -> bool:
            fits = self._ticks < QUEUE_TICKS and self._bytes + size <= QUEUE_BYTES
            return fits or not self._ticks

        with self._changed:
            if not self._changed.wait_for(free, wait_s):
                return False
            self._ticks, self._bytes = self._ticks + 1, self._bytes + size
        return True

    def give(self, size: int) -> None:
        with self._changed:
            self._ticks, self._bytes = self._ticks - 1, self._bytes - size
            self._changed.notify()


class DatasetRecorder:
    """`start()`, then `tick` and `goal_ended` on the control thread, then `close()`.

    Everything else may be read at any time. `lerobot` records by lerobot's names and units, with
    its columns only. `patient` waits for room instead of dropping; only where no tick has a
    deadline. `strict` is for what is played for the recording alone: a goal that cannot be recorded
    is a loss. `on_lost` is called, on any thread, when nothing more can be recorded, after the goal
    that runs; after a loss of a strict recording at once.
    """

    def __init__(
        self,
        root: Path,
        *,
        rate_hz: float,
        cameras: Sequence[str],
        robot: str,
        lerobot: LerobotUnits | None = None,
        patient: bool = False,
        strict: bool = False,
        on_lost: Callable[[], None] = lambda: None,
    ) -> None:
        self.root = root.absolute()
        self.counts = Counts(self.root)
        self.lost: VramError | None = None  # why nothing more can be recorded
        self.pid = 0  # of the writer; 0 before the start
        self._fps = whole_rate(rate_hz)
        self._cameras = tuple(cameras)
        self._robot = robot if lerobot is None else lerobot.robot_type
        self._lerobot = lerobot
        self._wait_s = PATIENCE_S if patient else 0.0
        self._strict = strict
        self._on_lost = on_lost
        self._queue: queue.SimpleQueue[_Tick | _End | _Ask | None] = queue.SimpleQueue()
        self._room = _Room()
        self._changing = threading.Lock()  # guards `lost`, `_closing` and `_goal_runs`
        self._goal_runs = False
        self._closing = False
        self._aborted = False
        self._dropped_now = 0  # of the goal that runs
        self._ours, self._theirs = socket.socketpair()
        self._writer = Connection(os.dup(self._ours.fileno()))
        self._feeding = threading.Thread(target=self._feed, name="dataset-feed", daemon=True)

    # -- life
    def start(self) -> None:
        """Start the writer; return when it can take rows.

        Raises ConfigError for missing packages, for a folder that cannot be recorded into and for
        a dataset of another robot or rate, AlreadyRunning when another program records there,
        Cancelled after `abort`, InternalError when the writer does not start.
        """
        if absent := [name for name in PACKAGES if importlib.util.find_spec(name) is None]:
            raise ConfigError(
                f"recording needs the packages {', '.join(absent)}",
                hint="pip install 'vram-arbiter[dataset]'",
            )
        commit.check_folder(self.root)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "vram_arbiter.runner.recording.writer",
             str(self._theirs.fileno())],
            pass_fds=[self._theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            env=_environment(self.root),
            start_new_session=True,  # a Ctrl-C for the runner must not cut the episode off
        )  # fmt: skip
        self._theirs.close()
        self.pid = self._process.pid
        units = UNITS if self._lerobot is None else LEROBOT_UNITS
        try:
            self._writer.send(
                {"root": str(self.root), "fps": self._fps, "robot": self._robot, "units": units}
            )
            if not self._writer.poll(START_S):
                raise InternalError(f"the dataset's writer did not come up within {START_S:.0f} s")
            self._ready(self._answered())
        except (VramError, OSError, EOFError) as error:
            aborted = self._aborted
            self.abort()
            if aborted and not isinstance(error, VramError):
                raise Cancelled("the recording was to end before it had begun") from error
            raise self._typed(error) from error
        self._feeding.start()

    def _ready(self, said: JsonObject) -> None:
        for text in said["repaired"]:
            log.warning("%s: an earlier recording was cut off: %s", self.root, text)
        if said["episodes"]:
            there = "%s has %d episodes, %d frames; more are added"
            log.info(there, self.root, said["episodes"], said["frames"])

    def abort(self) -> None:
        """End a `start` that runs, from any thread before the first row; nothing is written."""
        self._aborted = True
        with contextlib.suppress(OSError):  # it is gone already
            self._ours.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Finish the open episode and wait for the disk, at most CLOSE_S. Repeatable.

        The writer then ends by itself.
        """
        if self._closing or not self._feeding.ident:
            return
        with self._changing:
            self._closing = True
        self._queue.put(None)
        self._feeding.join(CLOSE_S)
        try:
            code = self._process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            log.warning("process %d still writes the dataset; it ends by itself", self.pid)
            return
        self._ours.close()
        if code != 0 and self.lost is None:
            self.counts.lose(InternalError(f"the dataset's writer died (status {code})"))
        log.info("%s", self.counts.summary())

    def facts(self) -> GoalData:
        """See `runner.protocols.TickSink`."""
        return self.counts.facts()

    # -- any thread
    def check(self, sample: GoalTick) -> None:
        """Compare a tick that is not recorded with an existing dataset. Blocks.

        Raises ConfigError that says what differs, or why no tick could be recorded.
        """
        try:
            row = row_of(sample, self._cameras, self._lerobot)
        except Incomplete as error:
            raise ConfigError(f"nothing could be recorded: {error}") from error
        self._ask("check", row)

    def mark(self, goal_id: str, verdict: Verdict) -> Marked:
        """Note the operator's verdict on the goal that runs, or the last one. Blocks.

        An empty `goal_id` means that goal. Raises BadRequest for another one, BadState.
        """
        said = self._ask("mark", goal_id, verdict)
        if verdict == "discard" and said["episode"] is not None:
            self.counts.episodes -= 1
            self.counts.frames -= said["frames"]
            self.counts.discarded += 1
        log.info("goal %s is marked as %s", said["goal_id"], verdict)
        return {"goal_id": said["goal_id"], "episode": said["episode"], "verdict": verdict}

    def _ask(self, *message: Any) -> JsonObject:
        ask = _Ask(message)
        with self._changing:
            if self._closing or self.lost is not None:
                raise BadState("nothing is recorded any more", hint="see the runner's log")
            self._queue.put(ask)
        try:
            return ask.answer.result(ANSWER_S)
        except TimeoutError:
            raise BadState(f"the dataset's writer gave no answer for {ANSWER_S:.0f} s") from None

    # -- control thread
    def tick(self, tick: GoalTick) -> None:
        """See `runner.protocols.TickSink`."""
        self._goal_runs = True
        if self._closing or self.lost is not None:
            return
        size = sum(len(frame.data or b"") for frame in (tick.world.image_frames or {}).values())
        if self._room.take(size, self._wait_s):
            self._queue.put(_Tick(tick, size))
            return
        self.counts.dropped += 1
        self._dropped_now += 1
        if self._dropped_now == 1:
            log.warning(
                "goal %s: the dataset's writer is too slow; ticks are dropped from now on",
                tick.goal.goal_id,
            )

    def goal_ended(self, goal: Goal, ended: SkillEnded | None) -> None:
        """See `runner.protocols.TickSink`. Never dropped."""
        with self._changing:
            self._goal_runs = False
            lost = self.lost is not None
            if not self._closing and not lost:
                self._queue.put(_End(goal, ended, self._dropped_now))
        self._dropped_now = 0
        if lost:
            self._on_lost()

    # -- the queue's other end
    def _feed(self) -> None:
        reasons: Counter[str] = Counter()  # of this goal's ticks that are no rows
        while (item := self._next()) is not None:
            try:
                match item:
                    case _Tick():
                        self._feed_tick(item.tick, reasons)
                    case _End():
                        note, reasons = self._note(item, reasons), Counter()
                        self._writer.send(("end", note))
                        self._conclude(item.goal.goal_id, self._answered())
                    case _Ask():
                        self._writer.send(item.message)
                        item.answer.set_result(self._answered())
            except VramError as error:
                if isinstance(item, _Ask):
                    item.answer.set_exception(error)
                else:
                    self.counts.lose(error)
                    if self._strict:
                        self._on_lost()
            except (OSError, EOFError) as error:
                if isinstance(item, _Ask):
                    item.answer.set_exception(self._typed(error))
                self._lose(self._typed(error))
        with contextlib.suppress(OSError):  # it is gone already
            self._writer.send(("close",))
        self._writer.close()

    def _next(self) -> _Tick | _End | _Ask | None:
        """Return what is to be done next; None: the recording is over.

        A writer that dies is noticed without work for it, too.
        """
        while True:
            try:
                item = self._queue.get(timeout=LOOK_S)
            except queue.Empty:
                if self._process.poll() is not None:
                    self._lose(self._typed(EOFError()))
                continue
            if isinstance(item, _Tick):
                self._room.give(item.size)
            return item

    def _answered(self) -> JsonObject:
        """Return the writer's answer. Raises what it says, EOFError when it is gone."""
        said: JsonObject = self._writer.recv()
        if "error" in said:
            raise from_wire(said["error"])
        return said

    def _feed_tick(self, tick: GoalTick, reasons: Counter[str]) -> None:
        try:
            row = row_of(tick, self._cameras, self._lerobot)
        except Incomplete as error:
            if not reasons[str(error)]:
                log.warning("ticks are left out of the dataset: %s", error)
            if str(error) in reasons or len(reasons) < REASONS_KEPT:
                reasons[str(error)] += 1
                self.counts.incomplete[str(error)] += 1
        else:
            self._writer.send(("row", row))

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

    def _conclude(self, goal_id: str, said: JsonObject) -> None:
        """Count what became of a goal's rows."""
        if "episode" in said:
            self.counts.episodes += 1
            self.counts.frames += said["frames"]
            log.info("goal %s is episode %d, %d frames", goal_id, said["episode"], said["frames"])
        elif "skipped" in said:
            self.counts.skipped += 1
            log.warning("goal %s is not recorded: %s", goal_id, said["skipped"])
        elif "discarded" in said:
            self.counts.discarded += 1
            log.info("the episode of goal %s is discarded", goal_id)

    def _typed(self, error: Exception) -> VramError:
        if isinstance(error, VramError):
            return error
        code = self._process.wait()
        return InternalError(f"the dataset's writer died (status {code})")

    def _lose(self, error: VramError) -> None:
        """Note that nothing more can be recorded, once."""
        with self._changing:
            if self.lost is not None:
                return
            self.lost = error
            runs = self._goal_runs
        self.counts.lose(error)
        log.error("NOTHING MORE IS RECORDED: %s", error)
        if not runs:
            self._on_lost()


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
