"""One small world: the engine, its journal, GPUs, clients, and what is under way between them.

An action is what may happen next (`World.actions`); `World.act` lets it happen and checks all that
must hold then. Nothing happens by itself, so the order of the actions is the whole story. Every
event has a moment of its own, `STEP_S` after the one before; time passes otherwise only by the
actions `tick` and `sleep`. It knows neither how worlds are searched nor which of them are alike.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Protocol

from tests.explore.clients import Broken, Hand, Talker, Told
from tests.support.engine_state import state_of
from tests.support.full_check import check_arbiter
from vram_arbiter.arbiter.core import effects as fx
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.arbiter.core.model.records import AnyRecord
from vram_arbiter.arbiter.core.model.refusals import NotJournaled
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.arbiter.host.records import processes_of
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.replies import AnyReply
from vram_arbiter.schemas.wire.spec import LeaseSpec

CAPACITY_BYTES = 8 * d.GIB
OVERHEAD_BYTES = 100 * d.MIB
"""The driver's own."""
STRANGER, STRANGER_BYTES = ProcessKey(9, 9), 150 * d.MIB
"""A process without a lease. With the driver's own bytes it fits the reserve."""
START_S = 1024.0
STEP_S = 2.0**-20
FOR_EVER_S, FAR_S = 3600.0, 600.0
"""The longest time to live; what is due so much later is not waited for."""
SLEEP_EVENTS_MAX = 400
QUICK: Mapping[str, Any] = {
    "ageing_s_per_point": 1e6,
    "revoke_resend_s": 1.0,
    "revoke_deadline_s": 4.0,
    "verify_timeout_s": 2.0,
    "verify_poll_s": (0.1, 0.25, 0.5),
    "verify_poll_until_s": (0.5, 1.0),
    "probe_load_s": 0.5,
    "fence_grace_s": 2.0,
    "host_ram_budget_bytes": 4 * d.GIB,
}
"""Constants of the engine in these worlds: few polls, so that more happens between two of them."""
FAULTS = frozenset(
    {
        *("cancel", "crash", "bye", "drop", "evict", "kill", "late", "fail", "full", "restart"),
        *("lie less", "lie more", "lie nonsense", "stranger", "suspend"),
    }
)
"""Verbs that happen only where a scenario allows it, and so often."""
_PERIODIC = ("probe", "verify", "revoke")

