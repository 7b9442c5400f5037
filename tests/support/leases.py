"""Leases as a client of the daemon sees them."""

from collections.abc import Awaitable, Callable

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.wire.spec import LeaseSpec
from vram_arbiter.schemas.wire.views import LeaseView

Spec = Callable[..., LeaseSpec]
Until = Callable[[Callable[[], bool]], Awaitable[None]]
"""Fixtures `spec` and `until` of tests/clients/conftest.py."""


def view_of(client: Client, consumer: str) -> LeaseView:
    """Return the one lease of a consumer."""
    (found,) = [lease for lease in client.status().leases if lease.consumer == consumer]
    return found


async def states(client: AsyncClient) -> dict[str, str]:
    """Return the state of each consumer's lease."""
    return {lease.consumer: lease.state for lease in (await client.status()).leases}
