"""The whole state of the engine and the small verbs that every step uses: note, refuse, push, wake.

Data and bookkeeping only: no decision is taken here.
"""

from collections import Counter, OrderedDict, deque
from collections.abc import Mapping
from dataclasses import astuple, dataclass, field
from hashlib import blake2b
from statistics import median
from typing import Any

from vram_arbiter.arbiter.core.effects import (
    JournalDelete,
    JournalPut,
    Note,
    Push,
    Refuse,
    Reply,
    Sample,
)
from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.hooks import HOOKS, Feature, overriding
from vram_arbiter.arbiter.core.learning.footprints import Footprints
from vram_arbiter.arbiter.core.ledger.ledger import GpuLedger
from vram_arbiter.arbiter.core.ledger.pending_free import PendingFree
from vram_arbiter.arbiter.core.model.lease import (
    LEAVING,
    Eviction,
    Failures,
    Lease,
    LeaseState,
    Use,
)
from vram_arbiter.arbiter.core.model.residents import Residents
from vram_arbiter.arbiter.core.model.turn import Turn
from vram_arbiter.arbiter.core.model.verification import Verification
from vram_arbiter.arbiter.core.scheduling.queue import WaitQueue
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.arbiter.core.timers import Timers
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token, UseId
from vram_arbiter.schemas.wire.codes import Block, Order, RevokeCause
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.pushes import AnyPush
from vram_arbiter.schemas.wire.replies import AnyReply

ENDED_REMEMBERED = 1024
LEARNT_REMEMBERED = 32
CONSUMERS_REMEMBERED = 1024
TOKEN_STEP_BYTES = 4
"""Tokens are apart by up to 2^32: 2^31 grants of one epoch stay below 2^63."""
NOT_COUNTED = (-1, -1)
_LOADING = frozenset({LeaseState.LOADING})
_MOVING = LEAVING | _LOADING
IDLE_PROBE_S = 10.0  # how long after the last client a card is still read in the background


@dataclass(frozen=True, slots=True)
class Client:
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
class Reuse:
    """Departures of one consumer: was it wanted again soon?"""

    left_at: float | None = None
    soon: deque[bool] = field(default_factory=lambda: deque(maxlen=LEARNT_REMEMBERED))

    def chance(self) -> float:
        """Half for one that is not known, nearer to what was seen with every departure."""
        return (1 + sum(self.soon)) / (2 + len(self.soon))


@dataclass(slots=True)
class Refusals:
    """Notes of one process's refused requests (`refusals`): how many lately, and how many were left
    out."""

    at: float
    noted: float = 0.0
    left_out: int = 0


LEFT_KEPT = 64  # more verdicts than can fall between a baseline and its own


@dataclass(slots=True)
class Gpu:
    """One GPU: its ledger, residents, queue and readings."""

    info: GpuInfo
    ledger: GpuLedger
    queue: WaitQueue
    residents: Residents = field(default_factory=Residents)
    verifications: dict[str, Verification] = field(default_factory=dict)
    evictions: list[Eviction] = field(default_factory=list)  # not yet counted to a grant
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
    keeper: Feature | None = None  # keeps it from the requests of all others
    pressed: bool = False  # a pressure note is out

    debts: set[LeaseId] = field(default_factory=set)  # charged, not resident; kept by `invariants`

    def in_state(self, *states: LeaseState) -> list[Lease]:
        return self.residents.in_state(*states)

    def sees_loads(self) -> bool:
        """Whether a lease loads, and readings can tell how much it takes."""
        listed = self.sample is not None and self.sample.lists_processes
        return listed and self.residents.any_in(_LOADING)

    def quiet(self) -> bool:
        """Whether no lease loads or unloads, so that unattributed bytes mean something."""
        return not self.verifications and not self.residents.any_in(_MOVING)


