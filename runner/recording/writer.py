"""Process that writes a runner's dataset: `python -m vram_arbiter.runner.recording.writer FD`.

Started by `runner.recording.recorder`, never by hand. It is a process of its own because importing
torch, encoding video and compressing would take the interpreter from the control thread, and
because it outlives the runner: whatever kills that, the socket ends and the episode so far is
finished. It ignores SIGTERM and SIGINT for the same reason. It takes rows, the end of a goal and
the end of all, and answers with what it has finished or could not.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import resource
import shutil
import signal
import socket
import sys
import warnings
from pathlib import Path
from typing import cast

from vram_arbiter.runner.recording import commit, wire
from vram_arbiter.runner.recording.columns import SUCCESS, Features, Frame, features_of, frame_of
from vram_arbiter.runner.recording.lerobot_files import LerobotFiles
from vram_arbiter.runner.recording.rows import Row
from vram_arbiter.schemas.errors import (
    BadRequest,
    ConfigError,
    FrameStale,
    InternalError,
    ModelError,
    VramError,
)
from vram_arbiter.schemas.runtime import logging as logs

log = logging.getLogger("vram_arbiter.runner.recording")

DISCARD = "discard"
NICENESS = 10  # the control loop goes first
_CAP_SYS_NICE, _CAPABILITY_VERSION_3 = 23, 0x20080522  # linux/capability.h
ROWS_MIN = 2  # lerobot has no statistics of a single picture
ROWS_MAX = 30 * 60 * 30  # half an hour at 30 Hz; a longer goal goes on in the next episode


class EpisodeWriter:
    """Rows in, episodes out. One goal at a time, as the runner has one at a time."""

    def __init__(self, peer: socket.socket, files: LerobotFiles, rows_max: int = ROWS_MAX) -> None:
        self._peer = peer
        self._files = files
        self._rows_max = rows_max
        self._goal: Row | None = None  # first row of the goal that is being recorded
        self._features: Features = {}
        self._last: Frame | None = None  # written when it is known whether it is the episode's last
        self._judged: bool | None = None  # verdict of the world with the last row; None: no verdict
        self._broken = 0  # rows of it with a picture that cannot be read
        self._refused = ""  # goal whose rows cannot be recorded
        self._mark = ""  # the operator's verdict on the goal that is being recorded
        self._finished: list[tuple[str, int]] = []  # goals with an episode, and that episode
        self._left_none = False  # the last goal has no episode: the one before has to be named

    def row(self, row: Row, pictures: list[bytes]) -> None:
        """Add one row of a goal; the first one begins its episode.

        Raises what prevents the recording.
        """
        goal_id = row["goal_id"]
        if goal_id == self._refused:
            return
        if self._goal is not None and self._goal["goal_id"] != goal_id:
            self._close({"status": "unfinished"})
        if self._goal is None:
            self._features = self._files.begin(features_of(row))
            self._goal, self._broken, self._mark = row, 0, ""
        try:
            frame = frame_of(row, pictures, self._features)
        except (
            FrameStale,
            ModelError,
        ) as error:  # one broken picture costs one row, not the episode
            self._broken += 1
            log.warning("tick %d is not recorded: %s", row["tick_idx"], error)
            return
        if self._last is not None:
            self._files.add(self._last)
        self._last, self._judged = frame, row["success"]
        if self._files.rows + 1 >= self._rows_max:
            self._close({"status": "continued"})

    def ended(self, note: commit.EpisodeNote) -> None:
        """End a goal, with or without rows. Raises what keeps its episode from being finished."""
        if self._goal is not None and self._goal["goal_id"] == note["goal_id"]:
            self._close(note)
        elif self._refused == note["goal_id"]:
            self._refused = ""

    def check(self, row: Row) -> None:
        """Compare the columns of a row that is not recorded with those of an existing dataset."""
        try:
            self._files.check_columns(features_of(row))
        except VramError as error:
            self._tell({"kind": "misfit", "error": error.to_wire()})
        else:
            self._tell({"kind": "fits"})

    def mark(self, goal_id: str, verdict: str) -> None:
        """Note the operator's verdict on the goal that is being recorded, or the last one.

        A discarded episode is not written, or is removed. An empty `goal_id` means that goal.
        """
        goal = self._goal["goal_id"] if self._goal is not None else ""
        finished, episode = self._finished[-1] if self._finished else ("", -1)
        try:
            if goal and goal_id in ("", goal):
                self._mark = verdict
                self._tell({"kind": "marked", "goal_id": goal, "episode": None})
                return
            unnamed = finished if self._left_none else ""
            if not finished or goal_id not in (unnamed, finished):
                what = "no goal was recorded" if not finished else f"the last one is {finished}"
                hint = "mark a goal while it runs, or before the next one"
                raise BadRequest(f"goal {goal_id or '?'} cannot be marked: {what}", hint=hint)
            if verdict == DISCARD:
                if goal:
                    raise BadRequest(f"the next goal, {goal}, is being recorded")
                commit.undo(self._files.root)
                self._finished.pop()
                self._left_none = True
            else:
                commit.mark(self._files.root, episode, verdict)
            self._tell({"kind": "marked", "goal_id": finished, "episode": episode})
        except VramError as error:
            self._tell({"kind": "unmarked", "error": error.to_wire()})

    def close(self, status: str) -> None:
        """End everything; an open goal is finished with its rows so far. Raises like `ended`."""
        if self._goal is not None:
            self.ended({"goal_id": self._goal["goal_id"], "status": status})

    def failed(self, goal_id: str, error: Exception) -> None:
        """Drop the goal's rows and report it; the next goal is tried again."""
        typed = (
            error
            if isinstance(error, VramError)
            else InternalError(f"{type(error).__name__}: {error}")
        )
        self._refused = goal_id
        self._tell({"kind": "failed", "goal_id": goal_id, "error": typed.to_wire()})
        self._forget()

    def _close(self, note: commit.EpisodeNote) -> None:
        first, last = self._goal, self._last
        if first is None:
            return
        rows = self._files.rows + (last is not None)
        if last is None or rows < ROWS_MIN:
            self._forget()
            self._tell(
                {
                    "kind": "skipped",
                    "goal_id": first["goal_id"],
                    "reason": f"{rows} rows are no episode",
                }
            )
            return
        if self._mark == DISCARD:
            self._forget()
            self._tell({"kind": "discarded", "goal_id": first["goal_id"]})
            return
        last["next.done"][0] = True
        if SUCCESS in last:
            last[SUCCESS][0] = note.get("status") == "succeeded" and self._judged is True
        self._files.add(last)
        about: commit.EpisodeNote = {
            "goal_id": first["goal_id"],
            "skill": first["skill"],
            "task": first["task"],
            "trace_id": first["trace_id"],
            "units": first["units"],
            "judged": self._judged,
        }
        if self._mark:
            about["marked"] = self._mark
        incomplete = note.get("incomplete", 0) + self._broken
        index = self._files.finish({**about, **note, "incomplete": incomplete})
        self._goal = self._last = None
        self._finished.append((first["goal_id"], index))
        self._left_none = False
        self._tell(
            {"kind": "episode", "goal_id": first["goal_id"], "episode": index, "frames": rows}
        )

    def _forget(self) -> None:
        self._goal = self._last = None
        self._left_none = True
        self._files.abandon()

    def _tell(self, message: wire.Header) -> None:
        _answer(self._peer, message)


