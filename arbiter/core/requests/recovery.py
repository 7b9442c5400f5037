"""After a restart of the daemon alone: the journal names the holders, and they reattach or do
not.

Until every recovered lease is accounted for (re-attached, given up, its process dead, or the card
is read at baseline) nothing is granted. Recovered bytes are charged from the first moment, until
their holder says that they are gone, dies, or its time is over. A journal in doubt names some
leases at best: its holders are believed, and grants wait as long as any holder may keep what it
has. A record of a sub-lease, as versions before 0.2.0 wrote it, comes back as a plain lease: parent
and sub-lease are each charged their own bytes until they are measured gone.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from vram_arbiter.arbiter.core.events import (
    DOUBT_KEY,
    LeaseSpec,
    MemorySampled,
    Reattached,
    ReattachedLease,
    Recovered,
)
from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.learning import drift
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import (
    AWAY,
    Lease,
    LeaseState,
    Request,
    Use,
)
from vram_arbiter.arbiter.core.model.refusals import Refused
from vram_arbiter.arbiter.core.model.state import Client, Core, Ended, Gpu
from vram_arbiter.arbiter.core.report import explain
from vram_arbiter.arbiter.core.requests import operators, uses
from vram_arbiter.arbiter.core.requests.requests import (
    become_held,
    client_of,
    ended_error,
    touch,
)
from vram_arbiter.arbiter.core.scheduling import placement
from vram_arbiter.arbiter.core.verification.schedule import begin_for_lease
from vram_arbiter.schemas import defaults
from vram_arbiter.schemas.ids import GpuId, LeaseId, ModelKey, ProcessKey, Token
from vram_arbiter.schemas.wire.codes import Order, Why
from vram_arbiter.schemas.wire.replies import ReattachedView, ReattachReply

EMPTY_JOURNAL = LeaseId("journal")
"""Stands for the holders that an empty, lost or doubted journal does not name; given up after a TTL
and the fence grace."""


def on_recovered(core: Core, event: Recovered) -> None:
    """Charge everything that the journal names, then wait for the holders. Records of a card that
    is gone are dropped."""
    core.recovering = set()
    for known in core.gpus.values():
        core.turn.touch(known)
    held = dict(sorted(event.records.items()))
    doubt = held.pop(DOUBT_KEY, None)
    if (drain := held.pop(operators.DRAIN_KEY, None)) is not None:
        operators.restore_drain(core, drain)
    for key, record in held.items():
        gpu = core.gpus.get(GpuId(str(record["gpu"])))
        if record.get("state") in AWAY:
            if doubt is None:
                _restore_away(core, record)
            else:  # it may have been granted again since: its holder tells
                core.forget(key)
        elif gpu is None:
            core.forget(key)
        elif key.startswith("residue:"):
            process = ProcessKey(int(record["pid"]), int(record["start_ticks"]))
            account = gpu.ledger.accounts.get(process)
            # it lies within what the process is charged for its leases, which were restored before
            # it
            own_bytes = 0 if account is None else account.approved_bytes()
            residue_bytes = min(int(record["residue_bytes"]), _room_bytes(gpu) + own_bytes)
            floor_bytes = min(int(record.get("floor_bytes", residue_bytes)), residue_bytes)
            gpu.ledger.set_residue(process, residue_bytes, core.now, floor_bytes)
            if (
                not residue_bytes
            ):  # stale leases fill the GPU: nothing else would take the record out
                core.forget(key)
        else:
            _restore(core, gpu, record)
    if not held or doubt is not None:
        core.recovering.add(EMPTY_JOURNAL)
        await_unnamed(core)
    facts: dict[str, Any] = {} if doubt is None else {"doubt": str(doubt["why"])}
    core.note("recovered", leases=sorted(core.recovering), records=len(held), **facts)


def await_unnamed(core: Core) -> None:
    """Holders that the journal does not name have their time from now on. A process with bytes that
    stays silent is a stowaway then."""
    grace_s = defaults.LEASE_TTL_S + core.settings.fence_grace_s
    core.timers.set(("recover", EMPTY_JOURNAL), core.now + grace_s)


def _restore_away(core: Core, record: Mapping[str, Any]) -> None:
    """A lease that is away holds nothing on a GPU: recovery does not wait for its holder, but it
    does not come back before it either.
    """
    lease = _remembered(core, record, LeaseState(str(record["state"])))
    lease.request.gpus = tuple(gpu.info.id for gpu in placement.selected(core, lease.spec))
    if not lease.request.gpus:  # the only card that it may come back to is gone
        core.forget(f"lease:{lease.id}")
        return
    _register(core, lease, record)


def _register(core: Core, lease: Lease, record: Mapping[str, Any]) -> None:
    core.add(lease)
    core.nonces[lease.process, lease.request.nonce] = lease.id
    for feature in core.hooked["from_record"]:
        feature.from_record(core, lease, record)


def _remembered(core: Core, record: Mapping[str, Any], state: LeaseState) -> Lease:
    """The lease of a record, on no card yet."""
    spec = spec_from_record(record["spec"])
    request = Request(
        nonce=str(record["nonce"]),
        arrived_at=core.now,
        arrival=core.next_arrival(),
        load_peak_bytes=int(record["load_peak_bytes"]),
        steady_bytes=max(spec.steady_bytes, spec.residue_bytes),
    )
    lease = Lease.recovered(
        LeaseId(str(record["lease_id"])),
        spec,
        ProcessKey(int(record["pid"]), int(record["start_ticks"])),
        request,
        Token(*record["token"]),
        state,
        core.now,
        Why.RECOVERED,
    )
    lease.attached = False
    lease.held_from = min(core.now, float(record.get("held_from", core.now)))
    lease.observed.reported_bytes = record["measured_bytes"]
    lease.departure.exiting = bool(record["exiting"])
    lease.pinned = None if record.get("pinned") is None else Order(*record["pinned"])
    return lease


def _restore(core: Core, gpu: Gpu, record: Mapping[str, Any]) -> None:
    state = str(record["state"])
    asked = state == LeaseState.REVOKING
    lease = _remembered(
        core, record, LeaseState.HELD if asked or state == "debt" else LeaseState(state)
    )
    lease.departure.revoked_before = asked
    lease_id, process, token, spec = lease.id, lease.process, lease.token, lease.spec
    lease.gpu, lease.request.gpus = gpu.info.id, (gpu.info.id,)
    _place(core, gpu, lease, int(record["charge_bytes"]))
    if state == "debt":
        core.nonces[process, lease.request.nonce] = lease_id
        gpu.ledger.to_debt(lease_id)
        grace_s = core.settings.fence_grace_s
        fenced_at = core.now + spec.ttl_s + grace_s
        begin_for_lease(core, gpu, lease, alive=True, grace_s=grace_s, fenced_at=fenced_at)
        core.remember(
            Ended(
                lease_id,
                process,
                lease.request.nonce,
                token,
                LeaseState.LOST,
                no.Lost(lease_id, Why.NOT_HELD),
            )
        )
        return
    _register(core, lease, record)
    gpu.residents[lease_id] = lease
    if lease.state is LeaseState.VERIFYING:
        begin_for_lease(core, gpu, lease, alive=True)
        return
    lease.expires_at = core.now + spec.ttl_s + core.settings.fence_grace_s
    core.timers.set(("ttl", lease_id), lease.expires_at)
    if lease.state is LeaseState.HELD:
        uses.restore(core, lease, record.get("users", ()))
    assert core.recovering is not None, "restoring outside recovery"
    core.recovering.add(lease_id)


def _place(core: Core, gpu: Gpu, lease: Lease, charge_bytes: int) -> None:
    """Charge what is there anyway. What the budget does not hold was never approved: it is
    pressure."""
    approved_bytes = min(charge_bytes, _room_bytes(gpu))
    gpu.ledger.charge(lease.id, lease.process, charge_bytes, approved_bytes, core.now)
    gpu.pending_free.give_up(
        lease.process, max(0, lease.request.load_peak_bytes - charge_bytes), core.now
    )
    gpu.changed_at = core.now


def _room_bytes(gpu: Gpu) -> int:
    """What can still be approved. A disk that was full keeps records that should be gone, and they
    may say more than the card has."""
    return max(0, gpu.ledger.budget_bytes - gpu.ledger.approved_bytes())


def spec_from_record(record: Mapping[str, Any]) -> LeaseSpec:
    """The inverse of what `Core.record_lease` writes."""
    return LeaseSpec(
        consumer=str(record["consumer"]),
        key=ModelKey(str(record["model_id"]), str(record["revision"])),
        gpu=str(record["gpu"]),
        exclusive=bool(record["exclusive"]),
        load_peak_bytes=int(record["load_peak_bytes"]),
        steady_bytes=int(record["steady_bytes"]),
        residue_bytes=int(record["residue_bytes"]),
        priority=int(record["priority"]),
        evictable=bool(record["evictable"]),
        ttl_s=float(record["ttl_s"]),
        min_residency_s=float(record["min_residency_s"]),
        deny_on_deadline=bool(record["deny_on_deadline"]),
        standby=bool(record.get("standby", False)),
        on_overstay=str(record.get("on_overstay", "wait")),
        park_bytes=int(record.get("park_bytes", 0)),
        independent=bool(record.get("independent", False)),
        gang=None
        if record.get("gang") is None
        else (str(record["gang"][0]), int(record["gang"][1])),
    )


# -- coming back
def on_reattached(core: Core, event: Reattached) -> None:
    """A client tells what it still holds. Every lease is answered for itself; nothing is lost
    because of a neighbour."""
    client = client_of(core, event.client)
    answers: list[ReattachedView] = []
    for item in event.leases:
        try:
            lease = _reattach(core, client, item)
        except Refused as refused:
            error = refused.refusal.view()
            answers.append(ReattachedView(item.lease, kept=False, error=error))
        else:
            view = explain.view(core, lease)
            answers.append(ReattachedView(item.lease, kept=True, lease=view))
    core.reply(event.client, event.request, ReattachReply(tuple(answers)))


def _reattach(core: Core, client: Client, item: ReattachedLease) -> Lease:
    lease = core.leases.get(item.lease)
    if lease is None:
        if item.lease in core.ended:
            raise ended_error(core.ended[item.lease])
        lease = _adopt(core, client, item)
    elif _journal_is_behind(core, lease, client, item):
        lease.token = item.token
        core.record_lease(lease)
    elif lease.token != item.token and not _missed_its_grant(lease, client, item):
        raise Refused(no.WrongToken(item.lease, str(item.token)))
    elif lease.process != client.process:
        raise Refused(no.NotHolder(item.lease, lease.process.pid))
    core.hand_to(lease, client.id)
    if not lease.attached:
        lease.attached = True
        # its residency begins anew: clients that marked uses on it may still be reconnecting
        lease.ready_at = core.now
        if lease.gpu is not None:
            core.gpu_of(lease).residents.recent[lease.id] = lease
    for feature in core.hooked["on_reattached"]:
        feature.on_reattached(core, lease, item)
    if lease.state is LeaseState.LOADING and item.held and not item.away:  # its `ready` was lost
        become_held(core, lease, item.measured_bytes)
        core.record_lease(lease)
    if lease.gpu is not None:
        _restore_uses(core, lease, client, item)
    touch(core, lease)
    account_for(core, lease.id)
    core.note("reattached", lease, uses=len(lease.uses), state=str(lease.state))
    return lease


def _journal_is_behind(core: Core, lease: Lease, client: Client, item: ReattachedLease) -> bool:
    """The journal is in doubt and has lost the lease's last grant, which its holder knows."""
    return (
        core.recovering is not None
        and EMPTY_JOURNAL in core.recovering
        and lease.process == client.process
        and lease.token is not None
        and lease.token < item.token
        and item.token.epoch < core.settings.epoch
    )


