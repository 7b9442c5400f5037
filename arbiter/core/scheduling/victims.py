"""Victims: which holders are revoked so that a request fits, or so that pressure ends.

  1. which holders may be revoked: `may_ask`, `residency_ends_at`
  2. the cheapest set that lets a request in (`victims`) or ends pressure (`relief`)
  3. when to look again, if no holder may be revoked yet: `ask_times`

Changes nothing.
"""

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Self

from vram_arbiter.arbiter.core.learning import Costs
from vram_arbiter.arbiter.core.ledger import HostRam
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.scheduling.admission import fits
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.schemas.ids import LeaseId

type _Covers = Callable[[Sequence[Lease]], bool]
EXACT_SEARCH_MAX = 12
"""Candidates of the exact search: at most 4,095 sets. The search is greedy beyond that."""
_WAKE_SLACK_S = 0.001  # so that rounding does not wake a GPU before the waiter has aged


def may_ask(lease: Lease) -> bool:
    """Return whether a holder may be revoked for others: not before it reattached after a restart.

    Processes that use a lease that has not reattached may be on their way back to it.
    """
    return lease.evictable and lease.attached


def in_use(plan: Sequence[Lease]) -> int:
    """Return how many of these holders are in use."""
    return len([one for one in plan if one.uses])


@dataclass(frozen=True, slots=True)
class Choice:
    """Choice of victims at one moment: what counts beside the leases and their GPU."""

    now: float
    settings: Settings
    costs: Costs
    host_ram: HostRam

    @classmethod
    def of(cls, core: Core) -> Self:
        return cls(core.now, core.settings, core.costs, core.host_ram)

    def residency_ends_at(self, lease: Lease, waiter: Lease | None) -> float:
        """Return until when a holder is not revoked for `waiter`, or for relief.

        A lease that returned from standby and was not used since has no claim to stay. One of two
        consumers that keep evicting each other stays for the learned cost of a switch, capped,
        except against a higher priority.
        """
        if lease.uses.unclaimed:
            return lease.ready_at
        stay_s = lease.spec.min_residency_s
        if waiter is not None and waiter.spec.priority <= lease.spec.priority:
            switch_s = self.costs.switch_s(lease.spec.consumer, waiter.spec.consumer, self.now)
            stay_s = max(stay_s, min(switch_s, self.settings.thrash_hold_max_s))
        return lease.ready_at + stay_s

    def victims(
        self, gpu: Gpu, waiter: Lease, going: Mapping[LeaseId, int], at: float | None = None
    ) -> list[Lease] | None:
        """Return the cheapest holders whose departure lets `waiter` in, for which the departure of
        leases in `going` is not enough.

        None: no holder may be revoked now, or it would not help. Idle holders may be revoked once
        their minimum residency is over, holders in use only for a waiter of at least their
        priority: they finish first. A set with fewer holders in use that is only a residency away
        is waited for. `at`: as it will be then, if nothing else changes (default: now).
        """
        at = self.now if at is None else at
        priority = waiter.priority_at(at, self.settings.ageing_s_per_point)
        willing: list[Lease] = []
        ripe: list[Lease] = []
        for lease in gpu.residents.by_state[LeaseState.HELD].values():
            if may_ask(lease) and (not lease.uses or lease.spec.priority <= priority):
                willing.append(lease)
                if self.residency_ends_at(lease, waiter) <= at:
                    ripe.append(lease)
        now = self._cheapest(gpu, waiter, going, ripe)
        if len(ripe) == len(willing) or (now is not None and not in_use(now)):
            return now
        later = self._cheapest(gpu, waiter, going, willing)
        if now is None or later is None or in_use(later) < in_use(now):
            return None
        return now

    def relief(self, gpu: Gpu, going: Mapping[LeaseId, int], over_bytes: int) -> list[Lease]:
        """Return the cheapest idle holders that cover the pressure, or all of them."""
        idle = [
            lease
            for lease in gpu.residents.by_state[LeaseState.HELD].values()
            if may_ask(lease) and not lease.uses and self.residency_ends_at(lease, None) <= self.now
        ]
        total = gpu.ledger.total_if(going)

        def covers(plan: Sequence[Lease]) -> bool:
            leave = {one.id: one.residue_bytes for one in plan}
            return total - gpu.ledger.total_if({**going, **leave}) >= over_bytes

        return self._search(gpu, going, idle, covers) if covers(idle) else idle

    def _cheapest(
        self, gpu: Gpu, waiter: Lease, going: Mapping[LeaseId, int], candidates: Sequence[Lease]
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
        return must + self._search(gpu, base, rest, covers)

    def _search(
        self,
        gpu: Gpu,
        going: Mapping[LeaseId, int],
        candidates: Sequence[Lease],
        covers: _Covers,
    ) -> list[Lease]:
        """Return the cheapest set that covers (ADR 17); all candidates together do, none of them
        does not.
        """
        total = gpu.ledger.total_if(going)
        freed = {
            one.id: total - gpu.ledger.total_if({**going, one.id: one.residue_bytes})
            for one in candidates
        }
        if len(candidates) > EXACT_SEARCH_MAX:
            return self._greedy(candidates, covers, freed)
        return self._exact(candidates, covers, freed)

    def _exact(
        self, candidates: Sequence[Lease], covers: _Covers, freed: Mapping[LeaseId, int]
    ) -> list[Lease]:
        """Take the fewest in use, then the lowest priority, then the fewest; among equals those
        that can park, then by the least expected reload time, the least bytes, the least recent
        use.
        """

        def cost(plan: Sequence[Lease]) -> tuple[int, float, int, float, list[int]]:
            return (
                len([one for one in plan if not self._can_park(one)]),
                sum(self.costs.reload_s(one.spec.consumer) for one in plan),
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

    def _can_park(self, holder: Lease) -> bool:
        count = holder.spec.park_bytes
        return count > 0 and self.host_ram.fits(holder.id, count)

    def _greedy(
        self, candidates: Sequence[Lease], covers: _Covers, freed: Mapping[LeaseId, int]
    ) -> list[Lease]:
        """Take cheap classes first, the largest of a class first, until they cover; then give back
        what is not needed.
        """

        def cost(one: Lease) -> tuple[float, ...]:
            age = (one.uses.last_at, one.request.arrival)
            return (
                bool(one.uses),
                one.spec.priority,
                not self._can_park(one),
                -freed[one.id],
                *age,
            )

        order = sorted(candidates, key=cost)
        size = 1 + bisect_left(range(1, len(order)), True, key=lambda n: covers(order[:n]))
        plan = order[:size]
        for lease in reversed(order[:size]):
            without = [other for other in plan if other is not lease]
            if covers(without):
                plan = without
        return plan

    def ask_times(self, gpu: Gpu, waiter: Lease | None) -> list[float]:
        """Return future instants at which a holder may be revoked that may not be revoked now."""
        times: list[float] = []
        for lease in gpu.residents.by_state[LeaseState.HELD].values():
            if not may_ask(lease):
                continue
            times.append(self.residency_ends_at(lease, waiter))
            if waiter is not None and lease.uses:
                gap = lease.spec.priority - waiter.spec.priority
                aged_at = waiter.request.arrived_at + gap * self.settings.ageing_s_per_point
                times.append(aged_at + _WAKE_SLACK_S)
        return [at for at in times if at > self.now]
