"""Victims: which holders are revoked so that a request fits, or so that pressure ends, and on which
of several GPUs.

  1. who may be revoked: `may_ask`, `residency_ends_at`
  2. the cheapest set that lets a request in (`choose_victims`) or ends pressure (`choose_relief`)
  3. the cheapest of several GPUs: `is_best_place`
  4. when to look again, if no holder may be revoked yet: `wake_when_evictable`
"""

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations, product

from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.scheduling.admission import blocked, fits, leaving
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Block

type _Covers = Callable[[Sequence[Lease]], bool]
EXACT_SEARCH_MAX = 12
"""Candidates of the exact search: at most 4,095 sets. The search is greedy beyond that."""
_WAKE_SLACK_S = 0.001  # so that rounding does not wake a GPU before the waiter has aged


# -- who may be revoked
def may_ask(lease: Lease) -> bool:
    """Return whether a holder may be revoked for others: not before it reattached after a restart.

    Processes that use a lease that has not reattached may be on their way back to it.
    """
    return lease.evictable and lease.attached


def residency_ends_at(core: Core, lease: Lease, waiter: Lease | None) -> float:
    """Return until when a holder is not revoked for `waiter`, or for relief.

    A lease that returned from standby and was not used since has no claim to stay. One of two
    consumers that keep evicting each other stays for the learned cost of a switch, capped, except
    against a higher priority.
    """
    if lease.uses.unclaimed:
        return lease.ready_at
    stay_s = lease.spec.min_residency_s
    if core.costs.switches and waiter is not None and waiter.spec.priority <= lease.spec.priority:
        switch_s = core.costs.switch_s(lease.spec.consumer, waiter.spec.consumer, core.now)
        stay_s = max(stay_s, min(switch_s, core.settings.thrash_hold_max_s))
    return lease.ready_at + stay_s


# -- the cheapest set
def choose_victims(
    core: Core, gpu: Gpu, waiter: Lease, going: Mapping[LeaseId, int], at: float | None = None
) -> list[Lease] | None:
    """Return the cheapest holders whose departure lets `waiter` in, for which the departure of
    leases in `going` is not enough.

    None: no holder may be revoked now, or it would not help. Idle holders may be revoked once their
    minimum residency is over, holders in use only for a waiter of at least their priority: they
    finish first. A set with fewer holders in use that is only a residency away is waited for.
    `at`: as it will be then, if nothing else changes (default: now).
    """
    at = core.now if at is None else at
    priority = waiter.priority_at(at, core.settings.ageing_s_per_point)
    willing: list[Lease] = []
    ripe: list[Lease] = []
    for lease in gpu.residents.by_state[LeaseState.HELD].values():
        if may_ask(lease) and (not lease.uses or lease.spec.priority <= priority):
            willing.append(lease)
            if residency_ends_at(core, lease, waiter) <= at:
                ripe.append(lease)
    now = _cheapest(core, gpu, waiter, going, ripe)
    if len(ripe) == len(willing) or (now is not None and not _in_use(now)):
        return now
    later = _cheapest(core, gpu, waiter, going, willing)
    if now is None or later is None or _in_use(later) < _in_use(now):
        return None
    return now


def choose_relief(
    core: Core, gpu: Gpu, going: Mapping[LeaseId, int], over_bytes: int
) -> list[Lease]:
    """Return the cheapest idle holders that cover the pressure, or all of them."""
    idle = [
        lease
        for lease in gpu.residents.by_state[LeaseState.HELD].values()
        if may_ask(lease) and not lease.uses and residency_ends_at(core, lease, None) <= core.now
    ]
    total = gpu.ledger.total_if(going)

    def covers(plan: Sequence[Lease]) -> bool:
        leave = {one.id: one.residue_bytes for one in plan}
        return total - gpu.ledger.total_if({**going, **leave}) >= over_bytes

    return _search(core, gpu, going, idle, covers) if covers(idle) else idle


def _cheapest(
    core: Core, gpu: Gpu, waiter: Lease, going: Mapping[LeaseId, int], candidates: Sequence[Lease]
) -> list[Lease] | None:
    """Return the cheapest of these holders that let `waiter` in; None if all of them do not.

    Exclusive holders have to leave in any case, and all of them for an exclusive waiter.
    """
    must = [lease for lease in candidates if lease.spec.exclusive or waiter.spec.exclusive]
    base = {**going, **{one.id: one.residue_bytes for one in must}}
    if must and fits(gpu, waiter, base):
        return must
    rest = [lease for lease in candidates if lease.id not in base]

    def covers(plan: Sequence[Lease]) -> bool:
        return fits(gpu, waiter, {**base, **{one.id: one.residue_bytes for one in plan}})

    if not rest or not covers(rest):
        return None
    if len(rest) == 1:
        return must + rest
    return must + _search(core, gpu, base, rest, covers)


