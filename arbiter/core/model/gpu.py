"""One GPU: its leases by state (`Residents`), its requests by effective priority (`WaitQueue`), and
its ledger, readings, verifications and bytes pending free (`Gpu`, `PendingFree`).

Effective priority is priority + waited/ageing. All requests age at the same rate, so the order of
two is fixed when they arrive: `arrival time − priority × ageing` (smaller first), then arrival. The
queue is a sorted list that time never disturbs; every wait is bounded. Without ageing (0) it is the
order of arrival.
"""

from bisect import bisect_left, bisect_right, insort
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from itertools import islice

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.ledger import GpuLedger, bytes_by_process, bytes_of
from vram_arbiter.arbiter.core.model.lease import LEAVING, Eviction, Lease, LeaseState, Verification
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.codes import Block

LEFT_KEPT = 64
"""Verdicts remembered: more than can fall between a baseline and its own."""

type Rank = tuple[float, int]


class Residents(dict[LeaseId, Lease]):
    """Leases of one GPU by id, oldest grant first, with tables of the few that a decision asks
    about.

    A GPU may have ten thousand small leases while one loads and two leave. `Core.move` keeps the
    tables, so that a decision costs what has changed and not what is there.
    """

    def __init__(self) -> None:
        super().__init__()
        self.by_state: dict[LeaseState, dict[LeaseId, Lease]] = {state: {} for state in LeaseState}
        self.exclusive: set[LeaseId] = set()
        self.recent: dict[LeaseId, Lease] = {}
        """Leases granted or ready since the newest reading began; may hold more."""
        self.touched: set[LeaseId] = set()
        """Leases that came or went since the last check of the invariants."""

    # -- changing
    def add(self, lease: Lease) -> None:
        """A lease is granted here, or found after a restart."""
        self[lease.id] = self.by_state[lease.state][lease.id] = self.recent[lease.id] = lease
        self.touched.add(lease.id)
        if lease.spec.exclusive:
            self.exclusive.add(lease.id)

    def remove(self, lease: Lease) -> None:
        """Take a lease off the GPU, if it is there."""
        if lease.id not in self:
            return
        for table in (self, self.by_state[lease.state], self.recent):
            table.pop(lease.id, None)
        self.exclusive.discard(lease.id)
        self.touched.add(lease.id)

    def moved(self, lease: Lease, before: LeaseState) -> None:
        """A lease came to another state; it may not be here yet."""
        if lease.id not in self:
            return
        self.by_state[before].pop(lease.id, None)
        now_there = self.by_state[lease.state]
        now_there[lease.id] = lease
        if lease.state is LeaseState.HELD:
            self.recent[lease.id] = lease
            if before is LeaseState.REVOKING:  # back among those that became ready since
                in_order = sorted(now_there.values(), key=lambda one: one.ready_at)
                now_there.clear()
                now_there.update((one.id, one) for one in in_order)

    def seen(self, taken_at: float) -> None:
        """Forget recent leases that a reading that began at `taken_at` has seen."""
        for lease in [lease for lease in self.recent.values() if not self._after(lease, taken_at)]:
            del self.recent[lease.id]

    # -- reading
    def unseen(self, taken_at: float) -> list[Lease]:
        """Return leases granted or ready after a reading began: it cannot show their bytes."""
        return [lease for lease in self.recent.values() if self._after(lease, taken_at)]

    def _after(self, lease: Lease, taken_at: float) -> bool:
        return max(lease.granted_at, lease.ready_at) > taken_at

    def filling(self, since: float) -> Iterator[Lease]:
        """Yield leases that load, or became ready after `since`.

        HELD lists them in the order of `ready_at`.
        """
        for lease in reversed(self.by_state[LeaseState.HELD].values()):
            if lease.ready_at <= since:
                break
            yield lease
        yield from self.by_state[LeaseState.LOADING].values()
        for state in LEAVING:
            for lease in self.by_state[state].values():
                if lease.ready_at > since:
                    yield lease

    def loaded_since(self, moment: float) -> Iterator[Lease]:
        """Yield leases that became ready at `moment` or later, and those that were granted then and
        leave already."""
        for lease in reversed(self.by_state[LeaseState.HELD].values()):
            if lease.ready_at < moment:
                break
            yield lease
        for state in LEAVING:
            for lease in self.by_state[state].values():
                if max(lease.granted_at, lease.ready_at) >= moment:
                    yield lease


