"""Grants: one pass over the GPUs that changed.

Per GPU, in this order (the numbers stand in `_serve`):
  0. take back revokes that nothing wants any more; what of them no GPU of the pass decides again
     is withdrawn at its end
  1. under pressure: revoke idle holders, grant nothing
  2. blocked (recovering, drained, reading unknown, a load under way): grant nothing, revoke no
     holder that was not revoked before
  3. nothing waits: a lease on standby comes back
  4. the request fits by ledger: grant it if the measurement agrees, else ask for a fresh reading; a
     head for which another GPU is being emptied is passed over from here on
  5. it does not fit: revoke the cheapest victims that cover it, unless enough bytes are pending
     free
  6. backfill: the first request behind the head that fits without an eviction and cannot delay the
     head; behind one that waits for bytes that no revoke brings (a stowaway's), only what fits
     beside it on the day that they are gone, and may be revoked itself
"""

from collections.abc import Sequence

from vram_arbiter.arbiter.core import eviction, standby
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState, Standby
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.report import status
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.arbiter.core.scheduling.victims import Choice, in_use
from vram_arbiter.schemas.wire.codes import Block, Wait, Why
from vram_arbiter.schemas.wire.notes import GrantedNote
from vram_arbiter.schemas.wire.pushes import GrantedPush
from vram_arbiter.schemas.wire.replies import AcquireReply


def schedule(core: Core) -> None:
    """Serve dirty GPUs until none is dirty: a grant on one may free a waiter's place on another."""
    while dirty := [gpu for gpu in core.gpus.values() if gpu.dirty]:
        for gpu in dirty:  # first: a choice among GPUs must not count on room of such
            if (note := gpu.ledger.note_pressure()) is not None:
                core.note(note)
            gpu.blocked = core.blocked(gpu)
            eviction.take_back(core, gpu)  # 0
        dirty[0].dirty = False
        _serve(core, dirty[0])
    eviction.settle(core)


def _serve(core: Core, gpu: Gpu) -> None:
    if gpu.ledger.pressed and core.serving:  # 1
        leaving = admission.leaving(gpu)
        over_bytes = gpu.ledger.total_if(leaving) - gpu.ledger.budget_bytes
        if over_bytes > 0:
            choice = Choice.of(core)
            for victim in choice.relief(gpu, leaving, over_bytes):
                eviction.ask(core, gpu, victim, None)
            core.timers.set_first(("plan", gpu.info.id), choice.ask_times(gpu, None))
        return
    if gpu.blocked:  # 2
        if core.turn.taken_back:
            _take_over(core, gpu)
        return
    if gpu.queue.head is None:  # 3
        _bring_back(core, gpu)
        return
    head = admission.front(core.gpus, gpu)
    if head is None:
        return
    if admission.fits(gpu, head):  # 4
        grant_if_measured(core, gpu, head)
        return
    planned = _make_room(core, gpu, head)  # 5
    if len(gpu.queue.by_arrival) > 1:  # 6
        later = choose_later(gpu, head, planned=planned)
        if later is not None:
            grant_if_measured(core, gpu, later)


def _bring_back(core: Core, gpu: Gpu) -> None:
    lease = standby.first_to_return(core.away, gpu)
    if lease is None:
        return
    due_at = standby.quiet_at(gpu, lease)
    if due_at <= core.now:
        grant_if_measured(core, gpu, lease)
    else:
        core.timers.set(("return", gpu.info.id), due_at)


def _take_over(core: Core, gpu: Gpu) -> None:
    """Keep holders revoked whose revoke was taken back, if the request to serve would choose them
    once the GPU grants again."""
    head, leaving = admission.front(core.gpus, gpu), admission.leaving(gpu)
    if head is None or admission.fits(gpu, head, leaving):
        return
    choice = Choice.of(core)
    plan = choice.victims(gpu, head, leaving) or ()
    again = [one for one in plan if one.id in core.turn.taken_back]
    if again and _is_best_place(core, choice, gpu, head, plan):
        head.request.planned_gpu = gpu.info.id
        for holder in again:
            eviction.ask(core, gpu, holder, head)


