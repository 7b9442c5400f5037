"""Checks of what the kernel may do to the daemon when memory runs out."""

from collections.abc import Iterator
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import CouldNotLook, Finding, warning
from vram_arbiter.clients.cli.doctor.machine import Machine
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.sizes import format_bytes

LIMIT_MIN_BYTES: Final = 256 * MIB
"""The daemon takes 30 to 140 MiB."""
UNIT_SCORE: Final = -500
"""OOMScoreAdjust= of the unit."""


def memory(m: Machine) -> Iterator[Finding]:
    """No cgroup above the daemon limits it to less than it needs."""
    lines = m.daemon_file("cgroup").splitlines()
    group = next(
        (one.removeprefix("0::").rstrip("/") for one in lines if one.startswith("0::")), ""
    )
    if not m.exists("/sys/fs/cgroup/cgroup.controllers"):
        raise CouldNotLook("this machine has no cgroup v2")
    while group:
        place, unit = f"/sys/fs/cgroup{group}", group.rpartition("/")[2]
        lift = f"{m.sudo}systemctl set-property {unit}"
        for name, key in (("memory.max", "MemoryMax"), ("memory.high", "MemoryHigh")):
            limit = (m.text(f"{place}/{name}") or "max").strip()
            if limit != "max" and int(limit) < LIMIT_MIN_BYTES:
                size = format_bytes(int(limit))
                what = f"{name} of {group} is {size}, the daemon may need 140 MiB"
                yield warning("cgroup.limit", what, f"{lift} {key}=infinity")
        group = group.rpartition("/")[0]


def out_of_memory(m: Machine) -> Iterator[Finding]:
    """The daemon is not the first to be killed."""
    score = int(m.daemon_file("oom_score_adj"))
    if score > 0 or (score > UNIT_SCORE and m.is_system):
        yield warning(
            "oom.score",
            f"oom_score_adj of the daemon is {score}: when host memory runs out it ends before "
            "programs that it knows",
            f"echo {UNIT_SCORE} | {m.sudo}tee /proc/{m.arbiter.pid}/oom_score_adj",
        )
