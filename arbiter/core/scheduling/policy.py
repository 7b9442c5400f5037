"""Pure decisions about one card: does it fit, is the measurement willing, who should leave, who may
pass the head.

Nothing here changes anything but when a card is looked at again (`wake_when_evictable`,
`is_best_place`).
"""

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from math import inf

from vram_arbiter.arbiter.core.learning import costs
from vram_arbiter.arbiter.core.ledger.ledger import NOTHING
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.schemas.ids import LeaseId, ProcessKey
from vram_arbiter.schemas.wire.codes import Block

EXACT_SEARCH_MAX = 12  # candidates; beyond that the search is greedy
_WAKE_SLACK_S = (
    0.001  # so that a wake-up for an ageing step does not come a rounding error too early
)

_LEAVING = (LeaseState.REVOKING, LeaseState.UNLOADING, LeaseState.VERIFYING)  # in a fixed order

type _Covers = Callable[[Mapping[LeaseId, int]], bool]
type _Choice = Callable[[Core, Sequence[Lease], _Covers, Mapping[LeaseId, int]], list[Lease]]


# -- fits
def blocked(core: Core, gpu: Gpu) -> Block | None:
    """Return why nothing can be granted on a GPU now, for any request; None if grants are
    possible."""
    if core.recovering is not None:
        return Block.RECOVERING
    if core.drain is not None:
        return Block.DRAINED
    if gpu.failed_at is not None:
        return Block.UNREADABLE
    if gpu.sample is None:
        return Block.UNREAD
    if gpu.in_state(LeaseState.LOADING):
        return Block.LOADING
    if gpu.keeper is not None:
        return Block.GANG
    return Block.PRESSURE if gpu.pressed else None


def kept_by(gpu: Gpu) -> str:
    """Return the name of the group that a feature keeps a GPU for; "" if none does."""
    return "" if gpu.keeper is None else gpu.keeper.blocks(gpu)


def leaving(gpu: Gpu) -> dict[LeaseId, int]:
    """Leases whose bytes are on their way back, with the residue each leaves. Those that outstayed
    a deadline do not count."""
    going: dict[LeaseId, int] = {}
    for lease in gpu.in_state(*_LEAVING):
        verification = gpu.verifications.get(lease.id)
        overdue = lease.departure.hangs or bool(
            lease.departure.eviction and lease.departure.eviction.overdue
        )
        late = verification.overdue if verification else overdue
        if not late:
            going[lease.id] = lease.residue_bytes
    for verification in gpu.verifications.values():  # debts
        if (
            verification.lease is not None
            and verification.lease not in gpu.residents
            and not verification.overdue
        ):
            going[verification.lease] = verification.retained_bytes
    return going


def room_is_coming(gpu: Gpu) -> bool:
    """Does anybody unload, or is anybody measured, who is not late with it?"""
    for lease in gpu.in_state(LeaseState.UNLOADING, LeaseState.VERIFYING):
        verification = gpu.verifications.get(lease.id)
        if not (verification.overdue if verification else lease.departure.hangs):
            return True
    return False


def residue_under_measurement(gpu: Gpu) -> bool:
    """A dead process's residue may come back any moment: nobody is asked to leave meanwhile."""
    return any(v.lease is None and not v.overdue for v in gpu.verifications.values())


def joining(lease: Lease) -> Mapping[ProcessKey, int]:
    """What a grant charges, by process: one lease's load peak, or what the leases of a group need
    together."""
    return (
        {lease.process: lease.request.load_peak_bytes}
        if lease.request.needs is None
        else lease.request.needs
    )


def fits(gpu: Gpu, lease: Lease, going: Mapping[LeaseId, int] = NOTHING) -> bool:
    """Would the ledger hold this waiter at its load peak, once these leases are gone?"""
    if lease.spec.exclusive:
        if any(other not in going for other in gpu.ledger.leases()):
            return False
    elif gpu.residents.exclusive and any(
        other not in going and other != lease.request.extends for other in gpu.residents.exclusive
    ):
        return False
    elif gpu.verifications and any(
        v.exclusive and v.lease not in going for v in gpu.verifications.values()
    ):
        return (
            False  # it died or expired, and still has the card to itself until it is measured gone
        )
    return gpu.ledger.total_if(going, joining(lease)) <= gpu.ledger.budget_bytes