def _make_room(core: Core, gpu: Gpu, head: Lease) -> bool:
    """Revoke the cheapest victims, if that is needed now and best done here. Return whether the
    head fits once all that leave have left.
    """
    request, leaving = head.request, admission.leaving(gpu)
    if admission.fits(gpu, head, leaving):
        request.reason = Wait.MAKING_ROOM
        return True
    if admission.residue_under_measurement(gpu):
        request.reason = Wait.RESIDUE
        return False
    choice = Choice.of(core)
    plan = choice.victims(gpu, head, leaving)
    if plan is None:
        request.reason = Wait.NO_VICTIM
        if not settle_for_less([core.gpus[gpu_id] for gpu_id in request.gpus], head):
            core.timers.set_first(("plan", gpu.info.id), choice.ask_times(gpu, head))
        return False
    if not _is_best_place(core, choice, gpu, head, plan):
        return False
    request.reason, request.planned_gpu = Wait.MAKING_ROOM, gpu.info.id
    for victim in plan:
        eviction.ask(core, gpu, victim, head)
    for gpu_id in request.gpus:
        if gpu_id != gpu.info.id:  # requests behind `head` on its other GPUs may now proceed
            core.gpus[gpu_id].wake()
    return True


def settle_for_less(gpus: Sequence[Gpu], lease: Lease) -> bool:
    """Charge a waiter less than was learned, though not less than it declares, if no candidate GPU
    could hold that even once every other lease has left. Return whether it is charged less now.

    What live processes retain and stowaways hold may stay for good, and those processes may
    themselves wait behind this request. Nothing is settled while bytes are being measured.
    """
    request = lease.request
    if any(gpu.verifications for gpu in gpus):
        return False
    excess = min(admission.excess_bytes_alone(gpu, lease) for gpu in gpus)
    less = request.load_peak_bytes - excess
    if excess <= 0 or less < lease.spec.footprint.load_peak_bytes:
        return False
    for gpu in gpus:
        gpu.queue.discard(lease)
    request.load_peak_bytes, request.steady_bytes = less, min(request.steady_bytes, less)
    for gpu in gpus:
        gpu.queue.add(lease)
        gpu.wake()
    return True


def _is_best_place(
    core: Core, choice: Choice, gpu: Gpu, waiter: Lease, plan: Sequence[Lease]
) -> bool:
    """Return whether emptying this GPU is the cheapest of its candidates. Wakes a better one."""
    best, best_cost = gpu, _place_cost(gpu, plan)
    for gpu_id in waiter.request.gpus:
        other = core.gpus[gpu_id]
        if other is gpu or other.queue.head is not waiter:
            continue
        going, block = admission.leaving(other), core.blocked(other)
        if block is Block.LOADING and not other.ledger.pressed:
            (load,) = other.residents.by_state[LeaseState.LOADING].values()
            load_ends_by = load.granted_at + core.settings.revoke_deadline_s
            if load_ends_by > core.now and admission.fits(other, waiter, going):
                core.timers.set(("plan", gpu.info.id), load_ends_by)
                return False  # it is the next there, once the load has ended
        if block is not None:
            continue
        if admission.fits(other, waiter, going):
            return False  # room comes there anyway
        rival = choice.victims(other, waiter, going)
        if rival is not None and _place_cost(other, rival) < best_cost:
            best, best_cost = other, _place_cost(other, rival)
    if best is not gpu:
        best.wake()
    return best is gpu


def _place_cost(gpu: Gpu, plan: Sequence[Lease]) -> tuple[int, ...]:
    highest = max(one.spec.priority for one in plan)
    steady_bytes = sum(one.request.steady_bytes for one in plan)
    return (in_use(plan), highest, len(plan), steady_bytes, gpu.info.index)


# -- granting
def grant_if_measured(core: Core, gpu: Gpu, lease: Lease) -> None:
    """Grant a lease that fits by the ledger, once a reading shows its bytes as free too.

    A reading that is too old, or began before the last grant, `ready` or verdict, cannot deny: a
    newer one is asked for.
    """
    oldest = core.now - core.settings.sample_max_age_s
    room = admission.measured_room_bytes(gpu, oldest)
    if room is not None and room >= admission.measured_need_bytes(gpu, lease):
        grant(core, gpu, lease)
    elif room is not None and gpu.sample is not None and gpu.sample.taken_at >= gpu.changed_at:
        lease.request.reason, gpu.blocked = Wait.NOT_FREE, Block.NOT_FREE
    else:
        lease.request.reason = Wait.READING
        gpu.want_sample(core.now, max(gpu.changed_at, oldest))


