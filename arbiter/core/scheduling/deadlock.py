"""Waits that can never end: a process that is in the middle of a use waits for a lease whose room
is kept, in a circle, by that use.

Found by reduction. Suppose that everything leaves that is not pinned and not in use by a process
that waits; serve the waiters that fit then; their processes wait no more, so their uses will end
and these leases leave too; repeat. The waiters left over wait forever, and among them is a circle.
Nothing is guessed: a lease in use that is revoked later (priorities, residencies), or bytes that
others keep (pins, retained bytes, stowaways), are a wait and no deadlock. A wait that the process
does not depend on says so (`independent`).

Runs only when a process that uses something begins to wait, or one that waits begins to use
something (`Turn.suspects`). Ends the wait of the newest waiter in the circle, before a holder is
revoked for it.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from math import inf

from vram_arbiter.arbiter.core import eviction
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey

WAITS_MAX = 64
"""A process that waits for more than so many leases at a time is not looked at: each look weighs
all of them.
"""


def resolve(core: Core) -> None:
    """Deny waiters until no circle is left, the newest of a circle first.

    Each is answered like any request that is refused, or by push if it waited already.
    """
    suspects = core.turn.suspects
    while any(process in core.users and _waits_of(core, process) for process in suspects):
        cycle = find(core)
        if not cycle:
            return
        users = [waiter for waiter in cycle if waiter.process in core.users]
        newest = max(users, key=lambda waiter: waiter.request.arrival)
        links = (_link(core, one, cycle[(n + 1) % len(cycle)]) for n, one in enumerate(cycle))
        eviction.deny(core, newest, no.Deadlock(tuple(links)))


def find(core: Core) -> list[Lease]:
    """Return the circle of the newest waiter that is in one, in its order; [] if every waiter can
    be served some day.
    """
    state = _Reduction(core)
    left = state.run()
    candidates = [w for w in left if w.process in state.waits and not w.spec.independent]
    for waiter in sorted(candidates, key=lambda waiter: -waiter.request.arrival):
        cycle = _way_back(waiter, state.waits_for)
        if cycle:
            return cycle
    return []


def _waits_of(core: Core, process: ProcessKey) -> list[Lease]:
    """Return the leases that a process depends on and waits for; [] if they are too many."""
    waits = [
        lease
        for lease in core.leases_of(process)
        if lease.state is LeaseState.QUEUED and not lease.spec.independent
    ]
    return waits if len(waits) <= WAITS_MAX else []


class _Reduction:
    """The waiters that could be served if every lease left that can."""

    def __init__(self, core: Core) -> None:
        self.core = core
        waits = {process: _waits_of(core, process) for process in core.users}
        self.waits = {process: mine for process, mine in waits.items() if mine}
        # a request in no queue waits for others of its feature, not for bytes
        self.served: set[LeaseId] = set(core.unqueued)
        self._movable: dict[GpuId, dict[LeaseId, int]] = {}

    def run(self) -> list[Lease]:
        """Waiters that are left over, by arrival."""
        before = -1
        while len(self.served) > before:
            before = len(self.served)
            for gpu in self.core.gpus.values():
                self._serve(gpu)
        left = [lease for lease in self.core.waiting.values() if lease.id not in self.served]
        return sorted(left, key=lambda lease: lease.request.arrival)

    def waits_for(self, waiter: Lease) -> list[Lease]:
        """Other waiters (or itself) without which it cannot be served: those before it, and those
        whose processes use what is in its way.
        """
        found: dict[LeaseId, Lease] = {}
        for gpu_id in waiter.request.gpus:
            gpu = self.core.gpus[gpu_id]
            head = next((lease for lease in gpu.queue if lease.id not in self.served), None)
            if head is not None and head is not waiter:
                found[head.id] = head
            for process in self._blockers(gpu, waiter):
                found.update((lease.id, lease) for lease in self._left_of(process))
        return list(found.values())

    def _serve(self, gpu: Gpu) -> None:
        """Pass once over a GPU's queue."""
        kept = self._kept(gpu, self._blocked())
        if not kept:  # everything leaves: no wait here depends on a use
            self.served.update(waiter.id for waiter in gpu.queue)
            return
        ledger = gpu.ledger
        going, everything = self._going(gpu, kept), self._going(gpu)
        head: Lease | None = None
        spare = -inf
        known: dict[tuple[int, bool], bool] = {}  # crowds ask for the same, again and again
        for waiter in gpu.queue:
            if waiter.id in self.served or (head is not None and waiter.process not in self.waits):
                continue  # no wait depends on a request behind a head that uses nothing
            wish = (waiter.request.load_peak_bytes, waiter.spec.exclusive)
            alike = waiter.process not in ledger.accounts and not ledger.stowaways
            possible = known.get(wish) if alike else None
            if possible is None:
                # one that could not be served even if every use ended waits for something else, and
                # that may come
                possible = admission.fits(gpu, waiter, going) or not admission.fits(
                    gpu, waiter, everything
                )
                if alike:
                    known[wish] = possible
            if head is not None:
                possible = possible and admission.added_bytes(gpu, waiter) <= spare
            if possible:
                self.served.add(waiter.id)
            elif head is None:
                head = waiter
                if not head.spec.exclusive:
                    after = ledger.total_if(everything, admission.joining(head))
                    spare = ledger.budget_bytes - after  # as `grants` backfills

    def _blocked(self) -> frozenset[ProcessKey]:
        """Return processes in a use that wait for a request that is not served."""
        return frozenset(process for process in self.waits if self._left_of(process))

    def _left_of(self, process: ProcessKey) -> list[Lease]:
        return [lease for lease in self.waits.get(process, ()) if lease.id not in self.served]

    def _blockers(self, gpu: Gpu, waiter: Lease) -> list[ProcessKey]:
        """Processes whose uses are in the way of a waiter: those that alone suffice for that, else
        all others.
        """
        users = [
            process
            for process in self._blocked()
            if any(lease.gpu == gpu.info.id for lease in self.core.users[process].values())
        ]
        users.sort()
        if admission.fits(gpu, waiter, self._going(gpu, self._kept(gpu, users))):
            return []
        alone = [
            process
            for process in users
            if not admission.fits(gpu, waiter, self._going(gpu, self._kept(gpu, [process])))
        ]
        return alone or [process for process in users if process != waiter.process]

    def _kept(self, gpu: Gpu, staying: Iterable[ProcessKey]) -> set[LeaseId]:
        """Return the leases of a GPU that these processes use."""
        return {
            lease.id
            for process in staying
            for lease in self.core.users[process].values()
            if lease.gpu == gpu.info.id
        }

    def _going(self, gpu: Gpu, kept: Collection[LeaseId] = ()) -> Mapping[LeaseId, int]:
        """Return what leaves a GPU some day as long as `kept` stays, with what it retains."""
        movable = self._movable.get(gpu.info.id)
        if movable is None:  # nothing of it changes meanwhile
            movable = self._movable[gpu.info.id] = _movable(gpu)
        return (
            {one: count for one, count in movable.items() if one not in kept} if kept else movable
        )