def largest_growth_bytes(gpu: Gpu, lease: Lease) -> int:
    """The most that a resident lease could ever get on top, once every other lease has ended."""
    going = {other.id: 0 for other in gpu.residents.values() if other is not lease}
    return gpu.ledger.budget_bytes - gpu.ledger.total_if(going)


def added_bytes(gpu: Gpu, lease: Lease) -> int:
    """What a grant would add to the ledger: the load peak less the residue it is folded with."""
    return gpu.ledger.total_if(joining=joining(lease)) - gpu.ledger.total_bytes()


def largest_fold_bytes(gpu: Gpu) -> int:
    """The most that any waiter's need may shrink by what its process already holds here."""
    ledger = gpu.ledger
    folded = [
        account.residue_bytes + account.measured_bytes for account in ledger.accounts.values()
    ]
    return max(
        [*folded, *(stranger.used_bytes for stranger in ledger.strangers.values())], default=0
    )


def placed_elsewhere(core: Core, gpu: Gpu, lease: Lease) -> bool:
    """Is another card being emptied for this waiter? Then it is nobody's head here, unless it fits
    as it is.

    Not once a holder there has outstayed the deadline, or has left and it was not enough.
    """
    there = lease.request.planned_gpu
    if there is None or there == gpu.info.id:
        return False
    return any(
        e.wanted_by == lease.id and not e.verdict and not e.overdue
        for e in core.gpus[there].evictions
    )


def front(core: Core, gpu: Gpu) -> Lease | None:
    """Whose turn it is here: the head's, or of the first behind it for whom no other card is being
    emptied."""
    head = gpu.queue.head()
    if head is None or not placed_elsewhere(core, gpu, head) or fits(gpu, head):
        return head
    return next((lease for lease in gpu.queue if not placed_elsewhere(core, gpu, lease)), None)


# -- the measurement
def measured_room_bytes(core: Core, gpu: Gpu) -> int | None:
    """Free bytes by the newest reading, less the leases that it cannot have seen. None: no reading
    young enough.

    A lease that became ready since counts with its load peak: what it freed at the end of its load
    may not be back yet.
    """
    sample = gpu.sample
    if (
        sample is None
        or gpu.failed_at is not None
        or core.now - sample.taken_at > core.settings.sample_max_age_s
    ):
        return None
    if any(
        debt.confirmed_at > sample.taken_at and not debt.baseline_comparable
        for debt in gpu.verifications.values()
        if debt.lease not in gpu.residents
    ):
        return None  # who came and died since may still be on the card, with its load peak
    unseen = sum(
        max(gpu.ledger.charge_bytes(lease.id), lease.request.load_peak_bytes)
        for lease in gpu.residents.unseen(sample.taken_at)
    )
    return min(gpu.info.capacity_bytes, sample.total_bytes) - sample.used_bytes - unseen


def measured_need_bytes(gpu: Gpu, lease: Lease) -> int:
    """What the reading must have free: what a grant charges, less what the processes already hold
    (their contexts)."""
    if lease.request.needs is None:
        return _unheld_bytes(gpu, lease.process, lease.request.load_peak_bytes)
    return sum(_unheld_bytes(gpu, process, count) for process, count in lease.request.needs.items())


def _unheld_bytes(gpu: Gpu, process: ProcessKey, count: int) -> int:
    account = gpu.ledger.accounts.get(process)
    if account is not None and any(lease not in gpu.ledger.reserved for lease in account.charges):
        return count  # what it holds is of its leases; reserved bytes are not held by anyone yet
    own = None if gpu.sample is None else gpu.sample.bytes_of(process)
    if own is None:
        own = account.residue_bytes if account is not None else 0
    return max(0, count - own)


def sample_is_behind(gpu: Gpu) -> bool:
    """Something was granted, became ready or came back since the newest reading began."""
    return gpu.sample is None or gpu.sample.taken_at < gpu.changed_at


