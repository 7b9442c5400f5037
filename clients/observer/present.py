"""The newest status of the arbiter: one question serves everything that asks within a moment."""

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.wire.replies import StatusReply

log = logging.getLogger(__name__)

ASK_S = 3.0
"""Longest wait for an answer."""


@dataclass(frozen=True, slots=True)
class Look:
    """A status with the leases of its pages, when it was read and how long that took."""

    status: StatusReply
    at: float
    took_s: float

    @property
    def origin(self) -> float:
        """The daemon's start, on this process's clock."""
        return self.at - self.status.uptime_s


class Present:
    """`look` asks the arbiter; `heard` is told of every answer, None: there was none."""

    def __init__(self, client: AsyncClient, heard: Callable[[Look | None], None]) -> None:
        self._client = client
        self._heard = heard
        self._asking = asyncio.Lock()
        self.newest: Look | None = None

    async def look(self, max_age_s: float = 0.0) -> Look | None:
        """Return a status that is no older; None: the arbiter is not reached."""
        wanted_at = time.monotonic() - max_age_s
        async with self._asking:
            if self.newest is None or self.newest.at < wanted_at:
                self.newest = await self._ask()
                self._heard(self.newest)
            return self.newest

    async def _ask(self) -> Look | None:
        began = time.monotonic()
        if not self._client.connected:
            return None
        try:
            async with asyncio.timeout(ASK_S):
                found = await self._client.status()
        except (VramError, TimeoutError) as error:
            log.debug("no status: %s", error)
            return None
        return Look(found, began, time.monotonic() - began)
