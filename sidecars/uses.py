"""Uses of one model: those in flight here, those that other processes mark, and the last one."""

import contextlib
import logging
import time
from collections.abc import AsyncIterator

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.errors import LeaseRevoking, VramError

_log = logging.getLogger("sidecars")


class Uses:
    """Counts them. `client` None: without an arbiter no other process marks a use."""

    def __init__(self, client: AsyncClient | None) -> None:
        self._client = client
        self.in_flight = 0
        self.last_s = time.monotonic()  # end of the last one

    @contextlib.asynccontextmanager
    async def use(
        self, lease: AsyncLease | None, label: str, *, handed: bool
    ) -> AsyncIterator[None]:
        """Mark a use. Under a handed-over token the caller's own use protects the model, also while
        revoked."""
        self.in_flight += 1
        try:
            async with contextlib.AsyncExitStack() as stack:
                if lease is not None:
                    try:
                        await stack.enter_async_context(lease.use(label))
                    except LeaseRevoking:
                        if not handed:
                            raise
                yield
        finally:
            self.in_flight -= 1
            self.last_s = time.monotonic()

    async def by_others(self, lease: AsyncLease | None) -> bool:
        """Ask the arbiter whether any process uses the lease; True if it cannot be reached."""
        if self._client is None or lease is None:
            return False
        try:
            status = await self._client.status()
        except VramError as error:
            _log.info("uses of the lease are unknown (%s): staying", error.code)
            return True
        return any(view.lease_id == lease.lease_id and view.uses for view in status.leases)
