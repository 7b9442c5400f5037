"""Process that writes a runner's dataset: `python -m vram_arbiter.runner.recording.writer FD`.

Started by `runner.recording.recorder`, never by hand. It is a process of its own because importing
torch, encoding video and compressing would take the interpreter from the control thread, and
because it outlives the runner: whatever kills that, the socket ends and the episode so far is
finished. It ignores SIGTERM and SIGINT for the same reason. Rows are taken without an answer; every
other message is answered.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import resource
import shutil
import signal
import sys
import warnings
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording.columns import (
    DONE,
    SUCCESS,
    Features,
    LerobotFrame,
    Row,
    features_of,
    frame_of,
)
from vram_arbiter.runner.recording.lerobot_files import LerobotFiles
from vram_arbiter.schemas.errors import (
    BadRequest,
    ConfigError,
    FrameStale,
    InternalError,
    ModelError,
    VramError,
)
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime import logging as logs

log = logging.getLogger("vram_arbiter.runner.recording")

DISCARD = "discard"
NICENESS = 10  # the control loop goes first
_CAP_SYS_NICE, _CAPABILITY_VERSION_3 = 23, 0x20080522  # linux/capability.h
ROWS_MIN = 2  # lerobot has no statistics of a single picture


class EpisodeWriter:
    """Rows in, episodes out. One goal at a time, as the runner has one at a time."""

    def __init__(self, files: LerobotFiles, units: str) -> None:
        self._files = files
        self._units = units
        self._goal: Row | None = None  # first row of the goal that is being recorded
        self._features: Features = {}
        # written when it is known whether it is the episode's last, with the world's verdict
        self._last: tuple[LerobotFrame, bool | None] | None = None
        self._broken = 0  # rows of it with a picture that cannot be read
        self._failure: VramError | None = None  # why the goal's rows cannot be recorded
        self._mark = ""  # the operator's verdict on the goal that is being recorded
        # goals with an episode, that episode and its frames
        self._finished: list[tuple[str, int, int]] = []
        self._left_none = False  # the last goal has no episode: the one before has to be named

    def row(self, row: Row) -> None:
        """Add one row of a goal; the first one begins its episode. A failure is told at its end."""
        if self._failure is not None:
            return
        try:
            self._add(row)
        except Exception as error:
            log.exception("goal %s is not recorded", row.goal_id)
            self._left_none = True
            self._failure = (
                error
                if isinstance(error, VramError)
                else InternalError(f"{type(error).__name__}: {error}")
            )

    def _add(self, row: Row) -> None:
        if self._goal is None:
            self._features = self._files.begin(features_of(row))
            self._goal, self._broken, self._mark = row, 0, ""
        try:
            frame = frame_of(row, self._features)
        except (FrameStale, ModelError) as error:  # a broken picture costs one row, no episode
            self._broken += 1
            log.warning("a tick of goal %s is not recorded: %s", row.goal_id, error)
            return
        if self._last is not None:
            self._files.add(self._last[0])
        self._last = frame, row.success

    def end(self, note: commit.EpisodeNote) -> JsonObject:
        """End a goal, with or without rows; return what became of it.

        Raises what keeps its episode from being finished; the next goal may be recorded again.
        """
        goal, last, failure = self._goal, self._last, self._failure
        self._goal = self._last = self._failure = None
        self._left_none = True  # until the goal has become an episode
        try:
            if failure is not None:
                raise failure
            if goal is None:
                return {}
            rows = self._files.rows + (last is not None)
            if last is None or rows < ROWS_MIN:
                return {"skipped": f"{rows} rows are no episode"}
            if self._mark == DISCARD:
                return {"discarded": True}
            index = self._close(goal, *last, note)
            self._finished.append((goal.goal_id, index, rows))
            self._left_none = False
            return {"episode": index, "frames": rows}
        finally:
            self._files.abandon()  # what was not finished

    def _close(
        self, goal: Row, last: LerobotFrame, success: bool | None, note: commit.EpisodeNote
    ) -> int:
        import numpy as np

        if DONE in last:
            last[DONE] = np.array([True])
        if SUCCESS in last:
            last[SUCCESS] = np.array([note.get("status") == "succeeded" and success is True])
        self._files.add(last)
        about: commit.EpisodeNote = {
            "goal_id": goal.goal_id,
            "skill": goal.skill,
            "task": goal.task,
            "trace_id": goal.trace_id,
            "units": self._units,
        }
        if self._mark:
            about["marked"] = self._mark
        incomplete = note.get("incomplete", 0) + self._broken
        return self._files.finish({**about, **note, "incomplete": incomplete})

    def check(self, row: Row) -> JsonObject:
        """Compare the columns of a row that is not recorded with those of an existing dataset.

        Raises ConfigError.
        """
        self._files.check(features_of(row))
        return {}

    def mark(self, goal_id: str, verdict: str) -> JsonObject:
        """Note the operator's verdict on the goal that is being recorded, or the last one.

        A discarded episode is not written, or is removed. An empty `goal_id` means that goal.
        Raises BadRequest, BadState.
        """
        goal = self._goal.goal_id if self._goal is not None else ""
        if goal and goal_id in ("", goal):
            self._mark = verdict
            return {"goal_id": goal, "episode": None}
        finished, episode, frames = self._finished[-1] if self._finished else ("", -1, 0)
        unnamed = "" if self._left_none else finished
        if not finished or (goal_id or unnamed) != finished:
            what = "no goal was recorded" if not finished else f"the last one is {finished}"
            hint = "mark a goal while it runs, or before the next one"
            raise BadRequest(f"goal {goal_id or '?'} cannot be marked: {what}", hint=hint)
        if verdict != DISCARD:
            commit.mark(self._files.root, episode, verdict)
        elif goal:
            raise BadRequest(f"the next goal, {goal}, is being recorded")
        else:
            commit.undo(self._files.root)
            self._finished.pop()
            self._left_none = True
        return {"goal_id": finished, "episode": episode, "frames": frames}


def serve(peer: Connection) -> int:
    """Write until the runner ends or disappears.

    Returns 0 if everything that came is finished, 1 if not, 2 if it cannot begin.
    """
    said = peer.recv()
    root = Path(said["root"])
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(commit.locked(root))
            stack.callback(shutil.rmtree, root / commit.FOLDER / commit.CACHE, ignore_errors=True)
            repaired = commit.repair(root)
            lerobot = said["units"] == "lerobot"
            files = LerobotFiles(root, fps=said["fps"], robot=said["robot"], lerobot=lerobot)
            episodes, frames = files.totals()
        except (ImportError, VramError, OSError) as error:
            _answer(peer, {"error": _typed(root, error).to_wire()})
            return 2
        os.nice(NICENESS)
        stay_ordinary()
        _answer(peer, {"repaired": repaired, "episodes": episodes, "frames": frames})
        writer = EpisodeWriter(files, said["units"])
        status = "runner_lost"
        for kind, *given in _messages(peer):
            if kind == "close":
                status = "unfinished"
                break
            if kind == "row":
                writer.row(*given)
            else:
                _answer(peer, _handled(getattr(writer, kind), given))
        said = _handled(writer.end, [{"status": status}])
        if "error" in said:
            log.error("the last episode is not recorded: %s", said["error"]["message"])
            return 1
    return 0


def _messages(peer: Connection) -> Iterator[Any]:
    """Yield what the runner says until it is gone, also in the middle of a message."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            yield peer.recv()


