"""Simulated programs on the real client library: `clients.client`, `clients.lease` and
`clients._protocol.protocol` under simulated time.

A `Consumer` is a process with models: it waits, loads in steps, works in uses, leaves when asked or
by itself, and misbehaves as its `Character` says. A `Runner` marks uses on other processes' leases.
An `Observer` asks questions, an `Operator` acts by hand. Every wait is remembered, so that in the
end nobody may still be waiting.
"""

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterator
from contextlib import AsyncExitStack
from dataclasses import dataclass, field

from tests.support.simulation.clock import ProcessLoop
from tests.support.simulation.device import SimOutOfMemory
from tests.support.simulation.world import Entitlement, SimProcess, World
from vram_arbiter.clients._protocol.protocol import ClientProtocol
from vram_arbiter.clients._session import Session
from vram_arbiter.clients._spec import checked_spec
from vram_arbiter.clients.client import CONNECT_TIMEOUT_S, AsyncClient
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.clients.net.dealer import Transport
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.errors import ArbiterUnreachable, VramError
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.requests import REQUESTS, Role
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

SIZES = (600 * d.MIB, d.GIB, 2 * d.GIB, 3_300_000_000, 4_300_000_000, 5_300_000_000, 7 * d.GIB)
RESIDUES = (0, 200 * d.MIB, 450 * d.MIB)
WAITS = (None, 1.0, 5.0, 20.0, 60.0)
CONNECT_PAUSE_S = 0.3
LOAD_STEPS = 3


class SimSession(Session):
    """The real client's connection with simulated time, names and sockets."""

    def __init__(self, world: World, process: SimProcess, role: Role) -> None:
        super().__init__(process.name, "ipc://simulated", role, CONNECT_TIMEOUT_S)
        self._world, self._process = world, process
        self.protocol = ClientProtocol(
            name=process.name, instance=world.clock.new_id("i"), role=role
        )
        process.on_kill.append(self._killed)

    def now(self) -> float:
        return self._world.clock.now

    def new_id(self) -> str:
        return self._world.clock.new_id("n")

    def pump(self) -> None:
        if self._process.alive:
            super().pump()
            self._world.touch()

    def _new_dealer(self) -> Transport:
        return self._world.open_link(self._process, self._received, self._hung_up)

    def _killed(self) -> None:
        self._open = False  # what is still on the stack of a dead process must not speak


class SimClient(AsyncClient):
    """The real client on a simulated connection."""

    def __init__(self, world: World, process: SimProcess, role: Role = "client") -> None:
        super().__init__(process.name, endpoint="ipc://simulated", role=role)
        self._session = SimSession(world, process, role)
        self.process = process

    @property
    def protocol(self) -> ClientProtocol:
        return self._session.protocol

    def now(self) -> float:
        return self._session.now()

    def may_load(self, lease: AsyncLease) -> bool:
        """What a careful holder asks before it puts more on the GPU: is the lease still mine, by
        my own clock too?"""
        record = self.protocol.holdings.held.get(lease.lease_id)
        return record is not None and self.now() < self.protocol.holdings.fence_at(record)


@dataclass(slots=True)
class Ask:
    """One wait for a lease. It must end."""

    who: str
    asked_at: float
    timeout_s: float | None
    process: SimProcess
    spec: LeaseSpec
    outcome: str = ""
    ended_at: float = 0.0
    give_up: Callable[[], object] = lambda: None

    def __str__(self) -> str:
        return (
            f"{self.who} ({self.process.key}) since {self.asked_at:.3f} for "
            f"{self.spec.footprint.load_peak_bytes}"
        )


@dataclass(slots=True)
class Holding:
    """A granted lease with what its process put on the GPU for it."""

    client: SimClient
    process: SimProcess
    lease: AsyncLease
    gpu: GpuId
    loaded: bool = False
    over: bool = False


