"""Drive the sans-IO core by hand: a clock that only moves when told, simulated GPUs that answer
`Sample`, a journal in a dict.

For tests of the core and of whatever stands on it. Knows nothing of sockets or real GPUs; never
sleeps.

    driver = CoreDriver(capacity_bytes=8 * GIB)
    vlm = driver.consumer("vlm")
    lease = vlm.acquire(load_peak_bytes=3 * GIB)
    vlm.load(lease)                        # bytes appear on the GPU, `ready` is sent
    driver.until(lambda: driver.state(lease) == "held")
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgpack

from tests.support.core_checks import well_formed, well_typed
from tests.support.full_check import check_arbiter
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import (
    Effect,
    JournalDelete,
    JournalPut,
    Note,
    Push,
    Refuse,
    Reply,
    Sample,
)
from vram_arbiter.arbiter.core.events import (
    BYE,
    Asked,
    ClientConnected,
    ClientLeft,
    Event,
    JournalFailed,
    MemorySampled,
    ProbeFailed,
    ProcessDied,
    ProcessUse,
    Recovered,
    Tick,
)
from vram_arbiter.arbiter.core.model.refusals import NotJournaled
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.arbiter.host.records import records_of
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.codec import from_map, to_map
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token, UseId
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.replies import AcquireReply
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

READING_S = 0.001
"""How long a simulated reading takes."""
START_S = 1000.0
"""When the driver makes its core."""


@dataclass(slots=True)
class SimDevice:
    """A GPU that shows what it was told. Bytes that are given up come back `lag_s` later."""

    gpu: GpuId
    total_bytes: int
    overhead_bytes: int = 0
    lag_s: float = 0.0
    lists_processes: bool = True
    knows_bytes: bool = True  # False: the driver lists processes without their bytes
    failing: str = ""  # not empty: readings fail with this reason
    lies: Mapping[str, Any] = field(
        default_factory=dict
    )  # fields of a reading that are not as they should be
    silent: bool = False  # readings hang and never answer
    reading_s: float = READING_S
    held: dict[ProcessKey, int] = field(default_factory=dict)
    names: dict[ProcessKey, str] = field(default_factory=dict)
    unlisted: set[ProcessKey] = field(default_factory=set)  # counted in the total only
    _late: list[tuple[float, ProcessKey, int]] = field(
        default_factory=list
    )  # (until, process, bytes still shown)

    def set(self, process: ProcessKey, count: int, now: float) -> None:
        """The process holds this many bytes now. What it gave up is shown until the lag is over."""
        before = self.held.get(process, 0)
        if count < before and self.lag_s:
            self._late.append((now + self.lag_s, process, before - count))
        if count:
            self.held[process] = count
        else:
            self.held.pop(process, None)

    def shown(self, now: float) -> dict[ProcessKey, int]:
        """Bytes per process as a reading sees them."""
        seen = dict(self.held)
        for until, process, count in self._late:
            if until > now:
                seen[process] = seen.get(process, 0) + count
        return seen

    def read(self, now: float) -> MemorySampled | ProbeFailed:
        if self.failing:
            return ProbeFailed(self.gpu, now, self.failing)
        seen = self.shown(now)
        processes = None
        if self.lists_processes:
            processes = tuple(
                ProcessUse(
                    process,
                    self.names.get(process, f"p{process.pid}"),
                    count if self.knows_bytes else None,
                )
                for process, count in sorted(seen.items())
                if process not in self.unlisted
            )
        sample = MemorySampled(
            self.gpu,
            now,
            min(self.total_bytes, sum(seen.values()) + self.overhead_bytes),
            self.total_bytes,
            processes,
        )
        return replace(sample, **self.lies)


class CoreDriver:
    """One core, its GPUs, its journal, and everything that it ever said."""

    def __init__(
        self,
        capacity_bytes: int = 8 * d.GIB,
        *,
        gpus: int = 1,
        reserve_bytes: int = d.RESERVE_BYTES,
        settings: Mapping[str, Any] | None = None,
        start: bool = True,
        engine: Callable[[Settings, float], Arbiter] = Arbiter,
    ) -> None:
        self.now = START_S
        infos = tuple(
            GpuInfo(
                GpuId(f"GPU-{index}"),
                index,
                f"simulated {index}",
                capacity_bytes,
                reserve_bytes,
                total_bytes=capacity_bytes,
            )
            for index in range(gpus)
        )
        self.devices = {info.id: SimDevice(info.id, capacity_bytes) for info in infos}
        self.settings = Settings(epoch=1, gpus=infos, **(settings or {}))
        self._engine = engine
        self.arbiter = engine(self.settings, self.now)
        self.effects: list[Effect] = []
        self.events: list[tuple[float, Event]] = []
        self.journal: dict[str, Mapping[str, Any]] = {}
        self.journal_failing = ""
        self._readings: list[tuple[float, MemorySampled | ProbeFailed]] = []
        self._requests = 0
        self._pids = 100
        self.after_event: Callable[[], None] | None = None  # a test's own invariants
        if start:
            self.advance(0.01)  # the first reading

    @property
    def device(self) -> SimDevice:
        """The first GPU."""
        return next(iter(self.devices.values()))

    # -- time and events
    def post(self, event: Event) -> list[Effect]:
        """Hand one event to the core at the present time and perform what it asks. Returns exactly
        those effects."""
        self.events.append((self.now, event))
        effects = self.arbiter.handle(event, self.now)
        check_arbiter(self.arbiter)
        well_formed(event, effects, self.arbiter.inspect())
        failed: list[JournalPut] = []
        held_back: list[JournalPut] = []
        performed: list[Effect] = []
        for effect in effects:
            if held_back and _names(effect, held_back[0].key.removeprefix("lease:")):
                if isinstance(effect, Reply):
                    key = held_back[0].key
                    lease = key.removeprefix("lease:")
                    held_back_by = NotJournaled(lease, key, self.journal_failing)
                    performed.append(Refuse(effect.client, effect.request, held_back_by))
                continue  # held back with its record, as the executor does
            performed.append(effect)
            match effect:
                case JournalPut():
                    if self.journal_failing:
                        failed.append(effect)
                        held_back += [effect] if effect.gates else []
                    else:
                        self.journal[effect.key] = as_wire(effect.record)
                case JournalDelete():
                    self.journal.pop(effect.key, None)
                case Sample():
                    device = self.devices[effect.gpu]
                    if not device.silent:
                        self._readings.append((self.now + device.reading_s, device.read(self.now)))
                case _:
                    pass
        self.effects += performed
        for put in failed:
            self.post(JournalFailed(put.key, self.journal_failing, put.gates))
        if self.after_event is not None:
            self.after_event()
        return effects

    def advance(self, seconds: float) -> None:
        """Let time pass: readings arrive and timers fire in their order."""
        target = self.now + seconds
        while True:
            reading = min(self._readings, key=lambda item: item[0], default=None)
            deadline = self.arbiter.next_deadline()
            if (
                reading is not None
                and reading[0] <= target
                and (deadline is None or reading[0] <= deadline)
            ):
                self._readings.remove(reading)
                self.now = max(self.now, reading[0])
                self.post(reading[1])
            elif deadline is not None and deadline <= target:
                self.now = max(self.now, deadline)
                self.post(Tick())
            else:
                self.now = target
                return

    def until(
        self, condition: Callable[[], bool], limit_s: float = 60.0, step_s: float = 0.005
    ) -> float:
        """Let time pass until something is true. Returns the seconds it took; raises AssertionError
        at the limit."""
        began = self.now
        while not condition():
            if self.now - began > limit_s:
                raise AssertionError(f"not within {limit_s} s; last effects: {self.effects[-8:]}")
            self.advance(step_s)
        return self.now - began

    def shrink(self, gpu: GpuId, capacity_bytes: int) -> None:
        """Another, smaller GPU is in the place of this one from the next `restart` on."""
        gpus = tuple(
            replace(info, capacity_bytes=capacity_bytes, total_bytes=capacity_bytes)
            if info.id == gpu
            else info
            for info in self.settings.gpus
        )
        self.settings = replace(self.settings, gpus=gpus)
        self.devices[gpu].total_bytes = capacity_bytes

    def restart(self, *, epoch: int = 2, keep_journal: bool = True, start: bool = True) -> None:
        """kill -9 of the daemon: a new core, the journal's records, no memory of anything else.
        `start`: until the first reading."""
        self.settings = replace(self.settings, epoch=epoch)
        self.arbiter = self._engine(self.settings, self.now)
        self._readings.clear()
        self.post(Recovered(records_of(self.journal) if keep_journal else {}))
        if start:
            self.advance(0.01)

    # -- people
    def consumer(
        self, name: str, *, pid: int | None = None, priority: int = d.PRIORITY, uid: int = 1000
    ) -> "Consumer":
        """A process with one connection."""
        if pid is None:
            self._pids += 1
            pid = self._pids
        process = ProcessKey(pid, 7 * pid)
        client = ClientId(f"c{pid}")
        person = Consumer(self, name, process, client, priority, uid)
        for device in self.devices.values():
            device.names[process] = name
        person.connect()
        return person

    def next_request(self) -> RequestId:
        self._requests += 1
        return RequestId(self._requests)

    # -- looking
    def view(self, lease: LeaseId) -> dict[str, Any] | None:
        """The lease as `status` shows it; None when it is over."""
        views = self.status()["leases"]
        return next((view for view in views if view["lease_id"] == lease), None)

    def status(
        self,
        reader: ProcessKey | None = None,
        after: Sequence[Any] | None = None,
        limit: int | None = None,
        *,
        details: bool = False,
    ) -> dict[str, Any]:
        """The status as the wire shows it."""
        page: Any = None if after is None else tuple(after)
        told = self.arbiter.status(self.now, reader, page, limit, details=details)
        well_typed(told)
        return as_wire(words.reply(told))

    def blocked(self, index: int = 0) -> str:
        """Why nothing is granted on a GPU, a code; "" if grants are possible."""
        why = self.gpu(index)["blocked"]
        return "" if why is None else str(why["code"])

    def why(self, consumer: str) -> dict[str, Any]:
        """The answer to `why` as the wire shows it, with its words."""
        told = self.arbiter.why(consumer, self.now)
        well_typed(told)
        return as_wire(words.reply(told))

    def state(self, lease: LeaseId) -> str:
        """The state of a lease; "over" once it has none."""
        found = self.arbiter.inspect().leases.get(lease)
        return "over" if found is None else str(found.state)

    def notes(self, kind: str) -> list[Mapping[str, Any]]:
        return [
            msgpack.unpackb(msgpack.packb(words.event(effect)))
            for effect in self.effects
            if isinstance(effect, Note) and effect.kind == kind
        ]

    def pushes(self, kind: str, lease: LeaseId | None = None) -> list[Mapping[str, Any]]:
        """Pushes of a kind; those about one lease if it is given."""
        pushed = [e.body for e in self.effects if isinstance(e, Push)]
        found = [as_wire(words.push(body)) for body in pushed if body.TAG[1] == kind]
        return [
            b
            for b in found
            if lease is None or lease in (b.get("lease_id"), b.get("lease", {}).get("lease_id"))
        ]

    def gpu(self, index: int = 0) -> dict[str, Any]:
        """The GPU as `status` shows it."""
        shown: dict[str, Any] = self.status()["gpus"][index]
        return shown


@dataclass(slots=True)
class Consumer:
    """A process that leases, as its client library would: remembers its tokens, answers for its
    bytes on the GPU."""

    driver: CoreDriver
    name: str
    process: ProcessKey
    client: ClientId
    priority: int = d.PRIORITY
    uid: int = 1000
    specs: dict[LeaseId, LeaseSpec] = field(default_factory=dict)
    nonces: int = 0
    traceparent: str | None = None  # sent with what it asks for

    # -- connection
    def connect(self) -> list[Effect]:
        return self.driver.post(
            ClientConnected(
                self.client, self.process, self.uid, self.name, f"{self.name}-{self.client}"
            )
        )

    def leave(self, reason: str = BYE) -> list[Effect]:
        return self.driver.post(ClientLeft(self.client, reason))

    def die(self) -> list[Effect]:
        """kill -9: the bytes go back to the GPU after its lag, the kernel says that the process is
        gone."""
        for device in self.driver.devices.values():
            device.set(self.process, 0, self.driver.now)
        return self.driver.post(ProcessDied(self.process))

    # -- requests
    def spec(
        self,
        load_peak_bytes: int,
        steady_bytes: int | None = None,
        *,
        residue_bytes: int = 0,
        exclusive: bool = False,
        priority: int | None = None,
        evictable: bool = True,
        gpu: str = "any",
        ttl_s: float = 3600.0,
        min_residency_s: float = 0.0,
        standby: bool = False,
        park_bytes: int = 0,
        key: str | None = None,
        cgroup: str | None = None,
    ) -> LeaseSpec:
        """A spec with the bytes that matter; no residue, no residency and a long ttl unless asked
        for.
        """
        steady_bytes = load_peak_bytes if steady_bytes is None else steady_bytes
        return LeaseSpec(
            consumer=self.name,
            model_id=key or f"{self.name}-model",
            gpu=gpu,
            mode="exclusive" if exclusive else "shared",
            footprint=Footprint(load_peak_bytes, steady_bytes, residue_bytes),
            priority=self.priority if priority is None else priority,
            evictable=evictable,
            ttl_s=ttl_s,
            min_residency_s=min_residency_s,
            standby=standby,
            park_bytes=park_bytes,
            cgroup=cgroup,
        )

    def acquire(
        self,
        load_peak_bytes: int,
        steady_bytes: int | None = None,
        *,
        wait_timeout_s: float | None = None,
        nonce: str | None = None,
        **spec: Any,
    ) -> LeaseId:
        """Ask for a lease. Returns its id; raises AssertionError if it is refused (see
        `try_acquire`)."""
        effects = self.try_acquire(
            load_peak_bytes, steady_bytes, wait_timeout_s=wait_timeout_s, nonce=nonce, **spec
        )
        bodies = (e.body for e in effects if isinstance(e, Reply))
        reply = next((body for body in bodies if isinstance(body, AcquireReply)), None)
        if reply is None:
            raise AssertionError(
                f"{self.name} was refused: {[e for e in effects if isinstance(e, Refuse)]}"
            )
        lease = LeaseId(reply.lease.lease_id)
        self.specs[lease] = self.spec(load_peak_bytes, steady_bytes, **spec)
        return lease

    def try_acquire(
        self,
        load_peak_bytes: int,
        steady_bytes: int | None = None,
        *,
        wait_timeout_s: float | None = None,
        nonce: str | None = None,
        **spec: Any,
    ) -> list[Effect]:
        """Ask for a lease; every effect of it."""
        self.nonces += 1
        wanted = self.spec(load_peak_bytes, steady_bytes, **spec)
        return self.ask(w.Acquire(nonce or f"n{self.nonces}", wanted, wait_timeout_s))

    def token(self, lease: LeaseId) -> Token:
        view = self.driver.view(lease)
        if view is None or view["token"] is None:
            raise AssertionError(f"{lease} has no token: {view}")
        return Token(*view["token"])

    def ready(self, lease: LeaseId, measured_bytes: int | None = None) -> list[Effect]:
        return self.ask(w.Ready(lease, self.token(lease), measured_bytes))

    def use_begin(
        self, lease: LeaseId, use: str = "u1", token: Token | None = None, label: str = ""
    ) -> list[Effect]:
        return self.ask(w.UseBegin(lease, token or self.token(lease), UseId(use), label))

    def use_end(self, lease: LeaseId, use: str = "u1", token: Token | None = None) -> list[Effect]:
        return self.ask(w.UseEnd(lease, token or self.token(lease), UseId(use)))

    def renew(self, *leases: tuple[LeaseId, Token]) -> list[Effect]:
        return self.ask(w.Renew(tuple(w.LeaseRef(*lease) for lease in leases)))

    def ack(self, lease: LeaseId, eta_s: float | None = None) -> list[Effect]:
        return self.ask(w.RevokeAck(lease, self.token(lease), eta_s))

    def unloading(self, lease: LeaseId) -> list[Effect]:
        return self.ask(w.Unloading(lease, self.token(lease)))

    def release(
        self,
        lease: LeaseId,
        *,
        exiting: bool = False,
        token: Token | None = None,
        parked: bool = False,
    ) -> list[Effect]:
        return self.ask(w.Release(lease, token or self.token(lease), exiting, parked))

    def cancel(self, lease: LeaseId) -> list[Effect]:
        return self.ask(w.Cancel(lease))

    def reacquire(
        self, lease: LeaseId, *, wait_timeout_s: float | None = None, token: Token | None = None
    ) -> list[Effect]:
        return self.ask(w.Reacquire(lease, token or self.token(lease), wait_timeout_s))

    def oom(
        self, lease: LeaseId, requested_bytes: int, allocated_bytes: int | None = None
    ) -> list[Effect]:
        return self.ask(w.Oom(lease, self.token(lease), requested_bytes, allocated_bytes))

    def order(
        self, action: str, target: str = "", reason: str = "test", by: str = "ops"
    ) -> list[Effect]:
        """An operator's action. `target`: "" for drain and resume."""
        return self.ask(w.REQUESTS[action](reason, *([target] if target else [])), by)

    def ask(self, request: w.AnyRequest, operator: str = "") -> list[Effect]:
        """Send any request."""
        number = self.driver.next_request()
        return self.driver.post(Asked(self.client, number, request, self.traceparent, operator))

    def reattach(
        self,
        lease: LeaseId,
        token: Token,
        *,
        held: bool = True,
        measured_bytes: int | None = None,
        uses: Sequence[str] = (),
        spec: LeaseSpec | None = None,
        away: bool = False,
        parked: bool = False,
    ) -> list[Effect]:
        item = w.ReattachLease(
            lease,
            token,
            spec or self.specs[lease],
            "parked" if parked else "standby" if away else "held" if held else "loading",
            measured_bytes,
            tuple(UseId(use) for use in uses),
        )
        return self.ask(w.Reattach((item,)))

    # -- as a cooperative holder
    def hold(self, count: int, *, gpu: GpuId | None = None) -> None:
        """Bytes of this process on a GPU from now on."""
        device = self.driver.device if gpu is None else self.driver.devices[gpu]
        device.set(self.process, count, self.driver.now)

    def load(self, lease: LeaseId, measured_bytes: int | None = None) -> list[Effect]:
        """Load: the steady bytes appear on the lease's GPU, then `ready`."""
        view = self.driver.view(lease)
        if view is None:
            raise AssertionError(f"{lease} is over")
        steady = (
            self.specs[lease].footprint.steady_bytes if measured_bytes is None else measured_bytes
        )
        self.hold(steady, gpu=GpuId(str(view["gpu"])))
        return self.ready(lease, measured_bytes)

    def unload(
        self, lease: LeaseId, *, unload_s: float = 0.0, parked: bool = False
    ) -> list[Effect]:
        """At a safe point: `unloading`, the bytes go (to host RAM if `parked`) but for the residue,
        `release`."""
        view = self.driver.view(lease)
        if view is None:
            raise AssertionError(f"{lease} is over")
        self.unloading(lease)
        self.driver.advance(unload_s)
        self.hold(self.specs[lease].footprint.residue_bytes, gpu=GpuId(str(view["gpu"])))
        return self.release(lease, parked=parked)


