"""Leases that end without their holder's word: they were not renewed, their process died, an
operator gave them up.

What they hold becomes a debt and is measured away (`measure`).
"""

from vram_arbiter.arbiter.core.learning import crashes
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.verification import schedule
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Order, Why
from vram_arbiter.schemas.wire.pushes import LostPush


def on_expiry_due(core: Core, lease_id: str) -> None:
    """A holder did not renew (a released lease has no such timer)."""
    lease = core.leases[LeaseId(lease_id)]
    expire(core, lease)


def expire(core: Core, lease: Lease, order: Order | None = None) -> None:
    """The lease is over for good, perhaps before its time (an operator's word). Its holder may
    still be loading until it fences itself, so no verdict before that; one that is loaded has to be
    measured gone (if that can be seen), or to have fenced itself.
    """
    why = Why.NOT_RENEWED if order is None else Why.GIVEN_UP
    refusal = no.Expired(lease.id, lease.spec.ttl_s, why, order)
    core.note("expired", lease, why=why, ttl_s=lease.spec.ttl_s)
    token = lease.token
    assert token is not None, f"{lease.id} expires without a token"
    core.push(lease, LostPush(lease.id, token, refusal.view()))
    # a restart's deadline has the grace in it
    grace_s = core.settings.fence_grace_s if lease.attached else 0.0
    fenced_at = lease.expires_at + grace_s
    weight_bytes = core.gpu_of(lease).ledger.charge_bytes(lease.id) - lease.spec.residue_bytes
    if (
        lease.state is LeaseState.LOADING
        or weight_bytes <= 2 * core.settings.verify_tolerance_bytes
    ):
        grace_s = max(
            0.0, fenced_at - core.now
        )  # what is so small no reading can tell from nothing
    if core.recovering is not None:
        # its bytes stay charged: a request that fits beside them need not wait for the verdict
        core.recovering.discard(lease.id)
    lose(core, lease, LeaseState.EXPIRED, refusal, alive=True, grace_s=grace_s, fenced_at=fenced_at)


def lose(
    core: Core,
    lease: Lease,
    to: LeaseState,
    refusal: no.Expired | no.Lost,
    *,
    alive: bool,
    grace_s: float = 0.0,
    fenced_at: float = 0.0,
) -> None:
    """A resident lease is over (expired or lost); its bytes become a debt and are measured away."""
    gpu = core.gpu_of(lease)
    crashes.failed(core, lease, refusal.why)
    for use in list(lease.uses.values()):
        core.unmark(lease, use)
    lease.uses.paused.clear()
    gpu.ledger.to_debt(lease.id)
    core.record_lease(lease, debt=True)
    if lease.departure.eviction is not None:
        lease.departure.eviction.released_at = core.now
        lease.departure.eviction.unloading_at = lease.departure.eviction.unloading_at or core.now
    schedule.begin_for_lease(core, gpu, lease, alive=alive, grace_s=grace_s, fenced_at=fenced_at)
    core.move(lease, to, refusal.why)
    core.end(lease, refusal)
