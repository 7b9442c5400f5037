"""A lease as a client of the daemon sees it."""

from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.wire.views import LeaseView


def view_of(client: Client, consumer: str) -> LeaseView:
    """Return the one lease of a consumer."""
    (found,) = [lease for lease in client.status().leases if lease.consumer == consumer]
    return found
