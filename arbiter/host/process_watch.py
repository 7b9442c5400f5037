"""Deaths of processes, told by the kernel: one pidfd per process, readable the moment it ends (0.2
ms here).

The process of a connection comes with the pidfd of its accept (`take`). One that is known by its
pid alone, from the journal, may have died and its pid been reused, so the start time is compared
after the pidfd is opened (`add`). Must not know clients or leases.
"""

import asyncio
import contextlib
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
        fd: int | None = None
        with contextlib.suppress(ProcessLookupError):
            fd = os.pidfd_open(process.pid)
            if process.start_ticks not in (0, self._start_ticks(process.pid)):
                os.close(fd)  # another process has this pid now
                fd = None
        self._fds[process] = fd
        if fd is None:
            self._loop.call_soon(self._ended, process)
        else:
            self._loop.add_reader(fd, self._ended, process)

    def take(self, process: ProcessKey, pidfd: int) -> bool:
        """Watch the process of a connection by a copy of the pidfd that was opened when it was
        accepted: its pid may have been reused.

        Return False if it was watched before. Raises OSError where no descriptor is left.
        """
        if process in self._fds:
            return False
        fd = self._fds[process] = os.dup(pidfd)
        self._loop.add_reader(fd, self._ended, process)
        return True

    def drop(self, process: ProcessKey) -> None:
        """Watch a process no longer: its death concerns nothing."""
        if (fd := self._fds.pop(process, None)) is not None:
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
        for process in list(self._fds):
            self.drop(process)

    def _ended(self, process: ProcessKey) -> None:
        if process in self._fds:  # not dropped meanwhile
            self.drop(process)
            self._died(process)