def _movable(gpu: Gpu) -> dict[LeaseId, int]:
    """Return residents of a GPU that are not pinned, with what they retain, and debts."""
    residents = gpu.residents
    movable = {one.id: one.residue_bytes for one in residents.values() if one.evictable}
    movable.update((debt, 0) for debt in gpu.ledger.charges if debt not in residents)
    return movable


def _way_back(start: Lease, waits_for: Callable[[Lease], list[Lease]]) -> list[Lease]:
    """A shortest circle through a waiter; [] if there is none."""
    came_from: dict[LeaseId, Lease] = {}
    frontier = [start]
    while frontier:
        waiter = frontier.pop(0)
        for other in waits_for(waiter):
            if other is start:
                path = [waiter]
                while path[-1] is not start:
                    path.append(came_from[path[-1].id])
                return path[::-1]
            if other.id not in came_from:
                came_from[other.id] = waiter
                frontier.append(other)
    return []


def _link(core: Core, waiter: Lease, following: Lease) -> no.CycleLink:
    """Return what a waiter of a circle holds, and what it waits for."""

    def named(leases: Iterable[Lease]) -> tuple[no.NamedLease, ...]:
        known = {one.id: no.NamedLease(one.id, one.spec.consumer, one.state) for one in leases}
        return tuple(known.values())

    used = core.users.get(following.process, {}).values()
    in_the_way = [lease for lease in used if lease.gpu in waiter.request.gpus]
    return no.CycleLink(
        pid=waiter.process.pid,
        consumer=waiter.spec.consumer,
        lease_id=waiter.id,
        waits_for=named(in_the_way or [following]),
        holds=named(core.users.get(waiter.process, {}).values()),
    )