class Core:
    """State plus the effects of the event being handled."""

    def __init__(self, settings: Settings, now: float, features: tuple[Feature, ...]) -> None:
        self.settings = settings
        self.features = features
        self.hooked = {hook: overriding(features, hook) for hook in HOOKS}
        self.started_at = now
        self.now = now
        self.turn = Turn()
        ageing_s = settings.ageing_s_per_point if settings.scheduling.by_priority else 0.0
        self.gpus: dict[GpuId, Gpu] = {
            info.id: Gpu(
                info, GpuLedger(info, settings.verify_tolerance_bytes), WaitQueue(ageing_s)
            )
            for info in sorted(settings.gpus, key=lambda info: info.index)
        }
        self.leases: dict[LeaseId, Lease] = {}
        self._of_process: dict[ProcessKey, dict[LeaseId, Lease]] = {}
        self._of_client: dict[ClientId, dict[LeaseId, Lease]] = {}
        self.waiting: dict[LeaseId, Lease] = {}
        self._waiting_by: dict[
            ProcessKey | int, int
        ] = {}  # waiters of each process and of each uid
        self.nonces: dict[tuple[ProcessKey, str], LeaseId] = {}
        self.clients: dict[ClientId, Client] = {}
        self.connected: dict[ProcessKey, int] = {}  # connections of each process
        self.instances: dict[
            tuple[ProcessKey, str], ClientId
        ] = {}  # the connection of each client object
        self.ended: OrderedDict[LeaseId, Ended] = OrderedDict()
        self.timers = Timers()
        self.serial = 0
        self.token_offset = 0  # tokens are ahead of `serial` by so much
        self.arrivals = 0
        self.last_token = Token(settings.epoch, 0)
        self.users: dict[
            ProcessKey, dict[tuple[LeaseId, UseId], Lease]
        ] = {}  # whose busy uses are where
        self.counted = (
            NOT_COUNTED  # waiters in queues, and all, when the invariants counted them last
        )
        self.last_client_at = now
        self.drain: Order | None = None  # an operator wants no new grants
        # None: serving; else the leases still to be accounted for
        self.recovering: set[LeaseId] | None = None
        self.footprints = Footprints()
        self.footprints.restore(settings.footprints)
        self.refusals: dict[ProcessKey, Refusals] = {}  # the latest last
        self.reuse: dict[str, Reuse] = {}  # by consumer
        self.crashes: dict[str, Failures] = {}  # by model, the latest last
        # (consumer that left, consumer it left for) → when last
        self.switches: dict[tuple[str, str], float] = {}
        self.durations: dict[str, dict[str, deque[float]]] = {}
        for consumer, medians in sorted(settings.learnt.items()):
            for phase, seconds in sorted(medians.items()):
                self.learn(consumer, phase, seconds)
        for gpu in self.gpus.values():
            self.wake(gpu)

    # -- effects
    def reply(self, client: ClientId, request: RequestId, body: AnyReply) -> None:
        self.turn.effects.append(Reply(client, request, body))

    def refuse(self, client: ClientId, request: RequestId, refusal: Refusal) -> None:
        self.turn.effects.append(Refuse(client, request, refusal))

    def push(self, lease: Lease, body: AnyPush) -> None:
        self.turn.effects.append(Push(self.voice_of(lease), body))

    def note(self, kind: str, lease: Lease | None = None, **data: Any) -> None:
        facts: dict[str, Any] = {}
        if lease is not None:
            facts = {"lease_id": lease.id, "consumer": lease.spec.consumer, "gpu": lease.gpu}
            if lease.request.traceparent is not None:
                facts["traceparent"] = lease.request.traceparent
        self.turn.effects.append(Note(kind, {**facts, **data}))

    def journal(self, key: str, record: Mapping[str, Any], *, gates: bool = False) -> None:
        self.turn.effects.append(JournalPut(key, record, gates))

    def forget(self, key: str) -> None:
        self.turn.effects.append(JournalDelete(key))

    def want_sample(self, gpu: Gpu, not_before: float) -> None:
        """Ask for a reading that begins at `not_before` or later, unless such a one is
        under way."""
        if gpu.asked_at is None or gpu.asked_at < not_before:
            gpu.asked_at = self.now
            self.turn.effects.append(Sample(gpu.info.id))

    def read_again(self, gpu: Gpu, after_s: float) -> None:
        """The next background reading comes in `after_s` at the latest."""
        key = ("probe", gpu.info.id)
        planned, due = self.timers.due(key), self.now + after_s
        if planned is None or due < planned:
            self.timers.set(key, due)

    # -- bookkeeping
    def voice_of(self, lease: Lease) -> ClientId:
        """Where pushes about a lease go: its client, or another living connection of the same
        process."""
        client = self.clients.get(lease.client)
        if client is not None and client.process == lease.process:
            return lease.client
        others = sorted(c.id for c in self.clients.values() if c.process == lease.process)
        return others[0] if others else lease.client

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
        """The card of a resident lease."""
        assert lease.gpu is not None, f"{lease.id} has no card"
        return self.gpus[lease.gpu]

    def wake(self, gpu: Gpu) -> None:
        """Serve the queue of a GPU in this turn: something changed that a waiter there may wait
        for."""
        self.turn.dirty[gpu.info.index] = gpu
        self.turn.touch(gpu)

    def join(self, client: Client) -> None:
        """A connection begins."""
        self.clients[client.id] = client
        self.connected[client.process] = self.connected.get(client.process, 0) + 1

    def part(self, client: ClientId) -> None:
        """A connection is over."""
        process = self.clients.pop(client).process
        self.connected[process] -= 1
        if not self.connected[process]:
            del self.connected[process]

    def add(self, lease: Lease) -> None:
        """A lease begins to live."""
        self.leases[lease.id] = lease
        self._of_process.setdefault(lease.process, {})[lease.id] = lease
        self._of_client.setdefault(lease.client, {})[lease.id] = lease

    def hand_to(self, lease: Lease, client: ClientId) -> None:
        """Another connection of its process speaks for a lease from now on."""
        _take_out(self._of_client, lease.client, lease.id)
        lease.client = client
        self._of_client.setdefault(client, {})[lease.id] = lease

    def leases_of_client(self, client: ClientId) -> list[Lease]:
        """Live leases that a connection speaks for."""
        return list(self._of_client.get(client, {}).values())

    def count_of_client(self, client: ClientId) -> int:
        return len(self._of_client.get(client, {}))

    def waiting_by(self, process: ProcessKey, uid: int) -> tuple[int, int]:
        """Waiters of a process, and of a user."""
        return self._waiting_by.get(process, 0), self._waiting_by.get(uid, 0)

    def disagreement(self) -> str:
        """Where the tables of owners and the leases disagree; "" if nowhere. Looks at everybody:
        for tests."""
        by_process = {
            lease_id: owner for owner, some in self._of_process.items() for lease_id in some
        }
        by_client = {
            lease_id: owner for owner, some in self._of_client.items() for lease_id in some
        }
        for lease in self.leases.values():
            if (by_process.pop(lease.id, None), by_client.pop(lease.id, None)) != (
                lease.process,
                lease.client,
            ):
                return f"{lease.id} is not listed under its process and its client"
        if by_process or by_client:
            return f"{sorted({**by_process, **by_client})} are listed and gone"
        busy = {(*use, lease.id) for lease in self.leases.values() for use in lease.uses}
        if odd := busy ^ {
            (who, use, lease) for who, mine in self.users.items() for lease, use in mine
        }:
            return f"{sorted(odd)}: uses are listed otherwise than they are"
        owners = Counter(
            owner for lease in self.waiting.values() for owner in (lease.process, lease.request.uid)
        )
        if owners != self._waiting_by:
            return f"waiters are {owners}, kept as {self._waiting_by}"
        counted = Counter(client.process for client in self.clients.values())
        return (
            ""
            if counted == self.connected
            else f"{counted} are connected, kept as {self.connected}"
        )

    def leases_of(self, process: ProcessKey) -> list[Lease]:
        """Live leases of a process, oldest first."""
        return list(self._of_process.get(process, {}).values())

    def mark(self, lease: Lease, use: Use) -> None:
        """A use is busy from now on."""
        lease.uses.paused.pop((use.process, use.id), None)
        lease.uses[use.process, use.id] = use
        self.users.setdefault(use.process, {})[lease.id, use.id] = lease
        self.turn.suspects.add(use.process)
        for feature in lease.features:
            feature.on_used(lease)

    def unmark(self, lease: Lease, use: Use) -> None:
        """A busy use ends or pauses."""
        del lease.uses[use.process, use.id]
        mine = self.users[use.process]
        del mine[lease.id, use.id]
        if not mine:
            del self.users[use.process]

    def move(self, lease: Lease, to: LeaseState, why: str) -> None:
        """Move a lease to another state and tell its features. Raises IllegalTransition."""
        before = lease.state
        lease.move(to, self.now, why)
        for feature in lease.features:
            feature.on_moved(self, lease, before)

    def next_state(self, lease: Lease) -> LeaseState | None:
        """Where a released lease goes once its bytes are measured gone; None: it is over then."""
        for feature in lease.features:
            if (state := feature.next_state(lease)) is not None:
                return state
        return None

    def enqueue(self, lease: Lease) -> None:
        """A lease begins to wait, on every card that it may be placed on."""
        self.hold_back(lease)
        for gpu_id in lease.request.gpus:
            self.gpus[gpu_id].queue.add(lease)
            self.wake(self.gpus[gpu_id])

    def hold_back(self, lease: Lease) -> None:
        """It waits, but in no queue yet."""
        self.waiting[lease.id] = lease
        for owner in (lease.process, lease.request.uid):
            self._waiting_by[owner] = self._waiting_by.get(owner, 0) + 1
        self.turn.suspects.add(lease.process)
        if lease.request.wait_timeout_s is not None:
            self.timers.set(
                ("wait", lease.id), lease.request.arrived_at + lease.request.wait_timeout_s
            )

    def dequeue(self, lease: Lease) -> None:
        if self.waiting.pop(lease.id, None) is not None:
            for owner in (lease.process, lease.request.uid):
                self._waiting_by[owner] -= 1
                if not self._waiting_by[owner]:
                    del self._waiting_by[owner]
        self.timers.clear(("wait", lease.id))
        for gpu_id in lease.request.gpus:
            self.gpus[gpu_id].queue.discard(lease)
            self.wake(self.gpus[gpu_id])

    def end(self, lease: Lease, error: Refusal | None) -> None:
        """Drop a lease that reached a terminal state; a bounded memory of it stays."""
        del self.leases[lease.id]
        _take_out(self._of_process, lease.process, lease.id)
        _take_out(self._of_client, lease.client, lease.id)
        for kind in ("ttl", "revoke", "overstay", "users"):
            self.timers.clear((kind, lease.id))
        if lease.gpu is not None:
            gpu = self.gpus[lease.gpu]
            gpu.residents.pop(lease.id, None)
            self.wake(gpu)
        elif lease.token is not None:  # it was resident once: the journal knows it as away
            self.forget(f"lease:{lease.id}")
        earlier = tuple(lease.request.earlier_nonces)
        revoked = None if lease.departure.eviction is None else lease.departure.eviction.why
        ended = Ended(
            lease.id,
            lease.process,
            lease.request.nonce,
            lease.token,
            lease.state,
            error,
            earlier,
            revoked,
        )
        self.remember(ended)

    def remember(self, ended: Ended) -> None:
        self.ended[ended.lease] = ended
        while len(self.ended) > ENDED_REMEMBERED:
            _, oldest = self.ended.popitem(last=False)
            for nonce in (oldest.nonce, *oldest.earlier_nonces):
                self.nonces.pop((oldest.process, nonce), None)

    def learn(self, consumer: str, phase: str, seconds: float) -> None:
        """Remember how long a phase (`drain_s`, `unload_s`, `verify_s`, `load_s`) took for a
        consumer."""
        phases = self.durations.pop(consumer, {})
        self.durations[consumer] = phases  # the newest last
        _forget_oldest(self.durations)
        phases.setdefault(phase, deque(maxlen=LEARNT_REMEMBERED)).append(max(0.0, seconds))

    def seen_leaving(self, consumer: str) -> None:
        """A consumer's bytes are gone: whether it is wanted again soon is learnt from now on."""
        seen = self.reuse.pop(consumer, None) or Reuse()
        self.reuse[consumer] = seen
        seen.left_at = self.now
        _forget_oldest(self.reuse)

    def learnt_s(self, consumer: str, phase: str) -> float | None:
        """Median of what was learnt; None: never seen."""
        seen = self.durations.get(consumer, {}).get(phase)
        return median(seen) if seen else None

    def record_lease(self, lease: Lease, *, debt: bool = False, gates: bool = False) -> None:
        """Write a lease that is resident (or its debt) or away to the journal. `gates`: it is a
        grant, which does not take place unless its record is written. Whatever else is recorded has
        happened; a stale record makes a later recovery more careful.
        """
        spec = lease.spec
        charge_bytes = 0 if lease.gpu is None else self.gpu_of(lease).ledger.charge_bytes(lease.id)
        assert lease.token is not None, f"{lease.id} is recorded without a token"
        asked = (
            lease.departure.revoked_before and lease.state is LeaseState.HELD
        )  # and not by this daemon yet
        features = {
            key: value
            for feature in lease.features
            for key, value in feature.to_record(lease).items()
        }
        users = [[*astuple(use.process), use.id, use.label] for use in lease.users()]
        self.journal(
            f"lease:{lease.id}",
            {
                "lease_id": lease.id,
                "token": [lease.token.epoch, lease.token.serial],
                "state": "debt" if debt else str(LeaseState.REVOKING if asked else lease.state),
                "gpu": lease.gpu,
                "pid": lease.process.pid,
                "start_ticks": lease.process.start_ticks,
                "nonce": lease.request.nonce,
                "held_from": lease.held_from,
                "charge_bytes": charge_bytes,
                "load_peak_bytes": lease.request.load_peak_bytes,
                "measured_bytes": lease.observed.reported_bytes,
                "exiting": lease.departure.exiting,
                "pinned": None if lease.pinned is None else [lease.pinned.by, lease.pinned.reason],
                **({"users": users} if users else {}),
                **features,
                "spec": {
                    "consumer": spec.consumer,
                    "model_id": spec.key.model_id,
                    "revision": spec.key.revision,
                    "gpu": spec.gpu,
                    "exclusive": spec.exclusive,
                    "load_peak_bytes": spec.load_peak_bytes,
                    "steady_bytes": spec.steady_bytes,
                    "residue_bytes": spec.residue_bytes,
                    "priority": spec.priority,
                    "evictable": spec.evictable,
                    "ttl_s": spec.ttl_s,
                    "min_residency_s": spec.min_residency_s,
                    "deny_on_deadline": spec.deny_on_deadline,
                    "standby": spec.standby,
                    "on_overstay": spec.on_overstay,
                    "park_bytes": spec.park_bytes,
                    "independent": spec.independent,
                    "gang": None if spec.gang is None else [*spec.gang],
                },
            },
            gates=gates,
        )

    def record_residue(self, gpu: Gpu, process: ProcessKey, residue_bytes: int) -> None:
        """Write (or, with 0, delete) what a process keeps."""
        key = f"residue:{process}:{gpu.info.id}"
        if not residue_bytes:
            self.forget(key)
            return
        self.journal(
            key,
            {
                "pid": process.pid,
                "start_ticks": process.start_ticks,
                "gpu": gpu.info.id,
                "residue_bytes": residue_bytes,
                "floor_bytes": gpu.ledger.accounts[process].residue_floor_bytes,
            },
        )

    def active(self, gpu: Gpu) -> bool:
        """Whether a client, a lease or a waiter concerns this GPU."""
        return bool(
            self.clients
            or gpu.residents
            or gpu.verifications
            or len(gpu.queue)
            or self.recovering
            or self.now - self.last_client_at <= IDLE_PROBE_S
        )


def _forget_oldest[T](by_consumer: dict[str, T]) -> None:
    """Names are free: what is remembered by them has a bound."""
    while len(by_consumer) > CONSUMERS_REMEMBERED:
        del by_consumer[next(iter(by_consumer))]


def _take_out[K](table: dict[K, dict[LeaseId, Lease]], owner: K, lease_id: LeaseId) -> None:
    """An owner without leases has no entry."""
    some = table[owner]
    del some[lease_id]
    if not some:
        del table[owner]
