"""The whole state of the engine (`Core`), its timers, and what the steps of one event tell each
other (`Turn`).

Data and bookkeeping only: no decision is taken here. What an event changes goes through the verbs
of `Core`, in this order: effects (`note`, `reply`, `push`), numbers, clients, leases, uses, waits,
the end of a lease, what grants wait for, and the journal.
"""

from collections import OrderedDict
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from hashlib import blake2b
from heapq import heapify, heappop, heappush
from types import MappingProxyType
from typing import Any, Final

from vram_arbiter.arbiter.core.effects import (
    Effect,
    JournalDelete,
    JournalPut,
    Note,
    Push,
    Refuse,
    Reply,
)
from vram_arbiter.arbiter.core.events import DOUBT_KEY
from vram_arbiter.arbiter.core.learning import Costs, Footprints
from vram_arbiter.arbiter.core.ledger import GpuLedger, HostRam
from vram_arbiter.arbiter.core.model.gpu import Gpu, WaitQueue
from vram_arbiter.arbiter.core.model.lease import (
    AWAY,
    EXPIRING,
    NONCES_MAX,
    Eviction,
    Lease,
    LeaseState,
    Use,
)
from vram_arbiter.arbiter.core.model.records import AnyRecord, ResidueRecord
from vram_arbiter.arbiter.core.model.refusals import End
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token, UseId
from vram_arbiter.schemas.wire.codes import Block, Order, RevokeCause, Why
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.notes import (
    About,
    AnyNote,
    CancelledNote,
    DeniedNote,
    LostNote,
    ServingNote,
)
from vram_arbiter.schemas.wire.pushes import AnyPush, DeniedPush
from vram_arbiter.schemas.wire.replies import AnyReply

ENDED_REMEMBERED = 1024
TOKEN_STEP_BYTES = 4
"""Tokens are apart by up to 2^32: 2^31 grants of one epoch stay below 2^63."""
TIMERS_SLACK = 256
"""Entries of cleared timers that stay in the heap however few are set."""

EMPTY_JOURNAL: Final = LeaseId("journal")
"""Stands for the holders that an empty, lost or doubted journal does not name; given up after a TTL
and the fence grace."""

type TimerKey = tuple[str, str]
"""(kind, subject), e.g. ("ttl", "L3-17")."""
type _UseKey = tuple[LeaseId, UseId]


@dataclass(frozen=True, slots=True)
class Client:
    """One connection that said hello. `instance` names the client object behind it."""

    id: ClientId
    process: ProcessKey
    name: str
    instance: str
    uid: int


@dataclass(frozen=True, slots=True)
class Ended:
    """What is remembered of a lease that is over, so that late messages get a true answer."""

    lease: LeaseId
    process: ProcessKey
    nonce: str
    token: Token | None
    state: LeaseState
    error: Refusal | None
    earlier_nonces: tuple[str, ...] = ()
    revoked: RevokeCause | None = None  # it was evicted


@dataclass(slots=True)
class Refusals:
    """Notes of one process's refused requests (`refusals`): how many lately, and how many were left
    out."""

    at: float
    noted: float = 0.0
    left_out: int = 0


class Waiting(dict[LeaseId, Lease]):
    """Requests that wait, and how many of each process and user."""

    def __init__(self) -> None:
        super().__init__()
        self.of: dict[ProcessKey | int, int] = {}  # how many, by process and by uid

    def add(self, lease: Lease) -> None:
        self[lease.id] = lease
        for owner in (lease.process, lease.request.uid):
            self.of[owner] = self.of.get(owner, 0) + 1

    def discard(self, lease: Lease) -> None:
        """Take a request out, if it is here."""
        if self.pop(lease.id, None) is not None:
            for owner in (lease.process, lease.request.uid):
                self.of[owner] -= 1
                if not self.of[owner]:
                    del self.of[owner]