def serve(peer: socket.socket) -> int:
    """Write until the runner ends or disappears. Returns 0 if everything that came is finished."""
    opening = wire.receive(peer)
    if opening is None:
        return 0
    said, _ = opening
    root = Path(said["root"])
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(commit.locked(root))
            stack.callback(shutil.rmtree, root / commit.FOLDER / commit.CACHE, ignore_errors=True)
            repaired = commit.repair(root)
            files = LerobotFiles(
                root, fps=said["fps"], robot=said["robot"], columns=said["columns"]
            )
            episodes, frames = files.totals()
            files.check(said["units"], said["joints"], said["cameras"])
        except (ImportError, VramError, OSError) as error:
            _answer(peer, {"kind": "refused", "error": _typed(root, error).to_wire()})
            return 2
        os.nice(NICENESS)
        stay_ordinary()
        _answer(
            peer, {"kind": "ready", "repaired": repaired, "episodes": episodes, "frames": frames}
        )
        writer = EpisodeWriter(peer, files)
        status = "runner_lost"
        while status == "runner_lost" and (message := wire.receive(peer)) is not None:
            if message[0]["kind"] == "close":
                status = "unfinished"
            else:
                _take(writer, *message)
        _take(writer, {"kind": "close", "goal_id": "", "status": status}, [])
    return 0


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


def _answer(peer: socket.socket, message: wire.Header) -> None:
    with contextlib.suppress(
        OSError
    ):  # the runner is gone; what there is to do is done all the same
        wire.send(peer, message)


def _typed(root: Path, error: Exception) -> VramError:
    """Return the reason why nothing can be recorded, as an error for the runner."""
    match error:
        case VramError():
            return error
        case ImportError():
            hint = "pip install 'vram-arbiter[dataset]'"
            return ConfigError(f"recording needs lerobot's dataset packages: {error}", hint=hint)
    return ConfigError(f"nothing can be recorded into {root}: {error}")


def _take(writer: EpisodeWriter, header: wire.Header, pictures: list[bytes]) -> None:
    """Handle one message. Errors never end the process: the next goal may be recorded again."""
    kind = header.pop("kind")
    try:
        if kind == "row":
            writer.row(cast(Row, header), pictures)
        elif kind == "end":
            writer.ended(cast(commit.EpisodeNote, header))
        elif kind == "check":
            writer.check(cast(Row, header))
        elif kind == "mark":
            writer.mark(header["goal_id"], header["verdict"])
        else:
            writer.close(header["status"])
    except Exception as error:
        log.exception("goal %s is not recorded", header["goal_id"])
        try:
            writer.failed(header["goal_id"], error)
        except Exception:
            log.exception("the unfinished episode stays; the next start takes it away")


def main(argv: list[str]) -> int:
    """Run the writer; the socket's file descriptor is the only argument."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    warnings.filterwarnings(
        "ignore", module="datasets.utils.tqdm"
    )  # progress bars are off, as they shall be
    logs.set_up("vram-runner", "WARNING", "human", "%(asctime)s dataset %(levelname)s %(message)s")
    with socket.socket(fileno=int(argv[0])) as peer:
        return serve(peer)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
