"""Checks of what the kernel may do to the daemon when memory runs out."""

from collections.abc import Iterator
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import (
    CouldNotLook,
    Finding,
    error,
    note,
    ok,
    warning,
)
from vram_arbiter.clients.cli.doctor.health import status_of
from vram_arbiter.clients.cli.doctor.machine import Machine
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.sizes import format_bytes

LIMIT_MIN_BYTES: Final = 256 * MIB
"""The daemon takes 30 to 140 MiB."""
SWAPPED_MIN_BYTES: Final = MIB
UNIT_SCORE: Final = -500
"""OOMScoreAdjust= of the unit."""


def memory(m: Machine) -> Iterator[Finding]:
    """No cgroup above the daemon limits it to less than it needs, or killed for it."""
    line = next(
        (one for one in m.daemon_file("cgroup").splitlines() if one.startswith("0::")), None
    )
    if line is None or not m.exists("/sys/fs/cgroup/cgroup.controllers"):
        raise CouldNotLook("this machine has no cgroup v2")
    group = line.removeprefix("0::").rstrip("/")
    clean = True
    while group:
        place = f"/sys/fs/cgroup{group}"
        unit = group.rpartition("/")[2]
        for name in ("memory.max", "memory.high"):
            limit = (m.text(f"{place}/{name}") or "max").strip()
            if limit != "max" and int(limit) < LIMIT_MIN_BYTES:
                clean = False
                key = "MemoryMax" if name == "memory.max" else "MemoryHigh"
                yield warning(
                    "cgroup.limit",
                    f"{name} of {group} is {format_bytes(int(limit))}, the daemon may need 140 MiB",
                    f"{m.sudo}systemctl set-property {unit} {key}=infinity",
                )
        kills = _field(m.text(f"{place}/memory.events"), "oom_kill")
        if kills and unit.startswith("vram-arbiter"):
            clean = False
            yield error(
                "cgroup.killed",
                f"the kernel killed {kills} processes of {group} for want of memory",
                f"{m.sudo}systemctl set-property {unit} MemoryMax=infinity",
            )
        group = group.rpartition("/")[0]
    if clean:
        yield ok("cgroup.limit", "no memory limit affects the daemon")


def out_of_memory(m: Machine) -> Iterator[Finding]:
    """The daemon is not the first to be killed, and is not swapped out."""
    score = int(m.daemon_file("oom_score_adj"))
    pid, clean = m.arbiter.pid, True
    if score > 0 or (score > UNIT_SCORE and m.is_system):
        clean = False
        yield warning(
            "oom.score",
            f"oom_score_adj of the daemon is {score}: when host memory runs out it ends before "
            "programs that it knows",
            f"echo {UNIT_SCORE} | {m.sudo}tee /proc/{pid}/oom_score_adj",
        )
    swapped = _field(m.daemon_file("status"), "VmSwap:") * 1024
    if swapped >= SWAPPED_MIN_BYTES:
        clean = False
        yield warning(
            "oom.swapped",
            f"{format_bytes(swapped)} of the daemon are swapped out: decisions wait for the disk",
            f"{m.sudo}systemctl set-property vram-arbiter MemorySwapMax=0 && "
            f"{m.service('restart')}",
        )
    if clean:
        yield ok("oom.score", f"oom_score_adj of the daemon is {score}, nothing is swapped out")


def parked(m: Machine) -> Iterator[Finding]:
    """Parked weights fit into host RAM."""
    ram = status_of(m).host_ram
    info = m.text("/proc/meminfo")
    if info is None:
        raise CouldNotLook("/proc/meminfo is not there")
    available = _field(info, "MemAvailable:") * 1024
    swap = _field(info, "SwapTotal:") * 1024
    more = ram.budget_bytes - ram.parked_bytes
    budget, free = format_bytes(ram.budget_bytes), format_bytes(available)
    if more > available + _field(info, "SwapFree:") * 1024:
        without = "" if swap else ", and there is no swap"
        yield warning(
            "parked.budget",
            f"parked weights may take {budget}, {format_bytes(ram.parked_bytes)} are taken, and "
            f"{free} of host RAM are available{without}",
            f"printf 'host:\\n  park_budget_bytes: {available // 2}\\n' | "
            f"{m.sudo}tee -a /etc/vram-arbiter/arbiter.yaml && {m.service('restart')}",
        )
    elif not swap:
        yield note(
            "parked.no-swap",
            f"the machine has no swap: what exceeds {free} of host RAM ends a process",
            f"{m.sudo}fallocate -l 4G /swapfile && {m.sudo}chmod 600 /swapfile && "
            f"{m.sudo}mkswap /swapfile && {m.sudo}swapon /swapfile",
        )
    else:
        yield ok("parked.budget", f"parked weights may take {budget}, {free} are available")


def _field(text: str | None, name: str) -> int:
    for line in (text or "").splitlines():
        words = line.split()
        if words[:1] == [name]:
            return int(words[1])
    return 0