def as_wire(message: object) -> dict[str, Any]:
    """A message as a client reads it: codes are texts, tuples are lists."""
    found: dict[str, Any] = msgpack.unpackb(msgpack.packb(to_map(message)))
    return found


def refusal(effects: Sequence[Effect]) -> ErrorView:
    """The one refusal among effects. Raises AssertionError if there is none."""
    found = [effect for effect in effects if isinstance(effect, Refuse)]
    if len(found) != 1:
        raise AssertionError(f"{len(found)} refusals in {list(effects)}")
    error = as_wire(words.error_view(found[0].refusal))
    return from_map(ErrorView, error)


def answer(effects: Sequence[Effect]) -> Mapping[str, Any]:
    """The body of the one reply among effects. Raises AssertionError if there is none."""
    found = [effect for effect in effects if isinstance(effect, Reply)]
    if len(found) != 1:
        raise AssertionError(f"{len(found)} replies in {list(effects)}")
    return as_wire(words.reply(found[0].body))


def _names(effect: Effect, lease: str) -> bool:
    """Is this effect about a lease? As the executor decides what to hold back with a record that
    could not be written."""
    match effect:
        case Reply() | Push():
            view = getattr(effect.body, "lease", None)
            return lease in (getattr(effect.body, "lease_id", None), view and view.lease_id)
        case Note():
            return effect.about is not None and effect.about.lease_id == lease
        case _:
            return False
