"""Recovery after a restart of the daemon alone, and resume from suspend: what was known before does
not count until holders and readings say it again.

1. `on_recovered`: what the journal names is charged from the first moment, until its holder says
   that it is gone, dies, or its time is over.
2. `on_reattached`: holders come back and say what they hold. A journal in doubt names some leases
   at best: its holders are believed, and grants wait as long as any holder may keep what it has.
3. `Core.account_for`, `Core.serve`: nothing is granted until every recovered lease is accounted for
   (reattached, given up, its process dead, or its GPU read as empty).
"""

from collections.abc import Mapping
from dataclasses import replace

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core import eviction
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import AWAY, EXPIRING, Lease, LeaseState, Request, Use
from vram_arbiter.arbiter.core.model.records import (
    DoubtRecord,
    DrainRecord,
    LeaseRecord,
    ResidueRecord,
)
from vram_arbiter.arbiter.core.model.refusals import Refused
from vram_arbiter.arbiter.core.model.state import EMPTY_JOURNAL, Client, Core, Ended
from vram_arbiter.arbiter.core.report import status
from vram_arbiter.arbiter.core.requests import uses
from vram_arbiter.arbiter.core.requests.requests import become_held, over, released
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.core.verification.schedule import begin_for_lease
from vram_arbiter.schemas import defaults
from vram_arbiter.schemas.ids import GpuId, ProcessKey
from vram_arbiter.schemas.wire.codes import Order, Why
from vram_arbiter.schemas.wire.notes import ReattachedNote, RecoveredNote, ResumedNote
from vram_arbiter.schemas.wire.pushes import GrantedPush
from vram_arbiter.schemas.wire.replies import ReattachedView, ReattachReply
from vram_arbiter.schemas.wire.requests import Reattach, ReattachLease


# -- restoring
def on_recovered(core: Core, event: ev.Recovered) -> None:
    """Restore what the journal names, then wait for the holders. Records of a GPU that is gone are
    dropped."""
    core.serving = False
    doubt: DoubtRecord | None = None
    held = 0
    for key, record in sorted(event.records.items()):  # a doubt first, residues after leases
        held += isinstance(record, LeaseRecord | ResidueRecord)
        match record:
            case DoubtRecord():
                doubt = record
            case DrainRecord():
                core.drain = Order(record.by, record.reason)
            case LeaseRecord() if record.state in AWAY:
                # in doubt it may have been granted again since: its holder tells
                if doubt is None and admission.selected(core.gpus, record.spec):
                    _restore(core, record, Why.RECOVERED)
                else:
                    core.forget(key)
            case _ if record.gpu not in core.gpus:
                core.forget(key)
            case LeaseRecord():
                _restore(core, record, Why.RECOVERED)
            case ResidueRecord():
                if not _restore_residue(core.gpus[GpuId(record.gpu)], record, core.now):
                    # stale leases fill the GPU: nothing else would take the record out
                    core.forget(key)
    if not held or doubt is not None:
        core.recovering.add(EMPTY_JOURNAL)
        core.timers.set(("recover", EMPTY_JOURNAL), _unnamed_until(core.settings, core.now))
    why = "" if doubt is None else doubt.why
    core.note(RecoveredNote(tuple(sorted(core.recovering)), held, why))


def _unnamed_until(settings: Settings, now: float) -> float:
    """Return until when holders that the journal does not name have their time. A process with
    bytes that stays silent is a stowaway then."""
    return now + defaults.LEASE_TTL_S + settings.fence_grace_s


