"""What clients ask for, one function a request. Each checks everything first (raising Refused) and
then changes things.

Permission: leases belong to a process, so a request on a lease must come from a client of that
process. Uses (`uses`) are open to any client that knows the exact token.
"""

from dataclasses import replace

from vram_arbiter.arbiter.core.events import (
    AcquireRequested,
    CancelRequested,
    LeaseSpec,
    OomReported,
    ReadyReported,
    ReleaseReported,
    Renewed,
    RevokeAcknowledged,
    UnloadStarted,
)
from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.learning import costs, crashes, drift
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import (
    AWAY,
    EXPIRING,
    Lease,
    LeaseState,
    Request,
    Use,
)
from vram_arbiter.arbiter.core.model.refusals import Misfit, Refused
from vram_arbiter.arbiter.core.model.state import Client, Core, Ended
from vram_arbiter.arbiter.core.report import explain
from vram_arbiter.arbiter.core.requests.limits import check_leases, check_waiters
from vram_arbiter.arbiter.core.scheduling import placement
from vram_arbiter.arbiter.core.verification.schedule import begin_for_lease
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, Token
from vram_arbiter.schemas.wire.codes import Why
from vram_arbiter.schemas.wire.replies import (
    AcquireReply,
    GoneLease,
    OomReply,
    ReadyReply,
    ReleaseReply,
    RenewReply,
    StateReply,
)


# -- clients and leases
def client_of(core: Core, client: ClientId) -> Client:
    known = core.clients.get(client)
    if known is None:
        raise Refused(no.NoSession())
    return known


def ended_error(ended: Ended) -> Refused:
    """The answer to a late message on a lease that is over."""
    return Refused(ended.error or no.LeaseOver(ended.lease, ended.state, ended.revoked))


def lease_for(core: Core, lease_id: LeaseId, token: Token) -> Lease:
    """A live lease by its exact token."""
    lease = core.leases.get(lease_id)
    if lease is None:
        ended = core.ended.get(lease_id)
        if ended is not None:
            raise ended_error(ended)
        raise Refused(no.NoLease(lease_id))
    if lease.token is None:
        raise bad_state(lease, Misfit.STILL_QUEUED)
    if lease.token != token:
        raise Refused(no.WrongToken(lease_id, str(token)))
    return lease


def own_lease(core: Core, client: ClientId, lease_id: LeaseId, token: Token) -> Lease:
    """A live lease of the client's own process. Hearing from its holder keeps it alive."""
    process = client_of(core, client).process
    lease = lease_for(core, lease_id, token)
    if lease.process != process:
        raise Refused(no.NotHolder(lease.id, lease.process.pid))
    touch(core, lease)
    return lease


def touch(core: Core, lease: Lease) -> None:
    """The holder lives: its time to live starts anew."""
    if lease.state in EXPIRING and lease.attached:
        lease.expires_at = core.now + lease.spec.ttl_s
        core.timers.set(("ttl", lease.id), lease.expires_at)


def bad_state(lease: Lease, misfit: Misfit, use_id: str = "") -> Refused:
    story, uses = lease.told(), len(lease.uses)
    return Refused(no.BadLeaseState(lease.id, lease.state, uses, misfit, story, use_id))


# -- waiting
def acquire(core: Core, event: AcquireRequested) -> None:
    """Queue a lease; the scheduling after this event may grant it in the same breath, and answers
    either way."""
    client = client_of(core, event.client)
    known = _known_by(core, event, client)
    if any(feature.on_acquire(core, event, known) for feature in core.hooked["on_acquire"]):
        return
    if known is not None:
        _answer_again(core, event, known)
        return
    spec = spec_of(core, event)
    load_peak, steady = drift.expected_bytes(core, spec)
    try:
        gpus = placement.places(core, spec, load_peak)
    except Refused as refused:
        for feature in core.hooked["on_refused"]:
            feature.on_refused(core, spec, refused.refusal)
        raise
    check_waiters(core, client, spec.priority)
    if spec.gang is None:
        crashes.check(core, spec, load_peak, gpus)
    lease = new_lease(core, event, client, spec, load_peak, steady, gpus)
    core.turn.unanswered.append(lease)
    kept = [feature.on_request(core, lease) for feature in core.hooked["on_request"]]
    if not any(kept):
        core.enqueue(lease)


