"""Requests that can change the engine, turned into its events. Pure: no sessions, no sockets, no
answers."""

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.schemas.ids import ClientId, LeaseId, ModelKey, RequestId, Token, UseId
from vram_arbiter.schemas.wire import requests as w

HOLDING = frozenset(("acquire", "reacquire", "reattach", "use_begin"))
"""Ops that can make the engine remember something of a client beyond its connection."""
BY_HAND = frozenset(("evict", "pin", "unpin", "release_dead", "drain", "resume"))
"""Ops for operators only."""


def event_of(request: w.Request, client: ClientId, operator: str) -> ev.Event | None:
    """Return the event of a request; None for a request that only reads. `operator` names the peer
    of an action by hand."""
    re = RequestId(request.id)
    match request:
        case w.Acquire():
            spec, wait_s = to_spec(request.spec), request.wait_timeout_s
            return ev.AcquireRequested(client, re, request.nonce, spec, wait_s, request.traceparent)
        case w.Ready():
            return ev.ReadyReported(client, re, *_on_lease(request), request.measured_bytes)
        case w.UseBegin():
            return ev.UseBegan(
                client, re, *_on_lease(request), UseId(request.use_id), request.label
            )
        case w.UseEnd():
            return ev.UseEnded(client, re, *_on_lease(request), UseId(request.use_id))
        case w.Yield():
            return ev.UseYielded(client, re, *_on_lease(request), UseId(request.use_id))
        case w.Renew():
            return ev.Renewed(
                client, re, tuple((LeaseId(r.lease_id), Token(*r.token)) for r in request.leases)
            )
        case w.RevokeAck():
            return ev.RevokeAcknowledged(client, re, *_on_lease(request), request.safe_point_eta_s)
        case w.Unloading():
            return ev.UnloadStarted(client, re, *_on_lease(request))
        case w.Release():
            return ev.ReleaseReported(
                client, re, *_on_lease(request), request.exiting, request.parked
            )
        case w.Cancel():
            return ev.CancelRequested(client, re, LeaseId(request.lease_id))
        case w.Reacquire():
            return ev.Reacquired(
                client, re, *_on_lease(request), request.wait_timeout_s, request.traceparent
            )
        case w.Resize():
            size = request.footprint
            sizes = (size.load_peak_bytes, size.steady_bytes, size.residue_bytes)
            return ev.ResizeAsked(client, re, *_on_lease(request), *sizes, request.wait_timeout_s)
        case w.Reattach():
            return ev.Reattached(client, re, tuple(_reattached(lease) for lease in request.leases))
        case w.Evict() | w.Pin() | w.Unpin() | w.ReleaseDead():
            return ev.OperatorAsked(
                client, re, request.op, request.target, operator, request.reason
            )
        case w.Drain() | w.Resume():
            return ev.OperatorAsked(client, re, request.op, "", operator, request.reason)
        case w.Oom():
            on, sizes_ = _on_lease(request), (request.requested_bytes, request.allocated_bytes)
            return ev.OomReported(client, re, *on, *sizes_)
        case _:
            return None


def to_spec(spec: w.LeaseSpec) -> ev.LeaseSpec:
    """The wire's lease spec as the core knows it."""
    return ev.LeaseSpec(
        consumer=spec.consumer,
        key=ModelKey(spec.model_id, spec.revision),
        gpu=spec.gpu,
        exclusive=spec.mode == "exclusive",
        load_peak_bytes=spec.footprint.load_peak_bytes,
        steady_bytes=spec.footprint.steady_bytes,
        residue_bytes=spec.footprint.residue_bytes,
        priority=spec.priority,
        evictable=spec.evictable,
        ttl_s=spec.ttl_s,
        min_residency_s=spec.min_residency_s,
        deny_on_deadline=spec.on_deadline == "deny",
        standby=spec.standby,
        on_overstay=spec.on_overstay,
        park_bytes=spec.park_bytes,
        independent=spec.independent,
        gang=None if spec.gang is None else (spec.gang.id, spec.gang.size),
    )


def _on_lease(
    request: w.Ready
    | w.UseBegin
    | w.UseEnd
    | w.Yield
    | w.RevokeAck
    | w.Unloading
    | w.Release
    | w.Reacquire
    | w.Resize
    | w.Oom,
) -> tuple[LeaseId, Token]:
    return LeaseId(request.lease_id), Token(*request.token)


def _reattached(lease: w.ReattachLease) -> ev.ReattachedLease:
    return ev.ReattachedLease(
        lease=LeaseId(lease.lease_id),
        token=Token(*lease.token),
        spec=to_spec(lease.spec),
        held=lease.state == "held",
        measured_bytes=lease.measured_bytes,
        uses=tuple(UseId(use) for use in lease.use_ids),
        away=lease.state in ("standby", "parked"),
        parked=lease.state == "parked",
    )
