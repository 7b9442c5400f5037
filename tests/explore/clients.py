"""Clients of the explored worlds: `Hand`, which is answered at once, and `Talker`, which speaks the
client's protocol over a connection with messages under way.

Both do what an honest program does in any order: ask, load, use, leave when they are not in use.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import msgpack

from tests.support.engine_state import state_of
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.model.lease import EXPIRING, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.rpc import codec, words
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol.protocol import ClientProtocol
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token, UseId
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.msgpack_codec import pack
from vram_arbiter.schemas.wire import pushes as p
from vram_arbiter.schemas.wire import replies as y
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.spec import LeaseSpec
from vram_arbiter.schemas.wire.views import LeaseView

if TYPE_CHECKING:
    from tests.explore.world import Client, Scenario, World


class Broken(AssertionError):
    """Something that must hold did not."""


type Told = y.AnyReply | p.AnyPush | Refusal
USE = UseId("u")
USABLE = (LeaseState.HELD, LeaseState.REVOKING)


class _Program:
    """What both kinds of client are: a process with bytes on GPUs, which may die."""

    def __init__(self, name: str, spec: LeaseSpec, scenario: "Scenario") -> None:
        self.name = name
        self.spec = spec
        self.acquires = scenario.acquires
        self.connections = self.lives = 0
        self.begin()

    def begin(self) -> None:
        """A new process."""
        self.lives += 1
        pid = 100 * self.lives + ord(self.name)
        self.process = ProcessKey(pid, pid)
        self.hang_up()

    def hang_up(self) -> None:
        """What is said to the connection so far reaches it no more."""
        self.connections += 1
        self.client = ClientId(f"{self.name}-{self.connections}")

    def hold(self, world: "World", gpu: str | None, count: int) -> None:
        """So many bytes on a GPU from now on."""
        assert gpu is not None
        world.devices[GpuId(gpu)].set(self.process, count, lags=world.scenario.lags)

    @property
    def weights(self) -> tuple[int, int, int]:
        """Bytes while it loads, once it is ready, and after it has unloaded."""
        sizes = self.spec.footprint
        return sizes.load_peak_bytes, sizes.steady_bytes, sizes.residue_bytes


class Hand(_Program):
    """A client that is answered at once. `phase`: idle, waiting, granted, loaded, held, unloading,
    away, lost."""

    def begin(self) -> None:
        super().begin()
        self.phase = "idle"
        self.lease = LeaseId("")
        self.token: Token | None = None
        self.gpu: str | None = None
        self.using = False
        self.borrowed: tuple[LeaseId, Token] | None = None
        self.connected = True

    def actions(self, world: "World") -> Iterator[str]:
        if not self.connected:
            yield "connect"
        elif self.using:
            yield "end"
        elif self.phase != "idle" or self.acquires:
            yield from _VERBS[self.phase]
        if self.connected and self.borrowed:
            yield "repay"
        elif self.connected and world.scenario.borrows and self._lender(world):
            yield "borrow"
        if "crash" in world.left:
            yield "crash"
        if self.connected and "bye" in world.left:
            yield "bye"
        if self.lease:
            yield from (order for order in ("evict", "kill") if order in world.left)

    def act(self, verb: str, world: "World") -> None:
        getattr(self, f"_{verb}")(world)

    # -- verbs
    def _acquire(self, world: "World") -> None:
        self.acquires -= 1
        self._ask_for(world)

    def _ask_for(self, world: "World") -> None:
        request = w.Acquire(f"n{self.acquires}", self.spec, world.scenario.wait_timeout_s)
        match world.ask(self, request):
            case y.AcquireReply("loading", lease):
                self._granted(lease)
            case y.AcquireReply("queued", lease):
                self.phase, self.lease = "waiting", LeaseId(lease.lease_id)
            case _:
                self._idle()

    def _cancel(self, world: "World") -> None:
        world.ask(self, w.Cancel(self.lease))
        self._idle()

    def _load(self, world: "World") -> None:
        self.phase = "loaded"
        self.hold(world, self.gpu, self.weights[0])

    def _ready(self, world: "World") -> None:
        self.hold(world, self.gpu, self.weights[1])
        self._after(world.ask(self, w.Ready(*self._on)), "held")

    def _use(self, world: "World") -> None:
        began = world.ask(self, w.UseBegin(*self._on, USE))
        self.using = isinstance(began, y.UsesReply)

    def _end(self, world: "World") -> None:
        self.using = False
        world.ask(self, w.UseEnd(*self._on, USE))

    def _leave(self, world: "World") -> None:
        """Refused while another client uses the lease."""
        if isinstance(world.ask(self, w.Unloading(*self._on)), y.StateReply):
            self.phase = "unloading"

    def _clear(self, world: "World") -> None:
        self.hold(world, self.gpu, self.weights[2])
        match world.ask(self, w.Release(*self._on)):
            case y.ReleaseReply(_, "standby"):
                self.phase = "away"
            case _:
                self._idle()

    def _want(self, world: "World") -> None:
        match world.ask(self, w.Reacquire(*self._on)):
            case y.AcquireReply("loading", lease):
                self._granted(lease)
            case y.AcquireReply("queued", _):
                self.phase = "waiting"
            case _:
                self._idle()

    def _free(self, world: "World") -> None:
        self.hold(world, self.gpu, self.weights[2])
        self._idle()

    def _lender(self, world: "World") -> "Hand | None":
        others = (one for one in world.clients.values() if isinstance(one, Hand))
        return next((one for one in others if one is not self and one.phase == "held"), None)

    def _borrow(self, world: "World") -> None:
        lender = self._lender(world)
        assert lender is not None
        if isinstance(world.ask(self, w.UseBegin(*lender._on, USE)), y.UsesReply):
            self.borrowed = lender._on

    def _repay(self, world: "World") -> None:
        assert self.borrowed is not None
        on, self.borrowed = self.borrowed, None
        world.ask(self, w.UseEnd(*on, USE))

    def _crash(self, world: "World") -> None:
        world.kill(self.process)
        self.begin()
        world.admit(self)

    def _bye(self, world: "World") -> None:
        """It frees what it holds and exits."""
        for device in world.devices.values():
            device.set(self.process, 0, lags=world.scenario.lags)
        world.post(ev.ClientLeft(self.client, ev.BYE))
        self._crash(world)

    def _evict(self, world: "World") -> None:
        world.ask(self, w.Evict("", self.lease))

    def _kill(self, world: "World") -> None:
        """An operator ends its process, if the engine lets him."""
        if isinstance(world.ask(self, w.Kill("", self.lease)), y.OperatorReply):
            self._crash(world)

    # -- connections
    def cut_off(self, world: "World") -> None:
        self.hang_up()
        self.connected = False

    def connect(self, world: "World") -> None:
        """Say hello, and what it had: a lease, a wait, a use."""
        self.connected = True
        world.admit(self)
        if self.phase in _REATTACHED:
            uses = (USE,) if self.using else ()
            state: Any = _REATTACHED[self.phase]
            had = w.ReattachLease(*self._on, self.spec, state, None, uses)
            match world.ask(self, w.Reattach((had,))):
                case y.ReattachReply((y.ReattachedView(kept=True, lease=lease),)):
                    if self.phase == "away" and lease is not None and lease.state == "loading":
                        self._granted(lease)
                case _:
                    self._lost()
        elif self.phase == "waiting":
            self._ask_for(world)
        if self.borrowed is not None and not isinstance(
            world.ask(self, w.UseBegin(*self.borrowed, USE)), y.UsesReply
        ):
            self.borrowed = None

    def _connect(self, world: "World") -> None:
        self.connect(world)

    # -- what it hears
    def hear(self, told: Told, re: RequestId | None, epoch: int) -> None:
        match told:
            case p.GrantedPush(lease) if lease.lease_id == self.lease:
                self._granted(lease)
            case p.DeniedPush(lease) if lease == self.lease:
                self._idle()
            case p.LostPush(lease, token) if (lease, token) == (self.lease, self.token):
                self._lost()
            case _:
                pass

    def _granted(self, lease: LeaseView) -> None:
        assert self.phase in ("idle", "waiting", "away"), f"a grant while {self.phase}"
        self.phase, self.lease = "granted", LeaseId(lease.lease_id)
        self.token, self.gpu = lease.token, lease.gpu

    def _after(self, answer: object, phase: str) -> None:
        self.phase = phase
        if isinstance(answer, Refusal):
            self._lost()

    def _lost(self) -> None:
        self.using = False
        if self.phase in ("loaded", "held", "unloading"):
            self.phase = "lost"
        else:
            self._idle()

    def _idle(self) -> None:
        self.phase, self.lease, self.token = "idle", LeaseId(""), None

    @property
    def _on(self) -> tuple[LeaseId, Token]:
        assert self.token is not None
        return self.lease, self.token

    # -- what the world asks
    def has_mail(self) -> bool:
        return False

    def next_deadline(self) -> float | None:
        return None

    def tick(self, world: "World") -> None:
        pass

    def standing(self) -> tuple[Any, ...]:
        return self.phase, self.using, self.borrowed is None, self.connected, self.acquires

    def is_excused(self) -> bool:
        return self.phase == "lost"

    def is_waiting(self) -> bool:
        return self.phase == "waiting"

    def coming_bytes(self, gpu: GpuId, held_bytes: int) -> int:
        if self.gpu != gpu or self.phase not in ("granted", "loaded"):
            return 0
        return max(0, self.weights[0] - held_bytes)

    def check(self, core: Core, others: Iterable["Client"]) -> None:
        used = {self.lease} if self.using else set()
        if self.borrowed is not None:  # a lease whose holder died is over, whoever uses it
            used |= {one.lease for one in others if one.lease == self.borrowed[0]}
        for lease in used:
            if lease not in core.leases or core.leases[lease].state not in USABLE:
                raise Broken(f"{lease} is in use, and not held")


_VERBS: Mapping[str, tuple[str, ...]] = {
    "idle": ("acquire",),
    "waiting": ("cancel",),
    "granted": ("load",),
    "loaded": ("ready",),
    "held": ("use", "leave"),
    "unloading": ("clear",),
    "away": ("want",),
    "lost": ("free",),
}
_REATTACHED = {
    "granted": "loading",
    "loaded": "loading",
    "held": "held",
    "unloading": "held",
    "away": "standby",
}
"""Phases with a lease, and what it says of it after a restart."""


class Talker(_Program):
    """A client of the protocol: its requests (`up`) and what it is told (`down`) are under way
    until they are sent or heard. `leaving`: "", asked, allowed."""

    def begin(self) -> None:
        super().begin()
        self.protocol = ClientProtocol(name=self.name, instance=str(self.process))
        self.up: list[Message] = []
        self.down: list[Message] = []
        self.linked = self.greeted = False
        self.lease = LeaseId("")
        self.record: r.LeaseRecord | None = None
        self.loaded = self.over = False
        self.using = self.leaving = ""
        self.awaited = 0  # the request whose answer it waits for

    def actions(self, world: "World") -> Iterator[str]:
        if not self.linked:
            yield "connect"
        elif "drop" in world.left:
            yield "drop"
        if self.up:
            yield "send"
        if self.down:
            yield "hear"
        record, waiters = self.record, self.protocol.waits.waiters
        if record is None:
            if waiters and not self.awaited:
                yield "cancel"
            elif self.acquires and not waiters:
                yield "acquire"
        elif self.using == "on":
            yield "end"
        elif self.over:
            yield "free"
        elif not self.loaded:
            yield "load"
        elif self.leaving == "allowed":
            yield "clear"
        elif record.held and not self.awaited:
            yield "leave"
            if record.revoke is None or record.withdrawn:
                yield "use"

    def act(self, verb: str, world: "World") -> None:
        getattr(self, f"_{verb}")(world)
        self._absorb(world)

    # -- verbs
    def _acquire(self, world: "World") -> None:
        self.acquires -= 1
        timeout_s = world.scenario.wait_timeout_s
        nonce = f"n{self.acquires}"
        self.protocol.waits.acquire(nonce, self.spec, world.now, wait_timeout_s=timeout_s)

    def _cancel(self, world: "World") -> None:
        for nonce in list(self.protocol.waits.waiters):
            self.protocol.waits.cancel(nonce, world.now)

    def _load(self, world: "World") -> None:
        assert self.record is not None
        self.loaded = True
        self.hold(world, self.record.view.gpu, self.weights[1])
        self.protocol.holdings.ready(self.record, None, world.now)

    def _use(self, world: "World") -> None:
        assert self.record is not None
        self.using = "asked"
        self.awaited = self.protocol.holdings.use_begin(self.record, USE, "", world.now)

    def _end(self, world: "World") -> None:
        assert self.record is not None
        self.using = ""
        self.protocol.holdings.use_end(self.record, USE, world.now)

    def _leave(self, world: "World") -> None:
        assert self.record is not None
        self.leaving = "asked"
        request = w.Unloading(self.record.lease_id, self.record.token)
        self.awaited = self.protocol.holdings.ask(self.record, request, world.now)

    def _clear(self, world: "World") -> None:
        assert self.record is not None
        self._free_bytes(world)
        self.protocol.holdings.release(self.record, False, world.now, 5.0)
        self.record = None

    def _free(self, world: "World") -> None:
        """It has lost its lease."""
        self._free_bytes(world)
        self.record = None

    def _free_bytes(self, world: "World") -> None:
        assert self.record is not None
        if self.loaded:
            self.hold(world, self.record.view.gpu, self.weights[2])
        self.loaded = self.over = False
        self.leaving = ""

    # -- the connection
    def connect(self, world: "World") -> None:
        self.act("connect", world)
        while self.has_mail():
            self.act("send" if self.up else "hear", world)

    def _connect(self, world: "World") -> None:
        self.linked = True
        self.protocol.connection.connected(world.now)

    def _drop(self, world: "World") -> None:
        """The connection is lost, with all that is under way."""
        before, greeted = self.client, self.greeted
        self.cut_off(world)
        if greeted and not world.engine.concerns(before):
            world.post(ev.ClientLeft(before, "its connection was lost"))

    def cut_off(self, world: "World") -> None:
        self.protocol.connection.contact_lost("hung up")
        self._absorb(world)

    def _send(self, world: "World") -> None:
        """The daemon's session takes the oldest message (`rpc.session`)."""
        envelope, request = codec.decode(pack(self.up.pop(0)), d.MESSAGE_MAX_BYTES)
        match request:
            case w.Hello():
                self.greeted = True
                world.admit(self)
                welcome = (d.WIRE_VERSION, "boot", "server", "client", d.HEARTBEAT_S)
                grace_s = state_of(world.engine).settings.fence_grace_s
                self.hear(y.WelcomeReply(*welcome, grace_s), envelope.id, world.epoch)
            case w.Ping():
                self.hear(y.PingReply("server"), envelope.id, world.epoch)
            case _:
                world.post(ev.Asked(self.client, envelope.id, request))

    def hear(self, told: Told, re: RequestId | None, epoch: int) -> None:
        if isinstance(told, Refusal):
            frame = codec.refusal(re, epoch, words.error_view(told))
        elif isinstance(told, y.AnyReply):
            frame = codec.reply(re or 0, epoch, told)
        else:
            frame = codec.push(0, epoch, told)
        self.down.append(msgpack.unpackb(frame))

    def _hear(self, world: "World") -> None:
        self.protocol.connection.receive(self.down.pop(0), world.now)

    def _absorb(self, world: "World") -> None:
        """Take what the protocol wants to send, and what it tells its owner."""
        connection = self.protocol.connection
        events, connection.events = connection.events, []
        for event in events:
            match event:
                case r.ContactLost():
                    self.hang_up()
                    self.up, self.down = [], []
                    self.linked = self.greeted = False
                case r.Granted(_, record):
                    self.record, self.lease = record, record.lease_id
                case r.Gone(record) if record is self.record:
                    self.over = True
                case r.Replied(self.awaited):
                    self.using = "on" if self.using == "asked" else self.using
                    self.leaving = "allowed" if self.leaving == "asked" else ""
                    self.awaited = 0
                case r.Failed(self.awaited):
                    self.using = "" if self.using == "asked" else self.using
                    self.leaving, self.awaited = "", 0
                case _:
                    pass
        if self.over and not self.loaded and self.using != "on":
            self.record, self.over, self.leaving = None, False, ""
        self.up += connection.outgoing
        connection.outgoing.clear()

    # -- what the world asks
    def has_mail(self) -> bool:
        return bool(self.up or self.down)

    def next_deadline(self) -> float | None:
        return self.protocol.next_deadline()

    def tick(self, world: "World") -> None:
        self.protocol.tick(world.now)
        self._absorb(world)

    def standing(self) -> tuple[Any, ...]:
        state = (self.linked, self.loaded, self.over, self.using, self.leaving, self.acquires)
        return *state, len(self.up), len(self.down), self.record is None

    def is_excused(self) -> bool:
        return self.over

    def is_waiting(self) -> bool:
        return bool(self.protocol.waits.waiters)

    def coming_bytes(self, gpu: GpuId, held_bytes: int) -> int:
        """A grant counts until the client has let go of it, whatever the engine says."""
        if self.record is None or self.loaded or self.over or self.record.view.gpu != gpu:
            return 0
        return max(0, self.weights[0] - held_bytes)

    def check(self, core: Core, others: Iterable["Client"]) -> None:
        """1. What is in use stays, unless its time to live ran out. 2. When all messages are heard,
        the client and the engine agree on what it holds and waits for."""
        lease = core.leases.get(self.lease)
        if self.using == "on" and not self.over:  # 1
            ended = core.ended.get(self.lease)
            expired = ended is not None and ended.state is LeaseState.EXPIRED
            if not expired and (lease is None or lease.state not in USABLE):
                raise Broken(f"{self.lease} is in use, and not held")
        if self.has_mail() or self.protocol.connection.phase != "up":  # 2
            return
        for record in self.protocol.holdings.held.values():
            if lease is None or lease.token != record.token or lease.state not in EXPIRING:
                raise Broken(f"{self.name} believes that it holds {record.lease_id}")
        for waiter in self.protocol.waits.waiters.values():
            if waiter.lease_id not in core.waiting:
                raise Broken(f"{self.name} waits for {waiter.lease_id}, and the engine does not")
