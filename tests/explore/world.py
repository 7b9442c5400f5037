"""One small world: the engine, its journal, GPUs, clients, and what is under way between them.

An action is what may happen next (`World.actions`); `World.act` lets it happen and checks what must
hold then. Nothing else happens, so the order of the actions is the whole story. Every event has a
moment of its own, `STEP_S` after the one before; time passes otherwise only by `tick`, `late` and
`sleep`. It knows neither how worlds are searched nor which of them are alike.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

import msgpack

from tests.support.core_driver import SimDevice
from tests.support.engine_state import state_of
from tests.support.full_check import check_arbiter, forgotten_waiter
from vram_arbiter.arbiter.core import effects as fx
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.model.lease import EXPIRING, LeaseState
from vram_arbiter.arbiter.core.model.records import AnyRecord
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.arbiter.core.verification.judge import DYING_S
from vram_arbiter.arbiter.host.records import processes_of
from vram_arbiter.arbiter.rpc import codec, words
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol.protocol import ClientProtocol
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey, UseId
from vram_arbiter.schemas.runtime.msgpack_codec import pack
from vram_arbiter.schemas.wire import replies as y
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.spec import LeaseSpec

CAPACITY_BYTES, OVERHEAD_BYTES = 8 * d.GIB, 100 * d.MIB
"""Of each GPU; the driver's own."""
GPUS = tuple(
    GpuInfo(GpuId(f"GPU-{n}"), n, "", CAPACITY_BYTES, total_bytes=CAPACITY_BYTES) for n in range(2)
)
START_S, STEP_S = 1024.0, 2.0**-20
FOR_EVER_S, FAR_S = 3600.0, 600.0
"""The longest time to live; what is due so much later is not waited for."""
LAG_S = 1.5
"""The longest time in which a driver returns memory."""
QUICK: Mapping[str, Any] = {
    "ageing_s_per_point": 1e6,
    "revoke_resend_s": 4.0,
    "revoke_deadline_s": 4.0,
    "verify_timeout_s": 2.0,
    "verify_poll_s": (0.1, 0.25, 0.5),
    "verify_poll_until_s": (0.5, 1.0),
    "probe_load_s": 0.5,
    "fence_grace_s": 2.0,
}
"""Constants of the engine in these worlds: few polls, so that more happens between two of them."""
LIES: Mapping[str, int] = {"nothing": 0, "everything": CAPACITY_BYTES, "nonsense": 1 << 60}
"""Bytes that a lying reading shows as used."""
FAULTS = frozenset({"cancel", "crash", "drop", "fail", "late", "lie", "restart"})
"""Verbs that happen only where a scenario allows it, and so often."""
USE = UseId("u")
_PERIODIC = ("probe", "verify")
SLEEP_EVENTS_MAX = 1000

type Action = tuple[str, str]
"""(verb, whose): the name of a client, a process or a GPU; ""."""
type Told = fx.Reply | fx.Refuse | fx.Push


class Broken(AssertionError):
    """Something that must hold did not."""


def story(text: str) -> list[Action]:
    """Return `acquire a, load a, tick` as actions."""
    steps = [step.partition(" ") for step in text.split(", ") if step]
    return [(verb, whose) for verb, _, whose in steps]


@dataclass(frozen=True, slots=True)
class Scenario:
    """What a world is made of.

    Args:
        clients: The spec of each client's lease.
        acquires: How often each client asks.
        after: What has happened already, as `acquire a, load a`.
        faults: How often these verbs may happen in one story from then on.
        lags: Whether the driver returns memory late.
        talks: Whether messages are under way until they are sent and heard, and readings come at
            once; else it is the other way round.
    """

    name: str
    clients: tuple[LeaseSpec, ...]
    gpus: int = 1
    acquires: int = 1
    after: str = ""
    wait_timeout_s: float | None = None
    faults: Mapping[str, int] = field(default_factory=dict)
    lags: bool = False
    lists: bool = True
    talks: bool = False
    engine: type[Arbiter] = Arbiter