def _missed_its_grant(lease: Lease, client: Client, item: ReattachedLease) -> bool:
    """It came back from standby while its holder, which knows the token before, was away."""
    return (
        item.away
        and lease.state is LeaseState.LOADING
        and lease.process == client.process
        and lease.token is not None
        and item.token < lease.token
    )


def _restore_uses(core: Core, lease: Lease, client: Client, item: ReattachedLease) -> None:
    """What this client says runs is what runs, as far as its own uses go.

    Other connections, of this process too, answer for theirs: after a restart they may have begun
    them again before this one came. An earlier connection of the same instance is no other: ROUTER
    never says that it is gone.
    """
    others = {c.id for c in core.clients.values() if c.instance != client.instance}
    for use in list(lease.uses.values()):
        if use.process == client.process and use.id not in item.uses and use.client not in others:
            core.unmark(lease, use)
    if lease.state in (LeaseState.HELD, LeaseState.REVOKING):
        for use_id in item.uses:
            key = (client.process, use_id)
            known = lease.uses.get(key) or lease.uses.paused.get(key)
            began = Use(use_id, client.id, client.process, "", core.now)
            core.mark(lease, began if known is None else replace(known, client=client.id))
    eviction.ask_again(core, lease)
    core.wake(core.gpu_of(lease))