class WaitQueue:
    """Sorted requests; keeps the smallest need, so that a full GPU is seen at a glance."""

    def __init__(self, ageing_s_per_point: float) -> None:
        self._ageing_s = ageing_s_per_point
        self.head: Lease | None = None
        self._ranks: list[Rank] = []
        self.by_arrival: dict[int, Lease] = {}
        self._needs: list[int] = []

    def __iter__(self) -> Iterator[Lease]:
        return (self.by_arrival[arrival] for _, arrival in self._ranks)

    def add(self, lease: Lease) -> None:
        insort(self._ranks, self.rank(lease))
        insort(self._needs, lease.request.load_peak_bytes)
        self.by_arrival[lease.request.arrival] = lease
        self.head = self.by_arrival[self._ranks[0][1]]

    def discard(self, lease: Lease) -> None:
        """Take a request out, if it is here."""
        if lease.request.arrival not in self.by_arrival:
            return
        del self.by_arrival[lease.request.arrival]
        del self._ranks[bisect_left(self._ranks, self.rank(lease))]
        del self._needs[bisect_left(self._needs, lease.request.load_peak_bytes)]
        self.head = self.by_arrival[self._ranks[0][1]] if self._ranks else None

    def smallest_need_bytes(self) -> int:
        """Return the smallest load peak of a queue that is not empty."""
        return self._needs[0]

    def position(self, lease: Lease) -> int:
        """Return the place of a request; 1 is the head."""
        return bisect_left(self._ranks, self.rank(lease)) + 1

    def ahead_of(self, lease: Lease) -> Lease | None:
        """Return the request directly before this one."""
        index = self.position(lease) - 2
        return self.by_arrival[self._ranks[index][1]] if index >= 0 else None

    def after(self, rank: Rank) -> Iterator[Lease]:
        """Yield the requests behind a rank, whether or not a request has it now."""
        first = bisect_right(self._ranks, rank)
        return (self.by_arrival[arrival] for _, arrival in islice(self._ranks, first, None))

    def rank(self, lease: Lease) -> Rank:
        """Return the key by which any queue orders this request."""
        return (
            lease.request.arrived_at - lease.spec.priority * self._ageing_s,
            lease.request.arrival,
        )


class PendingFree:
    """What each process gave up lately on one GPU, outside any verification, that the driver may
    not have returned yet.

    A load's peak and the bytes of a stowaway leave the GPU as slowly as any others. If they counted
    as unattributed bytes, the next verdict would allow for bytes that are gone by then.
    """

    def __init__(self) -> None:
        self._parts: dict[ProcessKey, tuple[float, int]] = {}  # (when last, bytes)

    def give_up(self, process: ProcessKey, count: int, now: float) -> None:
        """Add `count` bytes; a negative count takes the same memory again."""
        at, before = self._parts.get(process, (now, 0))
        if before + count > 0:
            self._parts[process] = (now if count > 0 else at, before + count)
        else:
            self._parts.pop(process, None)

    def watch(
        self,
        before: MemorySampled | None,
        reading: MemorySampled,
        leaving: Collection[ProcessKey],
        charged_to: Callable[[ProcessKey], int],
    ) -> None:
        """Compare two consecutive readings. Processes in `leaving` are under verification anyway.

        A process that is no longer listed may still hold its charge. The first reading of a daemon
        is compared with the charges: a holder may have freed bytes before the restart.
        """
        if reading.processes is None:
            return
        if before is None:
            for use in reading.processes:
                if use.used_bytes is not None:
                    freed_bytes = charged_to(use.process) - use.used_bytes
                    if freed_bytes > 0:
                        self.give_up(use.process, freed_bytes, reading.taken_at)
            return
        if before.processes == reading.processes:
            return
        now = bytes_by_process(reading)
        for process, held_before in bytes_by_process(before).items():
            held = now.get(process)
            if held != held_before and process not in leaving:
                freed_bytes = held_before - (charged_to(process) if held is None else held)
                self.give_up(process, freed_bytes, reading.taken_at)

    def since(self, at: float) -> int:
        """Return the most that may be pending of what was given up after `at`; forget the rest."""
        if not self._parts:
            return 0
        self._parts = {process: part for process, part in self._parts.items() if part[0] > at}
        return sum([count for _, count in self._parts.values()])


