"""The machine's users, groups and units, and the commands that change them."""

import grp
import os
import pwd
import re
import subprocess
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from vram_arbiter.schemas.errors import ConfigError, InstallFailed

COMMAND_S = 150.0
"""A start waits up to 90 s for a driver that initializes its GPUs."""
_BOOTED = Path("/run/systemd/system")


def command(*argv: str) -> str:
    """Run a command of the machine and return what it prints. Raises InstallFailed."""
    try:
        done = subprocess.run(
            argv, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=COMMAND_S,
            check=False,
        )  # fmt: skip
    except (FileNotFoundError, subprocess.TimeoutExpired) as error:
        raise InstallFailed(f"{' '.join(argv)}: {error}") from error
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip()).replace("\n", "; ")
        raise InstallFailed(f"{' '.join(argv)} failed with {done.returncode}: {said}")
    return done.stdout


def check_systemd(*, system: bool) -> None:
    """Raises ConfigError where no systemd would start the units."""
    if not _BOOTED.is_dir():
        raise ConfigError(
            f"systemd does not run on this machine: {_BOOTED} is missing",
            hint="in a container or a chroot, write only the files: --root /FOLDER",
        )
    if not system and "XDG_RUNTIME_DIR" not in os.environ:
        raise ConfigError(
            "no systemd of this user: XDG_RUNTIME_DIR is not set",
            hint="log in with a session (ssh, machinectl shell), not through su",
        )


def systemctl(*arguments: str, system: bool) -> list[str]:
    return ["systemctl", *([] if system else ["--user"]), *arguments]


def known_units(patterns: Sequence[str], wants: Path, *, system: bool) -> list[str]:
    """Return the units of these patterns that are loaded, and the instances that are enabled by
    links below the folder `wants`."""
    listed = command(*systemctl("list-units", "--all", "--plain", "--no-legend", system=system))
    names = {line.split()[0] for line in listed.splitlines() if line.strip()}
    names |= {path.name for path in wants.glob("*.wants/*")}
    return sorted(name for name in names if any(fnmatchcase(name, one) for one in patterns))


def is_active(unit: str, *, system: bool) -> bool:
    """Return whether a unit runs."""
    argv = systemctl("is-active", "--quiet", unit, system=system)
    return subprocess.run(argv, timeout=COMMAND_S, check=False).returncode == 0


def missing_accounts(snippet: str) -> list[tuple[str, str]]:
    """Return the users and groups of a sysusers.d snippet that the machine has not."""
    users = [("user", name) for name in re.findall(r"^u (\S+)", snippet, re.MULTILINE)]
    # a user has a group of its name
    groups = [("group", name) for name in re.findall(r"^[gu] (\S+)", snippet, re.MULTILINE)]
    return [account for account in [*users, *groups] if not exists(*account)]


def exists(kind: str, name: str) -> bool:
    """Return whether a user or a group is there."""
    try:
        (pwd.getpwnam if kind == "user" else grp.getgrnam)(name)
    except KeyError:
        return False
    return True