class Timers(dict[TimerKey, float]):
    """Deadlines by name, in a heap. A later deadline is cheap, as renewals set one all the time:
    the entry of the earlier one is corrected when it comes up."""

    def __init__(self) -> None:
        super().__init__()
        self._heap: list[tuple[float, TimerKey]] = []

    def set(self, key: TimerKey, at: float) -> None:
        """Set a deadline, or move it."""
        before = self.get(key)
        self[key] = at
        if before is None or at < before:
            heappush(self._heap, (at, key))

    def set_first(self, key: TimerKey, times: Collection[float]) -> None:
        """Set a deadline to the first of these times, if there is one."""
        if times:
            self.set(key, min(times))

    def cancel(self, key: TimerKey) -> None:
        """Forget a deadline, if it is set."""
        self.pop(key, None)
        if len(self._heap) > TIMERS_SLACK + 2 * len(self):
            # waits of a day that are given up after a second must not stay here for the day
            self._heap = [(at, timer) for timer, at in self.items()]
            heapify(self._heap)

    def next_at(self) -> float | None:
        """When the earliest timer is due."""
        while self._heap:
            at, key = self._heap[0]
            due = self.get(key)
            if due == at:
                return at
            heappop(self._heap)
            if due is not None and due > at:
                heappush(self._heap, (due, key))
        return None

    def pop_due(self, now: float) -> TimerKey | None:
        """Take the earliest timer that is due, or None."""
        at = self.next_at()
        if at is None or at > now:
            return None
        _, key = heappop(self._heap)
        del self[key]
        return key


@dataclass(slots=True)
class Turn:
    """What the steps of one event tell the next ones; nothing of it outlives the event."""

    effects: list[Effect] = field(default_factory=list)
    """To be performed, in this order."""
    unanswered: Lease | None = None
    """The lease of this event's acquire; it is answered `queued` unless it is granted at once."""
    granted: list[tuple[Token, GpuId]] = field(default_factory=list)
    """Grants, for the invariants."""
    taken_back: dict[LeaseId, Eviction] = field(default_factory=dict)
    """Revokes that nothing wanted any more, by holder; some are decided again, others withdrawn."""


@dataclass(frozen=True, slots=True)
class Inspection:
    """Read-only view of the engine's tables, for tests and offline tools: they change with the next
    event, and no decision reads it."""

    gpus: Mapping[GpuId, Gpu]
    leases: Mapping[LeaseId, Lease]
    waiting: Mapping[LeaseId, Lease]
    away: Mapping[LeaseId, Lease]
    ended: Mapping[LeaseId, Ended]
    nonces: Mapping[tuple[ProcessKey, str], LeaseId]
    clients: Mapping[ClientId, Client]
    users: Mapping[ProcessKey, Mapping[tuple[LeaseId, UseId], Lease]]
    host_ram: HostRam
    costs: Costs
    refusals: Mapping[ProcessKey, Refusals]
    footprints: Footprints
    timers: Timers


