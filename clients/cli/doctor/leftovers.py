"""Checks of what dead programs left, and of clashes with other arbiters."""

import os
from collections.abc import Iterator, Sequence
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import CouldNotLook, Finding, error, note, warning
from vram_arbiter.clients.cli.doctor.machine import SYSTEM_STATE, Machine, unix_sockets
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.yamltext import parse_yaml

ASIDE: Final = ".corrupt-"
CONFIG: Final = "/etc/vram-arbiter/arbiter.yaml"
PROGRAM: Final = "vram-arbiter"
MODULE: Final = "vram_arbiter.arbiter"


def sockets(m: Machine) -> Iterator[Finding]:
    """Each socket of the runtime folder is served, each lock belongs to a socket."""
    folder = os.path.dirname(m.socket)
    names, bound = m.names(folder), unix_sockets(m)
    if not names:
        raise CouldNotLook(f"{folder} is empty, or not there")
    for name in names:
        path = f"{folder}/{name}"
        if name.endswith(".sock") and path not in bound:
            what = f"{path} is left over: no process has it open"
            yield warning("orphans.socket", what, f"{m.sudo}rm {path}")
        if not name.endswith(".sock.lock") or name.removesuffix(".lock") in names:
            continue
        if _is_locked(m, path):
            what = f"a program holds {path} but its socket was removed: no client can reach it"
            yield error("orphans.unlinked", what, m.service("restart"))
        else:
            what = f"{path}: no program holds it, as after a stop"
            yield note("orphans.lock", what, f"{m.sudo}rm {path}")


def files(m: Machine) -> Iterator[Finding]:
    """No journal or history was put aside."""
    folder = _state_folder(m)
    if not m.exists(folder):
        raise CouldNotLook(f"{folder} is not there")
    for name in m.names(folder):
        if ASIDE in name:
            yield warning(
                "files.aside",
                f"{folder}/{name} could not be used and was set aside; check the disk, remove it",
                f"{m.sudo}rm {folder}/{name}",
            )


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


def _state_folder(m: Machine) -> str:
    words = m.command_line(m.arbiter.pid) if m.arbiter.pid else []
    path = flag(words, "--config") or (CONFIG if m.is_system else "")
    try:
        config = parse_yaml((path and m.text(path)) or "", path).data
    except ConfigError as error:
        raise CouldNotLook(error.message) from error
    section = config.get("state") if isinstance(config, dict) else None
    named = section.get("dir") if isinstance(section, dict) else None
    if named := flag(words, "--state-dir") or named:
        return str(named)
    if m.is_system:
        return SYSTEM_STATE
    beside = f"{os.path.dirname(m.socket)}/state"
    if m.exists(beside):
        return beside
    home = m.environ.get("XDG_STATE_HOME") or f"{m.environ.get('HOME', '/')}/.local/state"
    return f"{home}/vram-arbiter"


def _is_locked(m: Machine, path: str) -> bool:
    """Whether a process holds the lock of a file, by the kernel's table. Raises CouldNotLook."""
    found, table = m.stat(path), m.text("/proc/locks")
    if table is None:
        raise CouldNotLook("/proc/locks is not there")
    locks = [line.split() for line in table.splitlines()]
    inodes = [words[5].split(":")[2] for words in locks if len(words) > 5 and words[1] == "FLOCK"]
    return found is not None and str(found.st_ino) in inodes


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
