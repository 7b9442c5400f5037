"""Pids of the driver as pids of this namespace: NVML counts in the host's, a daemon may run in a
container.

On a host there is nothing to translate (the kernel gives the pids of clients in containers as the
host's). In a container the same number is another process, so a pid is believed only if the host's
/proc, mounted somewhere here, leads from it to one of ours: NSpid names its pids in every namespace
below, and the start time must agree. Evidence only: a reading's total does not depend on any of
this.
"""

import logging
import os
from pathlib import Path
from typing import Literal

from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import procfs

log = logging.getLogger(__name__)

INITIAL_NAMESPACE = "pid:[4026531836]"
"""The kernel's fixed inode number of the first pid namespace (PROC_PID_INIT_INO)."""


class PidMap:
    """`translate(pid)` says which process of this namespace a driver's pid is.

    `pids`: `own`: the driver counts as we do; `host`: it counts as `host_proc` does; `auto`: `own`
    on a host, `host` in a container. `proc` is the daemon's own /proc.
    """

    def __init__(
        self,
        pids: Literal["auto", "own", "host"] = "auto",
        host_proc: Path | None = None,
        proc: Path = Path("/proc"),
    ) -> None:
        self._proc = proc
        self._host_proc = host_proc
        self._own = pids == "own" or (pids == "auto" and _is_initial(proc))
        self._told: set[int] = set()
        if not self.knows:
            log.warning(
                "pid_unmapped: this daemon lives in a pid namespace and cannot tell whose bytes "
                "the driver lists; totals decide alone. "
                "Mount the host's /proc and set gpu.host_proc, or set gpu.pids to own"
            )

    @property
    def knows(self) -> bool:
        """False: the driver's pids mean nothing here, so its lists are no evidence."""
        return self._own or self._host_proc is not None

    @property
    def listed_in(self) -> Path:
        """The /proc that shows the processes by the driver's pids; only where something `knows`."""
        return self._proc if self._own or self._host_proc is None else self._host_proc

    def translate(self, pid: int) -> tuple[ProcessKey, str]:
        """(process, name). A process of another namespace gets its host's pid, negative, so that it
        is never taken for one of ours."""
        if self._own:
            return process_key(self._proc, pid), process_name(self._proc, pid)
        assert self._host_proc is not None, "there is nothing to translate with"
        host = process_key(self._host_proc, pid)
        name = process_name(self._host_proc, pid)
        for ours in _inner_pids(self._host_proc, pid):
            key = process_key(self._proc, ours)
            if key.start_ticks and key.start_ticks == host.start_ticks:
                return key, name
        if pid not in self._told:
            self._told.add(pid)
            log.warning(
                "pid_unmapped: host pid %d (%s) is not a process of this namespace",
                pid,
                name or "unseen",
            )
        return ProcessKey(-pid, 0), f"host pid {pid} {name}".strip()


def process_key(proc: Path, pid: int) -> ProcessKey:
    """Return the process, with its start time if it can be seen from here."""
    stat = procfs.read_stat(pid, proc)
    return ProcessKey(pid, 0 if stat is None else stat.start_ticks)


def process_name(proc: Path, pid: int) -> str:
    """Program and, for an interpreter, what it runs: `python -m vram_arbiter.sidecars` says more
    than `python`."""
    try:
        words = (proc / str(pid) / "cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return ""
    return " ".join([Path(words[0]).name, *(word for word in words[1:3] if word)])[:128].strip()


def _is_initial(proc: Path) -> bool:
    try:
        return os.readlink(proc / "self" / "ns" / "pid") == INITIAL_NAMESPACE
    except OSError:
        return True  # a kernel without pid namespaces


def _inner_pids(host_proc: Path, pid: int) -> list[int]:
    """Its pids in the namespaces below the host's, outermost first; none for a process of the host
    itself."""
    try:
        lines = (host_proc / str(pid) / "status").read_text(errors="replace").splitlines()
    except OSError:
        return []
    found = next((line for line in lines if line.startswith("NSpid:")), "")
    return [int(word) for word in found.split()[2:] if word.isdecimal()]