class Client:
    """One process with one lease at a time, an honest program over the client's protocol.

    It asks, loads, uses, and leaves when it is not in use, in any order. Its requests (`up`) and
    what it is told (`down`) are under way until they are sent or heard. `spec.consumer` is its
    kind; clients of a kind are alike. `uses`, `leaves`: it is in use; it may unload.
    """

    def __init__(self, name: str, spec: LeaseSpec, acquires: int) -> None:
        self.name, self.spec, self.acquires = name, spec, acquires
        self.connections = self.lives = 0
        self.begin()

    def begin(self) -> None:
        """A new process."""
        self.lives += 1
        pid = 100 * self.lives + ord(self.name)
        self.process = ProcessKey(pid, pid)
        self.protocol = ClientProtocol(name=self.name, instance=str(pid))
        self.gpu, self.bytes = GpuId(""), 0
        self.uses = self.leaves = False
        self._hang_up()

    def _hang_up(self) -> None:
        self.connections += 1
        self.client = ClientId(f"{self.name}-{self.connections}")
        self.up: list[ev.Asked] = []
        self.down: list[Told] = []

    @property
    def record(self) -> r.LeaseRecord | None:
        """The lease that it holds, as far as it knows."""
        return next(iter(self.protocol.holdings.held.values()), None)

    # -- what it may do
    def actions(self, world: "World") -> Iterator[str]:
        """Yield the verbs of what it may do."""
        record = self.record
        yield "connect" if self.protocol.connection.phase == "down" else "drop"
        yield from ["send"] * bool(self.up) + ["hear"] * bool(self.down)
        yield "crash"
        if self.uses:
            yield "end"
        elif self.bytes and (record is None or self.leaves):
            yield "free"
        elif record is None:
            waits = self.protocol.waits.waiters
            yield from ["cancel"] if waits else ["acquire"] * bool(self.acquires)
        elif not self.bytes:
            yield "load"
        elif not self._is_asking():
            yield "leave" if record.held else "ready"
            if record.held and (record.revoke is None or record.withdrawn):
                certain = self.protocol.holdings.is_certain(record, world.now)
                yield from ["use"] + ["ahead"] * (certain and world.scenario.talks)

    def _is_asking(self) -> bool:
        """Whether it waits for an answer before it goes on."""
        pending = self.protocol.connection._pending.values()
        return any(isinstance(one.request, w.Ready | w.UseBegin | w.Unloading) for one in pending)

    def act(self, verb: str, world: "World") -> None:
        """Do it. Raises what must not be raised."""
        getattr(self, f"do_{verb}")(world)
        self._absorb()

    def do_acquire(self, world: "World") -> None:
        self.acquires -= 1
        nonce, limit_s = f"n{self.acquires}", world.scenario.wait_timeout_s
        self.protocol.waits.acquire(nonce, self.spec, world.now, wait_timeout_s=limit_s)

    def do_cancel(self, world: "World") -> None:
        for nonce in list(self.protocol.waits.waiters):
            self.protocol.waits.cancel(nonce, world.now)

    def do_load(self, world: "World") -> None:
        self.gpu = GpuId(str(self._held.view.gpu))
        self._hold(world, self.spec.footprint.load_peak_bytes)

    def do_ready(self, world: "World") -> None:
        self._hold(world, self.spec.footprint.steady_bytes)
        self.protocol.holdings.ready(self._held, None, world.now)

    def do_use(self, world: "World") -> None:
        self.protocol.holdings.use_begin(self._held, USE, "", world.now)

    def do_ahead(self, world: "World") -> None:
        """A use begins ahead of the answer."""
        self.uses = True
        self.protocol.holdings.use_begin(self._held, USE, "", world.now, begun=True)

    def do_end(self, world: "World") -> None:
        self.uses = False
        if self.record is not None:
            self.protocol.holdings.use_end(self.record, USE, world.now)

    def do_leave(self, world: "World") -> None:
        record = self._held
        request = w.Unloading(record.lease_id, record.token)
        self.protocol.holdings.ask(record, request, world.now)

    def do_free(self, world: "World") -> None:
        """It frees its bytes, and releases what it still holds."""
        record = self.record
        self._hold(world, self.spec.footprint.residue_bytes)
        self.bytes, self.leaves = 0, False
        if record is not None:
            asleep = "standby" if self.spec.standby and record.revoke is not None else ""
            self.protocol.holdings.release(record, False, world.now, 5.0, asleep=asleep)

    def do_crash(self, world: "World") -> None:
        world.kill(self.process)
        self.begin()

    def do_tick(self, world: "World") -> None:
        self.protocol.tick(world.now)

    @property
    def _held(self) -> r.LeaseRecord:
        assert self.record is not None
        return self.record

    def _hold(self, world: "World", count: int) -> None:
        self.bytes = count
        world.devices[self.gpu].set(self.process, count, world.now)

    # -- its connection, and the daemon's session at the other end
    def do_connect(self, world: "World") -> None:
        self.protocol.connection.connected(world.now)

    def do_drop(self, world: "World") -> None:
        """The connection is lost, with all that is under way."""
        before = self.client
        self.do_lose(world)
        self._absorb()
        if before in state_of(world.engine).clients and not world.engine.concerns(before):
            world.post(ev.ClientLeft(before, "its connection was lost"))

    def do_lose(self, world: "World") -> None:
        self.protocol.connection.contact_lost("hung up")

    def do_send(self, world: "World") -> None:
        """The session takes the oldest request (`rpc.session`)."""
        asked = self.up.pop(0)
        match asked.request:
            case w.Hello(instance=instance):
                known = self.process, 1000, self.name, instance
                world.post(ev.ClientConnected(self.client, *known))
                welcome = d.WIRE_VERSION, "boot", "server", "client", d.HEARTBEAT_S
                reply = y.WelcomeReply(*welcome, QUICK["fence_grace_s"])
                self.down.append(fx.Reply(self.client, asked.id, reply))
            case w.Ping():
                self.down.append(fx.Reply(self.client, asked.id, y.PingReply("server")))
            case _:
                world.post(asked)

    def do_hear(self, world: "World") -> None:
        """The oldest answer or push arrives."""
        match self.down.pop(0):
            case fx.Reply(_, number, body):
                frame = codec.reply(number, world.epoch, body)
            case fx.Refuse(_, number, refusal):
                frame = codec.refusal(number, world.epoch, words.error_view(refusal))
            case fx.Push(_, body):
                frame = codec.push(0, world.epoch, body)
        self.protocol.connection.receive(msgpack.unpackb(frame), world.now)

    def _absorb(self) -> None:
        """Take what the protocol tells its owner, and what it wants to send."""
        connection, record = self.protocol.connection, self.record
        events, connection.events = connection.events, []
        for event in events:
            match event:
                case r.ContactLost():
                    self._hang_up()
                case r.Replied(body=y.UsesReply()):
                    self.uses = record is not None and USE in record.uses
                case r.Replied(body=y.StateReply()):
                    self.leaves = record is not None
                case _:
                    pass
        for message in connection.outgoing:
            envelope, request = codec.decode(pack(message), d.MESSAGE_MAX_BYTES)
            self.up.append(ev.Asked(self.client, envelope.id, request))
        connection.outgoing.clear()

    # -- what the world asks
    def standing(self) -> tuple[Any, ...]:
        """Return what it is in, to order clients that are alike."""
        state = self.protocol.connection.phase, self.acquires, self.bytes, self.uses, self.leaves
        return *state, self.record is None, len(self.up), len(self.down)

    def coming_bytes(self, device: SimDevice) -> int:
        """Return what a grant lets it put on a GPU beyond what it holds, whatever the engine says:
        until it knows that it has lost the lease."""
        record = self.record
        if record is None or self.bytes or record.view.gpu != device.gpu:
            return 0
        return max(0, self.spec.footprint.load_peak_bytes - device.held.get(self.process, 0))

    def check(self, core: Core) -> None:
        """1. What is in use stays, unless its time to live ran out. 2. When all messages are heard,
        client and engine agree on what it holds and uses, whether it may stay, and what it waits
        for."""
        agrees = not (self.up or self.down) and self.protocol.connection.phase == "up"
        for id, record in self.protocol.holdings.held.items():
            lease, ended = core.leases.get(record.lease_id), core.ended.get(record.lease_id)
            usable = lease is not None and lease.state in (LeaseState.HELD, LeaseState.REVOKING)
            expired = ended is not None and ended.state is LeaseState.EXPIRED
            if self.uses and not (usable or expired):  # 1
                raise Broken(f"{id} is in use, and not held")
            if not agrees:  # 2
                continue
            if lease is None or lease.token != record.token or lease.state not in EXPIRING:
                raise Broken(f"{self.name} believes that it holds {id}")
            leaves = record.revoke is not None and not record.withdrawn
            if usable and leaves != (lease.state is LeaseState.REVOKING):
                raise Broken(f"{self.name} believes of {id}, {lease.state}: revoked {leaves}")
            if not len(record.uses) == len(lease.uses) == self.uses:
                raise Broken(f"{self.name} believes of {id}: {record.uses} of {lease.uses} uses")
        for waiter in self.protocol.waits.waiters.values():
            if agrees and waiter.lease_id not in core.waiting:
                raise Broken(f"{self.name} waits for {waiter.lease_id}, and the engine does not")


