"""What clients ask for, one function a request. Each checks everything first (raising Refused) and
then changes things.

Permission: leases belong to a process, so a request on a lease must come from a client of that
process. Uses (`uses`) are open to any client that knows the exact token.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core import learning, standby
from vram_arbiter.arbiter.core.learning import check_load, newest
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import AWAY, Lease, LeaseState, Request, Use
from vram_arbiter.arbiter.core.model.refusals import Misfit, Refused, Share
from vram_arbiter.arbiter.core.model.state import Client, Core, Ended, Refusals
from vram_arbiter.arbiter.core.report import status
from vram_arbiter.arbiter.core.report.why import ahead_of, explain
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.arbiter.core.verification.schedule import begin_for_lease
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.codes import Why
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.notes import (
    CancelledNote,
    OomNote,
    QueuedNote,
    ReadyNote,
    RefusedNote,
    ReleasedNote,
    RevokeAckedNote,
    UnloadingNote,
    UseEndedNote,
)
from vram_arbiter.schemas.wire.replies import (
    AcquireReply,
    GoneLease,
    OomReply,
    ReadyReply,
    ReleaseReply,
    RenewReply,
    StateReply,
)

type OnLease = w.OnLease[Any] | w.LeaseRef
"""What names a lease by its exact token."""

AT_ONCE = 16
"""Refusals of one process that are noted one by one; after that one a second."""
PROCESSES_REMEMBERED = 1024


# -- leases
def over(known: Mapping[LeaseId, Ended], lease_id: LeaseId) -> Refused:
    """Return the answer to a message on a lease that is over, or never was."""
    ended = known.get(lease_id)
    if ended is None:
        return Refused(no.NoLease(lease_id))
    return Refused(ended.error or no.LeaseOver(ended.lease, ended.state, ended.revoked))


def lease_for(core: Core, on: OnLease) -> Lease:
    """Return a live lease by its exact token. Raises Refused."""
    lease = core.leases.get(on.lease_id)
    if lease is None:
        raise over(core.ended, on.lease_id)
    if lease.token is None:
        raise bad_state(lease, Misfit.STILL_QUEUED)
    if lease.token != on.token:
        raise Refused(no.WrongToken(lease.id, str(on.token)))
    return lease


def own_lease(core: Core, client: ClientId, on: OnLease) -> Lease:
    """Return a live lease of the client's own process; its time to live starts anew.

    Raises Refused.
    """
    lease = lease_for(core, on)
    if lease.process != core.clients[client].process:
        raise Refused(no.NotHolder(lease.id, lease.process.pid))
    if lease.attached:
        core.keep(lease)
    return lease


def bad_state(lease: Lease, misfit: Misfit) -> Refused:
    """Return the refusal of a request that does not fit the state of its lease."""
    refusal = no.BadLeaseState(lease.id, lease.state, len(lease.uses), misfit, lease.told())
    return Refused(refusal)


# -- waiting
def acquire(core: Core, asked: ev.Asked, request: w.Acquire) -> None:
    """Queue a lease. The scheduling after this event may grant it at once, and answers either way.

    Raises Refused.
      0. Its cgroup is charged to no other process.
      1. A lease of this process for the model that is away comes back for it.
      2. A repeat, known by its nonce, is answered as its lease is.
      3. The request fits on some GPU, as far as its model is known.
      4. There is a place for one waiter and one lease more.
      5. The model does not crash in every load.
      6. The lease is new, and waits in the queues.
    """
    client, spec = core.clients[asked.client], request.spec
    if spec.cgroup is not None:  # 0
        _check_cgroup(core.leases.values(), client.process, spec.cgroup)
    known = _known_by(core, client, request.nonce)
    mine = core.leases_of(client.process) if core.away else []
    away = standby.wanted(mine, request, known) if mine else None
    if away is not None:  # 1
        spec = spec if known is None else away.spec
        standby.call_back(core, away, asked, request, spec)
        return
    if known is not None:  # 2
        _answer_again(core, asked, known)
        return
    load_peak, steady = core.footprints.expected_bytes(spec)  # 3
    gpus = admission.places(core.gpus, spec, load_peak)
    admission.check_waiters(core.settings, core.waiting, client, spec.priority)  # 4
    owned, most = len(core.of_client.get(client.id, ())), core.settings.leases_per_client_max
    admission.check_shares("leases_per_client_max", (Share.CONNECTION, owned, most))
    if core.costs.failures:  # 5
        check_load(core.costs, [core.gpus[gpu] for gpu in gpus], spec, load_peak, core.now)
    core.enqueue(_new_lease(core, asked, request, load_peak, steady, gpus))  # 6


def _check_cgroup(leases: Iterable[Lease], process: ProcessKey, cgroup: str) -> None:
    """Raises Refused where another process's lease names an overlapping cgroup: bytes would have
    two holders."""
    for lease in leases:
        other = lease.spec.cgroup
        if other is not None and lease.process != process:
            shorter, longer = sorted((f"{other}/", f"{cgroup}/"), key=len)
            if longer.startswith(shorter):
                raise Refused(no.CgroupTaken(cgroup, lease.id, lease.spec.consumer, other))


def _known_by(core: Core, client: Client, nonce: str) -> Lease | None:
    """Return the lease that an earlier acquire with the same nonce asked for. Raises Refused where
    it is over."""
    lease_id = core.nonces.get((client.process, nonce))
    if lease_id is None:
        return None
    lease = core.leases.get(lease_id)
    if lease is None:
        raise over(core.ended, lease_id)
    return lease


def _answer_again(core: Core, asked: ev.Asked, lease: Lease) -> None:
    """Answer a repeat as its lease is. The newest connection of a process is the one that
    listens."""
    core.hand_to(lease, asked.client)
    if lease.state is LeaseState.LOADING and not lease.attached:
        lease.attached = True  # its grant was lost in a restart: no holder has it to reattach
        core.keep(lease)
        core.recovering.discard(lease.id)
    state = lease.state if lease.state in (LeaseState.QUEUED, *AWAY) else LeaseState.LOADING
    core.reply(asked.client, asked.id, AcquireReply(str(state), status.view(core, lease)))


def _new_lease(
    core: Core,
    asked: ev.Asked,
    wanted: w.Acquire,
    load_peak: int,
    steady: int,
    gpus: tuple[GpuId, ...],
) -> Lease:
    """Return a lease that is asked for, known by its nonce from now on."""
    client, spec = core.clients[asked.client], wanted.spec
    request = Request(
        nonce=wanted.nonce,
        arrived_at=core.now,
        arrival=core.next_arrival(),
        load_peak_bytes=load_peak,
        steady_bytes=steady,
        gpus=gpus,
        uid=client.uid,
        id=asked.id,
        wait_timeout_s=wanted.wait_timeout_s,
        traceparent=asked.traceparent,
    )
    story = [(core.now, LeaseState.QUEUED, str(Why.ACQUIRED))]
    lease_id = core.next_lease_id()
    lease = Lease(lease_id, spec, client.process, client.id, request, story=story)
    core.add(lease)
    core.nonces[client.process, wanted.nonce] = lease.id
    if spec.consumer in core.costs.reuse:
        core.costs.wanted(spec.consumer, core.now)
    core.turn.unanswered = lease
    return lease


def reacquire(core: Core, asked: ev.Asked, request: w.Reacquire) -> None:
    """Queue a lease that is away, or on its way there. Raises Refused."""
    lease = lease_for(core, request)
    if lease.process != core.clients[asked.client].process:
        raise Refused(no.NotHolder(lease.id, lease.process.pid))
    if lease.state in AWAY:
        standby.call_back(core, lease, asked, request, lease.spec)
        return
    if lease.state is LeaseState.VERIFYING and lease.next_state is not None:
        lease.request.traceparent = asked.traceparent
        if lease.standby.recalled_at is None:
            lease.standby.recalled_at = core.now
            lease.request.wait_timeout_s = request.wait_timeout_s
    elif lease.state is not LeaseState.QUEUED:
        raise bad_state(lease, Misfit.NOT_AWAY)
    core.hand_to(lease, asked.client)
    core.reply(asked.client, asked.id, AcquireReply("queued", status.view(core, lease)))


def answer_queued(core: Core, lease: Lease) -> None:
    """Tell an acquire of this event that the scheduling did not grant that it waits, and why."""
    request = lease.request
    if lease.state is not LeaseState.QUEUED or request.id is None:
        return
    view = status.view(core, lease)
    ahead = ahead_of(core.gpus, lease)
    gpu = core.gpus[request.planned_gpu or request.gpus[0]]
    block = None if ahead else status.block_view(core, gpu)
    core.note(QueuedNote(view.position, request.reason, ahead, block), lease)
    core.reply(lease.client, request.id, AcquireReply("queued", view))
    request.id = None


def cancel(core: Core, asked: ev.Asked, request: w.Cancel) -> None:
    """Give up a queued lease. One that was granted meanwhile must be released instead."""
    lease = core.leases.get(request.lease_id)
    if lease is None:
        ended = core.ended.get(request.lease_id)
        if ended is None or ended.state is not LeaseState.CANCELLED:
            raise over(core.ended, request.lease_id)
        core.reply(asked.client, asked.id, StateReply(ended.state))
        return
    if lease.process != core.clients[asked.client].process:
        raise Refused(no.NotHolder(lease.id, lease.process.pid))
    refusal = no.CancelledRequest(lease.id, Why.HOLDER_GAVE_UP)
    if lease.state is LeaseState.QUEUED:
        cancel_waiter(core, lease, Why.HOLDER_GAVE_UP)
    elif not standby.give_up(core, lease, LeaseState.CANCELLED, refusal):
        raise bad_state(lease, Misfit.GRANTED)
    core.reply(asked.client, asked.id, StateReply(lease.state))


def cancel_waiter(core: Core, lease: Lease, why: Why, by: str = "") -> None:
    """End a wait that its own client ends."""
    core.move(lease, LeaseState.CANCELLED, why)
    core.dequeue(lease)
    core.note(CancelledNote(why, by), lease)
    core.end(lease, no.CancelledRequest(lease.id, why, by))


def on_wait_timeout(core: Core, lease_id: str) -> None:
    """Deny a request that waited for as long as it wanted to."""
    lease = core.waiting[LeaseId(lease_id)]
    waited_s = core.now - lease.request.arrived_at
    why = explain(core, lease)
    core.deny(lease, no.TimedOut(lease.spec.consumer, waited_s, why))


# -- refused at once
def note_refused(
    core: Core, client: ClientId, request: w.Acquire | w.Reacquire, refusal: Refusal
) -> None:
    """Note that a request for bytes was refused at once, by whom it was sent, and why.

    A process that asks and is refused thousands of times a second must not push everything else
    out of the history: beyond a number at once its refusals are counted, and the next note says how
    many were left out.
    """
    process = core.clients[client].process
    seen = newest(core.refusals, process, lambda: Refusals(core.now), PROCESSES_REMEMBERED)
    seen.noted = max(0.0, seen.noted - (core.now - seen.at))
    seen.at = core.now
    if seen.noted > AT_ONCE - 1:
        seen.left_out += 1
        return
    seen.noted += 1
    lease = None if isinstance(request, w.Acquire) else core.leases.get(request.lease_id)
    consumer = request.spec.consumer if isinstance(request, w.Acquire) else ""
    core.note(RefusedNote(process.pid, refusal, consumer, seen.left_out), lease)
    seen.left_out = 0


# -- holding
def ready(core: Core, asked: ev.Asked, request: w.Ready) -> None:
    """Mark a lease loaded: from now on its steady bytes are charged, or what its holder measured.

    A repeat is answered again, also once the holder is revoked.
    """
    lease = own_lease(core, asked.client, request)
    if lease.state not in (LeaseState.LOADING, LeaseState.HELD, LeaseState.REVOKING):
        raise bad_state(lease, Misfit.NOT_LOADING)
    repeated = lease.state is not LeaseState.LOADING
    if not repeated:
        become_held(core, lease, request.measured_bytes)
    core.reply(asked.client, asked.id, ReadyReply(status.view(core, lease)))
    if repeated:
        return
    core.record_lease(lease)
    core.costs.learn(lease.spec.consumer, "load_s", core.now - lease.granted_at)
    loaded = ReadyNote(
        charge_bytes=core.gpu_of(lease).ledger.charge_bytes(lease.id),
        declared_bytes=lease.request.steady_bytes,
        measured_bytes=lease.observed.reported_bytes,
        load_ms=(core.now - lease.granted_at) * 1e3,
    )
    core.note(loaded, lease)
    core.note(status.switch_record(lease, core.now), lease)


def become_held(core: Core, lease: Lease, measured_bytes: int | None) -> None:
    """Mark a lease held and charge it so."""
    gpu, request = core.gpu_of(lease), lease.request
    core.move(lease, LeaseState.HELD, Why.READY)
    lease.ready_at = lease.uses.last_at = core.now
    lease.observed.reported_bytes = measured_bytes
    for drift in learning.on_ready(core.footprints, gpu, lease, measured_bytes):
        core.note(drift, lease)
    core.costs.failures.pop(learning.model_name(lease.spec), None)
    steady = request.steady_bytes
    if measured_bytes is not None:
        steady = max(measured_bytes, lease.spec.footprint.residue_bytes)
    peak = max(request.load_peak_bytes, lease.observed.peak_bytes)
    gpu.pending_free.give_up(lease.process, peak - steady, core.now)
    gpu.ledger.recharge(lease.id, steady, core.now)
    gpu.changed_at = core.now
    gpu.want_sample(core.now, core.now)  # what it holds now is what has to come back one day
    gpu.wake()


def renew(core: Core, asked: ev.Asked, request: w.Renew) -> None:
    """Keep leases alive. One that expired stays expired; one that is queued needs no renewal."""
    process = core.clients[asked.client].process
    alive: list[str] = []
    gone: list[GoneLease] = []
    for ref in request.leases:
        lease = core.leases.get(ref.lease_id)
        try:
            if lease is None or lease.state is not LeaseState.QUEUED or lease.process != process:
                lease = own_lease(core, asked.client, ref)
                if not lease.attached:  # its time to live runs on: saying "alive" would be untrue
                    raise bad_state(lease, Misfit.NOT_REATTACHED)
            alive.append(ref.lease_id)
        except Refused as refused:
            gone.append(GoneLease(ref.lease_id, refused.refusal.view()))
    core.reply(asked.client, asked.id, RenewReply(tuple(alive), tuple(gone)))


# -- leaving
def revoke_ack(core: Core, asked: ev.Asked, request: w.RevokeAck) -> None:
    """Take down that a holder heard its revoke: it is not pushed again before the safe point."""
    lease = own_lease(core, asked.client, request)
    revoked = lease.departure.eviction
    if revoked is not None and revoked.acked_at is None:
        revoked.acked_at = core.now
        core.note(RevokeAckedNote(request.safe_point_eta_s, len(lease.uses)), lease)
    core.reply(asked.client, asked.id, StateReply(lease.state, len(lease.uses)))


def unloading(core: Core, asked: ev.Asked, request: w.Unloading) -> None:
    """Begin the unloading of a holder at its safe point; a repeat is answered again.

    Refused while the lease is in use: this is the safe-point rule.
    """
    lease = own_lease(core, asked.client, request)
    if lease.state is LeaseState.UNLOADING:
        core.reply(asked.client, asked.id, StateReply(lease.state))
        return
    if lease.state not in (LeaseState.HELD, LeaseState.REVOKING):
        raise bad_state(lease, Misfit.NOT_UNLOADABLE)
    if lease.uses:
        raise bad_state(lease, Misfit.IN_USE)
    gpu, departure = core.gpu_of(lease), lease.departure
    core.move(lease, LeaseState.UNLOADING, Why.SAFE_POINT)
    departure.hangs, departure.baseline = False, gpu.sample
    core.timers.set(("revoke", lease.id), core.now + core.settings.revoke_deadline_s)
    if departure.eviction is not None:
        departure.eviction.unloading_at = core.now
        core.costs.learn(lease.spec.consumer, "drain_s", core.now - departure.eviction.asked_at)
    core.reply(asked.client, asked.id, StateReply(lease.state))
    core.note(UnloadingNote(asked=departure.eviction is not None), lease)
    gpu.wake()


def release(core: Core, asked: ev.Asked, request: w.Release) -> None:
    """Take a lease back from its holder. Its bytes stay charged until they are measured gone.

    A repeat is answered again; it never ends a lease that went on standby.
    """
    process = core.clients[asked.client].process
    ended = core.ended.get(request.lease_id)
    if (
        ended is not None
        and ended.state is LeaseState.RELEASED
        and (ended.token, ended.process) == (request.token, process)
    ):
        core.reply(asked.client, asked.id, ReleaseReply(ended.state, ended.state))
        return
    lease = own_lease(core, asked.client, request)
    if lease.gpu is not None and lease.state is not LeaseState.VERIFYING:
        _decide_return(core, lease, request)
        why = Why.EXITS if request.exiting else Why.LET_GO
        released(core, lease, exiting=request.exiting, why=why)
    after = lease.next_state or LeaseState.RELEASED
    core.reply(asked.client, asked.id, ReleaseReply(lease.state, after))


def _decide_return(core: Core, lease: Lease, request: w.Release) -> None:
    """Decide whether a lease that is released parks, and whether it comes back by itself: only if
    the engine revoked it, no operator. Raises Refused."""
    count, ram, ahead = lease.spec.park_bytes, core.host_ram, lease.standby
    if request.parked and (request.exiting or not count):
        raise bad_state(lease, Misfit.EXITS if request.exiting else Misfit.NO_PARK_BYTES)
    if request.parked and lease.id not in ram.booked and not ram.book(lease.id, count):
        raise Refused(no.NoHostRam(count, ram.budget_bytes, ram.taken_bytes()))
    revoked = lease.departure.eviction is not None or lease.departure.revoked_before
    stays = lease.spec.standby and revoked and not ahead.dismissed
    ahead.parks, ahead.comes_back = request.parked, stays and not request.exiting


def released(core: Core, lease: Lease, *, exiting: bool, why: Why) -> None:
    """Verify that the bytes of a resident lease return. Uses that others left on it end."""
    gpu, departure, before = core.gpu_of(lease), lease.departure, lease.state
    end_uses(core, lease, why)
    departure.exiting = exiting
    core.move(lease, LeaseState.VERIFYING, why)
    core.timers.cancel(("ttl", lease.id))
    if (asked := departure.eviction) is not None:
        asked.unloading_at = asked.unloading_at or core.now
        asked.released_at = core.now
        core.costs.learn(lease.spec.consumer, "unload_s", core.now - asked.unloading_at)
    begin_for_lease(core, gpu, lease, alive=True)
    core.record_lease(lease)
    core.note(ReleasedNote(exiting, before, why), lease)
    gpu.wake()


def end_uses(core: Core, lease: Lease, why: Why) -> None:
    """End every use that is still on a lease whose bytes go."""
    for use in list(lease.uses.values()):
        core.unmark(lease, use)
        note_ended(core, lease, use, why)


def note_ended(core: Core, lease: Lease, use: Use, why: Why, by: str = "") -> None:
    """Note the end of a use."""
    ms = (core.now - use.began_at) * 1e3
    core.note(UseEndedNote(use.id, use.label, ms, why, by), lease)


def oom(core: Core, asked: ev.Asked, request: w.Oom) -> None:
    """Learn from an allocation that failed, if its holder asked for more than it was granted."""
    lease = own_lease(core, asked.client, request)
    if lease.gpu is None:
        raise bad_state(lease, Misfit.HOLDS_NOTHING)
    gpu = core.gpu_of(lease)
    charge = gpu.ledger.charge_bytes(lease.id)
    allocated = charge if request.allocated_bytes is None else request.allocated_bytes
    wanted = min(allocated + request.requested_bytes, gpu.ledger.budget_bytes)
    learnt = wanted if wanted > charge else None
    if learnt is not None:
        core.footprints.out_of_memory(learning.model_name(lease.spec), learnt)
    gpu.want_sample(core.now, core.now)
    core.reply(asked.client, asked.id, OomReply(learnt))
    note = OomNote(
        requested_bytes=request.requested_bytes,
        allocated_bytes=request.allocated_bytes,
        charge_bytes=charge,
        learnt_load_peak_bytes=learnt,
    )
    core.note(note, lease)