type Action = tuple[str, str]
"""(verb, whose): a client's or process's name, a GPU, or ""."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """What a world is made of. Clients with the same spec are alike.

    Args:
        clients: The spec of each client's lease; its consumer is the client's kind.
        acquires: How often each client asks.
        faults: Verbs that may happen only so often in one story (`World.actions`).
        borrows: Whether clients use the leases of others.
        lags: Whether the driver returns memory late.
        talks: Whether clients speak the client's protocol, with messages under way.
    """

    name: str
    clients: tuple[LeaseSpec, ...]
    gpus: int = 1
    acquires: int = 1
    wait_timeout_s: float | None = None
    faults: Mapping[str, int] = field(default_factory=dict)
    borrows: bool = False
    lags: bool = False
    lists: bool = True
    talks: bool = False
    engine: type[Arbiter] = Arbiter


class Client(Protocol):
    """One process that leases (`tests.explore.clients`)."""

    name: str
    spec: LeaseSpec
    process: ProcessKey
    client: ClientId
    connections: int
    lease: LeaseId  # "": none

    def connect(self, world: "World") -> None:
        """Say hello on a new connection, and what it had."""
        ...

    def actions(self, world: "World") -> Iterator[str]:
        """Yield the verbs of what it may do."""
        ...

    def act(self, verb: str, world: "World") -> None: ...

    def hear(self, told: Told, re: RequestId | None, epoch: int) -> None:
        """Take what the engine says to its connection."""
        ...

    def cut_off(self, world: "World") -> None:
        """The daemon is another one: no connection outlives it."""
        ...

    def has_mail(self) -> bool:
        """Whether a message from it or to it is under way."""
        ...

    def next_deadline(self) -> float | None: ...

    def tick(self, world: "World") -> None: ...

    def coming_bytes(self, gpu: GpuId, held_bytes: int) -> int:
        """Return what it may put on a GPU at any moment, beyond what it holds there."""
        ...

    def is_waiting(self) -> bool: ...

    def standing(self) -> tuple[Any, ...]:
        """Return what it is in, to order clients that are alike."""
        ...

    def is_excused(self) -> bool:
        """Whether it may hold bytes that are not charged: it has lost its lease."""
        ...

    def check(self, core: Core, others: Iterable["Client"]) -> None:
        """Raise Broken where the engine does not know what this client counts on."""
        ...


@dataclass(slots=True)
class Device:
    """One GPU, and the one reading of it that may be under way (`host.prober`)."""

    gpu: GpuId
    lists: bool
    held: dict[ProcessKey, int] = field(default_factory=dict)
    late: dict[ProcessKey, int] = field(default_factory=dict)  # given up, and shown all the same
    reading: ev.MemorySampled | None = None
    again: bool = False  # a question came after the reading began
    stuck: bool = False  # the reading hangs, and was told as failed

    def set(self, process: ProcessKey, count: int, *, lags: bool) -> None:
        """A process holds so many bytes from now on."""
        freed = self.held.pop(process, 0) - count
        if lags and freed > 0:
            self.late[process] = self.late.get(process, 0) + freed
        if count:
            self.held[process] = count

    def shown(self) -> dict[ProcessKey, int]:
        """Bytes as a reading sees them."""
        return {
            process: self.held.get(process, 0) + self.late.get(process, 0)
            for process in sorted(self.held.keys() | self.late.keys())
        }

    def begin(self, now: float) -> None:
        """Begin a reading, right after the event that asks for it."""
        shown = self.shown()
        listed = tuple(ev.ProcessUse(process, "", count) for process, count in shown.items())
        self.again = False
        self.reading = ev.MemorySampled(
            self.gpu,
            now + STEP_S / 2,
            OVERHEAD_BYTES + sum(shown.values()),
            CAPACITY_BYTES,
            listed if self.lists else None,
        )


@lru_cache(maxsize=64)
def _settings(gpus: int, epoch: int) -> Settings:
    infos = (
        GpuInfo(GpuId(f"GPU-{n}"), n, "", CAPACITY_BYTES, total_bytes=CAPACITY_BYTES)
        for n in range(gpus)
    )
    return Settings(epoch=epoch, gpus=tuple(infos), **QUICK)


class World:
    """See the module. `left`: how often each limited verb may still happen."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.now = START_S
        self.epoch = 0
        self.engine: Arbiter
        self.devices = {
            info.id: Device(info.id, scenario.lists) for info in _settings(scenario.gpus, 1).gpus
        }
        make = Talker if scenario.talks else Hand
        specs = zip("abcdef", scenario.clients, strict=False)
        self.clients: dict[str, Client] = {name: make(name, spec, scenario) for name, spec in specs}
        self.journal: dict[str, AnyRecord] = {}
        self.owed: set[str] = set()  # records to be deleted once the disk has room
        self.disk_full = False
        self.left = dict(scenario.faults)
        self.last_token = Token(0, 0)
        self.dead: set[ProcessKey] = set()
        self.unheard: list[ProcessKey] = []  # deaths that the daemon will hear of
        self.lied = False
        self._requests = 0
        self._reply: AnyReply | Refusal | None = None
        self._start()
        for client in self.clients.values():
            client.connect(self)
        for device in self._reading():
            self._answered(device, None)

    # -- what may happen
    def actions(self) -> list[Action]:
        """Return everything that may happen next."""
        left = self.left
        found = [
            (verb, name)
            for name, client in self.clients.items()
            for verb in client.actions(self)
            if left.get(verb, verb not in FAULTS)
        ]
        for gpu, device in self.devices.items():
            if device.reading is not None:
                lies = ("lie less", "lie more", "lie nonsense")
                found += [(verb, gpu) for verb in ("fail", *lies) if left.get(verb)]
                found.append(("read", gpu))
            found += [("answer", gpu)] if device.stuck else []
            found += [("return", gpu)] if device.late else []
        found += [("die", str(process)) for process in self.unheard]
        found += [(verb, "") for verb in ("restart", "suspend", "stranger") if left.get(verb)]
        if self.disk_full:
            found.append(("room", ""))
        elif left.get("full"):
            found.append(("full", ""))
        return found + [(verb, "") for verb in self._passing()]

    def _passing(self) -> list[str]:
        """Return how time may pass: not while anything is under way, unless that may be late."""
        busy = any(device.reading for device in self.devices.values()) or any(
            client.has_mail() for client in self.clients.values()
        )
        if busy:
            return ["late"] if self.left.get("late") and self._next_at() else []
        tick, sleep = self._next_at(), self._decisive_at()
        found = [] if tick is None else ["tick"]
        return found if sleep is None or sleep == tick else [*found, "sleep"]

    def act(self, action: Action) -> None:
        """Let something happen. Raises what must not be raised."""
        verb, whose = action
        if verb in self.left:
            self.left[verb] -= 1
        client = self.clients.get(whose)
        if client is not None:
            client.act(verb, self)
        else:
            getattr(self, f"do_{verb.partition(' ')[0]}")(*verb.split()[1:], *whose.split())
        self._check()

    # -- the engine's side
    def post(self, event: ev.Event) -> None:
        """Hand an event to the engine and perform what it asks, as the executor does."""
        self.now += STEP_S
        effects = self.engine.handle(event, self.now)
        check_arbiter(self.engine)
        failed: list[fx.JournalPut] = []
        for effect in self._written(effects, failed):
            match effect:
                case fx.Reply(client, number, body):
                    self._tell(client, body, number)
                case fx.Refuse(client, number, refusal):
                    self._tell(client, refusal, number)
                case fx.Push(client, body):
                    self._tell(client, body, None)
                case fx.Sample(gpu):
                    self._sample(self.devices[gpu])
                case _:
                    pass
        for put in failed:
            self.post(ev.JournalFailed(put.key, "full", put.gates))

    def _written(
        self, effects: list[fx.Effect], failed: list[fx.JournalPut]
    ) -> Iterator[fx.Effect]:
        """Write the journal, and yield what is performed although records may have `failed`."""
        gone: dict[str, str] = {}
        for effect in effects:
            match effect:
                case fx.JournalPut(key, record, gates):
                    if gates:
                        self._check_token(Token(*record.token))  # type: ignore[union-attr]
                    if not self.disk_full:
                        self.journal[key] = record
                        continue
                    failed.append(effect)
                    if gates:
                        gone[key.removeprefix("lease:")] = key
                case fx.JournalDelete(key):
                    if self.disk_full:
                        self.owed.add(key)
                    else:
                        self.journal.pop(key, None)
                case _:
                    view = getattr(getattr(effect, "body", None), "lease", None)
                    key = gone.get(getattr(view, "lease_id", ""), "")
                    if not key:
                        yield effect
                    elif isinstance(effect, fx.Reply):
                        lost = NotJournaled(key.removeprefix("lease:"), key, "full")
                        yield fx.Refuse(effect.client, effect.request, lost)

    def _tell(self, client: ClientId, told: Told, re: RequestId | None) -> None:
        if re is not None:
            self._reply = told  # type: ignore[assignment]
        if (known := self.clients.get(client.partition("-")[0])) is not None:
            known.hear(told, re, self.epoch)

    def ask(self, client: Client, request: w.AnyRequest) -> AnyReply | Refusal | None:
        """Send a request, and return its answer at once."""
        self._requests += 1
        self._reply = None
        self.post(ev.Asked(client.client, RequestId(self._requests), request))
        return self._reply

    def admit(self, client: Client) -> None:
        """A connection says hello."""
        known = client.process, 1000, client.name, client.name
        self.post(ev.ClientConnected(client.client, *known))

    def kill(self, process: ProcessKey) -> None:
        """A process dies: its bytes go, and the daemon will hear of it."""
        for device in self.devices.values():
            device.set(process, 0, lags=self.scenario.lags)
        self.dead.add(process)
        self.unheard.append(process)

    def _sample(self, device: Device) -> None:
        if device.reading is None and not device.stuck:
            device.begin(self.now)
        else:
            device.again = True

    def _start(self) -> None:
        """The daemon starts, perhaps after an earlier one."""
        self.epoch += 1
        self.engine = self.scenario.engine(_settings(self.scenario.gpus, self.epoch), self.now)
        for device in self.devices.values():
            device.reading, device.again, device.stuck = None, False, False
        self.unheard.clear()
        for client in self.clients.values():
            client.cut_off(self)
        if not self.journal:
            self.post(ev.Tick())
            return
        records = dict(self.journal)
        self.post(ev.Recovered(records))
        self.unheard += sorted(set(processes_of(records)) & self.dead)

    # -- verbs of no client
    def do_restart(self) -> None:
        self._start()

    def do_die(self, process: str) -> None:
        (found,) = [one for one in self.unheard if str(one) == process]
        self.unheard.remove(found)
        self.post(ev.ProcessDied(found))

    def do_suspend(self) -> None:
        self.post(ev.Resumed(60.0))

    def do_stranger(self) -> None:
        for device in self.devices.values():
            device.set(STRANGER, 0 if STRANGER in device.held else STRANGER_BYTES, lags=False)

    def do_full(self) -> None:
        self.disk_full = True

    def do_room(self) -> None:
        self.disk_full = False
        for key in self.owed:
            self.journal.pop(key, None)
        self.owed.clear()

    def do_return(self, gpu: str) -> None:
        self.devices[GpuId(gpu)].late.clear()

    def do_read(self, gpu: str) -> None:
        self._answered(self.devices[GpuId(gpu)], None)

    def do_fail(self, gpu: str) -> None:
        self._answered(self.devices[GpuId(gpu)], ev.ProbeFailed(GpuId(gpu), self.now, "failed"))

    def do_lie(self, kind: str, gpu: str) -> None:
        """A reading that shows an empty GPU, a full one, or what cannot be."""
        self.lied = True
        total = CAPACITY_BYTES
        device = self.devices[GpuId(gpu)]
        assert device.reading is not None
        used = {"less": 0, "more": total, "nonsense": 2 * total}[kind]
        listed = () if kind == "less" else device.reading.processes
        told = (device.gpu, device.reading.taken_at, used, total, listed)
        self._answered(device, ev.MemorySampled(*told))

    def do_answer(self, gpu: str) -> None:
        """A reading that hung returns; a fresh one tells whether the GPU can be read."""
        device = self.devices[GpuId(gpu)]
        device.stuck = False
        device.begin(self.now)

    def _answered(self, device: Device, instead: ev.MemorySampled | ev.ProbeFailed | None) -> None:
        """The reading under way is told, or something else in its place."""
        reading, device.reading = device.reading, None
        assert reading is not None
        self.post(reading if instead is None else instead)
        if device.again and device.reading is None:
            device.begin(self.now)

    # -- time
    def _next_at(self) -> float | None:
        """When time passes to by itself: the next deadline of the engine, of a client, or of a
        reading that is late."""
        late = [one.reading.taken_at + d.PROBE_DEADLINE_S for one in self._reading()]  # type: ignore[union-attr]
        return self._first([self.engine.next_deadline(), *self._client_times(), *late])

    def _reading(self) -> list[Device]:
        return [device for device in self.devices.values() if device.reading is not None]

    def _client_times(self) -> list[float | None]:
        return [client.next_deadline() for client in self.clients.values()]

    def _first(self, times: list[float | None]) -> float | None:
        soon = [at for at in times if at is not None and at < self.now + FAR_S]
        return min(soon, default=None)

    def _decisive_at(self) -> float | None:
        """Return when something is due that is not done again and again."""
        core = state_of(self.engine)
        times: list[float | None] = [*self._client_times()]
        times += [at for (kind, _), at in core.timers.items() if kind not in _PERIODIC]
        for gpu in core.gpus.values():
            times += [one.deadline_at for one in gpu.verifications.values() if not one.overdue]
            for lease in gpu.in_state(LeaseState.REVOKING):
                asked = lease.departure.eviction
                if asked is not None and not asked.overdue:
                    times.append(asked.asked_at + core.settings.revoke_deadline_s)
            unloading = gpu.in_state(LeaseState.UNLOADING)
            times += [core.timers.get(("revoke", lease.id)) for lease in unloading]
        return self._first(times)

    def do_tick(self) -> None:
        """Time passes to the next deadline, which is served."""
        at = self._next_at()
        assert at is not None
        self.now = max(self.now, at)
        for device in self._reading():
            assert device.reading is not None
            if self.now >= device.reading.taken_at + d.PROBE_DEADLINE_S:
                device.reading, device.stuck = None, True
                self.post(ev.ProbeFailed(device.gpu, self.now, "late"))
        for client in self.clients.values():
            due = client.next_deadline()
            if due is not None and due <= self.now:
                client.tick(self)
        due = self.engine.next_deadline()
        if due is not None and due <= self.now:
            self.post(ev.Tick())

    def do_late(self) -> None:
        self.do_tick()

    def do_sleep(self) -> None:
        """Time passes to the next decisive moment; readings on the way are told as they are."""
        until = self._decisive_at()
        assert until is not None
        for _event in range(SLEEP_EVENTS_MAX):
            reading = self._reading()
            for device in reading:
                self._answered(device, None)
            at = self._next_at()
            if not reading and (at is None or at > until):
                return
            if not reading:
                self.do_tick()
                if at == until or any(client.has_mail() for client in self.clients.values()):
                    return

    # -- what must hold
    def _check_token(self, token: Token) -> None:
        if token <= self.last_token:
            raise Broken(f"token {token} was granted after {self.last_token}")
        self.last_token = token

    def _check(self) -> None:
        core = state_of(self.engine)
        for client in self.clients.values():
            client.check(core, self.clients.values())
        for gpu_id, device in self.devices.items():
            if not self.lied:
                self._check_bytes(core, gpu_id, device)
            gpu = core.gpus[gpu_id]
            head = gpu.queue.head
            if head is None or core.blocked(gpu) or gpu.asked_at is not None:
                continue
            room = admission.measured_room_bytes(gpu, core.now - core.settings.sample_max_age_s)
            needed = admission.measured_need_bytes(gpu, head)
            if admission.fits(gpu, head) and room is not None and room >= needed:
                raise Broken(f"{head.id} fits on {gpu_id} and is not granted")

    def _check_bytes(self, core: Core, gpu: GpuId, device: Device) -> None:
        shown = device.shown()
        total = OVERHEAD_BYTES + sum(shown.values())
        ledger = core.gpus[gpu].ledger
        for client in self.clients.values():
            total += client.coming_bytes(gpu, device.held.get(client.process, 0))
        if total > CAPACITY_BYTES:
            raise Broken(f"{total} bytes are granted or occupied on {gpu}: {shown}")
        excused = {one.process for one in self.clients.values() if one.is_excused()}
        for process, held_bytes in device.held.items():
            account = ledger.accounts.get(process)
            charged = 0 if account is None else account.charged_bytes
            slack = 0 if device.lists else d.RESERVE_BYTES + d.VERIFY_TOLERANCE_BYTES
            if process not in {STRANGER, *excused} and held_bytes > charged + slack:
                raise Broken(f"{process} holds {held_bytes} bytes on {gpu}, {charged} are charged")
