"""A client of the explored worlds: an honest program over the client's protocol.

It asks, loads, uses, and leaves when it is not in use, in any order. Its requests (`up`) and what
it is told (`down`) are under way until they are sent or heard.
"""

from collections.abc import Iterator
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
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, UseId
from vram_arbiter.schemas.runtime.msgpack_codec import pack
from vram_arbiter.schemas.wire import replies as y
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.pushes import AnyPush
from vram_arbiter.schemas.wire.requests import AnyRequest
from vram_arbiter.schemas.wire.spec import LeaseSpec

if TYPE_CHECKING:
    from tests.explore.world import World

type Told = y.AnyReply | AnyPush | Refusal
USE = UseId("u")
USABLE = (LeaseState.HELD, LeaseState.REVOKING)


class Broken(AssertionError):
    """Something that must hold did not."""


class Client:
    """One process with one lease at a time. `spec.consumer` is its kind; clients of a kind are
    alike. `does`: "", begins, uses, leaves, left, by its newest request and its answer."""

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
        self.lease = LeaseId("")
        self.record: r.LeaseRecord | None = None  # granted, until its bytes are freed
        self.bytes = 0
        self.over = False  # the lease ended without this client
        self.does = ""
        self.awaited = 0
        self._hang_up()

    def _hang_up(self) -> None:
        self.connections += 1
        self.client = ClientId(f"{self.name}-{self.connections}")
        self.linked = self.greeted = False
        self.up: list[tuple[RequestId, AnyRequest]] = []
        self.down: list[tuple[RequestId | None, Told]] = []

    # -- what it may do
    def actions(self) -> Iterator[str]:
        """Yield the verbs of what it may do."""
        yield from ["drop"] if self.linked else ["connect"]
        yield from ["send"] * bool(self.up) + ["hear"] * bool(self.down)
        yield "crash"
        record, waits = self.record, bool(self.protocol.waits.waiters)
        if record is None:
            yield from ["cancel"] if waits else ["acquire"] * bool(self.acquires)
        elif self.does == "uses":
            yield "end"
        elif self.over:
            yield "free"
        elif not self.bytes or not record.held:
            yield from ["load"] if not self.bytes else ["ready"] * (not self.awaited)
        elif self.does == "left":
            yield "free"
        elif not self.does:
            yield from ["leave"] + ["use"] * (record.revoke is None or record.withdrawn)

    def act(self, verb: str, world: "World") -> None:
        """Do it. Raises what must not be raised."""
        world.touched.add(self.name)
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
        self._hold(world, self.spec.footprint.load_peak_bytes)

    def do_ready(self, world: "World") -> None:
        self._hold(world, self.spec.footprint.steady_bytes)
        self.awaited = self.protocol.holdings.ready(self._record, None, world.now)

    def do_use(self, world: "World") -> None:
        self.does = "begins"
        self.awaited = self.protocol.holdings.use_begin(self._record, USE, "", world.now)

    def do_end(self, world: "World") -> None:
        self.does = ""
        self.protocol.holdings.use_end(self._record, USE, world.now)

    def do_leave(self, world: "World") -> None:
        self.does, record = "leaves", self._record
        request = w.Unloading(record.lease_id, record.token)
        self.awaited = self.protocol.holdings.ask(record, request, world.now)

    def do_free(self, world: "World") -> None:
        """It frees its bytes, and releases what it still holds."""
        record, left = self._record, self.does == "left" and not self.over
        self._hold(world, self.spec.footprint.residue_bytes)
        self.record, self.bytes, self.over, self.does = None, 0, False, ""
        if left:
            asleep = "standby" if self.spec.standby and record.revoke is not None else ""
            self.protocol.holdings.release(record, False, world.now, 5.0, asleep=asleep)

    def do_crash(self, world: "World") -> None:
        world.kill(self.process)
        self.begin()

    @property
    def _record(self) -> r.LeaseRecord:
        assert self.record is not None
        return self.record

    def _hold(self, world: "World", count: int) -> None:
        self.bytes = count
        world.hold(self.process, GpuId(str(self._record.view.gpu)), count)

    # -- its connection, and the daemon's session at the other end
    def do_connect(self, world: "World") -> None:
        self.linked = True
        self.protocol.connection.connected(world.now)

    def do_drop(self, world: "World") -> None:
        """The connection is lost, with all that is under way."""
        before = self.client if self.greeted else None
        self.cut_off()
        if before is not None and not world.engine.concerns(before):
            world.post(ev.ClientLeft(before, "its connection was lost"))

    def cut_off(self) -> None:
        self.protocol.connection.contact_lost("hung up")
        self._absorb()

    def do_send(self, world: "World") -> None:
        """The session takes the oldest request (`rpc.session`)."""
        number, request = self.up.pop(0)
        match request:
            case w.Hello():
                self.greeted = True
                known = self.process, 1000, self.name, request.instance
                world.post(ev.ClientConnected(self.client, *known))
                grace_s = state_of(world.engine).settings.fence_grace_s
                welcome = (d.WIRE_VERSION, "boot", "server", "client", d.HEARTBEAT_S, grace_s)
                self.down.append((number, y.WelcomeReply(*welcome)))
            case w.Ping():
                self.down.append((number, y.PingReply("server")))
            case _:
                world.post(ev.Asked(self.client, number, request))

    def do_hear(self, world: "World") -> None:
        """The oldest answer or push arrives."""
        re, told = self.down.pop(0)
        if isinstance(told, Refusal):
            frame = codec.refusal(re, world.epoch, words.error_view(told))
        elif isinstance(told, y.AnyReply):
            frame = codec.reply(re or 0, world.epoch, told)
        else:
            frame = codec.push(0, world.epoch, told)
        self.protocol.connection.receive(msgpack.unpackb(frame), world.now)

    def _absorb(self) -> None:
        """Take what the protocol tells its owner, and what it wants to send."""
        connection = self.protocol.connection
        events, connection.events = connection.events, []
        for event in events:
            match event:
                case r.ContactLost():
                    self._hang_up()
                case r.Granted(_, record) | r.Returned(record):
                    self.record, self.lease = record, record.lease_id
                case r.Gone(record) if record is self.record:
                    self.over = True
                case r.Replied(self.awaited):
                    self.does = {"begins": "uses", "leaves": "left"}.get(self.does, self.does)
                    self.awaited = 0
                case r.Failed(self.awaited):
                    self.does, self.awaited = "", 0
                case _:
                    pass
        if self.over and not self.bytes:
            self.record, self.over, self.does = None, False, ""
        for message in connection.outgoing:
            envelope, request = codec.decode(pack(message), d.MESSAGE_MAX_BYTES)
            self.up.append((envelope.id, request))
        connection.outgoing.clear()

    # -- what the world asks
    def has_mail(self) -> bool:
        """Whether a message from it or to it is under way."""
        return bool(self.up or self.down)

    def is_waiting(self) -> bool:
        return bool(self.protocol.waits.waiters)

    def tick(self, world: "World") -> None:
        """Let it do what is due."""
        due = self.protocol.next_deadline()
        if due is not None and due <= world.now:
            world.touched.add(self.name)
            self.protocol.tick(world.now)
            self._absorb()

    def decisive_times(self) -> Iterator[float]:
        """Yield when it gives up something."""
        yield from self.protocol.waits.deadlines()
        yield from map(self.protocol.holdings.fence_at, self.protocol.holdings.held.values())

    def standing(self) -> tuple[Any, ...]:
        """Return what it is in, to order clients that are alike."""
        state = self.protocol.connection.phase, self.acquires, self.bytes, self.over, self.does
        return *state, self.record is None, len(self.up), len(self.down)

    def coming_bytes(self, gpu: GpuId, held_bytes: int) -> int:
        """Return what a grant lets it put on a GPU beyond what it holds, whatever the engine says:
        until it knows that it has lost the lease."""
        record = self.record
        if record is None or self.bytes or self.over or record.view.gpu != gpu:
            return 0
        return max(0, self.spec.footprint.load_peak_bytes - held_bytes)

    def check(self, core: Core) -> None:
        """1. What is in use stays, unless its time to live ran out. 2. When all messages are heard,
        client and engine agree on what it holds, whether it may stay, and what it waits for."""
        lease, ended = core.leases.get(self.lease), core.ended.get(self.lease)
        if self.does == "uses" and not self.over:  # 1
            expired = ended is not None and ended.state is LeaseState.EXPIRED
            if not expired and (lease is None or lease.state not in USABLE):
                raise Broken(f"{self.lease} is in use, and not held")
        if self.has_mail() or self.protocol.connection.phase != "up":  # 2
            return
        for record in self.protocol.holdings.held.values():
            if lease is None or lease.token != record.token or lease.state not in EXPIRING:
                raise Broken(f"{self.name} believes that it holds {record.lease_id}")
            leaves = record.revoke is not None and not record.withdrawn
            if lease.state in USABLE and leaves != (lease.state is LeaseState.REVOKING):
                raise Broken(f"{self.name} believes of {lease.id}, {lease.state}: revoked {leaves}")
        for waiter in self.protocol.waits.waiters.values():
            if waiter.lease_id not in core.waiting:
                raise Broken(f"{self.name} waits for {waiter.lease_id}, and the engine does not")
