"""Programs that others start: systemd units and containers, under a lease as they are.

They descend from no `vramctl`, so the lease names their cgroup. One that runs already is adopted.
Everything is done by `systemctl`, `podman` and `docker`, with lists of arguments and no shell.
"""

import asyncio
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil
from pathlib import Path
from typing import Any, Final

from vram_arbiter.clients.foreign.say import say
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.limits import CONTAINER_NAME, UNIT_NAME
from vram_arbiter.schemas.runtime import procfs

ENGINES: Final = ("podman", "docker")
ASK_S: Final = 10.0
LOOK_S: Final = 0.2
LOG_LINES: Final = 20
ENDING: Final = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGHUP})


@dataclass(frozen=True, slots=True)
class Service:
    """A unit or a container: the cgroup that it runs in, or will, and the commands for it.

    `run` starts it, unless it runs, and may end before it; `stop` ends it in order, `kill` at once;
    `log` prints the end of its log (empty: it was printed meanwhile). `look()` returns the cgroup
    that it runs in now, "" while it does not, and the exit code of its last run; it blocks.
    """

    name: str
    cgroup: str
    run: Sequence[str]
    stop: Sequence[str]
    kill: Sequence[str]
    log: Sequence[str]
    look: Callable[[], tuple[str, int]]


class ServiceProgram:
    """A service, running. Its manager ends what it started."""

    def __init__(self, service: Service) -> None:
        self.stopping = False
        self._service = service
        self._misplaced = False
        self._run = asyncio.create_task(self._follow())
        self._asked: asyncio.Task[int] | None = None

    @property
    def running(self) -> bool:
        return not self._run.done()

    async def wait(self) -> int:
        """Return its exit code once it has ended."""
        return await asyncio.shield(self._run)

    def send_signal(self, number: signal.Signals) -> None:
        """Pass on the first signal that asks it to end; others are its manager's matter."""
        if number in ENDING and self.running and self._asked is None:
            self._asked = asyncio.create_task(_call(self._service.stop, quiet=True))

    async def end(self, grace_s: float | None) -> bool:
        """Stop it, and kill it after the grace. Return whether that was needed."""
        if not self.running:
            return False
        stopping = asyncio.create_task(_call(self._service.stop, quiet=True))
        await asyncio.wait({self._run}, timeout=grace_s)
        late = self.running
        if late:
            await _call(self._service.kill, quiet=True)
        await self.wait()
        await stopping
        return late

    async def end_orphans(self) -> int:
        return 0

    def reap(self) -> None:
        """It has no children here."""

    def tree(self) -> list[int]:
        """Return the pids of its cgroup."""
        root = procfs.cgroup_root()
        found: list[int] = []
        for folder, _, _ in os.walk(f"{root}{self._service.cgroup}") if root else ():
            with contextlib.suppress(OSError):  # it has ended meanwhile
                found += map(int, Path(folder, "cgroup.procs").read_text().split())
        return found

    async def _follow(self) -> int:
        service = self._service
        checking = asyncio.create_task(self._check())
        code = await _call(service.run)
        running = True
        while running and not code:
            await asyncio.sleep(LOOK_S)
            if not self.tree():
                place, code = await asyncio.to_thread(service.look)
                running = bool(place)
        checking.cancel()
        await _call(service.stop, quiet=True)  # a manager could start it again, without a lease
        if code and service.log:
            await _call(service.log)
        return 1 if self._misplaced else code

    async def _check(self) -> None:
        """End it where it runs outside the cgroup of its lease: its bytes would be a stowaway's."""
        service = self._service
        place = ""
        while not place:
            await asyncio.sleep(LOOK_S)
            place, _ = await asyncio.to_thread(service.look)
        if not f"{place}/".startswith(f"{service.cgroup}/"):
            self._misplaced = True
            say(f"{service.name} runs in the cgroup {place}, not in {service.cgroup}; ending it")
            await _call(service.stop, quiet=True)


async def _call(command: Sequence[str], *, quiet: bool = False) -> int:
    """Return the exit code of a command. `quiet`: what it prints is not the service's."""
    none, out = asyncio.subprocess.DEVNULL, asyncio.subprocess.DEVNULL if quiet else None
    try:
        child = await asyncio.create_subprocess_exec(*command, stdin=none, stdout=out)
    except OSError as error:
        say(f"{command[0]}: {error.strerror}")
        return 1
    return await child.wait()


# -- by name
def find_unit(name: str) -> Service:
    """Return a service of the calling user's systemd, else of the machine's. Raises ConfigError."""
    _check_name(name, UNIT_NAME)
    users = [] if os.getuid() == 0 else [("systemctl", "--user")]
    for program in (*users, ("systemctl", "--no-ask-password")):
        shown = _shown(program, name)
        if shown.get("LoadState") != "loaded" or not shown["Id"].endswith(".service"):
            continue
        unit = shown["Id"]
        predicted = _slice(program, shown["Slice"]) + f"/{unit}"
        which = "--user-unit" if "--user" in program else "--unit"
        return Service(
            name=unit,
            cgroup=shown["ControlGroup"] or predicted,
            run=(*program, "start", "--", unit),
            stop=(*program, "stop", "--", unit),
            kill=(*program, "kill", "--signal=SIGKILL", "--", unit),
            log=(
                "journalctl",
                f"{which}={unit}",
                f"--lines={LOG_LINES}",
                "--output=cat",
                "--quiet",
            ),
            look=partial(_look_at_unit, program, unit),
        )
    raise ConfigError(
        f"there is no service {name!r} that is loaded without an error",
        hint=f"see `systemctl status {name}`; a user's unit is found for that user",
    )