def _restore(core: Core, record: LeaseRecord, why: Why) -> Lease:
    """Return the lease of a record, in the state in which it was found.

    1. What it holds on a GPU is charged.
    2. A debt has no holder to wait for: its bytes are measured away.
    3. The bytes of a lease that is verified are measured away.
    4. A lease that is away, or will be, keeps no others waiting, nor comes back before its holder.
    5. Every other holder has its time to reattach. What others use stays in use.
    """
    grace_s = core.settings.fence_grace_s
    named = tuple(gpu.info.id for gpu in admission.selected(core.gpus, record.spec))
    lease = _found(record, named, core.next_arrival(), core.now, why)
    core.nonces[lease.process, record.nonce] = lease.id
    gpu = None if lease.gpu is None else core.gpus[lease.gpu]
    if gpu is not None:
        _charge(gpu, lease, record.charge_bytes, core.now)  # 1
    if gpu is not None and record.state == "debt":  # 2
        fenced_at = core.now + lease.spec.ttl_s + grace_s
        begin_for_lease(core, gpu, lease, alive=True, grace_s=grace_s, fenced_at=fenced_at)
        lost = no.Lost(lease.id, Why.NOT_HELD)
        nonce, token = lease.request.nonce, lease.token
        core.remember(Ended(lease.id, lease.process, nonce, token, LeaseState.LOST, lost))
        return lease
    core.add(lease)
    if record.parked_bytes:
        core.host_ram.find(lease.id, record.parked_bytes)
    if gpu is None:
        core.away[lease.id] = lease
    else:
        gpu.residents.add(lease)
    if gpu is not None and lease.state is LeaseState.VERIFYING:  # 3
        begin_for_lease(core, gpu, lease, alive=True)
    if lease.state not in EXPIRING:  # 4
        core.timers.set(("away", lease.id), core.now + lease.spec.ttl_s + grace_s)
        return lease
    core.keep(lease, grace_s)  # 5
    if lease.state is LeaseState.HELD:
        uses.restore(core, lease, record.users)
    core.recovering.add(lease.id)
    return lease


def _found(
    record: LeaseRecord, named: tuple[GpuId, ...], arrival: int, now: float, why: Why
) -> Lease:
    """Return the lease of a record, which is not charged yet. `named`: GPUs that its spec names."""
    sizes = record.spec.footprint
    request = Request(
        nonce=record.nonce,
        arrived_at=now,
        arrival=arrival,
        load_peak_bytes=record.load_peak_bytes,
        steady_bytes=max(sizes.steady_bytes, sizes.residue_bytes),
        gpus=named,
    )
    return Lease.recovered(record, request, now, why)


def _charge(gpu: Gpu, lease: Lease, charge_bytes: int, now: float) -> None:
    """Charge what is there anyway. What the budget does not hold was never approved: it is
    pressure."""
    approved_bytes = min(charge_bytes, _room_bytes(gpu))
    gpu.ledger.charge(lease.id, lease.process, charge_bytes, approved_bytes, now)
    gpu.pending_free.give_up(lease.process, lease.request.load_peak_bytes - charge_bytes, now)
    gpu.changed_at = now


def _room_bytes(gpu: Gpu) -> int:
    """Return what can still be approved. A disk that was full keeps records that should be gone,
    and they may say more than the GPU has."""
    return max(0, gpu.ledger.budget_bytes - gpu.ledger.approved_bytes)


def _restore_residue(gpu: Gpu, record: ResidueRecord, now: float) -> int:
    """Charge what a process keeps, within what it is charged for its leases. Return the bytes."""
    process = ProcessKey(record.pid, record.start_ticks)
    account = gpu.ledger.accounts.get(process)
    own_bytes = 0 if account is None else account.approved_bytes
    residue_bytes = min(record.residue_bytes, _room_bytes(gpu) + own_bytes)
    floor_bytes = residue_bytes if record.floor_bytes is None else record.floor_bytes
    gpu.ledger.retain(process, residue_bytes, now, min(floor_bytes, residue_bytes))
    return residue_bytes


# -- reattaching
def reattach(core: Core, asked: ev.Asked, request: Reattach) -> None:
    """Take what a client says that it still holds. Every lease is answered for itself."""
    client = core.clients[asked.client]
    answers: list[ReattachedView] = []
    for item in request.leases:
        try:
            view = status.view(core, _reattach(core, client, item))
            answers.append(ReattachedView(item.lease_id, kept=True, lease=view))
        except Refused as refused:
            error = refused.refusal.view()
            answers.append(ReattachedView(item.lease_id, kept=False, error=error))
    core.reply(asked.client, asked.id, ReattachReply(tuple(answers)))


