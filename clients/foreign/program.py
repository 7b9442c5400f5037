"""A started program and its process tree.

The program dies with `vramctl` (parent-death signal): without it nothing answers for its GPU
memory, and a suspended program would never be resumed. It stays in the process group of `vramctl`,
so that the terminal's signals and input reach it.
"""

import asyncio
import contextlib
import ctypes
import os
import signal
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final, Protocol, Self

from vram_arbiter.schemas.runtime import procfs

ORPHAN_GRACE_S: Final = 5.0
"""From SIGTERM to SIGKILL for processes that outlive the program itself."""
STDERR: Final = 2
"""The descriptor, also where `sys.stderr` is another file."""
ORPHAN_POLL_S: Final = 0.05
_PR_SET_PDEATHSIG: Final = 1
_PR_SET_CHILD_SUBREAPER: Final = 36
_libc = ctypes.CDLL(None, use_errno=True)


def adopt_orphans() -> None:
    """Become the parent of processes whose parent ends, so that none leaves the tree (prctl(2))."""
    if _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def dying_with_parent() -> Callable[[], None]:
    """Return what a child does before it executes its program (`preexec_fn`), so that it dies with
    this process."""
    parent = os.getpid()

    def prepare() -> None:
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGQUIT})
        if os.getppid() != parent:  # it ended before the call above
            os._exit(128 + signal.SIGKILL)

    return prepare


class Program(Protocol):
    """One run of a program. `stopping`: it is ended to make room, and is to be started again."""

    stopping: bool

    @property
    def running(self) -> bool: ...

    async def wait(self) -> int:
        """Return its exit code once it has ended, -n after signal n."""
        ...

    def send_signal(self, number: signal.Signals) -> None:
        """Signal it unless it has ended."""
        ...

    async def end(self, grace_s: float | None) -> bool:
        """End it in order, and by force after the grace. Return whether that was needed."""
        ...

    async def end_orphans(self) -> int:
        """End its processes that outlived it. Return how many there were."""
        ...

    def tree(self) -> list[int]:
        """Return the pids of its living processes."""
        ...

    def reap(self) -> None:
        """Take the exit status of adopted processes that ended."""
        ...


class ForeignProgram:
    """A child of this process."""

    def __init__(self, child: asyncio.subprocess.Process, others: frozenset[int]) -> None:
        self.pid = child.pid
        self._child = child
        self.stopping = False
        try:
            self._pidfd: int | None = os.pidfd_open(child.pid)
        except ProcessLookupError:
            self._pidfd = None  # it has ended, and asyncio knows
        self._others = others  # children of this process that are not the program's

    @classmethod
    async def start(
        cls, path: str, arguments: Sequence[str], environ: Mapping[str, str], out: int | None = None
    ) -> Self:
        """Start it; what it prints goes to the descriptor `out` if one is given. Raises OSError
        where it cannot be executed."""
        others = frozenset(_children().get(os.getpid(), ()))
        child = await asyncio.create_subprocess_exec(
            path, *arguments, env=environ, preexec_fn=dying_with_parent(), stdout=out
        )
        return cls(child, others)

    @property
    def running(self) -> bool:
        return self._child.returncode is None

    async def wait(self) -> int:
        """Return the exit code of the program itself, -n after signal n."""
        code = await self._child.wait()
        if self._pidfd is not None:
            os.close(self._pidfd)
            self._pidfd = None
        return code

    def send_signal(self, number: signal.Signals) -> None:
        """Signal the program unless it has ended.

        Through its pidfd: asyncio's own `send_signal`, in Python 3.12.1 at least, takes the exit
        status of a program that has just ended, and 255 is reported.
        """
        if self._pidfd is not None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    async def end(self, grace_s: float | None) -> bool:
        """Send SIGTERM, and SIGKILL after the grace. Return whether it needed SIGKILL."""
        if not self.running:
            return False
        self.send_signal(signal.SIGTERM)
        try:
            await asyncio.wait_for(self.wait(), grace_s)
        except TimeoutError:
            self.send_signal(signal.SIGKILL)
            await self.wait()
            return True
        return False

    async def end_orphans(self) -> int:
        """End the processes of the tree that outlived the program, through their pidfds: SIGTERM,
        then SIGKILL. Return how many there were. Needs `adopt_orphans`."""
        ended: set[int] = set()
        for number in (signal.SIGTERM, signal.SIGKILL):
            signaled: set[int] = set()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(ORPHAN_GRACE_S):
                    while orphans := self._orphans():
                        for pid in orphans - signaled:
                            send_below(pid, number)
                        signaled |= orphans
                        await asyncio.sleep(ORPHAN_POLL_S)
            ended |= signaled
        return len(ended)

    def tree(self) -> list[int]:
        """Return the pids of the program's living processes, parents first."""
        return below(os.getpid(), self._others)

    def reap(self) -> None:
        """Take the exit status of adopted processes that ended. Needs `adopt_orphans`."""
        with contextlib.suppress(ChildProcessError):
            options = os.WEXITED | os.WNOHANG | os.WNOWAIT
            while ended := os.waitid(os.P_ALL, 0, options):
                if ended.si_pid in self._others or ended.si_pid == self.pid:
                    return  # asyncio's; the next call goes on
                os.waitpid(ended.si_pid, os.WNOHANG)

    def _orphans(self) -> set[int]:
        self.reap()
        return set(self.tree()) - {self.pid}


def _children() -> dict[int, list[int]]:
    """Return the living processes by their parents."""
    found: dict[int, list[int]] = {}
    for entry in procfs.PROC.iterdir():
        if entry.name.isdecimal():
            stat = procfs.read_stat(int(entry.name))
            if stat is not None and stat.alive:
                found.setdefault(stat.parent_pid, []).append(int(entry.name))
    return found


def below(ancestor: int, others: Collection[int] = ()) -> list[int]:
    """Return the living processes that descend from one, parents first, but for some of its
    children and what is below them."""
    children = _children()
    found = [pid for pid in children.get(ancestor, ()) if pid not in others]
    for pid in found:
        found += children.get(pid, ())
    return found


def send_below(pid: int, number: signal.Signals) -> None:
    """Signal a process of this process's tree by its pidfd, unless it has ended; a process that
    took its pid is not of the tree."""
    try:
        pidfd = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        if is_below(pid, os.getpid()):  # asked after the pidfd names the process
            signal.pidfd_send_signal(pidfd, number)
    except ProcessLookupError:
        pass
    finally:
        os.close(pidfd)


def is_below(pid: int, ancestor: int) -> bool:
    """Return whether a process is another one, or descends from it."""
    while pid > 1 and pid != ancestor:
        stat = procfs.read_stat(pid)
        pid = 0 if stat is None else stat.parent_pid
    return pid == ancestor
