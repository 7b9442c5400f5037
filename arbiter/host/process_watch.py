"""Deaths of processes, told by the kernel: one pidfd per process, readable the moment it ends (0.2
ms here).

The process of a connection comes with the pidfd of its accept (`take`). One that is known by its
pid alone, from the journal, may have died and its pid been reused, so the start time is compared
after the pidfd is opened (`add`). Must not know clients or leases.
"""

import asyncio
import logging
import os
import signal
from collections.abc import Callable

from vram_arbiter.schemas.ids import ProcessKey

log = logging.getLogger(__name__)

_SIGNALS = {"term": signal.SIGTERM, "kill": signal.SIGKILL}


class ProcessWatch:
    """Calls `died` once per watched process, on the loop's thread, never from inside `add`."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        start_ticks: Callable[[int], int | None],
        died: Callable[[ProcessKey], None],
    ) -> None:
        self._loop = loop
        self._start_ticks = start_ticks
        self._died = died
        self._fds: dict[ProcessKey, int | None] = {}  # None: dead already, the call is under way

    def add(self, process: ProcessKey) -> None:
        """Watch a process; a second time changes nothing. Dead already: `died` is called in the
        loop's next turn.

        Raises OSError where no descriptor is left (EMFILE, ENFILE).
        """
        if process in self._fds:
            return
        try:
            fd = os.pidfd_open(process.pid)
        except ProcessLookupError:
            self._gone(process)
            return
        if process.start_ticks != 0 and self._start_ticks(process.pid) != process.start_ticks:
            os.close(fd)  # another process has this pid now
            self._gone(process)
            return
        self._watch(process, fd)

    def take(self, process: ProcessKey, pidfd: int) -> bool:
        """Watch the process of a connection by a copy of the pidfd that was opened when it was
        accepted: its pid may have been reused.

        Return False if it was watched before. Raises OSError where no descriptor is left.
        """
        if process in self._fds:
            return False
        self._watch(process, os.dup(pidfd))
        return True

    def drop(self, process: ProcessKey) -> None:
        """Watch a process no longer: its death concerns nothing."""
        fd = self._fds.pop(process, None)
        if fd is not None:
            self._loop.remove_reader(fd)
            os.close(fd)

    def signal(self, process: ProcessKey, kind: str) -> None:
        """Send SIGTERM ("term") or SIGKILL ("kill") through the pidfd, which names the process
        whose start time was compared. One that is not watched (it died) gets nothing, nor does one
        whose start time was never known. Must not raise: a refusal is logged.
        """
        fd = self._fds.get(process)
        if fd is None or process.start_ticks == 0:
            log.warning("no %s for %s: it is gone or not known by its start time", kind, process)
            return
        try:
            signal.pidfd_send_signal(fd, _SIGNALS[kind])
        except OSError as error:
            log.error("%s could not be sent to %s: %s", kind, process, error)

    def __len__(self) -> int:
        return len(self._fds)

    def close(self) -> None:
        for fd in self._fds.values():
            if fd is not None:
                self._loop.remove_reader(fd)
                os.close(fd)
        self._fds.clear()

    def _watch(self, process: ProcessKey, fd: int) -> None:
        self._fds[process] = fd
        self._loop.add_reader(fd, self._readable, process, fd)

    def _gone(self, process: ProcessKey) -> None:
        self._fds[process] = None
        self._loop.call_soon(self._report, process)

    def _readable(self, process: ProcessKey, fd: int) -> None:
        self._loop.remove_reader(fd)
        os.close(fd)
        self._report(process)

    def _report(self, process: ProcessKey) -> None:
        if process in self._fds:  # not closed meanwhile
            del self._fds[process]
            self._died(process)