def _reattach(core: Core, client: Client, item: ReattachLease) -> Lease:
    """Return the lease that a holder reattaches. Raises Refused.

    1. The lease is the one that the journal names, or its holder is believed.
    2. The connection that reattached it speaks for it.
    3. What was lost with the daemon is made up: a standby, a `ready`, uses.
    4. Nothing waits for this holder any longer.
    """
    lease = core.leases.get(item.lease_id)  # 1
    if lease is None:
        if item.lease_id in core.ended:
            raise over(core.ended, item.lease_id)
        if core.serving or item.token.epoch >= core.settings.epoch:
            raise Refused(no.Lost(item.lease_id, Why.UNKNOWN))
        sizes = core.footprints.expected_bytes(item.spec)
        lease = _restore(core, _adopted(core.gpus, client, item, *sizes), Why.ADOPTED)
        lease.request.steady_bytes = sizes[1]
        core.record_lease(lease)
    elif lease.token != item.token:
        in_doubt = EMPTY_JOURNAL in core.recovering and item.token.epoch < core.settings.epoch
        if _knows_newer(lease, client, item, in_doubt=in_doubt):
            lease.token = item.token
            core.record_lease(lease)
    elif lease.process != client.process:
        raise Refused(no.NotHolder(item.lease_id, lease.process.pid))
    core.hand_to(lease, client.id)  # 2
    if not lease.attached:
        lease.attached = True
        # its residency begins anew: clients that marked uses on it may still be reconnecting
        lease.ready_at = core.now
        if lease.gpu is not None:
            core.gpu_of(lease).residents.recent[lease.id] = lease
    if item.state in AWAY:  # 3
        _reattach_away(core, lease, item)
    if lease.state is LeaseState.LOADING and item.state == "held":
        become_held(core, lease, item.measured_bytes)
        core.record_lease(lease)
    if lease.gpu is not None:
        _restore_uses(core, lease, client, item)
    core.keep(lease)  # 4
    core.account_for(lease.id)
    core.note(ReattachedNote(len(lease.uses), lease.state), lease)
    return lease


def _reattach_away(core: Core, lease: Lease, item: ReattachLease) -> None:
    """Believe a holder whose lease, it says, is away; its release, or the grant, was lost."""
    if lease.state in AWAY:
        core.wake_candidates(lease)
    elif lease.token != item.token:
        core.push(lease, GrantedPush(status.view(core, lease)))
    elif lease.state in EXPIRING:
        lease.standby.comes_back = lease.spec.standby and not lease.standby.dismissed
        lease.standby.parks = item.state == "parked"
        if lease.standby.parks and lease.id not in core.host_ram.booked:
            core.host_ram.find(lease.id, lease.spec.park_bytes)
        released(core, lease, exiting=False, why=Why.LET_GO_BEFORE)


def _knows_newer(lease: Lease, client: Client, item: ReattachLease, *, in_doubt: bool) -> bool:
    """Return whether a holder that knows its lease by another token is right. Raises Refused.

    Either a journal in doubt has lost the last grant, and the holder is right; or the lease came
    back from standby while its holder was away, and the holder knows the token before.
    """
    if lease.process == client.process and lease.token is not None:
        if in_doubt and lease.token < item.token:
            return True
        if item.state in AWAY and lease.state is LeaseState.LOADING and item.token < lease.token:
            return False
    raise Refused(no.WrongToken(item.lease_id, str(item.token)))


def _restore_uses(core: Core, lease: Lease, client: Client, item: ReattachLease) -> None:
    """Take what this client says runs as what runs, as far as its own uses go.

    Other connections, of this process too, answer for theirs: after a restart they may have begun
    them again before this one came. An earlier connection of the same instance is no other: ROUTER
    never says that it is gone.
    """
    siblings = core.connected[client.process].values()
    others = {other.id for other in siblings if other.instance != client.instance}
    for use in list(lease.uses.values()):
        if (
            use.process == client.process
            and use.id not in item.use_ids
            and use.client not in others
        ):
            core.unmark(lease, use)
    if lease.state in (LeaseState.HELD, LeaseState.REVOKING):
        for use_id in item.use_ids:
            key = (client.process, use_id)
            known = lease.uses.get(key)
            began = Use(use_id, client.id, client.process, "", core.now)
            core.mark(lease, began if known is None else replace(known, client=client.id))
    if lease.departure.eviction is not None:
        lease.departure.eviction.acked_at = None  # it was heard on another connection
        eviction.push_revoke(core, lease)
    core.gpu_of(lease).wake()


