"""Victims: which holders are revoked so that a request fits, or so that pressure ends.

Public: `choose_victims`, `choose_relief`, `may_ask`, `residency_ends_at`, `ask_times`,
`wake_when_evictable`, `cost_of`, `as_leaving`. Changes nothing but the timer of
`wake_when_evictable`.
"""

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations

from vram_arbiter.arbiter.core.learning import costs
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.scheduling.admission import fits
from vram_arbiter.schemas.ids import LeaseId

type _Covers = Callable[[Mapping[LeaseId, int]], bool]
type _Choice = Callable[[Core, Sequence[Lease], _Covers, Mapping[LeaseId, int]], list[Lease]]
EXACT_SEARCH_MAX = 12  # candidates; beyond that the search is greedy
_WAKE_SLACK_S = (
    0.001  # so that a wake-up for an ageing step does not come a rounding error too early
)


def choose_victims(
    core: Core, gpu: Gpu, waiter: Lease, going: Mapping[LeaseId, int], at: float | None = None
) -> list[Lease] | None:
    """Return the cheapest holders whose departure lets `waiter` in.

    None: no holder may be revoked now, or it would not help. Idle holders may be revoked once their
    minimum residency is over, holders in use only for a waiter of at least their priority: they
    finish first. A set with fewer holders in use that is only a residency away is waited for.
    `at`: as it will be then, if nothing else changes (default: now).
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
    """Return the cheapest idle holders that cover the pressure, or all of them."""
    idle = [
        lease
        for lease in gpu.in_state(LeaseState.HELD)
        if may_ask(lease) and not lease.in_use and residency_ends_at(core, lease, None) <= core.now
    ]
    ledger = gpu.ledger
    total = ledger.total_if(going)

    def covers(more: Mapping[LeaseId, int]) -> bool:
        return total - ledger.total_if({**going, **more}) >= over_bytes

    return (
        _search(core, idle, covers, _freed(gpu, going, idle)) if covers(as_leaving(idle)) else idle
    )


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
    """Return until when a holder is not revoked for `waiter`, or for relief.

    A lease that returned from standby and was not used since has no claim to stay. Two consumers
    that keep evicting each other stay longer, by the learned cost of a switch.
    """
    if any(feature.unclaimed(lease) for feature in lease.features):
        return lease.ready_at
    held_s = 0.0 if waiter is None else costs.hold_s(core, lease, waiter)
    return lease.ready_at + max(lease.spec.min_residency_s, held_s)


def wake_when_evictable(core: Core, gpu: Gpu, waiter: Lease | None) -> None:
    """Look again when a residency ends, or when the waiter has aged enough for a holder in use."""
    later = ask_times(core, gpu, waiter)
    if later:
        core.timers.set(("plan", gpu.info.id), min(later))


def ask_times(core: Core, gpu: Gpu, waiter: Lease | None) -> list[float]:
    """Return future instants at which a holder may be revoked that may not be revoked now."""
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


def cost_of(plan: Sequence[Lease], index: int) -> tuple[int, int, int, int, int]:
    """Return the key by which plans on several GPUs are compared."""
    return (
        _in_use(plan),
        max((lease.spec.priority for lease in plan), default=0),
        len(plan),
        sum(lease.request.steady_bytes for lease in plan),
        index,
    )


def _in_use(plan: Sequence[Lease]) -> int:
    return sum(1 for lease in plan if lease.in_use)


def as_leaving(leases: Sequence[Lease]) -> dict[LeaseId, int]:
    """Return what each lease would leave behind, as the ledger takes it."""
    return {lease.id: lease.residue_bytes for lease in leases}


def _freed(
    gpu: Gpu, going: Mapping[LeaseId, int], candidates: Sequence[Lease]
) -> dict[LeaseId, int]:
    total = gpu.ledger.total_if(going)
    return {
        lease.id: total - gpu.ledger.total_if({**going, **as_leaving([lease])})
        for lease in candidates
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
    base = {**going, **as_leaving(must)}
    if fits(gpu, waiter, base):
        return must
    rest = [lease for lease in candidates if lease.id not in base]

    def covers(more: Mapping[LeaseId, int]) -> bool:
        return fits(gpu, waiter, {**base, **more})

    if not rest or not covers(as_leaving(rest)):
        return None
    return must + search(core, rest, covers, _freed(gpu, base, rest))


def _search(
    core: Core, candidates: Sequence[Lease], covers: _Covers, freed: Mapping[LeaseId, int]
) -> list[Lease]:
    """Return the cheapest covering set; all candidates together cover.

    Fewest in use, then lowest priority, then fewest; among equals those that can park, with the
    least expected reload time, the least bytes, the least recent use.
    """
    if len(candidates) > EXACT_SEARCH_MAX:
        return _greedy(core, candidates, covers, freed)
    idle = [lease for lease in candidates if not lease.in_use]
    busy = [lease for lease in candidates if lease.in_use]
    count = next(
        k
        for k in range(len(busy) + 1)
        if any(covers(as_leaving([*idle, *some])) for some in combinations(busy, k))
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
        found for group in groups if (found := [plan for plan in group if covers(as_leaving(plan))])
    )
    return min(found, key=lambda plan: _fineness(core, plan, freed))


def _oldest(
    core: Core, candidates: Sequence[Lease], covers: _Covers, freed: Mapping[LeaseId, int]
) -> list[Lease]:
    """Return idle leases first, then by least recent use alone, until they cover."""
    order = sorted(
        candidates,
        key=lambda lease: (
            lease.in_use,
            not freed[lease.id],
            lease.uses.last_at,
            lease.request.arrival,
        ),
    )
    return order[: next(n for n in range(1, len(order) + 1) if covers(as_leaving(order[:n])))]


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
    """Take cheap classes first, the largest of a class first; then drop what is not needed."""
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
    size = 1 + bisect_left(range(1, len(order)), True, key=lambda n: covers(as_leaving(order[:n])))
    plan = order[:size]
    for lease in reversed(list(plan)):
        without = [other for other in plan if other is not lease]
        if covers(as_leaving(without)):
            plan = without
    return plan