# -- victims
def choose_victims(
    core: Core, gpu: Gpu, waiter: Lease, going: Mapping[LeaseId, int], at: float | None = None
) -> list[Lease] | None:
    """The cheapest holders whose leaving lets the waiter in. None: nobody may be asked now, or it
    would not help.

    Idle holders may be asked by anyone once they have had their minimum residency, holders in use
    only by a waiter of at least their priority (they finish first). If a set with fewer holders in
    use is only a residency away, it is waited for. `at`: as it will be then, if nothing else
    changes (default: now).
    """
    at = core.now if at is None else at
    priority = waiter.priority_at(at, core.settings.ageing_s_per_point)
    willing = [
        lease
        for lease in gpu.in_state(LeaseState.HELD)
        if may_ask(lease)
        and lease.id != waiter.request.extends
        and (not lease.in_use or lease.spec.priority <= priority)
    ]
    search = _oldest if core.settings.scheduling.least_recent else _search
    ripe = [lease for lease in willing if residency_ends_at(core, lease, waiter) <= at]
    now = _cheapest(core, gpu, waiter, going, ripe, search)
    if now is not None and not _in_use(now):
        return now
    later = _cheapest(core, gpu, waiter, going, willing, search)
    if now is None or later is None or _in_use(later) < _in_use(now):
        return None
    return now


def choose_relief(
    core: Core, gpu: Gpu, going: Mapping[LeaseId, int], over_bytes: int
) -> list[Lease]:
    """Idle holders to ask while the card is under pressure: the cheapest that cover it, or all of
    them."""
    idle = [
        lease
        for lease in gpu.in_state(LeaseState.HELD)
        if may_ask(lease) and not lease.in_use and residency_ends_at(core, lease, None) <= core.now
    ]
    ledger = gpu.ledger
    total = ledger.total_if(going)

    def covers(more: Mapping[LeaseId, int]) -> bool:
        return total - ledger.total_if({**going, **more}) >= over_bytes

    return _search(core, idle, covers, _freed(gpu, going, idle)) if covers(_leave(idle)) else idle


def may_ask(lease: Lease) -> bool:
    """Return whether a holder may be revoked for others: not before it reattached after a restart,
    nor while a feature protects it.

    Processes that use a lease that has not reattached may be on their way back to it.
    """
    if not (lease.evictable and lease.attached):
        return False
    return not protected_by(lease)


def protected_by(lease: Lease) -> str:
    """Return the name of the group that keeps a holder from being revoked; "" if none does."""
    return next(filter(None, (feature.protects(lease) for feature in lease.features)), "")


def residency_ends_at(core: Core, lease: Lease, waiter: Lease | None) -> float:
    """Until when a holder is not asked to leave for this waiter (or for relief).

    Who came back by itself and was not used since has no claim to stay: its return must cost nobody
    time. Two that keep throwing each other out stay longer, by what a switch of theirs costs.
    """
    if any(feature.unclaimed(lease) for feature in lease.features):
        return lease.ready_at
    held_s = 0.0 if waiter is None else costs.hold_s(core, lease, waiter)
    return lease.ready_at + max(lease.spec.min_residency_s, held_s)


def wake_when_evictable(core: Core, gpu: Gpu, waiter: Lease | None) -> None:
    """Look again when a residency ends or the waiter has aged enough to ask somebody in use."""
    later = ask_times(core, gpu, waiter)
    if later:
        core.timers.set(("plan", gpu.info.id), min(later))


def ask_times(core: Core, gpu: Gpu, waiter: Lease | None) -> list[float]:
    """Instants to come at which somebody may be asked who may not be asked now."""
    ageing_s = core.settings.ageing_s_per_point
    times: list[float] = []
    for lease in gpu.in_state(LeaseState.HELD):
        if not may_ask(lease):
            continue
        times.append(residency_ends_at(core, lease, waiter))
        if waiter is not None and lease.in_use:
            gap = lease.spec.priority - waiter.spec.priority
            times.append(waiter.request.arrived_at + gap * ageing_s + _WAKE_SLACK_S)
    return [at for at in times if at > core.now]


