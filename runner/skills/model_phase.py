"""How far a policy's model is on its way to the GPU, for goals that have not begun to move."""

from __future__ import annotations

from typing import Final

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.schemas.wire.explained import Explanation

PHASE_S: Final = 1.0  # between two looks


async def model_phase(client: SidecarClient, arbiter: AsyncClient | None) -> str:
    """Return the phase in words: starting, waiting for the GPU (for what), loading (how far).

    Raises what the sidecar and the arbiter raise.
    """
    if not client.connected:
        return "starting: its sidecar does not answer yet"
    if client.of_field:
        return "starting"
    told = await client.ping(timeout_s=PHASE_S)
    consumer = told.get("consumer", "")
    leases = (await arbiter.why(consumer)).leases if arbiter is not None and consumer else ()
    if leases:
        return _of_lease(leases[-1])
    if told["state"] == "loading":
        return "loading"
    return "starting: its sidecar imports libraries and reads the weights"


def _of_lease(lease: Explanation) -> str:
    if lease.state in ("loading", "held"):
        held, peak = lease.footprint.held_bytes, lease.footprint.declared_bytes["load_peak"]
        return f"loading: {format_bytes(held or 0)} of {format_bytes(peak)}"
    return f"waiting for the GPU: {lease.next}"