@dataclass(frozen=True, slots=True)
class Character:
    """How a consumer behaves; probabilities per lease."""

    grows: float = 0.0  # holds more than it declared, and says so
    hides: float = 0.0  # holds more than it declared, and does not say so
    leaks: float = 0.0  # does not free everything
    fails_to_load: float = 0.05
    gives_up_waiting: float = 0.1
    pinned: float = 0.05
    exclusive: float = 0.15
    standby: float = 0.2
    parks: float = 0.2
    leases: int = 1


@dataclass(slots=True)
class Cast:
    """Everybody, and what they know of each other."""

    world: World
    asks: list[Ask] = field(default_factory=list)
    holdings: dict[str, Holding] = field(default_factory=dict)
    # lease → use → (by whom, in which epoch)
    uses: dict[str, dict[str, tuple[SimProcess, int | None]]] = field(default_factory=dict)
    stopping: bool = False
    granted: int = 0
    evicted: int = 0
    ooms: int = 0
    refusals: dict[str, int] = field(default_factory=dict)
    clients: list[SimClient] = field(default_factory=list)

    def entitlements(self) -> Iterator[Entitlement]:
        """Leases that living clients believe in, and would not have fenced by their own clock."""
        for client in self.clients:
            if not client.process.alive:
                continue
            for record in client.protocol.holdings.held.values():
                if client.now() >= client.protocol.holdings.fence_at(record):
                    continue
                spec = record.spec
                holding = self.holdings.get(record.lease_id)
                residue = spec.footprint.residue_bytes
                loaded = holding is not None and holding.loaded
                size = spec.footprint.steady_bytes if loaded else spec.footprint.load_peak_bytes
                yield Entitlement(
                    client.process.key,
                    record.lease_id,
                    GpuId(str(record.view.gpu)),
                    max(size, residue),
                    residue,
                    spec.exclusive,
                )

    def count_refusal(self, error: VramError) -> None:
        self.refusals[error.code] = self.refusals.get(error.code, 0) + 1

    def used_by_others(self, holding: Holding) -> list[str]:
        """Uses that living processes in contact with this very daemon began on a lease and have not
        ended."""
        epoch = self.world.machine.epochs[-1]
        return [
            use
            for use, (process, began_in) in self.uses.get(holding.lease.lease_id, {}).items()
            if process.alive and process is not holding.process and began_in == epoch
        ]

    def living(self) -> list[Holding]:
        """Leases that are held, in use or idle, by processes that live."""
        return [
            holding
            for holding in self.holdings.values()
            if holding.loaded
            and not holding.over
            and holding.lease.state == "held"
            and holding.process.alive
        ]


class Program(ABC):
    """One simulated program: its process, its client, its life as a coroutine."""

    role: Role = "client"
    uid = 1000

    def __init__(self, cast: Cast, name: str, pid: int | None = None) -> None:
        self.cast, self.world = cast, cast.world
        self.random = cast.world.clock.random
        self.process = cast.world.spawn(name, pid, self.uid)
        self.loop: ProcessLoop = self.process.loop
        self.client: SimClient
        self.done = False
        self.loop.enter(lambda: self.loop.create_task(self._live()).add_done_callback(self._ended))

    def _ended(self, task: asyncio.Task[None]) -> None:
        if error := task.exception():
            self.world.fail(f"{self.process.name} raised {type(error).__name__}: {error}")

    async def _live(self) -> None:
        self.client = SimClient(self.world, self.process, self.role)
        self.cast.clients.append(self.client)
        async with AsyncExitStack() as connection:
            while not self.client.connected:
                try:
                    await connection.enter_async_context(self.client)
                except ArbiterUnreachable:
                    await asyncio.sleep(CONNECT_PAUSE_S)
            await self.life()
        self.done = True
        self.world.clock.after(0.001, lambda: self.world.kill(self.process))

    @abstractmethod
    async def life(self) -> None:
        """What it does between its hello and its end."""

    async def pause(self, longest_s: float) -> None:
        await asyncio.sleep(self.random.random() * longest_s)


