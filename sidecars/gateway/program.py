"""One model server under one lease: a child `vramctl run --control`, its states and its log.

One child for each server, units and containers too, because the arbiter charges bytes to processes
and learns from a process with one lease.
"""

import asyncio
import json
import os
import shlex
import socket
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final, Self

from vram_arbiter.clients.foreign.control import REST, WANT
from vram_arbiter.clients.foreign.service import find_container, find_unit
from vram_arbiter.schemas.config.gateway import GatewayConfig, ServerConfig
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.ids import Token
from vram_arbiter.schemas.runtime.ports import free_port
from vram_arbiter.sidecars.gateway.logs import LINE_MAX_BYTES, Log
from vram_arbiter.sidecars.gateway.upstream import Upstream

OUTPUT_S: Final = 1.0
ASLEEP: Final = frozenset({"standby", "parked", "gone"})
"""States of a lease whose program holds no bytes."""
LEAVING: Final = frozenset({"revoking", "unloading"}) | ASLEEP
VRAMCTL: Final = (sys.executable, "-m", "vram_arbiter.clients")


class Program:
    """`await Program.start(…)`; `changed` is called at each change of `state`, which is `queued` or
    the lease's."""

    def __init__(self, url: str, log: Log, changed: Callable[[], None]) -> None:
        self.upstream = Upstream(url)
        self.state = "queued"
        self.lease_id, self.token, self.gpu = "", Token(0, 0), ""
        self.reason = ""
        self.granted = False  # at least once
        self._wanted = False  # it was told so in this state
        self._dismissed = False
        self._log, self._changed = log, changed
        self._child: asyncio.subprocess.Process
        self._control: asyncio.StreamWriter
        self._tasks: list[asyncio.Task[None]] = []

    @classmethod
    async def start(
        cls, name: str, config: ServerConfig, endpoint: str, log: Log, changed: Callable[[], None]
    ) -> Self:
        """Start it. Raises OSError."""
        port = config.port or free_port()
        program = cls(f"http://127.0.0.1:{port}", log, changed)
        ours, theirs = socket.socketpair()
        try:
            words = arguments(name, config, port, endpoint, theirs.fileno())
            environ = {
                **os.environ,
                **dict(zip(config.env, place(config.env.values(), port), strict=True)),
            }
            program._child = await asyncio.create_subprocess_exec(
                *VRAMCTL,
                *words,
                env=environ,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.STDOUT,
                pass_fds=(theirs.fileno(),),
                start_new_session=True,  # a terminal's Ctrl-C is the gateway's
            )
        except OSError:
            ours.close()
            raise
        finally:
            theirs.close()
        reader, program._control = await asyncio.open_connection(sock=ours)
        program._tasks = [
            asyncio.create_task(program._follow(reader)),
            asyncio.create_task(program._read_log()),
        ]
        return program

    @property
    def pid(self) -> int:
        return self._child.pid

    @property
    def leaves(self) -> bool:
        """Whether it is on its way out, or out, because it was evicted or not wanted any more."""
        return self._dismissed or self.state in LEAVING

    def want(self) -> None:
        """Let it come back from its sleep, or be started where it does not run."""
        if not self._wanted:
            self._wanted = True
            self._order(WANT)

    def rest(self) -> None:
        """Let it leave the GPU after the requests in flight, until it is wanted."""
        self._order(REST)

    def end(self) -> None:
        """Let it end now; without a lease it gives up its place in the queue."""
        self._dismissed = True
        self._control.close()

    async def wait(self) -> int:
        """Return the exit code, -n after signal n, with all read that it said and printed."""
        code = await self._child.wait()
        # a process that outlived it may keep its output open
        _, open_ = await asyncio.wait(self._tasks, timeout=OUTPUT_S)
        for task in open_:
            task.cancel()
        self._control.close()
        return code

    def _order(self, order: str) -> None:
        if not self._control.is_closing():
            self._control.write(json.dumps(order).encode() + b"\n")

    async def _follow(self, reader: asyncio.StreamReader) -> None:
        try:
            while line := await reader.readline():
                said = json.loads(line)
                before = self.state, self.token
                self.state, self.reason = said["state"], said["reason"]
                if said["lease_id"]:
                    self.granted = True
                    self.lease_id, self.token = said["lease_id"], Token(*said["token"])
                    self.gpu = said["gpu"]
                if (self.state, self.token) != before:
                    self._wanted = False
                    self._changed()
        except ConnectionError:
            return

    async def _read_log(self) -> None:
        assert self._child.stdout is not None
        partial = b""
        while data := await self._child.stdout.read(1 << 16):
            *lines, partial = (partial + data).split(b"\n")
            for line in lines:
                self._log.add(line)
            partial = partial[-LINE_MAX_BYTES:]
        if partial:
            self._log.add(partial)


def runs_already(config: ServerConfig) -> bool:
    """Return whether a server is a unit or container that runs. Blocks. Raises ConfigError."""
    if config.unit is not None:
        return bool(find_unit(config.unit).look()[0])
    return config.container is not None and bool(find_container(config.container, None).look()[0])


def sized(config: GatewayConfig) -> GatewayConfig:
    """Return the configuration with `vram` of all servers, from `footprints_file` where they have
    none of their own. Raises ConfigError."""
    unsized = {name: server for name, server in config.servers.items() if server.vram is None}
    path, entries = Path(config.footprints_file), {}
    if unsized and path.exists():
        from vram_arbiter.sidecars.settings import read_footprints

        entries = read_footprints(path)
    for name, server in unsized.items():
        if (entry := entries.get(f"local/{name}")) is None:
            words = shlex.join(place(server.command, server.port or free_port()))
            raise ConfigError(
                f"{name} has no `vram`, and {path} no entry local/{name}",
                hint=f"vramctl calibrate --seconds 60 --name {name} -- {words} >>{path}",
            )
        unsized[name] = server.model_copy(update={"vram": entry.load_peak})
    return config.model_copy(update={"servers": config.servers | unsized})


def arguments(name: str, config: ServerConfig, port: int, endpoint: str, control: int) -> list[str]:
    """Return the arguments of `vramctl` for a server. Nothing in them is a client's."""
    url = f"http://127.0.0.1:{port}"
    action = "end" if config.on_evict == "stop" else config.on_evict
    named = {
        "--vram": f"{config.vram}B",
        "--name": name,
        "--gpu": config.gpu,
        "--priority": str(config.priority),
        "--on-revoke": "term",
        "--on-evict": action,
        "--grace": f"{config.grace_s}",
        "--min-residency": f"{config.min_residency_s}",
        "--health": url + config.health,
        "--start": f"{config.start_s}",
        "--control": str(control),
        "--endpoint": endpoint,
    }
    if action == "http":
        named["--url"] = f"{url}{config.free_path}"
        if config.restore_path is not None:
            named["--restore-url"] = f"{url}{config.restore_path}"
    elif action not in ("end", "cuda-checkpoint"):
        named["--url"] = url
    if action != "end":
        named["--timeout"] = f"{config.action_timeout_s}"
        if config.park is not None:
            named["--park"] = f"{config.park}B" if config.park else "0"
    for option, service in (("--unit", config.unit), ("--container", config.container)):
        if service is not None:
            named[option] = service
    flags = [word for pair in named.items() for word in pair]
    return ["run", *flags, "--", *place(config.command, port)]


def place(words: Iterable[str], port: int) -> list[str]:
    return [word.replace("{port}", str(port)) for word in words]