def spec_of(core: Core, event: AcquireRequested) -> LeaseSpec:
    """Return what is asked for, as the scheduling policy has it."""
    return replace(event.spec, exclusive=True) if core.settings.scheduling.alone else event.spec


def new_lease(
    core: Core,
    event: AcquireRequested,
    client: Client,
    spec: LeaseSpec,
    load_peak: int,
    steady: int,
    gpus: tuple[GpuId, ...],
) -> Lease:
    """A lease that is asked for, known by its nonce from now on. Refuses what is one too many for
    its connection."""
    check_leases(core, client)
    lease = Lease(
        id=core.next_lease_id(),
        spec=spec,
        process=client.process,
        client=client.id,
        request=Request(
            nonce=event.nonce,
            arrived_at=core.now,
            arrival=core.next_arrival(),
            load_peak_bytes=load_peak,
            steady_bytes=steady,
            gpus=gpus,
            uid=client.uid,
            id=event.request,
            wait_timeout_s=event.wait_timeout_s,
            traceparent=event.traceparent,
        ),
        story=[(core.now, LeaseState.QUEUED, Why.ACQUIRED)],
    )
    core.add(lease)
    core.nonces[client.process, event.nonce] = lease.id
    costs.wanted(core, spec.consumer)
    return lease


def answer_queued(core: Core) -> None:
    """After the scheduling: a request that was not granted at once is told that it waits, and why."""
    for lease in core.turn.unanswered:
        if (
            lease.state is LeaseState.QUEUED
            and not lease.request.answered
            and lease.request.id is not None
        ):
            lease.request.answered = True
            view = explain.view(core, lease)
            behind = explain.behind(core, lease)
            block = None if behind else explain.blocked_for(core, lease)
            core.note(
                "queued",
                lease,
                position=view.position,
                wait=lease.request.reason,
                behind=behind,
                **({"block": block} if block else {}),
            )
            core.reply(lease.client, lease.request.id, AcquireReply("queued", view))


def _known_by(core: Core, event: AcquireRequested, client: Client) -> Lease | None:
    """Return the lease that an earlier acquire with the same nonce asked for. Raises Refused where
    it is over."""
    lease_id = core.nonces.get((client.process, event.nonce))
    if lease_id is None:
        return None
    lease = core.leases.get(lease_id)
    if lease is None:
        raise ended_error(core.ended[lease_id])
    return lease


def _answer_again(core: Core, event: AcquireRequested, lease: Lease) -> None:
    """A repeat is answered as its lease is. The newest connection of a process is the one that
    listens."""
    core.hand_to(lease, event.client)
    state = str(lease.state) if lease.state in (LeaseState.QUEUED, *AWAY) else "loading"
    core.reply(event.client, event.request, AcquireReply(state, explain.view(core, lease)))


def cancel(core: Core, event: CancelRequested) -> None:
    """Give up a queued lease. One that was granted meanwhile must be released instead."""
    client = client_of(core, event.client)
    lease = core.leases.get(event.lease)
    if lease is None:
        ended = core.ended.get(event.lease)
        if ended is not None and ended.state is LeaseState.CANCELLED:
            core.reply(event.client, event.request, StateReply("cancelled"))
            return
        raise (ended_error(ended) if ended else Refused(no.NoLease(event.lease)))
    if lease.process != client.process:
        raise Refused(no.NotHolder(lease.id, lease.process.pid))
    given_up = no.CancelledRequest(lease.id, Why.HOLDER_GAVE_UP)
    if any(
        feature.give_up(core, lease, LeaseState.CANCELLED, given_up) for feature in lease.features
    ):
        if lease.state is LeaseState.VERIFYING:  # over with its verdict
            core.record_lease(lease)
        core.reply(event.client, event.request, StateReply(lease.state))
        return
    if lease.state is not LeaseState.QUEUED:
        raise bad_state(lease, Misfit.GRANTED)
    cancel_waiter(core, lease, Why.HOLDER_GAVE_UP)
    core.reply(event.client, event.request, StateReply("cancelled"))


def cancel_waiter(core: Core, lease: Lease, why: Why, by: str = "") -> None:
    """A revoke that was sent for it stands: the holder may be unloading by now."""
    core.move(lease, LeaseState.CANCELLED, why)
    core.dequeue(lease)
    core.note("cancelled", lease, why=why, **({"by": by} if by else {}))
    core.end(lease, no.CancelledRequest(lease.id, why, by))