class World:
    """See the module. `left`: how often each fault may still happen; `readings`: under way, one of
    each GPU (`host.prober`), and `again`: a question came after it began."""

    engine: Arbiter

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.left = scenario, dict(scenario.faults)
        self.now, self.epoch, self.lied = START_S, 0, False
        lag_s = LAG_S if scenario.lags else 0.0
        self.devices = {
            info.id: SimDevice(info.id, CAPACITY_BYTES, OVERHEAD_BYTES, lag_s, scenario.lists)
            for info in GPUS[: scenario.gpus]
        }
        self.readings: dict[GpuId, ev.MemorySampled] = {}
        self.again = set[GpuId]()
        self.clients = {
            name: Client(name, spec, scenario.acquires)
            for name, spec in zip("abcdef", scenario.clients, strict=False)
        }
        self.journal: dict[str, AnyRecord] = {}
        self.unheard: list[ProcessKey] = []  # deaths that the daemon will hear of
        self.do_restart()
        for client in self.clients.values():
            client.act("connect", self)
            self._deliver_mail()
        self._deliver_readings()
        for action in story(scenario.after):
            self.act(action)

    def waits(self) -> bool:
        """Whether a client waits for a grant."""
        return any(client.protocol.waits.waiters for client in self.clients.values())

    # -- what may happen
    def actions(self) -> list[Action]:
        """Return everything that may happen next."""
        found = [(verb, one.name) for one in self.clients.values() for verb in one.actions(self)]
        for gpu, device in self.devices.items():
            if gpu in self.readings:
                found += [("read", gpu), ("fail", gpu)] + [("lie", f"{gpu} {lie}") for lie in LIES]
            found += [("return", gpu)] if device.late else []
        found += [("die", str(process)) for process in self.unheard] + [("restart", "")]
        tick, sleep = self._next_at(), self._decisive_at()
        # what is under way arrives before time passes, unless it may be late
        busy = self.readings or any(one.up or one.down for one in self.clients.values())
        found += [("late" if busy else "tick", "")] if tick < self.now + FAR_S else []
        found += [("sleep", "")] if tick != sleep < self.now + FAR_S and not busy else []
        return [one for one in found if one[0] not in FAULTS or self.left.get(one[0])]

    def act(self, action: Action) -> None:
        """Let something happen. Raises what must not be raised."""
        (verb, whose), before = action, self.now
        if verb in self.left:
            self.left[verb] -= 1
        if whose in self.clients:
            self.clients[whose].act(verb, self)
        else:
            getattr(self, f"do_{verb}")(*whose.split())
        if self.scenario.talks:
            self._deliver_readings()
        else:
            self._deliver_mail()
        if self.now > before:  # the engine may have heard of it
            check_arbiter(self.engine)
        self._check(state_of(self.engine))

    def _deliver_mail(self) -> None:
        """Let all messages arrive, in the order of clients."""
        while some := [one for one in self.clients.values() if one.up or one.down]:
            some[0].act("send" if some[0].up else "hear", self)

    def _deliver_readings(self) -> None:
        while self.readings:
            self.do_read(min(self.readings))

    # -- the engine
    def post(self, event: ev.Event) -> None:
        """Hand an event to the engine and perform what it asks, as the executor does."""
        self.now += STEP_S
        for effect in self.engine.handle(event, self.now):
            match effect:
                case fx.JournalPut(key, record):
                    self.journal[key] = record
                case fx.JournalDelete(key):
                    self.journal.pop(key, None)
                case fx.Reply() | fx.Refuse() | fx.Push():
                    self._tell(effect)
                case fx.Sample(gpu):
                    self._read(gpu)
                case _:
                    pass

    def _tell(self, told: Told) -> None:
        client = self.clients.get(told.client.partition("-")[0])
        if client is not None and client.client == told.client:
            client.down.append(told)

    def _read(self, gpu: GpuId) -> None:
        """Begin a reading right after the event that asks for it, or after the one under way."""
        if gpu in self.readings:
            self.again.add(gpu)
            return
        self.again.discard(gpu)
        reading = self.devices[gpu].read(self.now + STEP_S / 2)
        assert isinstance(reading, ev.MemorySampled)
        self.readings[gpu] = reading

    def kill(self, process: ProcessKey) -> None:
        """A process dies: its bytes go, and the daemon will hear of it."""
        for device in self.devices.values():
            device.set(process, 0, self.now)
        self.unheard.append(process)

    # -- verbs of no client
    def do_restart(self) -> None:
        """The daemon starts, perhaps after an earlier one."""
        self.epoch += 1
        settings = Settings(epoch=self.epoch, gpus=GPUS[: self.scenario.gpus], **QUICK)
        self.engine = self.scenario.engine(settings, self.now)
        self.readings.clear()
        self.again.clear()
        for client in self.clients.values():
            client.act("lose", self)
        records = dict(self.journal)
        self.post(ev.Recovered(records) if records else ev.Tick())
        alive = {client.process for client in self.clients.values()}
        self.unheard = sorted(set(processes_of(records)) - alive)

    def do_die(self, process: str) -> None:
        (found,) = [one for one in self.unheard if str(one) == process]
        self.unheard.remove(found)
        self.post(ev.ProcessDied(found))

    def do_return(self, gpu: str) -> None:
        self.devices[GpuId(gpu)].late.clear()

    def do_read(self, gpu: str) -> None:
        self._answer(self.readings[GpuId(gpu)])

    def do_fail(self, gpu: str) -> None:
        self._answer(ev.ProbeFailed(GpuId(gpu), self.now, "failed"))

    def do_lie(self, gpu: str, lie: str) -> None:
        self.lied, reading = True, self.readings[GpuId(gpu)]
        listed = () if lie == "nothing" else reading.processes
        self._answer(replace(reading, used_bytes=LIES[lie], processes=listed))

    def _answer(self, told: ev.MemorySampled | ev.ProbeFailed) -> None:
        del self.readings[told.gpu]
        self.post(told)
        if told.gpu in self.again:
            self._read(told.gpu)

    # -- time
    def _next_at(self) -> float:
        """Return when something is due."""
        times = [one.protocol.next_deadline() for one in self.clients.values()]
        return min([at for at in (self.engine.next_deadline(), *times) if at], default=inf)

    def do_tick(self) -> None:
        """Time passes to the next deadline, which is served."""
        self.now = max(self.now, self._next_at())
        for client in self.clients.values():
            client.act("tick", self)
        if (self.engine.next_deadline() or inf) <= self.now:
            self.post(ev.Tick())

    do_late = do_tick

    def _decisive_at(self) -> float:
        """Return when something is due that is not done again and again."""
        core = state_of(self.engine)
        times = [at for one in self.clients.values() for at in one.protocol.waits.deadlines()]
        holdings = [one.protocol.holdings for one in self.clients.values()]
        times += [some.fence_at(record) for some in holdings for record in some.held.values()]
        times += [at for (kind, _), at in core.timers.items() if kind not in _PERIODIC]
        debts = [debt for gpu in core.gpus.values() for debt in gpu.verifications.values()]
        times += [one.deadline_at + DYING_S * one.overdue for one in debts]
        return min([at for at in times if at > self.now], default=inf)

    def do_sleep(self) -> None:
        """Time passes to the next decisive moment; what is said on the way is as it should be."""
        until = self._decisive_at()
        for _ in range(SLEEP_EVENTS_MAX):
            self._deliver_mail()
            self._deliver_readings()
            if self._next_at() > until:
                return
            self.do_tick()

    # -- what must hold
    def _check(self, core: Core) -> None:
        for client in self.clients.values():
            client.check(core)
        for device in self.devices.values():
            self._check_bytes(core, device)
        if waiter := forgotten_waiter(core):
            raise Broken(f"{waiter} fits and is not granted")

    def _check_bytes(self, core: Core, device: SimDevice) -> None:
        """What is granted or occupied fits; what a process with a lease holds is charged."""
        total = OVERHEAD_BYTES + sum(device.shown(self.now).values())
        total += sum(one.coming_bytes(device) for one in self.clients.values())
        if self.lied:
            return
        if total > CAPACITY_BYTES:
            raise Broken(f"{total} bytes are granted or occupied on {device.gpu}")
        ledger = core.gpus[device.gpu].ledger
        slack = 0 if self.scenario.lists else d.RESERVE_BYTES + d.VERIFY_TOLERANCE_BYTES
        excused = {one.process for one in self.clients.values() if one.bytes and one.record is None}
        for process, held in device.held.items():
            charged = ledger.charged_to(process)
            if held > charged + slack and process not in excused:
                raise Broken(f"{process} holds {held} bytes on {device.gpu}, {charged} are charged")
