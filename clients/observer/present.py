"""The newest status of the arbiter: one question serves everything that asks within a moment."""

import asyncio
import logging
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.requests import Status

log = logging.getLogger(__name__)

ASK_S = 3.0
"""Longest wait for an answer."""
SOME_MAX = 100
WHOLE_S = 2.0


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
        self._whole_at = float("-inf")
        self.newest: Look | None = None

    async def look(self, max_age_s: float = 0.0, touched: Collection[str] = ()) -> Look | None:
        """Return a status that is no older; None: the arbiter is not reached.

        `touched`: leases that changed; of many leases the others are asked for every WHOLE_S.
        """
        wanted_at = time.monotonic() - max_age_s
        async with self._asking:
            if self.newest is None or self.newest.at < wanted_at:
                self.newest = await self._ask(touched)
                self._heard(self.newest)
            return self.newest

    async def _ask(self, touched: Collection[str]) -> Look | None:
        began = time.monotonic()
        if not self._client.connected:
            return None
        try:
            async with asyncio.timeout(ASK_S):
                found = await self._some(touched) or await self._all()
        except (VramError, TimeoutError) as error:
            log.debug("no status: %s", error)
            return None
        return Look(found, began, time.monotonic() - began)

    async def _some(self, touched: Collection[str]) -> StatusReply | None:
        """Ask for some leases of many. Return the status with these and the others as they were;
        None: it is time for all of them."""
        if self.newest is None or not 0 < len(touched) <= SOME_MAX:
            return None
        leases = {lease.lease_id: lease for lease in self.newest.status.leases}
        if len(leases) <= SOME_MAX or time.monotonic() - self._whole_at > WHOLE_S:
            return None
        request = Status(leases=tuple(map(LeaseId, touched)))
        found = await self._client.ask(request, timeout_s=ASK_S)
        if found.epoch != self.newest.status.epoch:
            return None
        for lease_id in touched:
            leases.pop(lease_id, None)
        leases |= {lease.lease_id: lease for lease in found.leases}
        return replace(found, leases=tuple(leases.values()))

    async def _all(self) -> StatusReply:
        self._whole_at = time.monotonic()
        return await self._client.status()