def _adopted(
    gpus: Mapping[GpuId, Gpu], client: Client, item: ReattachLease, peak: int, steady: int
) -> LeaseRecord:
    """Return the record of a lease that the journal does not know, by its holder's word; the caller
    has seen that the engine recovers and that its token is of an earlier epoch. Raises Refused."""
    named, spec = admission.selected(gpus, item.spec), item.spec
    if not named:
        raise Refused(no.UnknownGpu(spec.gpu, tuple(gpus)))
    # the journal that knew its GPU is lost: it is where most of the process's bytes are seen
    gpu = max(named, key=lambda gpu: (gpu.shown_bytes(client.process) or 0, -gpu.info.index))
    charge = steady if item.state == "held" else peak
    if item.state == "held" and item.measured_bytes is not None:
        charge = max(item.measured_bytes, spec.footprint.residue_bytes)
    return LeaseRecord(
        lease_id=item.lease_id,
        token=(item.token.epoch, item.token.serial),
        state=item.state,
        gpu=None if item.state in AWAY else gpu.info.id,
        pid=client.process.pid,
        start_ticks=client.process.start_ticks,
        nonce=f"adopted {item.lease_id}",
        charge_bytes=charge,
        load_peak_bytes=peak,
        measured_bytes=item.measured_bytes,
        exiting=False,
        spec=spec,
        comes_back=item.state == "standby" or (item.state == "parked" and spec.standby),
        parks=item.state == "parked",
        parked_bytes=spec.park_bytes if item.state == "parked" else 0,
    )


# -- end of a recovery
def account_for_the_empty(core: Core, gpu: Gpu, sample: ev.MemorySampled) -> None:
    """Wait for no holder on a GPU that is read as good as empty.

    Holders that have not reattached live, and they alone can say that a lease is over, or their
    time: a model may sleep in host RAM, and a reading may lie. Their bytes stay charged, and they
    are not revoked before they are heard of.
    """
    noise_bytes = gpu.info.reserve_bytes + core.settings.verify_tolerance_bytes
    if sample.taken_at < core.started_at or sample.used_bytes > noise_bytes:
        return
    for lease_id in gpu.residents:
        core.account_for(lease_id)
    if all(g.sample is not None and g.sample.used_bytes <= noise_bytes for g in core.gpus.values()):
        core.account_for(EMPTY_JOURNAL)


# -- resume from suspend
def on_resumed(core: Core, event: ev.Resumed) -> None:
    """Let no reading count that began before the machine was suspended, such as by a laptop's lid.

    The monotonic clock stood still, so no time to live ran out. Drivers may have moved or dropped
    memory, and holders wake up in any order: each gets its whole time to live, every GPU is unknown
    until it is read, and verifications begin again.
    """
    core.note(ResumedNote(event.slept_s))
    for lease in core.leases.values():
        core.keep(lease, 0.0 if lease.attached else core.settings.fence_grace_s)
        if ("users", lease.id) in core.timers:
            uses.await_users(core, lease)
    if ("recover", EMPTY_JOURNAL) in core.timers:
        core.timers.set(("recover", EMPTY_JOURNAL), _unnamed_until(core.settings, core.now))
    for gpu in core.gpus.values():
        gpu.before_sleep = gpu.sample or gpu.before_sleep
        gpu.sample = None
        gpu.read_from = core.now
        gpu.want_sample(core.now, core.now)
        for verification in gpu.verifications.values():
            verification.confirmed_at, verification.last_used_bytes = core.now, None
            gpu.verify(verification, core.now, core.settings)
        gpu.wake()