@dataclass(slots=True)
class Gpu:
    """One GPU: its ledger, residents, queue and readings."""

    info: GpuInfo
    ledger: GpuLedger
    queue: WaitQueue
    readings: list[GpuId]  # of all GPUs, to be asked for at the end of the event
    residents: Residents = field(default_factory=Residents)
    verifications: dict[str, Verification] = field(default_factory=dict)
    evictions: list[Eviction] = field(default_factory=list)  # for waiters that still wait
    pending_free: PendingFree = field(default_factory=PendingFree)
    # when the newest verdicts fell, and how many bytes left by each
    left: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=LEFT_KEPT))
    sample: MemorySampled | None = None
    before_sleep: MemorySampled | None = None  # says nothing of now, but what was there then
    reading_s: float = 0.0  # how long the newest reading took
    failed_at: float | None = None  # last failed reading, None after a good one
    failure: str = ""
    read_from: float = 0.0  # no reading that began earlier counts (resume from suspend)
    asked_at: float | None = None  # last Sample asked for, None if its answer is here
    changed_at: float = 0.0  # last grant, ready or verdict
    blocked: Block | None = None
    debts: set[LeaseId] = field(default_factory=set)  # charged, not resident; kept by `invariants`
    # of the event that is handled
    dirty: bool = True  # its queue must be served
    touched: bool = True  # its records may have changed: reading and invariants follow

    def wake(self) -> None:
        """Serve its queue in this turn: something changed that a waiter here may wait for."""
        self.dirty = self.touched = True

    def want_sample(self, now: float, not_before: float) -> None:
        """Ask for a reading that begins at `not_before` or later, unless such a one is under
        way."""
        if self.asked_at is None or self.asked_at < not_before:
            self.asked_at = now
            self.readings.append(self.info.id)

    def verify(self, verification: Verification, now: float, settings: Settings) -> None:
        """Begin polls and deadline of a verification, or begin them anew: time without readings
        says nothing of the memory's return."""
        self.verifications[verification.key] = verification
        verification.paced_from = max(now, verification.not_before)
        verification.deadline_at = verification.paced_from + settings.verify_timeout_s
        verification.overdue = False
        verification.verdict = None
        self.read_soon(verification, now, settings)

    def read_soon(self, verification: Verification, now: float, settings: Settings) -> None:
        """Read at once and again soon: most memory is back when its holder reports the release."""
        self.want_sample(now, now)
        verification.next_poll_at = max(now + settings.verify_confirm_s, verification.paced_from)
        self.touched = True

    def in_state(self, *states: LeaseState) -> list[Lease]:
        """Return its leases in these states, in the order in which they came to them."""
        by_state = self.residents.by_state
        return [lease for state in states for lease in by_state[state].values()]

    def leaving(self) -> list[Lease]:
        """Return its leaving leases, oldest grant first."""
        return [lease for lease in self.residents.values() if lease.state in LEAVING]

    def shown_bytes(self, process: ProcessKey) -> int | None:
        """Return the bytes of a process by the newest reading, 0 where that omits it; None: it
        cannot tell."""
        return None if self.sample is None else bytes_of(self.sample, process)
