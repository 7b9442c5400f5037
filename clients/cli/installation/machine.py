"""The machine's users, groups and services, and the commands that change them."""

import grp
import os
import pwd
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
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
    except FileNotFoundError as error:
        raise InstallFailed(
            f"{argv[0]} is not installed", hint="install it, then run the command again"
        ) from error
    except subprocess.TimeoutExpired as error:
        raise InstallFailed(f"{' '.join(argv)}: no end after {COMMAND_S:g} s") from error
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip()).replace("\n", "; ")
        raise InstallFailed(f"{' '.join(argv)} failed with {done.returncode}: {said}")
    return done.stdout


@dataclass(frozen=True, slots=True)
class Services:
    """systemd of the machine, or of the calling user."""

    system: bool

    def check(self) -> None:
        """Raises ConfigError where no systemd would start the units."""
        if not _BOOTED.is_dir():
            raise ConfigError(
                f"systemd does not run on this machine: {_BOOTED} is missing",
                hint="in a container or a chroot, write only the files: --root /FOLDER",
            )
        if not self.system and "XDG_RUNTIME_DIR" not in os.environ:
            raise ConfigError(
                "no systemd of this user: XDG_RUNTIME_DIR is not set",
                hint="log in with a session (ssh, machinectl shell), not through su",
            )

    def ctl(self, *arguments: str) -> str:
        """Run systemctl. Raises InstallFailed."""
        return command("systemctl", *([] if self.system else ["--user"]), *arguments)

    def is_active(self, unit: str) -> bool:
        return self._state(unit, "ActiveState") in ("active", "activating", "reloading")

    def is_enabled(self, unit: str) -> bool:
        return self._state(unit, "UnitFileState") == "enabled"

    def _state(self, unit: str, name: str) -> str:
        return self.ctl("show", unit, f"--property={name}", "--value").strip()

    def known(self, patterns: Sequence[str], wants: Path) -> list[str]:
        """Return the units of these patterns that are loaded, and the instances that are enabled
        by links below the folder `wants`."""
        listed = self.ctl("list-units", "--all", "--plain", "--no-legend", "--full")
        names = {line.split()[0] for line in listed.splitlines() if line.strip()}
        names |= {path.name for path in wants.glob("*.wants/*")}
        return sorted(
            name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)
        )


def has_user(name: str) -> bool:
    try:
        pwd.getpwnam(name)
    except KeyError:
        return False
    return True


def has_group(name: str) -> bool:
    try:
        grp.getgrnam(name)
    except KeyError:
        return False
    return True


def members(group: str) -> list[str]:
    """Return the users of a group that exists."""
    found = grp.getgrnam(group)
    first = [user.pw_name for user in pwd.getpwall() if user.pw_gid == found.gr_gid]
    return sorted({*found.gr_mem, *first})


def is_member(user: str, group: str) -> bool:
    """Return whether a user belongs to a group; False if either does not exist."""
    try:
        found, account = grp.getgrnam(group), pwd.getpwnam(user)
    except KeyError:
        return False
    return user in found.gr_mem or account.pw_gid == found.gr_gid