def on_wait_timeout(core: Core, lease_id: str) -> None:
    lease = core.waiting[LeaseId(lease_id)]
    waited_s = core.now - lease.request.arrived_at
    why = explain.explain_lease(core, lease)
    eviction.deny(core, lease, no.TimedOut(lease.spec.consumer, waited_s, why))


# -- holding
def ready(core: Core, event: ReadyReported) -> None:
    """Loaded: from now on the steady bytes are charged, or what the holder measured."""
    lease = own_lease(core, event.client, event.lease, event.token)
    if lease.state is LeaseState.HELD:  # a repeat
        core.reply(event.client, event.request, ReadyReply(explain.view(core, lease)))
        return
    if lease.state is not LeaseState.LOADING:
        raise bad_state(lease, Misfit.NOT_LOADING)
    become_held(core, lease, event.measured_bytes)
    core.reply(event.client, event.request, ReadyReply(explain.view(core, lease)))
    core.record_lease(lease)
    core.learn(lease.spec.consumer, "load_s", core.now - lease.granted_at)
    core.note(
        "ready",
        lease,
        charge_bytes=core.gpu_of(lease).ledger.charge_bytes(lease.id),
        declared_bytes=lease.request.steady_bytes,
        measured_bytes=lease.observed.reported_bytes,
        load_ms=(core.now - lease.granted_at) * 1e3,
    )
    core.note("switch", lease, **explain.switch_record(core, lease))


def become_held(core: Core, lease: Lease, measured_bytes: int | None) -> None:
    """Mark the lease held."""
    core.move(lease, LeaseState.HELD, Why.READY)
    lease.ready_at = lease.uses.last_at = core.now
    _charge_held(core, lease, measured_bytes)


def _charge_held(core: Core, lease: Lease, measured_bytes: int | None) -> None:
    gpu = core.gpu_of(lease)
    lease.observed.reported_bytes = measured_bytes
    drift.on_ready(core, lease, measured_bytes)
    crashes.succeeded(core, lease)
    steady = (
        lease.request.steady_bytes
        if measured_bytes is None
        else max(measured_bytes, lease.spec.residue_bytes)
    )
    peak = max(lease.request.load_peak_bytes, lease.observed.peak_bytes)
    gpu.pending_free.give_up(lease.process, max(0, peak - steady), core.now)
    gpu.ledger.recharge(lease.id, steady, core.now)
    gpu.changed_at = core.now
    core.want_sample(gpu, core.now)  # what it holds now is what has to come back one day
    core.wake(gpu)


def renew(core: Core, event: Renewed) -> None:
    """Keep leases alive. One that expired stays expired."""
    client = client_of(core, event.client)
    alive: list[str] = []
    gone: list[GoneLease] = []
    for lease_id, token in event.leases:
        lease = core.leases.get(lease_id)
        if (
            lease is not None
            and lease.state is LeaseState.QUEUED
            and lease.process == client.process
        ):
            alive.append(lease_id)
            continue
        try:
            own_lease(core, event.client, lease_id, token)
            alive.append(lease_id)
        except Refused as refused:
            gone.append(GoneLease(lease_id, refused.refusal.view()))
    core.reply(event.client, event.request, RenewReply(tuple(alive), tuple(gone)))


# -- leaving
def revoke_ack(core: Core, event: RevokeAcknowledged) -> None:
    lease = own_lease(core, event.client, event.lease, event.token)
    eviction.acknowledge(core, lease, event.safe_point_eta_s)
    core.reply(event.client, event.request, StateReply(lease.state, len(lease.uses)))


