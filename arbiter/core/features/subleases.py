"""Sub-leases: carved at once out of a lease, by its token, from any process that knows it (runner → its policy sidecar).

A tree is one unit to everybody else: in use while any lease of it is, asked to leave as a whole, a victim by its root. Inside,
children leave before their parent. Whoever outlives its parent is a root of its own.
"""

from dataclasses import replace

from vram_arbiter.arbiter.core.events import AcquireRequested, Spec
from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.features import families, standby
from vram_arbiter.arbiter.core.learning import drift
from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu, Refused
from vram_arbiter.arbiter.core.report import explain
from vram_arbiter.arbiter.core.requests.requests import (
    bad_state,
    client_of,
    find_again,
    lease_for,
    let_go,
    new_lease,
)
from vram_arbiter.schemas import defaults
from vram_arbiter.schemas.ids import LeaseId, Token


def acquire(core: Core, event: AcquireRequested, ref: tuple[LeaseId, Token]) -> None:
    """Grant a sub-lease in the same breath, or refuse it: it never waits, its bytes are reserved or they are not."""
    client = client_of(core, event.client)
    if find_again(core, event, client):
        return
    if event.spec.gang is not None:
        raise Refused(
            "bad_request", "a sub-lease is granted at once: it is in no gang", "let its parent join"
        )
    parent = lease_for(core, *ref)
    gpu = _may_carve(core, parent, event.spec)
    # its root says who may be beside the tree, and comes back for all of it
    spec = replace(event.spec, exclusive=False, standby=False, park_bytes=0)
    peak, steady = drift.expected_bytes(core, spec)
    need, fold = families.need_bytes(gpu, parent, client.process, peak)
    left = families.left_bytes(gpu, parent)
    if need > left:
        raise Refused(
            "parent_too_small",
            f"{spec.consumer} needs {peak} bytes, {parent.spec.consumer} ({parent.id}) has {left} left",
            "acquire a parent with room for all that it lends at once",
            needed_bytes=need,
            left_bytes=left,
        )
    lease = new_lease(core, event, client, spec, peak, steady, (gpu.info.id,))
    token = core.next_token()
    lease.token, lease.gpu = token, gpu.info.id
    lease.granted_at = lease.held_from = core.now
    lease.move(LeaseState.LOADING, core.now, f"carved out of {parent.id}")
    gpu.residents[lease.id] = lease
    gpu.ledger.charge(lease.id, lease.process, peak, peak, core.now)
    families.join(core, gpu, parent, lease, fold)
    gpu.changed_at = core.now
    core.granted.append((token, None))
    lease.expires_at = core.now + spec.ttl_s
    core.timers.set(("ttl", lease.id), lease.expires_at)
    core.record_lease(lease, gates=True)
    core.record_lease(parent)
    lease.answered = True
    core.reply(
        lease.client, event.request, {"state": "loading", "lease": explain.view(core, lease)}
    )
    reason = f"carved out of {parent.spec.consumer} ({parent.id}), which keeps {left - need} bytes"
    core.note(
        "granted",
        lease,
        charge_bytes=peak,
        waited_ms=0.0,
        evicted=[],
        parent=parent.id,
        reason=reason,
    )
    core.wake(gpu)


def _may_carve(core: Core, parent: Lease, spec: Spec) -> Gpu:
    if parent.gpu is None:
        raise bad_state(parent, "it holds nothing to carve from")
    if any(feature.size_changes(parent) for feature in core.features):
        raise bad_state(parent, "it changes its size; carve when it has the new one")
    gpu = core.gpu_of(parent)
    depth, lease = 2, parent
    while True:
        if lease.state in LEAVING:
            raise Refused(
                "lease_revoking",
                f"{lease.spec.consumer} ({lease.id}) was asked to leave",
                "acquire a parent again",
                state=str(lease.state),
            )
        if lease.parent is None:
            break
        depth, lease = depth + 1, lease.parent
    if depth > defaults.SUBLEASE_DEPTH_MAX:
        raise Refused(
            "limit_exceeded",
            f"a sub-lease of {parent.id} would be number {depth} of its line",
            "carve it out of a lease nearer to the root",
            limit="sublease_depth_max",
        )
    if spec.gpu not in ("any", gpu.info.id, str(gpu.info.index)):
        raise Refused(
            "bad_request",
            f"a sub-lease is on the card of its parent, {gpu.info.id}, not on {spec.gpu!r}",
            "leave `gpu` away",
        )
    return gpu


# -- leaving -----------------------------------------------------------------------------------------------------------
def finish(core: Core) -> None:
    """Parents that wait for nothing but their last sub-lease: let those go that let go or hold nothing, tell the others once."""
    for gpu in core.gpus.values():
        for lease in list(gpu.estates.values()):
            if lease.state is not LeaseState.REVOKING or lease.children or lease.uses:
                continue
            assert lease.estate is not None, f"{lease.id} is listed without an estate"
            if lease.departing:
                let_go(core, lease, exiting=lease.exiting, why="its last sub-lease has left")
            elif families.holds_nothing(core, gpu, lease):
                _give_up(core, lease)
            elif not lease.estate.told:
                lease.estate.told = True
                eviction.reached_safe_point(core, lease)


def _give_up(core: Core, lease: Lease) -> None:
    """A mere reservation needs no holder to unload it."""
    token = lease.token
    assert token is not None, f"{lease.id} is resident without a token"
    why = "it was asked to leave and its last sub-lease has left"
    assert lease.eviction is not None, f"{lease.id} is revoked and was not asked"
    why += f": {lease.eviction.reason}"
    if standby.stays_on(lease):
        let_go(core, lease, exiting=False, why=why, comes_back=True)
        return
    error = {
        "code": "lease_lost",
        "message": f"{lease.id}: {why}",
        "hint": "acquire again",
        "details": {},
    }
    core.push(
        lease,
        {
            "push": "lost",
            "lease_id": lease.id,
            "token": [token.epoch, token.serial],
            "error": error,
        },
    )
    let_go(core, lease, exiting=False, why=why)
