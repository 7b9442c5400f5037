"""Checks of what dead programs left, and of clashes with other arbiters."""

import os
from collections.abc import Iterator, Sequence
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import CouldNotLook, Finding, warning
from vram_arbiter.clients.cli.doctor.machine import Machine, unix_sockets

PROGRAM: Final = "vram-arbiter"
MODULE: Final = "vram_arbiter.arbiter"


def sockets(m: Machine) -> Iterator[Finding]:
    """Each socket of the runtime folder is served."""
    folder = os.path.dirname(m.socket)
    names, bound = m.names(folder), unix_sockets(m)
    if not names:
        raise CouldNotLook(f"{folder} is empty, or not there")
    for name in names:
        path = f"{folder}/{name}"
        if name.endswith(".sock") and path not in bound:
            what = f"{path} is left over: no process has it open"
            yield warning("orphans.socket", what, f"{m.sudo}rm {path}")


def arbiters(m: Machine) -> Iterator[Finding]:
    """At most one arbiter leases the real GPUs of this machine."""
    found = {pid: words for pid in m.pids() if _is_arbiter(words := m.command_line(pid))}
    real = {
        pid: words for pid, words in found.items() if not flag(words, "--gpu").startswith("fake:")
    }
    if len(real) > 1:
        named = ", ".join(f"pid {pid} ({' '.join(words[-3:])})" for pid, words in real.items())
        spare = next((pid for pid in sorted(real, reverse=True) if pid != m.arbiter.pid), 0)
        what = f"{len(real)} arbiters run without knowing each other: {named}"
        yield warning("ports.arbiters", what, f"{m.sudo}kill {spare}")


def _is_arbiter(words: Sequence[str]) -> bool:
    names = [os.path.basename(word) for word in words[:3]]
    if not names or not names[0].startswith("python"):
        return names[:1] == [PROGRAM]
    return names[1:2] == [PROGRAM] or names[1:] == ["-m", MODULE]


def flag(words: Sequence[str], name: str) -> str:
    """Return the value of a flag, "" where it is not given."""
    for word, value in zip(words, [*words[1:], ""], strict=False):
        if word == name:
            return value
        if word.startswith(f"{name}="):
            return word.partition("=")[2]
    return ""