class Core:
    """State plus the effects of the event being handled."""

    def __init__(self, settings: Settings, now: float) -> None:
        self.settings = settings
        self.started_at = now
        self.now = now
        self.turn = Turn()
        self.readings: list[GpuId] = []  # to be asked for at the end of the event
        self.gpus: dict[GpuId, Gpu] = {
            info.id: Gpu(
                info,
                GpuLedger(info, settings.verify_tolerance_bytes),
                WaitQueue(settings.ageing_s_per_point),
                self.readings,
            )
            for info in sorted(settings.gpus, key=lambda info: info.index)
        }
        self.timers = Timers()
        # leases, and who asks for them
        self.leases: dict[LeaseId, Lease] = {}
        self._of_process: dict[ProcessKey, dict[LeaseId, Lease]] = {}
        self.of_client: dict[ClientId, dict[LeaseId, Lease]] = {}  # leases that it speaks for
        self.clients: dict[ClientId, Client] = {}
        self.connected: dict[ProcessKey, dict[ClientId, Client]] = {}  # clients by process
        self.last_client_at = now
        self.nonces: dict[tuple[ProcessKey, str], LeaseId] = {}
        self.ended: OrderedDict[LeaseId, Ended] = OrderedDict()
        self.refusals: dict[ProcessKey, Refusals] = {}  # the latest last
        self.terminated: set[ProcessKey] = set()  # told to end by an operator, and alive
        # waits, uses, and leases without bytes on a GPU in the order of their leaving
        self.waiting = Waiting()
        self.users: dict[ProcessKey, dict[_UseKey, Lease]] = {}  # leases that a process uses
        self.away: dict[LeaseId, Lease] = {}
        self.host_ram = HostRam(settings.host_ram_budget_bytes)
        # numbers: tokens are ahead of `serial` by `token_offset`
        self.serial = self.token_offset = self.arrivals = 0
        self.last_token = Token(settings.epoch, 0)
        # what grants wait for: an operator, and after a restart leases to be accounted for
        self.drain: Order | None = None
        self.serving = True
        self.recovering: set[LeaseId] = set()
        # what was learned
        self.footprints = Footprints(
            max([gpu.ledger.budget_bytes for gpu in self.gpus.values()], default=0)
        )
        self.footprints.restore(settings.footprints)
        self.costs = Costs(settings.learnt, settings.thrash_window_s)

    # -- effects
    def reply(self, client: ClientId, request: RequestId, body: AnyReply) -> None:
        self.turn.effects.append(Reply(client, request, body))

    def refuse(self, client: ClientId, request: RequestId, refusal: Refusal) -> None:
        self.turn.effects.append(Refuse(client, request, refusal))

    def push(self, lease: Lease, body: AnyPush) -> None:
        """Push to the client of a lease, or to another living connection of its process."""
        living = self.connected.get(lease.process, {})
        to = lease.client if lease.client in living or not living else min(living)
        self.turn.effects.append(Push(to, body))

    def note(self, body: AnyNote, lease: Lease | None = None) -> None:
        about = None
        if lease is not None:
            about = About(lease.id, lease.spec.consumer, lease.gpu, lease.request.traceparent)
        self.turn.effects.append(Note(body, about))

    def journal(self, key: str, record: AnyRecord, *, gates: bool = False) -> None:
        self.turn.effects.append(JournalPut(key, record, gates))

    def forget(self, key: str) -> None:
        self.turn.effects.append(JournalDelete(key))

    # -- bookkeeping
    def next_lease_id(self) -> LeaseId:
        self.serial += 1
        return LeaseId(f"L{self.settings.epoch}-{self.serial}")

    def next_token(self) -> Token:
        """Return a token greater than every one before it. With `Settings.token_secret` the
        distance to the last one cannot be guessed: a token is what authorizes a use, and lease ids
        are public.
        """
        self.serial += 1
        if self.settings.token_secret:
            key = bytes.fromhex(self.settings.token_secret)
            step = blake2b(b"%d" % self.serial, digest_size=TOKEN_STEP_BYTES, key=key).digest()
            self.token_offset += int.from_bytes(step)
        return Token(self.settings.epoch, self.serial + self.token_offset)

    def next_arrival(self) -> int:
        self.arrivals += 1
        return self.arrivals

    def gpu_of(self, lease: Lease) -> Gpu:
        """Return the GPU of a resident lease."""
        assert lease.gpu is not None, f"{lease.id} has no GPU"
        return self.gpus[lease.gpu]

    def wake_all(self) -> None:
        """Serve every queue."""
        for gpu in self.gpus.values():
            gpu.wake()

    def wake_candidates(self, lease: Lease) -> None:
        """Serve the queues of every GPU that a request may be granted on."""
        for gpu_id in lease.request.gpus:
            self.gpus[gpu_id].wake()

    def join(self, client: Client) -> None:
        """A connection begins."""
        self.clients[client.id] = client
        self.connected.setdefault(client.process, {})[client.id] = client

    def part(self, client: ClientId) -> None:
        """A connection is over."""
        _take_out(self.connected, self.clients.pop(client).process, client)

    def add(self, lease: Lease) -> None:
        """A lease begins to live."""
        self.leases[lease.id] = lease
        self._of_process.setdefault(lease.process, {})[lease.id] = lease
        self.of_client.setdefault(lease.client, {})[lease.id] = lease

    def keep(self, lease: Lease, grace_s: float = 0.0) -> None:
        """Let a lease that expires have its whole time to live from now on."""
        if lease.state in EXPIRING:
            lease.expires_at = self.now + lease.spec.ttl_s + grace_s
            self.timers.set(("ttl", lease.id), lease.expires_at)

    def hand_to(self, lease: Lease, client: ClientId) -> None:
        """Another connection of its process speaks for a lease from now on."""
        _take_out(self.of_client, lease.client, lease.id)
        lease.client = client
        self.of_client.setdefault(client, {})[lease.id] = lease
        if ("away", lease.id) in self.timers:  # after a restart: its holder is back
            self.timers.cancel(("away", lease.id))
            lease.attached = True

    def leases_of(self, process: ProcessKey) -> list[Lease]:
        """Live leases of a process, oldest first."""
        return list(self._of_process.get(process, {}).values())

    def mark(self, lease: Lease, use: Use) -> None:
        """A use begins."""
        lease.uses[use.process, use.id] = use
        self.users.setdefault(use.process, {})[lease.id, use.id] = lease
        lease.uses.unclaimed = False

    def unmark(self, lease: Lease, use: Use) -> None:
        """A use ends."""
        del lease.uses[use.process, use.id]
        _take_out(self.users, use.process, (lease.id, use.id))

    def used_by(self, process: ProcessKey) -> list[Lease]:
        """Return the live leases with a use of a process; some twice."""
        return list(self.users.get(process, {}).values())

    def move(self, lease: Lease, to: LeaseState, why: str) -> None:
        """Move a lease to another state, in the tables too. Raises IllegalTransition."""
        before = lease.state
        lease.move(to, self.now, why)
        if lease.gpu is not None:
            self.gpus[lease.gpu].residents.moved(lease, before)
        if to in AWAY:
            self.away[lease.id] = lease
        else:
            self.away.pop(lease.id, None)
        if to is LeaseState.HELD or (to is LeaseState.VERIFYING and not lease.standby.parks):
            self.host_ram.free(lease.id)  # its weights are on the GPU, or nowhere

    def enqueue(self, lease: Lease) -> None:
        """A request waits in the queue of every candidate GPU."""
        request = lease.request
        if lease.id not in self.waiting:
            self.waiting.add(lease)
            if request.wait_timeout_s is not None:
                self.timers.set(("wait", lease.id), request.arrived_at + request.wait_timeout_s)
        for gpu_id in request.gpus:
            self.gpus[gpu_id].queue.add(lease)
            self.gpus[gpu_id].wake()

    def rename(self, lease: Lease, nonce: str) -> None:
        """Another acquire asks for a lease. The earlier ones are remembered, for their repeats."""
        request = lease.request
        if len(request.earlier_nonces) == NONCES_MAX:
            self.nonces.pop((lease.process, request.earlier_nonces[0]), None)
        request.earlier_nonces.append(request.nonce)
        request.nonce = nonce
        self.nonces[lease.process, nonce] = lease.id

    def requeue(
        self, lease: Lease, client: ClientId, asked: RequestId | None, asked_at: float
    ) -> None:
        """Queue a lease that is away. Without a request (`asked`) its grant is pushed."""
        request = lease.request
        self.move(lease, LeaseState.QUEUED, Why.WANTED)
        self.hand_to(lease, client)
        request.id = asked
        request.arrived_at, request.arrival = asked_at, self.next_arrival()
        request.planned_gpu = None
        self.enqueue(lease)

    def dequeue(self, lease: Lease) -> None:
        """A request waits no more."""
        self.waiting.discard(lease)
        self.timers.cancel(("wait", lease.id))
        for gpu_id in lease.request.gpus:
            self.gpus[gpu_id].queue.discard(lease)
            self.gpus[gpu_id].wake()

    def deny(self, waiter: Lease, refusal: Refusal) -> None:
        """End a wait with a refusal. Its request was answered as queued."""
        self.move(waiter, LeaseState.DENIED, refusal.code)
        self.dequeue(waiter)
        self.push(waiter, DeniedPush(waiter.id, refusal.view()))
        self.note(DeniedNote(refusal), waiter)
        self.end(waiter, refusal)

    def end_away(self, lease: Lease, to: LeaseState, refusal: End) -> None:
        """End a lease that is away: nothing has to be measured."""
        self.move(lease, to, refusal.why)
        note = LostNote if to is LeaseState.LOST else CancelledNote
        self.note(note(refusal.why), lease)
        self.end(lease, refusal)

    def end(self, lease: Lease, error: Refusal | None) -> None:
        """Drop a lease that reached a terminal state; a bounded memory of it stays."""
        del self.leases[lease.id]
        _take_out(self._of_process, lease.process, lease.id)
        _take_out(self.of_client, lease.client, lease.id)
        for kind in ("ttl", "revoke", "users", "away"):
            self.timers.cancel((kind, lease.id))
        self.host_ram.free(lease.id)
        if lease.gpu is not None:
            gpu = self.gpus[lease.gpu]
            gpu.residents.remove(lease)
            gpu.wake()
        elif lease.token is not None:  # it was resident once: the journal knows it as away
            self.forget(f"lease:{lease.id}")
        request, eviction = lease.request, lease.departure.eviction
        known = (lease.id, lease.process, request.nonce, lease.token, lease.state, error)
        revoked = None if eviction is None else eviction.why
        self.remember(Ended(*known, tuple(request.earlier_nonces), revoked))

    def remember(self, ended: Ended) -> None:
        """Remember a lease that is over; the oldest such is forgotten."""
        self.ended[ended.lease] = ended
        while len(self.ended) > ENDED_REMEMBERED:
            _, oldest = self.ended.popitem(last=False)
            for nonce in (oldest.nonce, *oldest.earlier_nonces):
                self.nonces.pop((oldest.process, nonce), None)

    def inspect(self) -> Inspection:
        tables: Any = {field.name: getattr(self, field.name) for field in fields(Inspection)}
        shown: Any = {
            name: MappingProxyType(table) if isinstance(table, dict) else table
            for name, table in tables.items()
        }
        return Inspection(**shown)

    def blocked(self, gpu: Gpu) -> Block | None:
        """Return why nothing can be granted on a GPU now, for any request; None: it can be."""
        if not self.serving:
            return Block.RECOVERING
        if self.drain is not None:
            return Block.DRAINED
        if gpu.failed_at is not None:
            return Block.UNREADABLE
        if gpu.sample is None:
            return Block.UNREAD
        if gpu.residents.by_state[LeaseState.LOADING]:
            return Block.LOADING
        return Block.PRESSURE if gpu.ledger.pressed else None

    def serve(self) -> None:
        """Begin to grant: every holder is accounted for."""
        self.serving = True
        self.note(ServingNote(self.now - self.started_at))
        self.wake_all()

    def account_for(self, lease_id: str) -> None:
        """Wait for one lease less before the first grant, or (EMPTY_JOURNAL) no longer for holders
        that the journal does not name."""
        if lease_id in self.recovering:
            self.recovering.remove(LeaseId(lease_id))
            if lease_id == EMPTY_JOURNAL:
                self.forget(DOUBT_KEY)

    def record_lease(self, lease: Lease, *, debt: bool = False, gates: bool = False) -> None:
        """Write a lease that is resident (or its debt) or away to the journal. `gates`: it is a
        grant, which does not take place unless its record is written. Whatever else is recorded has
        happened; a stale record makes a later recovery more careful.
        """
        charge_bytes = 0 if lease.gpu is None else self.gpu_of(lease).ledger.charge_bytes(lease.id)
        record = lease.record(charge_bytes, self.host_ram.booked.get(lease.id, 0), debt=debt)
        self.journal(f"lease:{lease.id}", record, gates=gates)

    def record_residue(self, gpu: Gpu, process: ProcessKey, residue_bytes: int) -> None:
        """Write (or, with 0, delete) what a process keeps."""
        key = f"residue:{process}:{gpu.info.id}"
        if not residue_bytes:
            self.forget(key)
            return
        floor_bytes = gpu.ledger.accounts[process].retained_floor_bytes
        record = ResidueRecord(
            process.pid, process.start_ticks, gpu.info.id, residue_bytes, floor_bytes
        )
        self.journal(key, record)


def _take_out[K, I, T](table: dict[K, dict[I, T]], owner: K, item: I) -> None:
    """An owner without items has no entry."""
    some = table[owner]
    del some[item]
    if not some:
        del table[owner]
