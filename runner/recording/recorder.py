"""Recorder of a runner's goals: hands ticks from the control thread to the writer process.

The control thread only appends to a bounded queue. When the writer is slower than the robot, ticks
are dropped, counted and logged. A writer that dies costs the episode in its hands, which is logged,
and is started again; after RESTARTS_MAX times the session ends. Must not import lerobot: that lives
in the writer's process.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import subprocess
import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypedDict

from vram_arbiter.runner.protocols import Goal, GoalData, GoalTick, SkillEnded
from vram_arbiter.runner.recording import commit, wire
from vram_arbiter.runner.recording.counts import Counts
from vram_arbiter.runner.recording.queue import TickQueue
from vram_arbiter.runner.recording.rows import LEROBOT, ROBOT, Incomplete, row_of, whole_rate
from vram_arbiter.runner.recording.writer_process import Opening, WriterProcess
from vram_arbiter.runner.robots.units import LerobotUnits
from vram_arbiter.schemas.errors import BadState, ConfigError, InternalError, VramError, from_wire

log = logging.getLogger("vram_arbiter.runner.recording")

PATIENCE_S = 10.0  # without a rate nothing is late: the loop may wait so long for room
CLOSE_S = 120.0
ANSWER_S = 60.0  # of a writer that may be closing an episode's files
RESTARTS_MAX = 3
REASONS_KEPT = 8
PACKAGES = ("lerobot", "datasets", "pyarrow", "pandas", "av")

Verdict = Literal["success", "failure", "discard"]


class Marked(TypedDict):
    """An operator's verdict in force. `episode` None: the goal is still being recorded."""

    goal_id: str
    episode: int | None
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class _End:
    goal: Goal
    ended: SkillEnded | None
    dropped: int


@dataclass(frozen=True, slots=True)
class _Ask:
    """A message that the writer answers."""

    message: wire.Header
    answer: Future[wire.Header] = field(default_factory=Future)


@dataclass(frozen=True, slots=True)
class _Gone:
    """A writer that ended by itself."""

    writer: WriterProcess
    code: int


