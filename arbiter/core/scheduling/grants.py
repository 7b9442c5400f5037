"""Grants: one pass over the GPUs that changed.

Per card, in this order (the numbers stand in `_serve`):
  1. under pressure: ask idle holders to leave, grant nothing
  2. a feature keeps the GPU for its own requests: it grants them (`Feature.blocks`, `serve`)
  3. blocked (recovering, drained, reading unknown, a load under way): grant and revoke nothing
  4. nothing waits, or a feature owns the head: served by features alone
  5. the head fits by ledger: grant it if the measurement agrees, else ask for a fresh reading; a
     head for which another card is being emptied is passed over from here on
  6. the head does not fit: ask the cheapest victims that cover it, unless enough is on its way out
     already
  7. backfill: the first waiter behind the head that fits without an eviction and cannot delay the
     head; behind one that waits for bytes that no revoke brings (a stowaway's), only what fits
     beside it on the day that they are gone, and may be asked itself
"""

from collections.abc import Mapping

from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.hooks import owner_of
from vram_arbiter.arbiter.core.learning import costs
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.report import explain
from vram_arbiter.arbiter.core.scheduling import admission, backfill, placement, victims
from vram_arbiter.arbiter.core.verification.evidence import note_pressure
from vram_arbiter.schemas.ids import GpuId, LeaseId
from vram_arbiter.schemas.wire.codes import Block, Wait, Why
from vram_arbiter.schemas.wire.pushes import GrantedPush
from vram_arbiter.schemas.wire.replies import AcquireReply


def schedule(core: Core) -> None:
    """Serve every dirty GPU.

    A grant on one may free a waiter's place on another, so until none is dirty.
    """
    gpu: Gpu | None = None
    while (gpu := core.turn.next_dirty(gpu)) is not None:
        _serve(core, gpu)


def on_plan_due(core: Core, gpu_id: str) -> None:
    """Look at a GPU again: a residency ended, a waiter aged, or the GPU has been quiet for long
    enough.
    """
    core.wake(core.gpus[GpuId(gpu_id)])


def _serve(core: Core, gpu: Gpu) -> None:
    note_pressure(core, gpu)
    gpu.blocked = admission.blocked(core, gpu)
    if gpu.pressed and core.recovering is None:  # 1
        _relieve(core, gpu)
        return
    if gpu.keeper is not None:  # 2
        gpu.keeper.serve(core, gpu, None)
        return
    if gpu.blocked:  # 3
        return
    if not len(gpu.queue):  # 4
        for feature in core.hooked["serve"]:
            feature.serve(core, gpu, None)
        return
    head = placement.front(core, gpu)
    if head is None:
        return
    owner = owner_of(head)
    if owner is not None:  # 4
        owner.serve(core, gpu, head)
        return
    if admission.fits(gpu, head):  # 5
        grant_if_measured(core, gpu, head)
        return
    leaving = admission.leaving(gpu)
    planned = admission.fits(gpu, head, leaving)
    if planned:
        head.request.reason = Wait.MAKING_ROOM
    elif _ask_victims(core, gpu, head, leaving):  # 6
        leaving, planned = admission.leaving(gpu), True
    later = backfill.choose(core, gpu, head, leaving, planned=planned)  # 7
    if later is not None:
        grant_if_measured(core, gpu, later)


def _relieve(core: Core, gpu: Gpu) -> None:
    leaving = admission.leaving(gpu)
    over = gpu.ledger.total_if(leaving) - gpu.ledger.budget_bytes
    if over <= 0:
        return
    for victim in victims.choose_relief(core, gpu, leaving, over):
        eviction.ask(core, gpu, victim, None)
    victims.wake_when_evictable(core, gpu, None)


def grant_if_measured(core: Core, gpu: Gpu, lease: Lease) -> None:
    """Grant a lease that fits by the ledger, once a reading shows its bytes as free too."""
    room = admission.measured_room_bytes(core, gpu)
    need = admission.measured_need_bytes(gpu, lease)
    if room is None or (room < need and admission.sample_is_behind(gpu)):
        lease.request.reason = Wait.READING
        core.want_sample(gpu, max(gpu.changed_at, core.now - core.settings.sample_max_age_s))
        return
    if room < need:
        lease.request.reason = Wait.NOT_FREE
        gpu.blocked = Block.NOT_FREE
        return
    grant(core, gpu, lease)


def _ask_victims(core: Core, gpu: Gpu, head: Lease, leaving: Mapping[LeaseId, int]) -> bool:
    if admission.residue_under_measurement(gpu):
        head.request.reason = Wait.RESIDUE
        return False
    plan = victims.choose_victims(core, gpu, head, leaving)
    if plan is None:
        head.request.reason = Wait.NO_VICTIM
        victims.wake_when_evictable(core, gpu, head)
        return False
    if len(head.request.gpus) > 1 and not placement.is_best_place(core, gpu, head, plan):
        return False
    head.request.planned_gpu = gpu.info.id
    head.request.reason = Wait.MAKING_ROOM
    for victim in plan:
        eviction.ask(core, gpu, victim, head)
    for gpu_id in head.request.gpus:
        core.wake(core.gpus[gpu_id])  # those behind it there are no longer behind it
    return True


def grant(core: Core, gpu: Gpu, lease: Lease) -> None:
    """Give the lease its card and its token.

    The record goes to the journal before the holder hears of it.
    """
    _collect_evictions(core, gpu, lease)
    if any(feature.grant(core, gpu, lease) for feature in lease.features):
        return
    core.dequeue(lease)
    by_itself = lease.state is not LeaseState.QUEUED
    token = core.next_token()
    lease.token = token
    lease.gpu = gpu.info.id
    core.move(lease, LeaseState.LOADING, Why.RETURNED if by_itself else Why.GRANTED)
    lease.granted_at = lease.held_from = core.now
    lease.request.reason = None
    gpu.residents[lease.id] = lease
    gpu.ledger.charge(
        lease.id,
        lease.process,
        lease.request.load_peak_bytes,
        lease.request.load_peak_bytes,
        core.now,
    )
    gpu.changed_at = core.now
    core.turn.granted.append((token, gpu.info.id))
    lease.expires_at = core.now + lease.spec.ttl_s
    core.timers.set(("ttl", lease.id), lease.expires_at)
    core.record_lease(lease, gates=True)
    if lease.request.answered:
        core.push(lease, GrantedPush(explain.view(core, lease)))
        lease.request.id = None
    else:
        assert lease.request.id is not None, f"{lease.id} was never asked for"
        view = explain.view(core, lease)
        core.reply(lease.client, lease.request.id, AcquireReply("loading", view))
        lease.request.answered = True
    core.note(
        "granted",
        lease,
        charge_bytes=lease.request.load_peak_bytes,
        waited_ms=(core.now - lease.request.arrived_at) * 1e3,
        evicted=[e.consumer for e in lease.request.evicted],
        **({"by_itself": True} if by_itself else {}),
    )
    gpu.blocked = admission.blocked(core, gpu)


def _collect_evictions(core: Core, gpu: Gpu, lease: Lease) -> None:
    """Collect the leases that left for this one, or for a waiter that has gone since; the rest
    stays on the card's list.
    """
    mine = [
        e
        for e in gpu.evictions
        if e.wanted_by == lease.id
        or (e.verdict and (e.wanted_by is None or e.wanted_by not in core.waiting))
    ]
    lease.request.evicted = [e for e in mine if e.verdict]
    gpu.evictions = [e for e in gpu.evictions if e not in mine]
    for gone in lease.request.evicted:
        costs.switched(core, gone.consumer, lease.spec.consumer)