def grant(core: Core, gpu: Gpu, lease: Lease) -> None:
    """Give a lease its GPU and its token.

    The record goes to the journal before the holder hears of it.
    """
    request = lease.request
    # the list of the GPU is brought up to date at the end of the pass (`eviction.settle`)
    request.evicted = [e for e in gpu.evictions if e.wanted_by == lease.id and e.verdict]
    for made_room in request.evicted:
        core.costs.switched(made_room.consumer, lease.spec.consumer, core.now)
    core.dequeue(lease)
    by_itself = lease.state is not LeaseState.QUEUED
    if by_itself:  # it has not waited
        request.arrived_at = core.now
    lease.standby = Standby(returned=by_itself)
    lease.token = token = core.next_token()
    lease.gpu = gpu.info.id
    core.move(lease, LeaseState.LOADING, Why.RETURNED if by_itself else Why.GRANTED)
    lease.granted_at = lease.held_from = gpu.changed_at = core.now
    lease.uses.unclaimed = by_itself
    request.reason = None
    gpu.residents.add(lease)
    peak = request.load_peak_bytes
    gpu.ledger.charge(lease.id, lease.process, peak, peak, core.now)
    core.turn.granted.append((token, gpu.info.id))
    lease.expires_at = core.now + lease.spec.ttl_s
    core.timers.set(("ttl", lease.id), lease.expires_at)
    core.record_lease(lease, gates=True)
    view = status.view(core, lease)
    if request.id is None:
        core.push(lease, GrantedPush(view))
    else:
        core.reply(lease.client, request.id, AcquireReply("loading", view))
    note = GrantedNote(
        charge_bytes=peak,
        waited_ms=(core.now - request.arrived_at) * 1e3,
        evicted=tuple([e.consumer for e in request.evicted]),
        by_itself=by_itself,
    )
    core.note(note, lease)


# -- backfill
def choose_later(gpu: Gpu, head: Lease, *, planned: bool) -> Lease | None:
    """Return the first request behind the queue's first that fits, evicts no holder and cannot
    delay `head`; None: there is none.

    `planned`: with the leases gone whose bytes are pending free, `head` fits.
    """
    ledger, queue = gpu.ledger, gpu.queue
    if head.spec.exclusive:
        return None
    fold = _largest_fold_bytes(gpu)
    smallest, free = queue.smallest_need_bytes() - fold, ledger.budget_bytes - ledger.total_bytes()
    going, stuck = admission.leaving(gpu), False
    away_soon = gpu.in_state(LeaseState.UNLOADING, LeaseState.VERIFYING)
    if smallest > free or any(lease.id in going for lease in away_soon):
        return None  # a load now would only be in the way of the head's room
    if planned:
        spare = ledger.budget_bytes - ledger.total_if(going, admission.joining(head))
    else:
        spare, stuck = admission.spare_unplanned_bytes(
            gpu, head, going, lambda one: _passed(gpu, one, head)
        )
    if smallest > spare or (stuck and admission.residue_under_measurement(gpu)):
        return None
    most = min(free, spare) + fold
    for lease in queue:
        if lease is head or lease.request.load_peak_bytes > most:
            continue  # seen at a glance: thousands may wait
        if stuck and not lease.evictable:
            continue  # the head may need its bytes once a stowaway leaves
        if admission.added_bytes(gpu, lease) <= spare and admission.fits(gpu, lease):
            return lease
    return None


def _largest_fold_bytes(gpu: Gpu) -> int:
    """Return the most by which a need may shrink through what its process already holds here."""
    accounts, stowaways = gpu.ledger.accounts.values(), gpu.ledger.stowaways.values()
    folded = [account.retained_bytes + account.measured_bytes for account in accounts]
    return max([*folded, *(stowaway.held_bytes for stowaway in stowaways)], default=0)


def _passed(gpu: Gpu, lease: Lease, head: Lease) -> bool:
    """Return whether a lease was granted while `head` waited before it."""
    rank = gpu.queue.rank
    return lease.granted_at >= head.request.arrived_at and rank(head) < rank(lease)