class DatasetRecorder:
    """`start()`, then `tick` and `goal_ended` on the control thread, then `close()`.

    Everything else may be read at any time. `cameras` is called for every tick, on a thread of its
    own: some worlds know theirs only after their first reset. `joints` are the robot's, where they
    are known. `lerobot` records by lerobot's names and units, with its columns only. `patient`
    waits for room instead of dropping; only where no tick has a deadline. `strict` ends the session
    with the first episode that cannot be recorded. `on_lost` is called, on any thread, when nothing
    more can be recorded, after the goal that runs.
    """

    def __init__(
        self,
        root: Path,
        *,
        rate_hz: float,
        cameras: Callable[[], Sequence[str]],
        robot: str,
        joints: Sequence[str] = (),
        lerobot: LerobotUnits | None = None,
        patient: bool = False,
        strict: bool = False,
        on_lost: Callable[[], None] = lambda: None,
    ) -> None:
        self.root = root.absolute()
        self._fps = whole_rate(rate_hz)
        self._cameras = cameras
        self._robot = robot if lerobot is None else lerobot.robot_type
        self._joints = joints
        self._lerobot = lerobot
        self._patient = patient
        self._strict = strict
        self._on_lost = on_lost
        self._queue: TickQueue[_End | _Ask | _Gone | None] = TickQueue()  # None: the end
        self._dropped_now = 0  # of the goal that runs
        self._goal_runs = False
        self._writer: WriterProcess | None = None
        self._feeding: threading.Thread | None = None
        self._aborted = False
        self._closing = False
        self._restarts = 0
        self._answers: deque[_Ask] = deque()  # asked and not answered
        self._unfinished: dict[str, None] = {}  # goals whose rows the writer has in its hands
        self._given_up_goal = ""  # whose rows went down with a writer
        self.counts = Counts(self.root)
        self.lost: VramError | None = None  # why nothing more can be recorded

    @property
    def pid(self) -> int:
        """Process of the writer; 0 before the start."""
        return 0 if self._writer is None else self._writer.pid

    # -- life
    def start(self) -> None:
        """Start the writer; return when it can take rows.

        Raises ConfigError for missing packages, for a folder that cannot be recorded into and for
        a dataset of another robot, other units or columns, AlreadyRunning when another program
        records there, InternalError when the writer does not start.
        """
        if absent := [name for name in PACKAGES if importlib.util.find_spec(name) is None]:
            raise ConfigError(
                f"recording needs the packages {', '.join(absent)}",
                hint="pip install 'vram-arbiter[dataset]'",
            )
        commit.check_folder(self.root)
        self._writer = self._new_writer()
        if self._aborted:
            self._writer.abort()
        self._writer.await_ready()
        self._feeding = threading.Thread(target=self._feed, name="dataset-feed", daemon=True)
        self._feeding.start()

    def _new_writer(self) -> WriterProcess:
        joints = dict.fromkeys(self._joints, 0.0)
        cameras = list(self._cameras())
        opening: Opening = {
            "root": str(self.root),
            "fps": self._fps,
            "robot": self._robot,
            "columns": "full" if self._lerobot is None else "lerobot",
            "units": LEROBOT if self._lerobot is not None else ROBOT if self._joints else "",
            "joints": list(joints if self._lerobot is None else self._lerobot.named(joints)),
            "cameras": cameras if self._joints else None,
        }
        return WriterProcess(opening, self._heard, self._writer_gone)

    def abort(self) -> None:
        """End a `start` that runs, from any thread before the first row; nothing is written."""
        self._aborted = True
        if self._writer is not None:
            self._writer.abort()

    def close(self) -> None:
        """Finish the open episode and wait for the disk, at most CLOSE_S. Repeatable.

        The writer then ends by itself.
        """
        if self._feeding is None or self._writer is None or self._closing:
            return
        with self._queue.changed:
            self._closing = True
            self._queue.put(None)
        self._feeding.join(CLOSE_S)
        try:
            code = self._writer.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            log.warning(
                "the dataset is still being written, by process %d; it ends by itself", self.pid
            )
            return
        if code != 0:
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
            row, _ = row_of(sample, self._cameras(), self._lerobot)
        except Incomplete as error:
            raise ConfigError(f"nothing could be recorded: {error}") from error
        self._ask({"kind": "check", **row})

    def mark(self, goal_id: str, verdict: Verdict) -> Marked:
        """Note the operator's verdict on the goal that runs, or the last one. Blocks.

        An empty `goal_id` means that goal. Raises BadRequest for another one, BadState.
        """
        said = self._ask({"kind": "mark", "goal_id": goal_id, "verdict": verdict})
        if verdict == "discard" and said["episode"] is not None:
            self.counts.discard(said["goal_id"], finished=True)
        else:
            log.info("goal %s is marked as %s", said["goal_id"], verdict)
        return {"goal_id": said["goal_id"], "episode": said["episode"], "verdict": verdict}

    def _ask(self, message: wire.Header) -> wire.Header:
        ask = _Ask(message)
        with self._queue.changed:
            if self._closing or self.lost is not None or self._feeding is None:
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
        if self._patient:
            self._queue.wait(lambda: self._queue.fits(tick) or self.lost is not None, PATIENCE_S)
        if self._closing or self.lost is not None or self._queue.put_tick(tick):
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
        with self._queue.changed:
            self._goal_runs = False
            lost = self.lost is not None
            if not self._closing and not lost:
                self._queue.put(_End(goal, ended, self._dropped_now))
        self._dropped_now = 0
        if lost:
            self._on_lost()

    # -- the queue's other end
    def _feed(self) -> None:
        reasons: Counter[str] = Counter()
        while (item := self._queue.next()) is not None:
            match item:
                case GoalTick():
                    self._feed_tick(item, reasons)
                case _End():
                    self._given_up_goal = ""
                    self._send({"kind": "end", **self._note(item, reasons)})
                    reasons = Counter()
                case _Ask():
                    self._answers.append(item)
                    self._send(item.message)
                case _Gone():
                    self._revive(item)
        if self._writer is not None:
            with contextlib.suppress(OSError):  # it is gone already
                self._writer.send({"kind": "close"})

    def _feed_tick(self, tick: GoalTick, reasons: Counter[str]) -> None:
        if tick.goal.goal_id == self._given_up_goal:
            self.counts.dropped += 1
            return
        try:
            row, pictures = row_of(tick, self._cameras(), self._lerobot)
        except Incomplete as error:
            if not reasons[str(error)]:
                log.warning("ticks are left out of the dataset: %s", error)
            if str(error) in reasons or len(reasons) < REASONS_KEPT:
                reasons[str(error)] += 1
                self.counts.incomplete[str(error)] += 1
            return
        self._unfinished[tick.goal.goal_id] = None
        self._send({"kind": "row", **row}, pictures)

    def _send(self, message: wire.Header, pictures: Sequence[bytes] = ()) -> None:
        """Send a message; one that a dead writer does not take is lost with what it had."""
        if self._writer is None or self.lost is not None:
            return
        try:
            self._writer.send(message, pictures)
        except OSError:
            log.debug("the dataset's writer is gone")  # `_revive` accounts for it
        except ValueError as error:
            self.counts.lose(InternalError(f"the dataset's writer does not take rows: {error}"))

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

    # -- a writer that died
    def _writer_gone(self, writer: WriterProcess, code: int) -> None:
        if not self._closing:
            self._queue.put(_Gone(writer, code), first=True)

    def _revive(self, gone: _Gone) -> None:
        """Account for what a dead writer had, and start another one."""
        lost = ", ".join(self._unfinished) or "none"
        self.counts.lose(
            InternalError(
                f"the dataset's writer died (status {gone.code}); goals without an episode: {lost}"
            )
        )
        self._given_up_goal = next(reversed(self._unfinished), "")
        self._unfinished.clear()
        while self._answers:
            self._answers.popleft().answer.set_exception(
                BadState("the dataset's writer died", hint="ask again")
            )
        error: VramError = InternalError(f"the dataset's writer died {RESTARTS_MAX + 1} times")
        while self._restarts < RESTARTS_MAX and not self._closing:
            self._restarts += 1
            log.warning(
                "the dataset's writer is started again (%d of %d)", self._restarts, RESTARTS_MAX
            )
            self._writer = self._new_writer()
            try:
                self._writer.await_ready()
            except VramError as refused:
                self.counts.lose(refused)
                error = refused
            else:
                return
        self._lose(error)

    def _lose(self, error: VramError) -> None:
        with self._queue.changed:
            self.lost = error
            runs = self._goal_runs
            self._queue.changed.notify_all()
        log.error("NOTHING MORE IS RECORDED: %s", error)
        if not runs:
            self._on_lost()

    # -- what the writer says
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
            case "episode":
                self._unfinished.pop(said["goal_id"], None)
                self.counts.finished(said["goal_id"], said["episode"], said["frames"])
            case "skipped":
                self._unfinished.pop(said["goal_id"], None)
                self.counts.skip(said["goal_id"], said["reason"])
            case "discarded":
                self._unfinished.pop(said["goal_id"], None)
                self.counts.discard(said["goal_id"], finished=False)
            case "failed":
                self._unfinished.pop(said["goal_id"], None)
                error = from_wire(said["error"])
                self.counts.lose(error)
                if self._strict:
                    self._lose(error)
            case "fits" | "marked":
                self._answers.popleft().answer.set_result(said)
            case "misfit" | "unmarked":
                self._answers.popleft().answer.set_exception(from_wire(said["error"]))
