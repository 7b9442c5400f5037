"""The observer: its parts joined, from the first contact with the arbiter to SIGTERM."""

import asyncio
import contextlib
import logging
import os
import signal
import socket
from collections.abc import Coroutine, Mapping
from contextlib import aclosing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.feed import Cursor, follow
from vram_arbiter.clients.observer import figures
from vram_arbiter.clients.observer.exports import Exports, Scrapes
from vram_arbiter.clients.observer.hooks.actions import act
from vram_arbiter.clients.observer.hooks.queues import Runner, Saved, StateFile
from vram_arbiter.clients.observer.page import server
from vram_arbiter.clients.observer.page.access import Access, read_token
from vram_arbiter.clients.observer.page.app import StatusSite
from vram_arbiter.clients.observer.page.feed import PageFeed
from vram_arbiter.clients.observer.page.usage import UsageRecord
from vram_arbiter.clients.observer.present import Look, Present
from vram_arbiter.schemas.config.observer import HttpConfig, ObserverConfig
from vram_arbiter.schemas.errors import ArbiterUnreachable, VramError
from vram_arbiter.schemas.runtime.systemd import Notifier
from vram_arbiter.schemas.urls import HttpAddress, http_address

log = logging.getLogger(__name__)

NAME: Final = "vram-observer"
RETRY_S: Final = 1.0
"""How long an arbiter is waited for at the start, and between two attempts."""
GAP_S, QUIET_GAP_S = 0.06, 0.5
"""Shortest time between two looks, with and without an open page."""
BEAT_S, IDLE_S = 1.0, 15.0
"""Longest time between two looks: each one lets the arbiter read its GPUs."""
LOAD = 0.5
"""A look is followed by a pause so many times as long. The arbiter works for about a quarter of a
look, so that pages beside many leases take a sixth of its time at most."""


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line says."""

    config: ObserverConfig
    endpoint: str
    state: Path
    ends_with: int | None = None


class Observer:
    """`await Observer(options).run()` observes until SIGTERM, SIGINT, or the end of another
    process."""

    def __init__(self, options: Options, environ: Mapping[str, str] = os.environ) -> None:
        """Bind and open everything. Raises ConfigError, AlreadyRunning."""
        self._options = options
        self._config = config = options.config
        self._notifier = Notifier(environ)
        self._listening = _listen(config.http)
        self._state = StateFile(options.state) if config.hooks else None
        saved = Saved() if self._state is None else self._state.load()
        self._cursor = Cursor(saved.read)
        self._exports = Exports()
        self._client = AsyncClient(
            NAME, endpoint=options.endpoint, role="observer", connect_timeout_s=RETRY_S
        )
        self._present = Present(self._client, self._heard)
        self._record = UsageRecord()
        self._woken = asyncio.Event()
        self._feed = PageFeed(self._client, self._record, self._woken.set)
        self._hooks = Runner(
            config.hooks, lambda hook, one: act(hook, one, options.endpoint), saved.pending
        )

    async def run(self) -> None:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, stop.set)
        tasks = [loop.create_task(work) for work in (self._observe(), *self._servants())]
        tasks.append(loop.create_task(self._stopped(stop)))
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._feed.lost()
            for task in tasks:
                task.cancel()
            ended = await asyncio.gather(*tasks, return_exceptions=True)
            if self._state is not None:
                try:
                    self._state.save(self._saved())
                except OSError as fault:
                    log.error("what was delivered cannot be saved: %s", fault)
            self._exports.close()
        for error in ended:
            if isinstance(error, Exception):
                raise error

    def _servants(self) -> list[Coroutine[Any, Any, None]]:
        """What runs whether or not there is an arbiter."""
        found: list[Coroutine[Any, Any, None]] = []
        if self._listening is not None:
            found.append(self._serve(*self._listening))
        if self._state is not None:
            found += [self._hooks.run(), self._hooks.keep(self._state.save, self._saved)]
        return found

    async def _serve(self, listening: socket.socket, address: HttpAddress) -> None:
        token_file = self._config.http.token_file
        token = None if token_file is None else read_token(Path(token_file))
        connections = server.Connections(loopback=address.loopback)
        access = Access(address, self._config.http.hosts, token)
        scrapes = Scrapes(self._exports, self._present)
        history = self._client.history
        site = StatusSite(access, self._feed, history, scrapes.text, connections, self._reached)
        log.info("status page: http://%s", address)
        await server.serve(site.app, listening, connections)

    async def _observe(self) -> None:
        """Read events and status until the program ends, across restarts of the arbiter."""
        await self._connect()
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._follow())
                group.create_task(self._watch())
        except* VramError as errors:
            raise errors.exceptions[0] from None
        finally:
            await self._client.__aexit__(None, None, None)

    async def _connect(self) -> None:
        said = False
        while True:
            try:
                await self._client.__aenter__()
                return
            except ArbiterUnreachable as error:
                if not said:
                    log.warning("waiting for an arbiter: %s", error)
                    self._notifier.ready("waiting for an arbiter")
                said = True
                await asyncio.sleep(RETRY_S)

    async def _follow(self) -> None:
        """Hand on new events. Tells systemd that the unit has started once none can be missed."""
        started = False
        async with aclosing(follow(self._client, self._cursor)) as batches:
            async for events in batches:
                self._hooks.put(events, self._cursor.numbering)
                self._exports.take(events)
                self._feed.happened(events)
                if events:
                    self._woken.set()
                if not started and self._cursor.numbering:
                    started = True
                    log.info("observes the arbiter at %s", self._client.endpoint)
                    self._notifier.ready(f"observes {self._client.endpoint}")

    async def _watch(self) -> None:
        """Look at the arbiter after each event, and now and then without one."""
        while True:
            self._woken.clear()
            look = await self._present.look()
            if look is not None:
                await self._feed.publish(look)
            read = self._feed.read
            gap_s = max(GAP_S if read else QUIET_GAP_S, LOAD * (look.took_s if look else 0.0))
            await asyncio.sleep(gap_s)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(BEAT_S if read or look is None else IDLE_S):
                    await self._woken.wait()

    async def _reached(self) -> bool:
        return await self._present.look(BEAT_S) is not None

    def _heard(self, look: Look | None) -> None:
        """The arbiter answered; None: it did not."""
        self._exports.show(look)
        if look is None:
            self._feed.lost()
        else:
            self._record.take(figures.usage(look.status), look.at)

    def _saved(self) -> Saved:
        return Saved(dict(self._cursor.read), self._hooks.pending)

    async def _stopped(self, stop: asyncio.Event) -> None:
        if self._options.ends_with is not None:
            try:
                pidfd = os.pidfd_open(self._options.ends_with)
            except ProcessLookupError:
                return
            asyncio.get_running_loop().add_reader(pidfd, stop.set)
        await stop.wait()


def _listen(config: HttpConfig) -> tuple[socket.socket, HttpAddress] | None:
    """Raises ConfigError."""
    if config.listen is None:
        return None
    wanted = http_address(config.listen)
    if config.token_file is not None:
        read_token(Path(config.token_file))
    bound = server.bound(wanted)
    return bound, HttpAddress(wanted.host, bound.getsockname()[1])