def _seen_bytes(gpu: Gpu, process: ProcessKey) -> int:
    """What the newest reading shows of a process; nothing where it cannot say. The journal that
    knew the card is lost."""
    return 0 if gpu.sample is None else gpu.sample.bytes_of(process) or 0


def _adopt(core: Core, client: Client, item: ReattachedLease) -> Lease:
    """The journal does not know this lease but its token is of an earlier epoch: its holder is
    believed while recovering."""
    if core.recovering is None or item.token.epoch >= core.settings.epoch:
        raise Refused(no.Lost(item.lease, Why.UNKNOWN))
    gpus = placement.selected(core, item.spec)
    if not gpus:
        known = tuple(gpu.info.id for gpu in core.gpus.values())
        raise Refused(no.UnknownGpu(item.spec.gpu, known))
    spec = item.spec
    peak, steady = drift.expected_bytes(core, spec)
    request = Request(
        nonce=f"adopted {item.lease}",
        arrived_at=core.now,
        arrival=core.next_arrival(),
        load_peak_bytes=peak,
        steady_bytes=steady,
    )
    lease = Lease.recovered(
        item.lease,
        spec,
        client.process,
        request,
        item.token,
        _adopted_state(item),
        core.now,
        Why.ADOPTED,
    )
    lease.client = client.id
    lease.observed.reported_bytes = item.measured_bytes
    core.add(lease)
    core.nonces[lease.process, request.nonce] = lease.id
    if item.away:
        request.gpus = tuple(gpu.info.id for gpu in gpus)
        return lease
    gpu = max(gpus, key=lambda gpu: (_seen_bytes(gpu, client.process), -gpu.info.index))
    lease.gpu, request.gpus = gpu.info.id, (gpu.info.id,)
    charge = peak
    if item.held:
        charge = (
            steady if item.measured_bytes is None else max(item.measured_bytes, spec.residue_bytes)
        )
    _place(core, gpu, lease, charge)
    gpu.residents[lease.id] = lease
    core.record_lease(lease)
    return lease