class Consumer(Program):
    """A process with models."""

    def __init__(self, cast: Cast, name: str, character: Character, pid: int | None = None) -> None:
        self.character = character
        self.residue_bytes = cast.world.clock.random.choice(RESIDUES)  # a process has one context
        super().__init__(cast, name, pid)

    async def life(self) -> None:
        lives = [self.loop.create_task(self._slot(n)) for n in range(self.character.leases)]
        for life in lives:
            await life

    async def _slot(self, slot: int) -> None:
        while not self.cast.stopping:
            await self.pause(1.5)
            if self.cast.stopping:
                return
            lease = await self._acquire(slot)
            if lease is not None:
                await self._hold(lease)

    def _spec(self, slot: int) -> LeaseSpec:
        chance, choice = self.world.clock.chance, self.random.choice
        peak = choice(SIZES)
        steady = peak if chance(0.5) else max(peak // 2, self.residue_bytes)
        gpus = ["any", *(str(info.index) for info in self.world.gpus), *self.world.devices]
        return checked_spec(
            {
                "consumer": self.process.name,
                "model_id": f"{self.process.name}-{slot}",
                "gpu": choice(gpus),
                "mode": "exclusive" if chance(self.character.exclusive) else "shared",
                "footprint": Footprint(
                    load_peak_bytes=max(peak, self.residue_bytes),
                    steady_bytes=steady,
                    residue_bytes=self.residue_bytes,
                ),
                "priority": choice((45, 50, 50, 55)),
                "evictable": not chance(self.character.pinned),
                "ttl_s": choice((2.0, 5.0, 10.0)),
                "min_residency_s": choice((0.0, 0.5, 2.0)),
                "standby": chance(self.character.standby),
                "park_bytes": steady if chance(self.character.parks) else 0,
            }
        )

    async def _acquire(self, slot: int) -> AsyncLease | None:
        timeout_s = self.random.choice(WAITS)
        spec = self._spec(slot)
        ask = Ask(self.process.name, self.world.clock.now, timeout_s, self.process, spec)
        self.cast.asks.append(ask)
        holding: list[Holding] = []

        async def unload() -> None:
            await self._watched(self._unload(holding[0]))

        async def restore(_: AsyncLease) -> None:
            await self._watched(self._come_back(holding[0]))

        async def lost(_: AsyncLease, error: VramError) -> None:
            self.cast.count_refusal(error)

        work = self.loop.create_task(
            self.client.acquire(
                spec, timeout_s, unload=unload, park=unload, restore=restore, on_lost=lost
            )
        )
        ask.give_up = lambda: self.loop.enter(work.cancel)
        if self.world.clock.chance(self.character.gives_up_waiting):
            self.loop.call_later(self.random.random() * 4.0, work.cancel)
        try:
            lease = await work
        except asyncio.CancelledError:
            ask.outcome = "cancelled"
            return None
        except VramError as error:
            ask.outcome = error.code
            self.cast.count_refusal(error)
            return None
        finally:
            ask.ended_at = self.world.clock.now
        ask.outcome = "granted"
        self.cast.granted += 1
        held = Holding(self.client, self.process, lease, GpuId(lease.gpu))
        holding.append(held)
        self.cast.holdings[lease.lease_id] = held
        return lease

    async def _watched(self, work: Awaitable[None]) -> None:
        """The library survives what a callback raises; here it is a defect of the simulation."""
        try:
            await work
        except VramError as error:
            self.cast.count_refusal(error)
        except Exception as error:
            self.world.fail(f"{self.process.name}: {type(error).__name__}: {error}")
            raise

    # -- holding
    async def _hold(self, lease: AsyncLease) -> None:
        holding = self.cast.holdings[lease.lease_id]
        try:
            await self._make_use_of(holding)
        except VramError as error:
            self.cast.count_refusal(error)
        while lease.state != "gone":  # idle, or away, until somebody wants the room
            await asyncio.sleep(0.5)
            if self.cast.stopping:
                await self.pause(3.0)
                await lease.give_up()
            elif lease.state in ("standby", "parked") and self.world.clock.chance(0.1):
                await self._want_back(lease)
            elif lease.state == "held" and holding.loaded and self.world.clock.chance(0.1):
                with contextlib.suppress(VramError):
                    await self._work(holding)
            elif lease.state == "held" and lease.spec.park_bytes and self.world.clock.chance(0.05):
                await lease.park()
                self.world.faults["parked_by_itself"] += 1
        await lease.wait_gone()

    async def _make_use_of(self, holding: Holding) -> None:
        lease = holding.lease
        if not await self._load(holding):
            await lease.give_up()
            return
        measured = await self._settle(holding)
        holding.loaded = True
        self.world.touch()
        await lease.ready(measured)
        await self._work(holding)
        if self.cast.stopping or not lease.spec.evictable or self.world.clock.chance(0.3):
            await lease.give_up()

    async def _come_back(self, holding: Holding) -> None:
        """Granted again after an eviction."""
        holding.loaded = holding.over = False
        holding.gpu = GpuId(holding.lease.gpu)
        self.world.faults["returned"] += 1
        await self._make_use_of(holding)

    async def _want_back(self, lease: AsyncLease) -> None:
        ask = Ask(self.process.name, self.world.clock.now, 10.0, self.process, lease.spec)
        self.cast.asks.append(ask)
        self.world.faults["reacquired"] += 1
        try:
            await lease.reacquire(10.0)
            ask.outcome = "returned"
        except VramError as error:
            ask.outcome = error.code
            self.cast.count_refusal(error)

    async def _load(self, holding: Holding) -> bool:
        """In steps, context first; the last step is the temporary peak. False: given up or
        failed."""
        device, key = self.world.devices[holding.gpu], self.process.key
        footprint = holding.lease.spec.footprint
        load_s = self.random.uniform(0.05, 1.2)
        fails = self.world.clock.chance(self.character.fails_to_load)
        weights = max(0, footprint.load_peak_bytes - self.residue_bytes)
        for step in range(LOAD_STEPS):
            await asyncio.sleep(load_s / LOAD_STEPS)
            if not self.client.may_load(holding.lease):
                return False
            if fails and step:
                return False
            part = (
                weights // LOAD_STEPS
                if step < LOAD_STEPS - 1
                else weights - 2 * (weights // LOAD_STEPS)
            )
            reused = min(part, device.held.get((key, "leak"), 0))  # its allocator has these already
            missing = self.residue_bytes - device.held.get((key, "context"), 0)
            try:
                device.rename(key, "leak", holding.lease.lease_id, reused)
                if missing > 0:
                    device.allocate(key, "context", missing)
                device.allocate(key, holding.lease.lease_id, part - reused)
            except SimOutOfMemory as error:
                await self._report_oom(holding, part, error)
                return False
        return self.client.may_load(holding.lease)

    async def _report_oom(self, holding: Holding, wanted: int, error: SimOutOfMemory) -> None:
        """Somebody holds what was granted to us: legal only for stowaways, liars and growers."""
        self.cast.ooms += 1
        device = self.world.devices[holding.gpu]
        strange = [block for block in device.blocks() if block.tag in ("stranger", "excess")]
        if not strange and not self.world.distrusted:
            self.world.fail(
                f"{self.process.name} was granted {holding.lease.lease_id} and met: {error}"
            )
        await holding.lease.oom(
            wanted, device.held.get((self.process.key, holding.lease.lease_id), 0)
        )

    async def _settle(self, holding: Holding) -> int | None:
        """Drop the temporary peak; perhaps take more than was declared. Returns what is to be
        reported."""
        device, key, chance = (
            self.world.devices[holding.gpu],
            self.process.key,
            self.world.clock.chance,
        )
        lease_id, footprint = holding.lease.lease_id, holding.lease.spec.footprint
        steady = max(0, footprint.steady_bytes - self.residue_bytes)
        device.free(key, lease_id, device.held.get((key, lease_id), 0) - steady)
        await asyncio.sleep(0)
        grows, hides = chance(self.character.grows), chance(self.character.hides)
        if grows or hides:
            extra = int(footprint.steady_bytes * self.random.uniform(0.05, 0.4))
            try:
                device.allocate(key, "excess", extra)
            except SimOutOfMemory:
                extra = 0
            if grows:
                return max(footprint.steady_bytes, self.residue_bytes) + extra
        return self.random.choice((None, max(footprint.steady_bytes, self.residue_bytes)))

    async def _work(self, holding: Holding) -> None:
        lease = holding.lease
        for _ in range(self.random.randrange(4)):
            await self.pause(1.0)
            if lease.state != "held":
                return
            async with lease.use("work"):
                await self.pause(self.random.choice((0.05, 0.5, 3.0)))

    async def _unload(self, holding: Holding) -> None:
        """Called by the library at the safe point, or after a loss."""
        used = self.cast.used_by_others(holding)
        # without a connection no daemon can refuse
        alone = holding.lease.given_up and not self.client.connected
        if used and holding.lease.state != "gone" and not alone:
            self.world.fail(f"{holding.lease.lease_id} unloads while {used} use it")
        device, key = self.world.devices[holding.gpu], self.process.key
        await self.pause(0.5)
        tag = holding.lease.lease_id
        if self.world.clock.chance(self.character.leaks):
            device.rename(key, tag, "leak", device.held.get((key, tag), 0) // 3)
            self.world.faults["leak"] += 1
        device.free(key, tag)
        device.free(key, "excess")
        holding.over = True
        self.cast.evicted += 1


class Runner(Program):
    """Marks uses on leases of others by their tokens."""

    async def life(self) -> None:
        while not self.cast.stopping:
            await self.pause(2.0)
            if held := self.cast.living():
                await self._use(self.random.choice(held))

    async def _use(self, holding: Holding) -> None:
        lease = holding.lease
        try:
            use = await self.client.begin_use(lease.lease_id, lease.token, "goal", timeout_s=3.0)
        except VramError as error:
            self.cast.count_refusal(error)
            return
        marks = self.cast.uses.setdefault(lease.lease_id, {})
        marks[use.use_id] = (self.process, self.client.epoch)
        await self.pause(self.random.choice((0.1, 1.0, 5.0)))
        del marks[use.use_id]
        await use.end()


class Observer(Program):
    """Asks questions all the time: reads must never change or break anything."""

    role = "observer"

    async def life(self) -> None:
        while not self.cast.stopping:
            await self.pause(3.0)
            try:
                status = await self.client.status()
                names = sorted({view.consumer for view in status.leases})
                if names:
                    await self.client.why(self.random.choice(names))
            except VramError as error:
                self.cast.count_refusal(error)


class Operator(Program):
    """Somebody with a keyboard: evicts, pins and unpins, drains and resumes."""

    role = "operator"
    uid = 0

    async def life(self) -> None:
        while not self.cast.stopping:
            await self.pause(12.0)
            action = self.random.choice(("evict", "evict", "pin", "drain", "release_dead"))
            if action == "drain":
                await self._do("drain")
                await self.pause(4.0)
                continue_with = "resume"
                target = ""
            elif held := self.cast.living():
                target = self.random.choice(held).lease.lease_id
                await self._do(action, target)
                await self.pause(3.0)
                continue_with = "unpin" if action == "pin" else ""
            else:
                continue
            while continue_with and not await self._do(continue_with, target):
                await self.pause(1.0)
        # an operator before this one may have died with the GPU drained
        while not await self._do("resume"):
            await self.pause(1.0)

    async def _do(self, action: str, target: str = "") -> bool:
        """False: nobody answered, say it again."""
        request = REQUESTS[action]("simulated", *([target] if target else []))
        try:
            await self.client.ask(request, timeout_s=5.0)
        except ArbiterUnreachable:
            return False
        except VramError as error:
            self.cast.count_refusal(error)
        self.world.faults[f"operator_{action}"] += 1
        return True
