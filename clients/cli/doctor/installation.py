"""Checks of the installation: where programs come from, versions, systemd units."""

import os
import shlex
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
from vram_arbiter.clients.cli.doctor.machine import UNIT, Machine, user_folders

SYSTEM_FOLDERS: Final = ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")


def origins(m: Machine) -> Iterator[Finding]:
    """One copy of the package is on the path, and the programs on PATH belong to it."""
    installed = m.installed
    yield ok("installation.origin", f"{installed.package} ({installed.version})")
    if installed.strays:
        yield error(
            "installation.mixed",
            f"modules come from two copies of the package, also from {installed.strays[0]}",
            _remove(installed.strays[0], installed.bin),
        )
    for copy in installed.copies:
        if os.path.realpath(copy) != os.path.realpath(installed.package):
            yield note(
                "installation.shadowed",
                f"another copy is on the path of this Python, but is not used: {copy}",
                _remove(copy, installed.bin),
            )
    for name, place in installed.programs.items():
        own = os.path.realpath(f"{installed.bin}/{name}")
        if place != own and os.path.exists(own):
            yield warning(
                "installation.path",
                f"`{name}` on PATH is {place}, this installation has {own}",
                f"{m.sudo}ln -sf {own} /usr/local/bin/{name}",
            )


def _remove(copy: str, bin: str) -> str:
    """Return the command after which another copy of the package is no longer found."""
    if "/site-packages/" in copy:
        return f"{bin}/python -m pip uninstall vram-arbiter"
    return "unset PYTHONPATH"


def versions(m: Machine) -> Iterator[Finding]:
    """Client and daemon are of one version."""
    if m.arbiter.refusal is not None and m.arbiter.refusal.code == "version_mismatch":
        yield error("versions.wire", m.arbiter.refusal.message, m.service("restart"))
    elif m.arbiter.status is None:
        raise CouldNotLook("no arbiter answers")
    elif (daemon := m.arbiter.server.rpartition(" ")[2]) != m.installed.version:
        yield warning(
            "versions.differ",
            f"the daemon runs {daemon or 'an unknown version'}, this program is "
            f"{m.installed.version}",
            m.service("restart"),
        )
    else:
        yield ok("versions.same", f"client and daemon are {daemon}")


def units(m: Machine) -> Iterator[Finding]:
    """The arbiter's unit is installed, enabled, and starts a program that exists."""
    if not m.exists("/run/systemd/system"):
        raise CouldNotLook("systemd does not run here")
    system = _unit(m, SYSTEM_FOLDERS)
    user = _unit(m, user_folders(m.environ))
    if system is None and user is None:
        yield note(
            "units.missing",
            "no unit vram-arbiter.service: the arbiter does not start with the machine",
            f"{m.sudo}vramctl install",
        )
        return
    enabled = _enabled(m, "/etc/systemd/system")
    user_enabled = any(_enabled(m, folder) for folder in user_folders(m.environ))
    found = list(_of_unit(m, system, "system")) if system else []
    found += _of_unit(m, user, "user") if user and user_enabled else []
    if enabled and user_enabled:
        fix = "systemctl --user disable --now vram-arbiter"
        yield warning(
            "units.both", "the system's and a user's unit are enabled: two arbiters of one GPU", fix
        )
    elif not enabled and not user_enabled:
        command = f"{m.sudo}systemctl" if system else "systemctl --user"
        yield warning(
            "units.disabled",
            f"{system or user} is not enabled: the arbiter does not start with the machine",
            f"{command} enable --now vram-arbiter",
        )
    elif not found:
        yield ok("units.enabled", f"{system if enabled else user} is enabled")
    yield from found


def _unit(m: Machine, folders: tuple[str, ...]) -> str | None:
    return next((f"{one}/{UNIT}" for one in folders if m.exists(f"{one}/{UNIT}")), None)


def _enabled(m: Machine, folder: str) -> bool:
    wants = [name for name in m.names(folder) if name.endswith((".wants", ".requires"))]
    return any(m.exists(f"{folder}/{name}/{UNIT}") for name in wants)


def _of_unit(m: Machine, path: str, kind: str) -> Iterator[Finding]:
    if m.exists(path) and os.path.realpath(m.path(path)) == "/dev/null":
        flag = "--user " if kind == "user" else ""
        yield error(f"units.masked-{kind}", f"{path} is masked", f"systemctl {flag}unmask {UNIT}")
        return
    lines = (m.text(path) or "").splitlines()
    started = [line.partition("=")[2] for line in lines if line.startswith("ExecStart=")]
    program = shlex.split(started[0])[0] if started else ""
    if not program or not m.exists(program):
        what = f"{program} is not there" if program else "it starts nothing"
        yield error(f"units.program-{kind}", f"{path}: {what}", f"{m.sudo}vramctl install")
