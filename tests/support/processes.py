"""What /proc tells about the processes of a program under test."""

import os
from pathlib import Path

from vram_arbiter.schemas.runtime import procfs


def children(pid: int) -> list[int]:
    """Return the pids of a process's children."""
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(child) for child in listed.split()]


def alive(pid: int) -> bool:
    """Return whether a process runs; a zombie does not."""
    stat = procfs.read_stat(pid)
    return stat is not None and stat.alive


def rss_bytes(pid: int) -> int:
    """Return the bytes of a process that are in RAM."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


def threads(pid: int) -> int:
    """Return the number of a process's threads."""
    return len(os.listdir(f"/proc/{pid}/task"))


def server_of_imports(sidecar: int) -> int:
    """Return the pid of the sidecar's child from which its keeper is forked."""
    (server,) = [
        pid
        for pid in children(sidecar)
        if "resource_tracker" not in Path(f"/proc/{pid}/cmdline").read_text()
    ]
    return server
