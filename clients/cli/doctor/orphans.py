"""Checks of what dead programs left: sockets, locks, files put aside."""

import os
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
from vram_arbiter.clients.cli.doctor.machine import SYSTEM_STATE, Machine, unix_sockets
from vram_arbiter.clients.cli.doctor.options import options_of

ASIDE: Final = ".corrupt-"


def sockets(m: Machine) -> Iterator[Finding]:
    """Each socket of the runtime folder is served, each lock belongs to a socket."""
    folder = os.path.dirname(m.socket)
    names, bound = m.names(folder), unix_sockets(m)
    clean = True
    if not names:
        raise CouldNotLook(f"{folder} is empty, or not there")
    for name in names:
        path = f"{folder}/{name}"
        if name.endswith(".sock") and path not in bound:
            clean = False
            what = f"{path} is left over: no process has it open"
            yield warning("orphans.socket", what, f"{m.sudo}rm {path}")
        elif name.endswith(".sock.lock") and (held := _is_locked(m, path)) is not None:
            served = name.removesuffix(".lock") in names
            if held and not served:
                clean = False
                yield error(
                    "orphans.unlinked",
                    f"a program holds {path} but its socket was removed: no client can reach it",
                    m.service("restart"),
                )
            elif not held and not served:
                clean = False
                yield note(
                    "orphans.lock",
                    f"{path}: no program holds it, as after a stop",
                    f"{m.sudo}rm {path}",
                )
    if clean:
        yield ok("orphans.none", f"{folder}: every socket is served")


def files(m: Machine) -> Iterator[Finding]:
    """No journal or history was put aside."""
    folder = _state_folder(m)
    if not m.exists(folder):
        raise CouldNotLook(f"{folder} is not there")
    aside = [name for name in m.names(folder) if ASIDE in name]
    for name in aside:
        yield warning(
            "files.aside",
            f"{folder}/{name} could not be used and was set aside; check the disk, then remove it",
            f"{m.sudo}rm {folder}/{name}",
        )
    if not aside:
        yield ok("files.sound", f"{folder}: nothing was set aside")


def _state_folder(m: Machine) -> str:
    options = options_of(m)
    if named := options.flag("--state-dir") or options.key("state", "dir"):
        return named
    if m.is_system:
        return SYSTEM_STATE
    beside = f"{os.path.dirname(m.socket)}/state"
    if m.exists(beside):
        return beside
    home = m.environ.get("XDG_STATE_HOME") or f"{m.environ.get('HOME', '/')}/.local/state"
    return f"{home}/vram-arbiter"


def _is_locked(m: Machine, path: str) -> bool | None:
    """Whether a process holds the lock of a file, by the kernel's table. Raises CouldNotLook."""
    found, table = m.stat(path), m.text("/proc/locks")
    if table is None:
        raise CouldNotLook("/proc/locks is not there")
    if found is None:
        return None
    inodes = [
        words[5].split(":")[2]
        for line in table.splitlines()
        if len(words := line.split()) > 5 and words[1] == "FLOCK"
    ]
    return str(found.st_ino) in inodes
