"""The weights of one model in host RAM: read once, also ahead of a request, and dropped.

The arbiter's budget of host RAM is for parked weights. It is asked before weights are read ahead,
and once they are on a GPU: where it could never let them stay for a parked lease, they are dropped.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Final

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.sidecars.weights_keeper import ModelProcesses

FORESEEN_S: Final = 120.0
"""How long weights that were read ahead wait for a request: longer than a drive."""
_log = logging.getLogger("sidecars")


class HostCopy:
    """Weights in host RAM, and the tasks that read and drop them.

    `expected_bytes` is their size before they were first read. `client` None: without an arbiter
    they are never read ahead and always stay.
    """

    def __init__(
        self, models: ModelProcesses, client: AsyncClient | None, expected_bytes: int
    ) -> None:
        self._models, self._client, self._expected_bytes = models, client, expected_bytes
        self._reading: asyncio.Task[int] | None = None  # under way, or there
        self._foreseen: asyncio.Task[None] | None = None  # reads ahead of a request
        self._expiry: asyncio.TimerHandle | None = None  # drops them where no request comes
        self._background: set[asyncio.Task[None]] = set()
        self.size_bytes: int | None = None  # when they were there the last time; None: read first

    def fetch(self) -> asyncio.Task[int]:
        """Begin to read them, if they are not there."""
        if self._reading is None or self._reading.done():
            self._reading = asyncio.create_task(self._models.load(), name="weights")
            self._reading.add_done_callback(_look_at)
        return self._reading

    async def fetched(self, reading: asyncio.Task[int]) -> int:
        """Wait for what `fetch` began, and return their bytes. It outlives a caller that is
        canceled. Raises ModelError or ConfigError."""
        self.size_bytes = self._expected_bytes = await asyncio.shield(reading)
        return self.size_bytes

    def drop(self) -> None:
        """Free their host RAM, after what is asked of them now; a later `fetch` reads them."""
        self._in_background(self._models.drop(), "drop the weights")

    def _in_background(self, work: Coroutine[Any, Any, None], name: str) -> None:
        task = asyncio.create_task(work, name=name)
        self._background.add(task)
        task.add_done_callback(self._background.discard)

    def read_ahead(
        self, prepared: Callable[[], Awaitable[None]], wanted: Callable[[], bool]
    ) -> None:
        """Read them once `prepared` is over, where the budget has room beside what is parked.

        They are dropped after `FORESEEN_S` where they are not `wanted` then, and at once where they
        are there and the budget has no room.
        """
        if self._client is None or (self._foreseen is not None and not self._foreseen.done()):
            return
        if self._expiry is not None:
            self._expiry.cancel()
        ahead = self._read_ahead(self._client, prepared, wanted)
        self._foreseen = asyncio.create_task(ahead, name="read ahead")

    def drop_if_too_large(self, resident: Callable[[], bool]) -> None:
        """Drop them where the arbiter could never let them stay, if they are `resident` then."""
        if self._client is not None and self.size_bytes:
            self._in_background(self._drop_if_too_large(self._client, resident), "host RAM")

    async def stop(self) -> None:
        """End what is under way."""
        if self._expiry is not None:
            self._expiry.cancel()
        under_way = {task for task in (self._foreseen, self._reading) if task and not task.done()}
        for task in under_way:
            task.cancel()
        if under_way:
            await asyncio.wait(under_way)

    async def _read_ahead(
        self,
        client: AsyncClient,
        prepared: Callable[[], Awaitable[None]],
        wanted: Callable[[], bool],
    ) -> None:
        try:
            await prepared()
            ram = (await client.status()).host_ram
            room = ram.budget_bytes - ram.parked_bytes
            if (size := self.size_bytes or self._expected_bytes) > room:
                _log.info("%d bytes of weights, room for %d: they are not read ahead", size, room)
                if not wanted():
                    self.drop()
                return
            await self.fetched(self.fetch())
        except VramError as error:
            _log.info("the weights are not read ahead: %s", error)
            if not wanted():
                self.drop()
            return
        loop = asyncio.get_running_loop()
        self._expiry = loop.call_later(FORESEEN_S, self._expire, wanted)

    def _expire(self, wanted: Callable[[], bool]) -> None:
        if not wanted():
            _log.info("no request came for it: dropping the weights")
            self.drop()

    async def _drop_if_too_large(self, client: AsyncClient, resident: Callable[[], bool]) -> None:
        try:
            budget_bytes = (await client.status()).host_ram.budget_bytes
        except VramError as error:
            _log.info("the budget of host RAM is unknown (%s): the weights stay", error.code)
            return
        if (self.size_bytes or 0) > budget_bytes and resident():
            self.drop()


def _look_at(task: asyncio.Task[int]) -> None:
    """Take note of a failure, also where the request that wanted the weights has ended."""
    if not task.cancelled() and (error := task.exception()) is not None:
        _log.debug("the weights could not be read: %s", error)
