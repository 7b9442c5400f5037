"""Host RAM of this machine, as the kernel counts it. Reads one file; decides nothing."""

from pathlib import Path

MEMINFO = Path("/proc/meminfo")
PARK_SHARE = 2
"""Of what is available at start, one part in so many may keep parked weights."""


def available_bytes(meminfo: Path = MEMINFO) -> int:
    """What a program could have now without swapping. Raises OSError, or ValueError where the kernel does not say."""
    for line in meminfo.read_text().splitlines():
        name, _, rest = line.partition(":")
        if name == "MemAvailable":
            return int(rest.split()[0]) * 1024
    raise ValueError(f"{meminfo} has no MemAvailable")


def park_budget_bytes(configured: int | None, meminfo: Path = MEMINFO) -> int:
    """The budget for parked weights: what the operator says, else half of what is available; where that is unknown, nothing."""
    if configured is not None:
        return configured
    try:
        return available_bytes(meminfo) // PARK_SHARE
    except (OSError, ValueError):
        return 0
