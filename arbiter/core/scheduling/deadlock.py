"""Waits that can never end: a process that is in the middle of a use waits for a lease whose room
is kept, in a circle, by that use.

Found by reduction. Suppose that everything leaves which is not pinned and not in use by a process
that waits; serve the waiters that fit then; its process waits no more, so its uses will end and
their leases leave too; repeat. The waiters left over wait for ever, and among them is a circle.
Nothing is
guessed: a lease in use that will merely be asked later (priorities, residencies), or bytes that
others keep (pins, residues, stowaways), are a wait and no deadlock. A wait that the process does
not depend on says so (`independent`).

Looked for only when a process that uses something begins to wait, or one that waits begins to use
something. Changes nothing but the wait of the newest in the circle, before a holder is asked to
leave for it.
"""

from collections.abc import Callable, Iterable, Mapping

from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.scheduling import admission, backfill
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

WAITS_MAX = 64
"""A process that waits for more than so many leases at a time is not looked at: each look weighs
all of them.
"""


def resolve(core: Core) -> None:
    """Deny waiters until no circle is left.

    Each is answered like any request that is refused, or by push if it waited already.
    """
    suspects = core.turn.suspects
    while any(
        core.users.get(process) and _is_looked_at(_waits_of(core, process)) for process in suspects
    ):
        cycle = find(core)
        if not cycle:
            return
        users = [waiter for waiter in cycle if waiter.process in core.users]
        _deny(core, max(users, key=lambda waiter: waiter.request.arrival), cycle)


def find(core: Core) -> list[Lease]:
    """The circle that the newest possible waiter is in, in its order; [] if everybody can be served
    some day.
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
    return [
        lease
        for lease in core.leases_of(process)
        if lease.state is LeaseState.QUEUED and not lease.spec.independent
    ]


def _is_looked_at(waits: list[Lease]) -> bool:
    return 0 < len(waits) <= WAITS_MAX


class _Reduction:
    """Return the waiters that could be served if every lease left that can."""

    def __init__(self, core: Core) -> None:
        self.core = core
        waits = {process: _waits_of(core, process) for process in core.users}
        self.waits = {process: mine for process, mine in waits.items() if _is_looked_at(mine)}
        # a request in no queue waits for others of its feature, not for bytes
        self.served: set[LeaseId] = {
            lease.id for feature in core.hooked["unplaced"] for lease in feature.unplaced()
        }

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
        """One pass over a card's queue."""
        going = self._going(gpu, self._blocked())
        everything = self._going(gpu, frozenset())
        head: Lease | None = None
        known: dict[tuple[int, bool], bool] = {}  # crowds ask for the same, again and again
        for waiter in gpu.queue:
            if waiter.id in self.served or (head is not None and waiter.process not in self.waits):
                continue  # no wait depends on a request behind a head that uses nothing
            wish = (waiter.request.load_peak_bytes, waiter.spec.exclusive)
            alike = waiter.process not in gpu.ledger.accounts and not gpu.ledger.strangers
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
                possible = possible and self._passes(gpu, head, waiter, everything)
            if possible:
                self.served.add(waiter.id)
            elif head is None:
                head = waiter

    def _passes(
        self, gpu: Gpu, head: Lease, waiter: Lease, everything: Mapping[LeaseId, int]
    ) -> bool:
        """May it be served while a waiter before it cannot be? As `grants` backfills."""
        if head.spec.exclusive or not self.core.settings.scheduling.backfill:
            return False
        spare = backfill.spare_beside_bytes(gpu, head, everything)
        return admission.added_bytes(gpu, waiter) <= spare

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
        if admission.fits(gpu, waiter, self._going(gpu, users)):
            return []
        alone = [
            process
            for process in users
            if not admission.fits(gpu, waiter, self._going(gpu, [process]))
        ]
        return alone or [process for process in users if process != waiter.process]

    def _going(self, gpu: Gpu, staying: Iterable[ProcessKey]) -> dict[LeaseId, int]:
        """Everything on a card that leaves as long as these processes do not end their uses."""
        kept = {
            lease.id
            for process in staying
            for lease in self.core.users[process].values()
            if lease.gpu == gpu.info.id
        }
        kept.update(gpu.residents.pinned)
        going: dict[LeaseId, int] = {
            lease.id: lease.residue_bytes
            for lease in gpu.residents.values()
            if lease.id not in kept
        }
        going.update(
            (lease, 0) for lease in gpu.ledger.leases() if lease not in gpu.residents
        )  # debts
        return going


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


# -- telling ---------------------------------------------------------------------------------------
def _deny(core: Core, waiter: Lease, cycle: list[Lease]) -> None:
    links = (_link(core, one, cycle[(n + 1) % len(cycle)]) for n, one in enumerate(cycle))
    eviction.deny(core, waiter, no.Deadlock(tuple(links)))


def _link(core: Core, waiter: Lease, following: Lease) -> no.CycleLink:
    used = core.users.get(following.process, {}).values()
    theirs = {lease.id: lease for lease in used if lease.gpu in waiter.request.gpus}
    held = {lease.id: lease for lease in core.users.get(waiter.process, {}).values()}
    return no.CycleLink(
        pid=waiter.process.pid,
        consumer=waiter.spec.consumer,
        lease_id=waiter.id,
        waits_for=tuple(map(_named, theirs.values())) or (_named(following),),
        holds=tuple(map(_named, held.values())),
    )


def _named(lease: Lease) -> no.NamedLease:
    return no.NamedLease(lease.id, lease.spec.consumer, lease.state)