def _handled(handler: Any, given: list[Any]) -> JsonObject:
    """Return the answer to one message. Errors never end the process."""
    try:
        answer: JsonObject = handler(*given)
        return answer
    except VramError as error:
        return {"error": error.to_wire()}
    except Exception as error:
        log.exception("the dataset's writer goes on after an error")
        return {"error": InternalError(f"{type(error).__name__}: {error}").to_wire()}


def stay_ordinary() -> None:
    """Give up the right to run before other programs, for this thread and all that it starts.

    The AV1 encoder of lerobot's format (SVT-AV1) takes the highest real-time priority for each of
    its threads where it may, as for root: they would run before the control loop.
    """
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable: low words, then high ones
    if libc.capget(header, sets):
        raise OSError(ctypes.get_errno(), "capget")
    for low_word in range(3):
        sets[low_word] &= ~(1 << _CAP_SYS_NICE)
    if libc.capset(header, sets):
        raise OSError(ctypes.get_errno(), "capset")


def _answer(peer: Connection, message: JsonObject) -> None:
    with contextlib.suppress(OSError):  # the runner is gone; what there is to do is done
        peer.send(message)


def _typed(root: Path, error: Exception) -> VramError:
    """Return the reason why nothing can be recorded, as an error for the runner."""
    match error:
        case VramError():
            return error
        case ImportError():
            hint = "pip install 'vram-arbiter[dataset]'"
            return ConfigError(f"recording needs lerobot's dataset packages: {error}", hint=hint)
    return ConfigError(f"nothing can be recorded into {root}: {error}")


def main(argv: list[str]) -> int:
    """Run the writer; the socket's file descriptor is the only argument."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    # it warns that the progress bars are off, which the runner asked for
    warnings.filterwarnings("ignore", module="datasets.utils.tqdm")
    logs.set_up("vram-runner", "WARNING", "human", "%(asctime)s dataset %(levelname)s %(message)s")
    with Connection(int(argv[0])) as peer:
        return serve(peer)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
