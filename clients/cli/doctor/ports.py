"""Checks of clashes: several arbiters of one GPU, ports that another program has."""

import os
from collections.abc import Iterator, Sequence
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import CouldNotLook, Finding, ok, warning
from vram_arbiter.clients.cli.doctor.machine import Machine
from vram_arbiter.clients.cli.doctor.options import flag, options_of

PROGRAM: Final = "vram-arbiter"
MODULE: Final = "vram_arbiter.arbiter"
LISTEN: Final = "0A"


def arbiters(m: Machine) -> Iterator[Finding]:
    """At most one arbiter leases the real GPUs of this machine."""
    found = {pid: words for pid in m.pids() if _is_arbiter(words := m.command_line(pid))}
    real = {pid: words for pid, words in found.items() if not _simulates(words)}
    if len(real) > 1:
        named = ", ".join(f"pid {pid} ({' '.join(words[-3:])})" for pid, words in real.items())
        spare = next((pid for pid in sorted(real, reverse=True) if pid != m.arbiter.pid), 0)
        yield warning(
            "ports.arbiters",
            f"{len(real)} arbiters run without knowing each other: {named}",
            f"{m.sudo}kill {spare}",
        )
    else:
        yield ok("ports.arbiters", f"{len(found)} arbiter{'' if len(found) == 1 else 's'} seen")


def ports(m: Machine) -> Iterator[Finding]:
    """The observer beside the daemon has the port that it was told to serve."""
    http = options_of(m).flag("--http")
    port = http.rpartition(":")[2]
    if not port.isdecimal() or not 0 < int(port) < 65536:
        yield ok("ports.free", "ports of the daemon: none is configured")
        return
    table = "".join(m.text(f"/proc/net/{name}") or "" for name in ("tcp", "tcp6"))
    if not table:
        raise CouldNotLook("/proc/net/tcp is not there")
    owners = {
        int(words[7])
        for line in table.splitlines()
        if len(words := line.split()) > 9
        and words[3] == LISTEN
        and words[1].endswith(f":{int(port):04X}")
    }
    if foreign := owners - {m.arbiter.uid}:
        users = ", ".join(sorted(m.user_name(uid) for uid in foreign))
        yield warning(
            "ports.taken",
            f"port {port} (--http) is taken by a program of {users}",
            f"vram-arbiter --http {http.replace(port, str(int(port) + 1))}",
        )
    else:
        yield ok("ports.free", f"ports of the daemon: {port} (--http)")


def _is_arbiter(words: Sequence[str]) -> bool:
    names = [os.path.basename(word) for word in words[:3]]
    if not names or not names[0].startswith("python"):
        return names[:1] == [PROGRAM]
    return names[1:2] == [PROGRAM] or names[1:] == ["-m", MODULE]


def _simulates(words: Sequence[str]) -> bool:
    return flag(words, "--gpu").startswith("fake:")