def find_container(name: str, grace_s: float | None) -> Service:
    """Return a container of podman or docker. Raises ConfigError.

    `grace_s`: from its stop signal to SIGKILL; None: the engine's own.
    """
    _check_name(name, CONTAINER_NAME)
    for engine in filter(shutil.which, ENGINES):
        if (found := _inspected(engine, name)) is not None:
            cgroup = _cgroup_of(found) or _predicted(engine, found)
            if found["Id"] not in cgroup:
                raise ConfigError(
                    f"the container {name!r} has no cgroup of its own: it runs in {cgroup}",
                    hint="let its engine make one by systemd (podman: a session of the user, or "
                    "`loginctl enable-linger`)",
                )
            grace = () if grace_s is None else (f"-t{ceil(grace_s)}",)
            return Service(
                name=name,
                cgroup=cgroup,
                run=(engine, "start", "--attach", "--", name),
                stop=(engine, "stop", *grace, "--", name),
                kill=(engine, "kill", "--", name),
                log=(),
                look=partial(_look_at_container, engine, name),
            )
    raise ConfigError(
        f"neither podman nor docker knows a container {name!r}",
        hint="create it first; vramctl starts what exists, with the rights of its own user",
    )


def _slice(program: Sequence[str], name: str) -> str:
    """Return the path of a manager's slice: a-b.slice is in a.slice (systemd.slice(5))."""
    root = _shown(program, "-.slice").get("ControlGroup", "").rstrip("/")
    parts = name.removesuffix(".slice").split("-")
    above = ("-".join(parts[: count + 1]) for count in range(len(parts)))
    return root if name == "-.slice" else root + "".join(f"/{one}.slice" for one in above)


def _check_name(name: str, pattern: str) -> None:
    if not re.fullmatch(pattern, name):
        raise ConfigError(f"not a name: {name!r}", hint=f"expected one that matches {pattern}")


def _shown(program: Sequence[str], name: str) -> dict[str, str]:
    """Return properties of a unit; none where its manager does not answer."""
    wanted = "--property=Id,LoadState,Slice,ControlGroup,Result,ExecMainStatus"
    said = said_by(*program, "show", wanted, "--", name)
    return dict(line.split("=", 1) for line in said.splitlines())


def _inspected(engine: str, name: str) -> dict[str, Any] | None:
    """Return what an engine tells of a container; None: it knows none of that name."""
    said = said_by(engine, "container", "inspect", "--", name)
    found = json.loads(said) if said else []
    return found[0] if found else None


def said_by(*command: str) -> str:
    """Return what a command printed; "" where it failed."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=ASK_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return "" if done.returncode else done.stdout


def _look_at_unit(program: Sequence[str], unit: str) -> tuple[str, int]:
    shown = _shown(program, unit)
    failed = shown.get("Result", "success") != "success"
    return shown.get("ControlGroup", ""), max(int(shown["ExecMainStatus"]), 1) if failed else 0


def _look_at_container(engine: str, name: str) -> tuple[str, int]:
    found = _inspected(engine, name)
    return ("" if found is None else _cgroup_of(found)), 0  # what it was run by says the code


def _cgroup_of(found: Mapping[str, Any]) -> str:
    """Return the cgroup of a running container, down to the folder that is named by its id; its
    process's where there is none; "" while it does not run."""
    pid = found["State"]["Pid"]
    parts = procfs.read_cgroup(pid).split("/") if pid else []
    own = [index for index, part in enumerate(parts) if found["Id"] in part]
    return "/".join(parts[: own[0] + 1] if own else parts)


def _predicted(engine: str, found: Mapping[str, Any]) -> str:
    """Return the cgroup that a container will have, by its engine's way of naming them."""
    host, identity = found["HostConfig"], found["Id"]
    manager = host.get("CgroupManager") or said_by(engine, "info", "--format={{.CgroupDriver}}")
    rootless = engine == "podman" and os.getuid() != 0
    systemd = ("systemctl", "--user") if rootless else ("systemctl",)
    prefix, parent, folder = {
        "podman": ("libpod-", "user.slice" if rootless else "machine.slice", "/libpod_parent"),
        "docker": ("docker-", "system.slice", "/docker"),
    }[engine]
    given = host.get("CgroupParent")
    if manager.strip() == "systemd":
        return f"{_slice(systemd, given or parent)}/{prefix}{identity}.scope"
    return f"{given or folder}/{prefix if engine == 'podman' else ''}{identity}"
