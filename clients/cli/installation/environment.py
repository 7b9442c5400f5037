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
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from vram_arbiter.clients.cli.installation.site import LINKS_MAX, PROGRAMS
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.version import version

HIDDEN: Final = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""Not seen by the system's units (ProtectHome=, PrivateTmp=): systemd reports 203/EXEC alone."""
ELSEWHERE: Final = (
    "make the environment elsewhere, with a Python elsewhere: "
    "UV_PYTHON_INSTALL_DIR=/opt/python uv python install 3.12"
)
_PLAIN: Final = re.compile(r"/[A-Za-z0-9._+/-]*")
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


def check_prefix(prefix: Path) -> None:
    """Raises ConfigError for a path that a unit file cannot hold as it is."""
    if not _PLAIN.fullmatch(str(prefix)) or ".." in prefix.parts:
        raise ConfigError(
            f"expected an absolute path of letters, digits and ._+- for --prefix, got '{prefix}'",
            hint="a unit file gives other characters a meaning",
        )


def check_environment(prefix: Path, *, system: bool) -> None:
    """Check the environment that the units will run. Raises ConfigError."""
    programs = [prefix / "bin" / name for name in PROGRAMS]
    for program in programs:
        if not os.access(program, os.X_OK):
            raise ConfigError(
                f"not found: {program}",
                hint="install the product there first, or name its environment with --prefix",
            )
    python = _interpreter(programs[0])
    if system:
        for program in (*programs, python):
            check_path(program)
    found, *places = _ask(python, _AS_A_UNIT if system else ())
    if system:
        for path in places:
            if os.path.exists(path):
                check_path(Path(path))
    if found != version():
        raise ConfigError(
            f"{prefix} has version {found}, this is version {version()}",
            hint=f"run {prefix}/bin/vramctl install",
        )


def _interpreter(program: Path) -> Path:
    """Return the interpreter that a program names in its first line. Raises ConfigError."""
    with program.open("rb") as file:
        found = re.match(rb"#!(/\S+)\s*$", file.readline())
    if found is None:
        raise ConfigError(f"{program} is not a program of pip's", hint="install the product again")
    return Path(os.fsdecode(found[1]))


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
        if through:
            raise ConfigError(
                f"a unit cannot run the product by {python}: {said}",
                hint="every user has to be able to read the environment, its Python and libpython; "
                + ELSEWHERE,
            )
        raise ConfigError(f"{python} cannot run the product: {said}", hint="install it there again")
    answer: list[str] = json.loads(done.stdout)
    return answer


def check_path(path: Path) -> None:
    """Check a program or folder of the system's units, every folder above it and every link on the
    way. Raises ConfigError."""
    for step, found in _steps(path):
        if any(step.is_relative_to(hidden) for hidden in HIDDEN):
            raise ConfigError(f"the system's units cannot read {step}", hint=ELSEWHERE)
        if problem := writable_by_others(found):
            raise ConfigError(
                f"{step} {problem}: this user could change what the units run",
                hint=f"let it belong to root: chown root:root {step}; chmod go-w {step}",
            )


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


def _steps(path: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield the components of a path as the kernel walks them. Raises ConfigError."""
    links = 0
    while True:
        for step in (*reversed(path.parents), path):
            try:
                found = step.lstat()
            except OSError as error:
                raise ConfigError(f"{step}: {error.strerror}") from error
            yield step, found
            if stat.S_ISLNK(found.st_mode):
                links += 1
                if links > LINKS_MAX:
                    raise ConfigError(f"{step}: too many links")
                path = step.parent / os.readlink(step) / path.relative_to(step)
                break
        else:
            return
