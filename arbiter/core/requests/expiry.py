"""Leases that end without their holder's word: nobody renewed them, their process died, an operator gave them up.

What they hold becomes a debt and is measured away (`measure`).
"""

from collections.abc import Mapping
from typing import Any

from vram_arbiter.arbiter.core.learning import crashes
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.verification import schedule
from vram_arbiter.schemas.ids import LeaseId


def on_expiry_due(core: Core, lease_id: str) -> None:
    """A holder did not renew (who has let go has no such timer)."""
    lease = core.leases[LeaseId(lease_id)]
    expire(core, lease, f"{lease.id} was not renewed for {lease.spec.ttl_s:g} s")


def expire(core: Core, lease: Lease, why: str) -> None:
    """The lease is over for good, perhaps before its time (an operator's word). Its holder may still be loading until it fences itself,
    so no verdict before that; one that is loaded has to be measured gone (if that can be seen), or to have fenced itself."""
    error = {
        "code": "lease_expired",
        "message": why,
        "hint": "unload, then acquire again",
        "details": {"ttl_s": lease.spec.ttl_s},
    }
    core.note("expired", lease, reason=error["message"])
    token = lease.token
    assert token is not None, f"{lease.id} expires without a token"
    core.push(
        lease,
        {
            "push": "lost",
            "lease_id": lease.id,
            "token": [token.epoch, token.serial],
            "error": error,
        },
    )
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
        # its bytes stay charged: nobody who fits beside them has to wait for the verdict
        core.recovering.discard(lease.id)
    lose(core, lease, LeaseState.EXPIRED, error, alive=True, grace_s=grace_s, fenced_at=fenced_at)


def lose(
    core: Core,
    lease: Lease,
    to: LeaseState,
    error: Mapping[str, Any],
    *,
    alive: bool,
    grace_s: float = 0.0,
    fenced_at: float = 0.0,
) -> None:
    """A resident lease is over (expired or lost); its bytes become a debt and are measured away."""
    gpu = core.gpu_of(lease)
    crashes.failed(core, lease, str(error["message"]))
    for use in list(lease.uses.values()):
        core.unmark(lease, use)
    lease.uses.paused.clear()
    gpu.ledger.to_debt(lease.id)
    core.record_lease(lease, debt=True)
    if lease.departure.eviction is not None:
        lease.departure.eviction.released_at = core.now
        lease.departure.eviction.unloading_at = lease.departure.eviction.unloading_at or core.now
    schedule.begin_for_lease(core, gpu, lease, alive=alive, grace_s=grace_s, fenced_at=fenced_at)
    core.move(lease, to, str(error["message"]))
    core.end(lease, error)