def is_best_place(core: Core, gpu: Gpu, waiter: Lease, plan: Sequence[Lease]) -> bool:
    """Of several cards that a waiter could be placed on, is emptying this one the cheapest? Wakes
    the better one."""
    best, best_cost = gpu, _cost(plan, gpu.info.index)
    for gpu_id in waiter.request.gpus:
        other = core.gpus[gpu_id]
        if other is gpu or other.queue.head() is not waiter:
            continue
        going = leaving(other)
        if (patience_ends_at := _load_ends_by(core, other)) > core.now and fits(
            other, waiter, going
        ):
            core.timers.set(("plan", gpu.info.id), patience_ends_at)
            return False  # it is the next there, once somebody has loaded
        if blocked(core, other):
            continue
        if fits(other, waiter, going):
            return False  # room comes there anyway
        rival = choose_victims(core, other, waiter, going)
        if rival is not None and _cost(rival, other.info.index) < best_cost:
            best, best_cost = other, _cost(rival, other.info.index)
    if best is gpu:
        return True
    core.wake(best)
    return False


def _load_ends_by(core: Core, gpu: Gpu) -> float:
    """Until when a load is waited for, rather than emptying another card, if it is all that keeps
    this one from granting; else 0."""
    loading = gpu.in_state(LeaseState.LOADING)
    if (
        not loading
        or gpu.failed_at is not None
        or gpu.sample is None
        or gpu.keeper is not None
        or gpu.pressed
    ):
        return 0.0
    return loading[0].granted_at + core.settings.revoke_deadline_s


def _cost(plan: Sequence[Lease], index: int) -> tuple[int, int, int, int, int]:
    return (
        _in_use(plan),
        max((lease.spec.priority for lease in plan), default=0),
        len(plan),
        sum(lease.request.steady_bytes for lease in plan),
        index,
    )


def _in_use(plan: Sequence[Lease]) -> int:
    return sum(1 for lease in plan if lease.in_use)


def _leave(leases: Sequence[Lease]) -> dict[LeaseId, int]:
    return {lease.id: lease.residue_bytes for lease in leases}


def _freed(
    gpu: Gpu, going: Mapping[LeaseId, int], candidates: Sequence[Lease]
) -> dict[LeaseId, int]:
    total = gpu.ledger.total_if(going)
    return {
        lease.id: total - gpu.ledger.total_if({**going, **_leave([lease])}) for lease in candidates
    }


def _cheapest(
    core: Core,
    gpu: Gpu,
    waiter: Lease,
    going: Mapping[LeaseId, int],
    candidates: Sequence[Lease],
    search: _Choice,
) -> list[Lease] | None:
    if waiter.spec.exclusive:
        must = list(candidates)
    else:
        must = [lease for lease in candidates if lease.spec.exclusive]
    base = {**going, **_leave(must)}
    if fits(gpu, waiter, base):
        return must
    rest = [lease for lease in candidates if lease.id not in base]

    def covers(more: Mapping[LeaseId, int]) -> bool:
        return fits(gpu, waiter, {**base, **more})

    if not rest or not covers(_leave(rest)):
        return None
    return must + search(core, rest, covers, _freed(gpu, base, rest))


def _search(
    core: Core, candidates: Sequence[Lease], covers: _Covers, freed: Mapping[LeaseId, int]
) -> list[Lease]:
    """Cheapest covering set; all candidates together do cover. Fewest in use, then lowest priority,
    fewest; of those alike the ones that can park, that cost the least to reload as far as that is
    likely, the least bytes, LRU.
    """
    if len(candidates) > EXACT_SEARCH_MAX:
        return _greedy(core, candidates, covers, freed)
    idle = [lease for lease in candidates if not lease.in_use]
    busy = [lease for lease in candidates if lease.in_use]
    count = next(
        k
        for k in range(len(busy) + 1)
        if any(covers(_leave([*idle, *some])) for some in combinations(busy, k))
    )
    groups = (
        [
            [*some, *others]
            for some in combinations(lively, count)
            for others in combinations(calm, size)
        ]
        for ceiling in sorted({lease.spec.priority for lease in candidates})
        for calm in [[lease for lease in idle if lease.spec.priority <= ceiling]]
        for lively in [[lease for lease in busy if lease.spec.priority <= ceiling]]
        for size in range(len(calm) + 1)
    )
    found = next(
        found for group in groups if (found := [plan for plan in group if covers(_leave(plan))])
    )
    return min(found, key=lambda plan: _fineness(core, plan, freed))


