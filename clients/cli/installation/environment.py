"""Whether the units may run the programs of an environment: they start, are of this version, and no
other user can change them.

systemd starts the units as services of the machine: a program that a plain user may write would run
with their groups and devices.
"""

import json
import os
import re
import stat
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from vram_arbiter.clients.cli.installation.site import PROGRAMS
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.version import version

HIDDEN: Final = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""Not seen by the system's units (ProtectHome=, PrivateTmp=): systemd reports 203/EXEC alone."""
ELSEWHERE: Final = (
    "make the environment elsewhere, with a Python elsewhere: "
    "UV_PYTHON_INSTALL_DIR=/opt/python uv python install 3.12"
)
_START_S: Final = 60.0
_ASK: Final = (
    "import json, sys, vram_arbiter\n"
    "from vram_arbiter.schemas.runtime.version import version\n"
    "files = {line.split(None, 5)[5].strip() for line in open('/proc/self/maps') if '/' in line}\n"
    "print(json.dumps([version(), vram_arbiter.__file__, *sys.path, *sorted(files)]))"
)
"""The mapped files are the interpreter's libraries: a libpython lies where its builder put it."""
_AS_A_UNIT: Final = (
    "unshare", "--mount", "sh", "-c",
    "for hidden in $0; do"
    " test ! -d $hidden || mount -t tmpfs -o mode=0 tmpfs $hidden || exit; done;"
    ' exec setpriv --reuid=65534 --regid=65534 --clear-groups "$@"',
    " ".join(HIDDEN),
)  # fmt: skip
"""What root can read says little of a unit, which has another user, and these folders hidden."""


def check_environment(prefix: Path, *, system: bool) -> None:
    """Check the environment that the units will run. Raises ConfigError."""
    programs = [prefix / "bin" / name for name in PROGRAMS]
    for program in programs:
        if not os.access(program, os.X_OK):
            raise ConfigError(
                f"not found: {program}",
                hint="install the product there first, or name its environment with --prefix",
            )
    first_line = re.match(rb"#!(/\S+)\s*\n", programs[0].read_bytes())
    if first_line is None:
        raise ConfigError(
            f"{programs[0]} is not a program of pip's", hint="install the product again"
        )
    python = Path(os.fsdecode(first_line[1]))
    for program in (*programs, python) if system else ():
        check_path(program)
    found, *places = _ask(python, _AS_A_UNIT if system else ())
    for place in places if system else ():
        if os.path.exists(place):
            check_path(Path(place))
    if found != version():
        raise ConfigError(
            f"{prefix} has version {found}, this is version {version()}",
            hint=f"run {prefix}/bin/vramctl install",
        )


def _ask(python: Path, through: Sequence[str] = ()) -> list[str]:
    """Return version, package, import folders and mapped files of an environment, whose interpreter
    is started `through` a command. Raises ConfigError."""
    done = subprocess.run(
        [*through, python, "-I", "-c", _ASK],
        env={}, cwd="/", capture_output=True, text=True, timeout=_START_S, check=False,
    )  # fmt: skip
    if through and done.stderr.startswith(("unshare:", "mount:")):
        return _ask(python)  # a container, where units get no folders of their own either
    if done.returncode:
        said = done.stderr.strip().rpartition("\n")[2] or f"exit code {done.returncode}"
        who = "a unit" if through else "this user"
        raise ConfigError(
            f"{who} cannot run the product by {python}: {said}",
            hint="every user has to be able to read the environment, its Python and libpython; "
            + ELSEWHERE,
        )
    answer: list[str] = json.loads(done.stdout)
    return answer


def check_path(path: Path) -> None:
    """Check a program or folder of the system's units, every folder above it and every link on the
    way, as the kernel walks them. Raises ConfigError."""
    try:
        path.resolve(strict=True)
    except (OSError, RuntimeError) as error:
        raise ConfigError(f"{path}: {error}") from error
    for step in (*reversed(path.parents), path):
        found = step.lstat()
        if any(step.is_relative_to(hidden) for hidden in HIDDEN):
            raise ConfigError(f"the system's units cannot read {step}", hint=ELSEWHERE)
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