def unloading(core: Core, event: UnloadStarted) -> None:
    """The holder is at its safe point and unloads. Refused while the lease is in use: this is
    the safe-point rule."""
    lease = own_lease(core, event.client, event.lease, event.token)
    if lease.state is LeaseState.UNLOADING:  # a repeat
        core.reply(event.client, event.request, StateReply(lease.state))
        return
    if lease.state not in (LeaseState.HELD, LeaseState.REVOKING):
        raise bad_state(lease, Misfit.NOT_UNLOADABLE)
    if lease.uses:
        raise bad_state(lease, Misfit.IN_USE)
    gpu = core.gpu_of(lease)
    end_uses(core, lease, Why.PAUSED)
    core.move(lease, LeaseState.UNLOADING, Why.SAFE_POINT)
    lease.departure.hangs = False
    core.timers.set(("revoke", lease.id), core.now + core.settings.revoke_deadline_s)
    lease.departure.baseline = gpu.sample
    if lease.departure.eviction is not None:
        lease.departure.eviction.unloading_at = core.now
        core.learn(lease.spec.consumer, "drain_s", core.now - lease.departure.eviction.asked_at)
    core.reply(event.client, event.request, StateReply(lease.state))
    core.note("unloading", lease, asked=lease.departure.eviction is not None)
    core.wake(gpu)


def release(core: Core, event: ReleaseReported) -> None:
    """The holder let go. Its bytes stay charged until they are measured gone. A repeat never ends a
    lease that went on standby."""
    process = client_of(core, event.client).process
    ended = core.ended.get(event.lease)
    same = ended is not None and (ended.token, ended.process) == (event.token, process)
    if ended is not None and same and ended.state is LeaseState.RELEASED:  # a repeat
        core.reply(event.client, event.request, ReleaseReply(ended.state, ended.state))
        return
    lease = own_lease(core, event.client, event.lease, event.token)
    if lease.gpu is not None and lease.state is not LeaseState.VERIFYING:  # else: a repeat
        for feature in core.features if event.parked else lease.features:
            feature.on_release(core, event, lease)
        why = Why.EXITS if event.exiting else Why.LET_GO
        let_go(core, lease, exiting=event.exiting, why=why)
    after = core.next_state(lease) or LeaseState.RELEASED
    core.reply(event.client, event.request, ReleaseReply(lease.state, after))


def end_uses(core: Core, lease: Lease, why: Why) -> None:
    """The bytes go: every use that is still on the lease ends with them, pausing ones too."""
    for use in lease.all_uses():
        if (use.process, use.id) in lease.uses:
            core.unmark(lease, use)
        note_ended(core, lease, use, why)
    lease.uses.paused.clear()


def note_ended(core: Core, lease: Lease, use: Use, why: Why, by: str = "") -> None:
    core.note(
        "use_ended",
        lease,
        use_id=use.id,
        label=use.label,
        ms=(core.now - use.began_at) * 1e3,
        why=why,
        **({"by": by} if by else {}),
    )


def let_go(core: Core, lease: Lease, *, exiting: bool, why: Why) -> None:
    """From any resident state to verification. Uses that others left on it end with it."""
    gpu = core.gpu_of(lease)
    end_uses(core, lease, why)
    before = lease.state
    lease.departure.exiting = exiting
    core.move(lease, LeaseState.VERIFYING, why)
    core.timers.clear(("ttl", lease.id))
    if lease.departure.eviction is not None:
        lease.departure.eviction.unloading_at = lease.departure.eviction.unloading_at or core.now
        lease.departure.eviction.released_at = core.now
        core.learn(
            lease.spec.consumer, "unload_s", core.now - lease.departure.eviction.unloading_at
        )
    begin_for_lease(core, gpu, lease, alive=True)
    core.record_lease(lease)
    core.note("released", lease, exiting=exiting, was=before, why=why)
    core.wake(gpu)


def oom(core: Core, event: OomReported) -> None:
    """An allocation failed. If the holder asked for more than it was granted, its footprint was
    wrong: learn it."""
    lease = own_lease(core, event.client, event.lease, event.token)
    if lease.gpu is None:
        raise bad_state(lease, Misfit.HOLDS_NOTHING)
    gpu = core.gpu_of(lease)
    charge = gpu.ledger.charge_bytes(lease.id)
    allocated = charge if event.allocated_bytes is None else event.allocated_bytes
    wanted = min(allocated + event.requested_bytes, gpu.ledger.budget_bytes)
    learnt = wanted > charge
    if learnt:
        core.footprints.out_of_memory(drift.model_name(lease.spec), wanted)
    core.want_sample(gpu, core.now)
    core.reply(event.client, event.request, OomReply(wanted if learnt else None))
    core.note(
        "oom",
        lease,
        requested_bytes=event.requested_bytes,
        allocated_bytes=event.allocated_bytes,
        charge_bytes=charge,
        learnt_load_peak_bytes=wanted if learnt else None,
    )