def _search(
    core: Core,
    gpu: Gpu,
    going: Mapping[LeaseId, int],
    candidates: Sequence[Lease],
    covers: _Covers,
) -> list[Lease]:
    """Return the cheapest set that covers (ADR 17); all candidates together do, none of them does
    not.
    """
    total = gpu.ledger.total_if(going)
    freed = {
        one.id: total - gpu.ledger.total_if({**going, one.id: one.residue_bytes})
        for one in candidates
    }
    if len(candidates) > EXACT_SEARCH_MAX:
        return _greedy(core, candidates, covers, freed)
    return _exact(core, candidates, covers, freed)


def _exact(
    core: Core, candidates: Sequence[Lease], covers: _Covers, freed: Mapping[LeaseId, int]
) -> list[Lease]:
    """Take the fewest in use, then the lowest priority, then the fewest; among equals those that
    can park, then by the least expected reload time, the least bytes, the least recent use.
    """

    def cost(plan: Sequence[Lease]) -> tuple[int, float, int, float, list[int]]:
        return (
            len([one for one in plan if not core.can_park(one)]),
            sum(core.costs.reload_s(one.spec.consumer) for one in plan),
            sum(freed[one.id] for one in plan),
            max(one.uses.last_at for one in plan),
            [one.request.arrival for one in plan],
        )

    idle = [one for one in candidates if not one.uses]
    busy = [one for one in candidates if one.uses]
    count = next(
        k
        for k in range(len(busy) + 1)
        if any(covers([*idle, *some]) for some in combinations(busy, k))
    )
    for ceiling in sorted({one.spec.priority for one in candidates}):
        calm = [one for one in idle if one.spec.priority <= ceiling]
        lively = [one for one in busy if one.spec.priority <= ceiling]
        for size in range(len(calm) + 1):
            pairs = product(combinations(lively, count), combinations(calm, size))
            plans = [[*some, *others] for some, others in pairs if covers([*some, *others])]
            if plans:
                return min(plans, key=cost)
    raise AssertionError("all candidates together cover")


def _greedy(
    core: Core, candidates: Sequence[Lease], covers: _Covers, freed: Mapping[LeaseId, int]
) -> list[Lease]:
    """Take cheap classes first, the largest of a class first, until they cover; then give back what
    is not needed.
    """

    def cost(one: Lease) -> tuple[float, ...]:
        age = (one.uses.last_at, one.request.arrival)
        return (bool(one.uses), one.spec.priority, not core.can_park(one), -freed[one.id], *age)

    order = sorted(candidates, key=cost)
    size = 1 + bisect_left(range(1, len(order)), True, key=lambda n: covers(order[:n]))
    plan = order[:size]
    for lease in reversed(order[:size]):
        without = [other for other in plan if other is not lease]
        if covers(without):
            plan = without
    return plan


def _in_use(plan: Sequence[Lease]) -> int:
    return len([one for one in plan if one.uses])


# -- which of several GPUs
def is_best_place(core: Core, gpu: Gpu, waiter: Lease, plan: Sequence[Lease]) -> bool:
    """Return whether emptying this GPU is the cheapest of its candidates. Wakes a better one."""
    best, best_cost = gpu, _place_cost(gpu, plan)
    for gpu_id in waiter.request.gpus:
        other = core.gpus[gpu_id]
        if other is gpu or other.queue.head is not waiter:
            continue
        going, block = leaving(other), blocked(core, other)
        if block is Block.LOADING and not other.ledger.pressed:
            (load,) = other.residents.by_state[LeaseState.LOADING].values()
            load_ends_by = load.granted_at + core.settings.revoke_deadline_s
            if load_ends_by > core.now and fits(other, waiter, going):
                core.timers.set(("plan", gpu.info.id), load_ends_by)
                return False  # it is the next there, once the load has ended
        if block is not None:
            continue
        if fits(other, waiter, going):
            return False  # room comes there anyway
        rival = choose_victims(core, other, waiter, going)
        if rival is not None and _place_cost(other, rival) < best_cost:
            best, best_cost = other, _place_cost(other, rival)
    if best is not gpu:
        core.wake(best)
    return best is gpu


def _place_cost(gpu: Gpu, plan: Sequence[Lease]) -> tuple[int, ...]:
    highest = max([one.spec.priority for one in plan], default=0)
    steady_bytes = sum(one.request.steady_bytes for one in plan)
    return (_in_use(plan), highest, len(plan), steady_bytes, gpu.info.index)


# -- when to look again
def wake_when_evictable(core: Core, gpu: Gpu, waiter: Lease | None) -> None:
    """Look again when a residency ends, or when the waiter has aged enough for a holder in use."""
    later = ask_times(core, gpu, waiter)
    if later:
        core.timers.set(("plan", gpu.info.id), min(later))


def ask_times(core: Core, gpu: Gpu, waiter: Lease | None) -> list[float]:
    """Return future instants at which a holder may be revoked that may not be revoked now."""
    times: list[float] = []
    for lease in gpu.residents.by_state[LeaseState.HELD].values():
        if not may_ask(lease):
            continue
        times.append(residency_ends_at(core, lease, waiter))
        if waiter is not None and lease.uses:
            gap = lease.spec.priority - waiter.spec.priority
            aged_at = waiter.request.arrived_at + gap * core.settings.ageing_s_per_point
            times.append(aged_at + _WAKE_SLACK_S)
    return [at for at in times if at > core.now]