def _adopted_state(item: ReattachedLease) -> LeaseState:
    if item.away:
        return LeaseState.PARKED if item.parked else LeaseState.STANDBY
    return LeaseState.HELD if item.held else LeaseState.LOADING


# -- coming to an end
def account_for(core: Core, lease_id: LeaseId) -> None:
    """One lease less to wait for."""
    if core.recovering is not None and lease_id in core.recovering:
        core.recovering.remove(lease_id)
        if lease_id == EMPTY_JOURNAL:
            core.forget(DOUBT_KEY)


def on_recover_due(core: Core, subject: str) -> None:
    account_for(core, LeaseId(subject))


def account_for_the_empty(core: Core, sample: MemorySampled) -> None:
    """The card is read as good as empty: no holder has to be waited for there.

    The holders that have not come back live, and they alone can say that a lease is over, or their
    time: a model may sleep in host RAM, and a reading may lie. Their bytes stay charged, and they
    are not revoked before they are heard of.
    """
    gpu = core.gpus.get(sample.gpu)
    if gpu is None or gpu.sample is not sample:
        return  # it does not count (`schedule.on_reading`)
    if core.recovering is None or sample.taken_at < core.started_at:
        return
    noise_bytes = gpu.info.reserve_bytes + core.settings.verify_tolerance_bytes
    if sample.used_bytes > noise_bytes:
        return
    for lease_id in gpu.residents:
        account_for(core, lease_id)
    if all(g.sample is not None and g.sample.used_bytes <= noise_bytes for g in core.gpus.values()):
        account_for(core, EMPTY_JOURNAL)


def serve_if_accounted(core: Core) -> None:
    """Everybody is accounted for: begin to grant."""
    if core.recovering is None or core.recovering:
        return
    core.recovering = None
    core.note("serving", seconds=core.now - core.started_at)
    for gpu in core.gpus.values():
        core.wake(gpu)
