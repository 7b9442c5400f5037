"""Host RAM: what the kernel says is available, and how freed memory goes back to it."""

import ctypes
from pathlib import Path

MEMINFO = Path("/proc/meminfo")
PARK_SHARE = 2
"""Of what is available at start, one part in so many may keep parked weights."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # <malloc.h>
_THRESHOLD_BYTES = 128 * 1024


def give_back_freed_memory() -> None:
    """Let malloc return large buffers to the kernel when they are freed, for the rest of this
    process.

    glibc raises its threshold for mmap (mallopt(3), M_MMAP_THRESHOLD) with every large buffer that
    is freed, up to 32 MiB, and keeps what lies below it: after one attack with incomplete messages
    the daemon stayed at 136 MiB; with fixed thresholds it is back at 29. Without effect on another
    C library.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _THRESHOLD_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _THRESHOLD_BYTES)


def available_bytes(meminfo: Path = MEMINFO) -> int:
    """What a program could have now without swapping. Raises OSError, or ValueError where the
    kernel does not say."""
    for line in meminfo.read_text().splitlines():
        name, _, rest = line.partition(":")
        if name == "MemAvailable":
            return int(rest.split()[0]) * 1024
    raise ValueError(f"{meminfo} has no MemAvailable")


def park_budget_bytes(configured: int | None, meminfo: Path = MEMINFO) -> int:
    """The budget for parked weights: what the operator says, else half of what is available; where
    that is unknown, nothing."""
    if configured is not None:
        return configured
    try:
        return available_bytes(meminfo) // PARK_SHARE
    except (OSError, ValueError):
        return 0
