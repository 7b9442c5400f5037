"""Whether the system's units may run this environment: no user other than root can change it.

systemd starts the units as services of the machine: a program that a plain user may write would run
with their groups and devices.
"""

import os
import stat
import sys
from pathlib import Path
from typing import Final

from vram_arbiter.clients.cli.installation.site import PROGRAMS
from vram_arbiter.schemas.errors import ConfigError

AS_A_UNIT: Final = (
    "unshare", "--mount", "sh", "-c",
    "for hidden in /home /root /run/user /tmp; do"
    " test ! -d $hidden || mount -t tmpfs -o mode=0 tmpfs $hidden || exit; done;"
    " exec env -i setpriv --reuid=65534 --regid=65534 --clear-groups"
    " $0 -I -c 'import vram_arbiter.clients.cli.main'", sys.executable,
)  # fmt: skip
"""What root can read says little of a unit, which has another user, and these folders hidden."""


def check_environment() -> None:
    """Check the environment of this program for the system's units. Raises ConfigError."""
    programs = [f"{sys.prefix}/bin/{name}" for name in PROGRAMS]
    for place in (*programs, sys.executable, *filter(os.path.exists, sys.path), *libraries()):
        check_path(Path(place))


def libraries() -> set[str]:
    """Return the shared libraries of this interpreter: a libpython lies where its builder put
    it."""
    lines = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    return {line.split(None, 5)[5] for line in lines if "/" in line and ".so" in line}


def check_path(path: Path) -> None:
    """Check a program or folder of the system's units, every folder above it and every link on the
    way, as the kernel walks them. Raises ConfigError."""
    try:
        path.resolve(strict=True)
    except (OSError, RuntimeError) as error:
        raise ConfigError(f"{path}: {error}") from error
    for step in (*reversed(path.parents), path):
        found = step.lstat()
        if problem := writable_by_others(found):
            raise ConfigError(
                f"{step} {problem}: this user could change what the units run",
                hint=f"let it belong to root: chown root:root {step}; chmod go-w {step}",
            )
        if stat.S_ISLNK(found.st_mode):
            check_path(step.parent / os.readlink(step) / path.relative_to(step))
            return


def writable_by_others(found: os.stat_result) -> str:
    """Return why a user other than root could change a file or folder; empty: none can."""
    if found.st_uid != 0:
        return f"belongs to uid {found.st_uid}"
    if stat.S_ISLNK(found.st_mode):
        return ""
    if found.st_mode & stat.S_IWOTH:
        return "may be written by every user"
    if found.st_mode & stat.S_IWGRP and found.st_gid != 0:
        return f"may be written by group {found.st_gid}"
    return ""
