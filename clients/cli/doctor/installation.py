"""Checks of the installation: versions, systemd units."""

import os
import shlex
from collections.abc import Iterator
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import (
    CouldNotLook,
    Finding,
    error,
    note,
    warning,
)
from vram_arbiter.clients.cli.doctor.machine import UNIT, Machine, user_folders

SYSTEM_FOLDERS: Final = ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")


def versions(m: Machine) -> Iterator[Finding]:
    """Client and daemon are of one version."""
    refusal, own = m.arbiter.refusal, m.version
    if refusal is not None and refusal.code == "version_mismatch":
        yield error("versions.wire", refusal.message, m.service("restart"))
    elif m.arbiter.status is None:
        raise CouldNotLook("no arbiter answers")
    elif (daemon := m.arbiter.server.rpartition(" ")[2]) != own:
        what = f"the daemon runs {daemon or 'an unknown version'}, this program is {own}"
        yield warning("versions.differ", what, m.service("restart"))


def units(m: Machine) -> Iterator[Finding]:
    """The arbiter's unit is installed, enabled, and starts a program that exists."""
    if not m.exists("/run/systemd/system"):
        raise CouldNotLook("systemd does not run here")
    system, user = _unit(m, SYSTEM_FOLDERS), _unit(m, user_folders(m.environ))
    if system is None and user is None:
        what = "no unit vram-arbiter.service: the arbiter does not start with the machine"
        yield note("units.missing", what, f"{m.sudo}vramctl install")
        return
    enabled = _enabled(m, "/etc/systemd/system")
    user_enabled = any(_enabled(m, folder) for folder in user_folders(m.environ))
    if enabled and user_enabled:
        what = "the system's and a user's unit are enabled: two arbiters of one GPU"
        yield warning("units.both", what, "systemctl --user disable --now vram-arbiter")
    elif not enabled and not user_enabled:
        command = f"{m.sudo}systemctl" if system else "systemctl --user"
        what = f"{system or user} is not enabled: the arbiter does not start with the machine"
        yield warning("units.disabled", what, f"{command} enable --now vram-arbiter")
    yield from _of_unit(m, system, "system") if system else ()
    yield from _of_unit(m, user, "user") if user and user_enabled else ()


def _unit(m: Machine, folders: tuple[str, ...]) -> str | None:
    return next((f"{one}/{UNIT}" for one in folders if m.exists(f"{one}/{UNIT}")), None)


def _enabled(m: Machine, folder: str) -> bool:
    wants = [name for name in m.names(folder) if name.endswith((".wants", ".requires"))]
    return any(m.exists(f"{folder}/{name}/{UNIT}") for name in wants)


def _of_unit(m: Machine, path: str, kind: str) -> Iterator[Finding]:
    if os.path.realpath(m.path(path)) == "/dev/null":
        flag = "--user " if kind == "user" else ""
        yield error(f"units.masked-{kind}", f"{path} is masked", f"systemctl {flag}unmask {UNIT}")
        return
    lines = (m.text(path) or "").splitlines()
    started = [line.partition("=")[2] for line in lines if line.startswith("ExecStart=")]
    program = shlex.split(started[0])[0] if started else ""
    if not program or not m.exists(program):
        what = f"{program} is not there" if program else "it starts nothing"
        yield error(f"units.program-{kind}", f"{path}: {what}", f"{m.sudo}vramctl install")
