"""One writer of a dataset as a process, and the socket to it, as its recorder sees them.

Must not import lerobot: that lives in the writer's process.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, TypedDict

from vram_arbiter.runner.recording import commit, wire
from vram_arbiter.schemas.errors import Cancelled, InternalError, VramError, from_wire

START_S = 180.0  # the writer imports torch; a minute on a busy machine


class Opening(TypedDict):
    """First message to a writer: what is to be recorded, and where."""

    root: str
    fps: int
    robot: str
    columns: Literal["full", "lerobot"]
    units: str  # empty: not known before the first row
    joints: list[str]  # names of state and action; empty: not known before the first row
    cameras: list[str] | None  # None: not known before the first row


class WriterProcess:
    """Starts the writer. `heard` gets its messages and `gone` its status when it has ended, both
    on a thread of their own.
    """

    def __init__(
        self,
        opening: Opening,
        heard: Callable[[wire.Header], None],
        gone: Callable[[WriterProcess, int], None],
    ) -> None:
        self._heard = heard
        self._gone = gone
        self._ready = threading.Event()
        self._aborted = False
        self._refused: VramError | None = None
        self._peer, theirs = socket.socketpair()
        command = [sys.executable, "-P", "-m", "vram_arbiter.runner.recording.writer"]
        try:
            self._process = subprocess.Popen(
                [*command, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=_environment(Path(opening["root"])),
                start_new_session=True,  # a Ctrl-C for the runner must not cut the episode off
            )
        finally:
            theirs.close()
        self.pid = self._process.pid
        self._hearing = threading.Thread(target=self._hear, name="dataset-hear", daemon=True)
        with contextlib.suppress(OSError):  # it is gone already, which `await_ready` reports
            wire.send(self._peer, {**opening})
        self._hearing.start()

    def await_ready(self) -> None:
        """Wait until it takes rows.

        Raises what it refuses, Cancelled after `abort`, InternalError when it does not come up.
        """
        came_up = self._ready.wait(START_S)
        if came_up and not self._aborted and self._refused is None:
            return
        aborted = self._aborted
        self.abort()
        if self._refused is not None:
            raise self._refused
        if aborted and came_up:
            raise Cancelled("the recording was to end before it had begun")
        raise InternalError(f"the dataset's writer did not come up within {START_S:.0f} s")

    def send(self, message: wire.Header, pictures: Sequence[bytes] = ()) -> None:
        """Send a message. Blocks. Raises OSError when the writer is gone, ValueError."""
        wire.send(self._peer, message, pictures)

    def abort(self) -> None:
        """Hang up: the writer finishes what it has and ends. Any thread."""
        self._aborted = True
        with contextlib.suppress(OSError):  # it is gone already
            self._peer.shutdown(socket.SHUT_RDWR)

    def wait(self, timeout_s: float) -> int:
        """Wait for its end and return its status. Raises subprocess.TimeoutExpired."""
        code = self._process.wait(timeout_s)
        if threading.current_thread() is not self._hearing:
            self._hearing.join()
        self._peer.close()
        return code

    def _hear(self) -> None:
        while (message := wire.receive(self._peer)) is not None:
            match message[0]["kind"]:
                case "refused":
                    self._refused = from_wire(message[0]["error"])
                    self._ready.set()
                case "ready":
                    self._heard(message[0])
                    self._ready.set()
                case _:
                    self._heard(message[0])
        if self._aborted:
            self._ready.set()
            return
        code = self._process.wait()
        if not self._ready.is_set():
            self._refused = self._refused or InternalError(
                f"the dataset's writer died (status {code})"
            )
            self._ready.set()
        elif self._refused is None:
            self._gone(self, code)


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
