"""The observer beside the daemon: `vram-arbiter --http` starts it for convenience.

A program of its own (`vram_arbiter.clients.observer`), a client of the daemon's socket. It ends
with the daemon; if it ends earlier that is said once, and changes nothing.
"""

import asyncio
import contextlib
import logging
import os
import subprocess
import sys

log = logging.getLogger(__name__)

MODULE = "vram_arbiter.clients.observer"
STOP_S = 3.0
"""From SIGTERM to SIGKILL."""


class Observer:
    """`start` once the socket is there; `close` at the end of the daemon."""

    def __init__(self, listen: str, endpoint: str) -> None:
        options = ["--http", listen, "--endpoint", endpoint, "--ends-with", str(os.getpid())]
        self._command = [sys.executable, "-m", MODULE, *options]
        self._child: subprocess.Popen[bytes] | None = None
        self._pidfd = -1

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            self._child = subprocess.Popen(self._command, stdin=subprocess.DEVNULL)
            self._pidfd = os.pidfd_open(self._child.pid)
        except OSError as error:
            log.warning("the observer cannot be started: %s; leases go on as before", error)
            return
        loop.add_reader(self._pidfd, self._ended, loop)

    def close(self) -> None:
        if self._child is None:
            return
        if self._pidfd >= 0:
            asyncio.get_running_loop().remove_reader(self._pidfd)
            self._forget()
        self._child.terminate()
        try:
            self._child.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()

    def _ended(self, loop: asyncio.AbstractEventLoop) -> None:
        assert self._child is not None
        loop.remove_reader(self._pidfd)
        self._forget()
        log.warning("the observer ended with %d; leases go on as before", self._child.wait())

    def _forget(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self._pidfd)
        self._pidfd = -1