def _oldest(
    core: Core, candidates: Sequence[Lease], covers: _Covers, freed: Mapping[LeaseId, int]
) -> list[Lease]:
    """Idle ones first, then least recent use alone, until it is enough; all candidates together
    are."""
    order = sorted(
        candidates,
        key=lambda lease: (
            lease.in_use,
            not freed[lease.id],
            lease.uses.last_at,
            lease.request.arrival,
        ),
    )
    return order[: next(n for n in range(1, len(order) + 1) if covers(_leave(order[:n])))]


def _fineness(
    core: Core, plan: Sequence[Lease], freed: Mapping[LeaseId, int]
) -> tuple[int, float, int, float, tuple[int, ...]]:
    return (
        sum(1 for lease in plan if not costs.can_park(core, lease)),
        sum(costs.reload_s(core, lease) for lease in plan),
        sum(freed[lease.id] for lease in plan),
        max(lease.uses.last_at for lease in plan),
        tuple(lease.request.arrival for lease in plan),
    )


def _greedy(
    core: Core, candidates: Sequence[Lease], covers: _Covers, freed: Mapping[LeaseId, int]
) -> list[Lease]:
    """Cheap classes first, the largest of a class first; then give back whoever turns out not to be
    needed."""
    order = sorted(
        candidates,
        key=lambda lease: (
            lease.in_use,
            lease.spec.priority,
            not costs.can_park(core, lease),
            -freed[lease.id],
            lease.uses.last_at,
            lease.request.arrival,
        ),
    )
    size = 1 + bisect_left(range(1, len(order)), True, key=lambda n: covers(_leave(order[:n])))
    plan = order[:size]
    for lease in reversed(list(plan)):
        without = [other for other in plan if other is not lease]
        if covers(_leave(without)):
            plan = without
    return plan


def spare_beside_bytes(gpu: Gpu, head: Lease, freed: Mapping[LeaseId, int]) -> int:
    """How much a waiter behind the head may take and stay without delaying it, when these leases
    leave for it and that is enough."""
    return gpu.ledger.budget_bytes - gpu.ledger.total_if(freed, joining(head))


def spare_unplanned_bytes(
    gpu: Gpu, head: Lease, going: Mapping[LeaseId, int], stays: Callable[[Lease], bool]
) -> tuple[int, bool]:
    """The same for a head that nothing is planned for; and: does it wait for bytes that nobody can
    be asked for?

    Everything could leave some day, but for those that took their room while this one stood before
    them (`stays`). If it would not fit even then, it is served when stowaways go; and if that is
    not enough either, when processes end that keep a residue. Only what is left beside it on that
    day may be taken today.
    """
    ledger, joins = gpu.ledger, joining(head)
    everything = _ever_freed(gpu, head, going, None)
    day = ledger.total_if(everything, joins)
    stay_bytes = ledger.total_if(_ever_freed(gpu, head, going, stays), joins) - day
    stuck = day > ledger.budget_bytes
    if day > ledger.budget_bytes:
        day = ledger.total_if(everything, joins, stowaways=False)
    if day > ledger.budget_bytes:
        day = sum(joins.values())
    return ledger.budget_bytes - day - stay_bytes, stuck


def passed(gpu: Gpu, lease: Lease, head: Lease) -> bool:
    """Was it granted, or did it grow, while this waiter stood before it?"""
    overtook = lease.granted_at >= head.request.arrived_at and gpu.queue.precedes(head, lease)
    return overtook or gpu.residents.enlarged.get(lease.id, -inf) >= head.request.arrived_at


def _ever_freed(
    gpu: Gpu, head: Lease, going: Mapping[LeaseId, int], stays: Callable[[Lease], bool] | None
) -> dict[LeaseId, int]:
    """All leases but the one that `head` extends, and those that stay."""
    leave = [
        lease
        for lease in gpu.residents.values()
        if lease.id != head.request.extends and not (stays and stays(lease))
    ]
    return {**_leave(leave), **going}
