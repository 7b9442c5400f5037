"""One small world: the engine, its journal, GPUs, clients, and what is under way between them.

An action is what may happen next (`World.actions`); `World.act` lets it happen and checks what must
hold then. Nothing else happens, so the order of the actions is the whole story. Every event has a
moment of its own, `STEP_S` after the one before; time passes otherwise only by `tick`, `late` and
`sleep`. It knows neither how worlds are searched nor which of them are alike.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from tests.explore.client import Broken, Client, Told
from tests.support.engine_state import state_of
from tests.support.full_check import check_arbiter
from vram_arbiter.arbiter.core import effects as fx
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.arbiter.core.model.records import AnyRecord, LeaseRecord
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.arbiter.core.verification.judge import DYING_S
from vram_arbiter.arbiter.host.records import processes_of
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey, RequestId
from vram_arbiter.schemas.wire.spec import LeaseSpec

CAPACITY_BYTES, OVERHEAD_BYTES = 8 * d.GIB, 100 * d.MIB
"""Of each GPU; the driver's own."""
START_S, STEP_S = 1024.0, 2.0**-20
FOR_EVER_S, FAR_S = 3600.0, 600.0
"""The longest time to live; what is due so much later is not waited for."""
LAG_S = 1.5
"""The longest time in which a driver returns memory."""
SLEEP_EVENTS_MAX = 1000
QUICK: Mapping[str, Any] = {
    "ageing_s_per_point": 1e6,
    "revoke_resend_s": 1.0,
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
REST = "rest"
_PERIODIC = ("probe", "verify", "revoke")

type Action = tuple[str, str]
"""(verb, whose): the name of a client, a process or a GPU; ""."""


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


@dataclass(slots=True)
class Device:
    """One GPU, and the one reading of it that may be under way (`host.prober`)."""

    gpu: GpuId
    lists: bool
    held: dict[ProcessKey, int] = field(default_factory=dict)
    late: dict[ProcessKey, int] = field(default_factory=dict)  # given up, and shown all the same
    freed_at: float = 0.0  # the last of that
    reading: ev.MemorySampled | None = None
    again: bool = False  # a question came after the reading began

    def set(self, process: ProcessKey, count: int, freed_at: float | None) -> None:
        """A process holds so many bytes from now on. `freed_at`: when it gave up the others, if the
        driver does not return them at once."""
        freed = self.held.pop(process, 0) - count
        if freed_at is not None and freed > 0:
            self.late[process] = self.late.get(process, 0) + freed
            self.freed_at = freed_at
        if count:
            self.held[process] = count

    def used_bytes(self) -> int:
        """Return what a reading shows."""
        return OVERHEAD_BYTES + sum(self.held.values()) + sum(self.late.values())

    def ask(self, now: float) -> None:
        """Begin a reading right after the event that asks for it, or after the one under way."""
        self.again = self.reading is not None
        if not self.again:
            at = now + STEP_S / 2
            listed = tuple(
                ev.ProcessUse(process, "", self.held.get(process, 0) + self.late.get(process, 0))
                for process in sorted(self.held.keys() | self.late.keys())
            )
            told = (self.used_bytes(), CAPACITY_BYTES, listed if self.lists else None)
            self.reading = ev.MemorySampled(self.gpu, at, *told)


@lru_cache(maxsize=64)
def _settings(gpus: int, epoch: int) -> Settings:
    infos = [
        GpuInfo(GpuId(f"GPU-{n}"), n, "", CAPACITY_BYTES, total_bytes=CAPACITY_BYTES)
        for n in range(gpus)
    ]
    return Settings(epoch=epoch, gpus=tuple(infos), **QUICK)


class World:
    """See the module. `left`: how often each fault may still happen."""

    engine: Arbiter

    def __init__(self, scenario: Scenario) -> None:
        self.origin: Mapping[str, object] = {}  # what its parts were thawed from
        self.touched = set[str]()  # parts that may have changed since then
        self.scenario, self.left = scenario, dict(scenario.faults)
        self.now, self.epoch = START_S, 0
        gpus = [info.id for info in _settings(scenario.gpus, 1).gpus]
        self.devices = {gpu: Device(gpu, scenario.lists) for gpu in gpus}
        self.clients = {
            name: Client(name, spec, scenario.acquires)
            for name, spec in zip("abcdef", scenario.clients, strict=False)
        }
        self.journal: dict[str, AnyRecord] = {}
        self.last_token = (0, 0)
        self.dead: set[ProcessKey] = set()
        self.unheard: list[ProcessKey] = []  # deaths that the daemon will hear of
        self.lied = False
        self.do_restart()
        for client in self.clients.values():
            client.act("connect", self)
            self._deliver(mail=True, readings=True)
        for action in story(scenario.after):
            self.act(action)

    # -- its parts
    def parts(self) -> dict[str, Any]:
        """Return what shares nothing that changes: the engine, each client, the rest."""
        apart = ("engine", "clients", "origin", "touched")
        rest = {name: value for name, value in vars(self).items() if name not in apart}
        return {REST: rest, "engine": self.engine, **self.clients}

    def put_back(self, name: str, part: Any) -> None:
        if name == REST:
            vars(self).update(part)
        elif name == "engine":
            self.engine = part
        else:
            self.clients[name] = part

    # -- what may happen
    def actions(self) -> list[Action]:
        """Return everything that may happen next."""
        found = [(verb, one.name) for one in self.clients.values() for verb in one.actions()]
        for gpu, device in self.devices.items():
            if device.reading is not None:
                found += [("read", gpu), ("fail", gpu)]
                found += [("lie", f"{gpu} {lie}") for lie in LIES]
            found += [("return", gpu)] if device.late else []
        found += [("die", str(process)) for process in self.unheard] + [("restart", "")]
        tick, sleep = self._next_at(), self._decisive_at()
        if self._is_busy():  # what is under way arrives before time passes, unless it may be late
            found += [("late", "")] if tick is not None else []
        else:
            found += [("tick", "")] if tick is not None else []
            found += [("sleep", "")] if sleep is not None and sleep != tick else []
        return [one for one in found if one[0] not in FAULTS or self.left.get(one[0])]

    def act(self, action: Action) -> None:
        """Let something happen. Raises what must not be raised."""
        verb, whose = action
        self.touched.add(REST)
        if verb in self.left:
            self.left[verb] -= 1
        if whose in self.clients:
            self.clients[whose].act(verb, self)
        else:
            getattr(self, f"do_{verb}")(*whose.split())
        self._deliver(mail=not self.scenario.talks, readings=self.scenario.talks)
        if "engine" in self.touched:
            check_arbiter(self.engine)
        self._check(state_of(self.engine))

    def _deliver(self, *, mail: bool, readings: bool) -> None:
        """Let arrive what is not under way in this scenario, in the order of clients and GPUs."""
        while True:
            under_way = [one for one in self.clients.values() if mail and one.has_mail()]
            read = [one.gpu for one in self.devices.values() if readings and one.reading]
            if under_way:
                under_way[0].act("send" if under_way[0].up else "hear", self)
            elif read:
                self.do_read(read[0])
            else:
                return

    # -- the engine
    def post(self, event: ev.Event) -> None:
        """Hand an event to the engine and perform what it asks, as the executor does."""
        self.now += STEP_S
        self.touched.add("engine")
        effects = self.engine.handle(event, self.now)
        for effect in effects:
            match effect:
                case fx.JournalPut(key, record, gates):
                    self.journal[key] = record
                    if gates and isinstance(record, LeaseRecord):
                        self._check_token(record.token)
                case fx.JournalDelete(key):
                    self.journal.pop(key, None)
                case fx.Reply(client, number, body):
                    self._tell(client, body, number)
                case fx.Refuse(client, number, refusal):
                    self._tell(client, refusal, number)
                case fx.Push(client, body):
                    self._tell(client, body, None)
                case fx.Sample(gpu):
                    self.devices[gpu].ask(self.now)
                case _:
                    pass

    def _tell(self, to: ClientId, told: Told, re: RequestId | None) -> None:
        client = self.clients.get(to.partition("-")[0])
        if client is not None and client.client == to:
            self.touched.add(client.name)
            client.down.append((re, told))

    def hold(self, process: ProcessKey, gpu: GpuId, count: int) -> None:
        """A process holds so many bytes on a GPU from now on."""
        self.devices[gpu].set(process, count, self.now if self.scenario.lags else None)

    def kill(self, process: ProcessKey) -> None:
        """A process dies: its bytes go, and the daemon will hear of it."""
        for gpu in self.devices:
            self.hold(process, gpu, 0)
        self.dead.add(process)
        self.unheard.append(process)

    # -- verbs of no client
    def do_restart(self) -> None:
        """The daemon starts, perhaps after an earlier one."""
        self.epoch += 1
        self.engine = self.scenario.engine(_settings(self.scenario.gpus, self.epoch), self.now)
        for device in self.devices.values():
            device.reading, device.again = None, False
        for client in self.clients.values():
            self.touched.add(client.name)
            client.cut_off()
        records = dict(self.journal)
        self.post(ev.Recovered(records) if records else ev.Tick())
        self.unheard = sorted(set(processes_of(records)) & self.dead)

    def do_die(self, process: str) -> None:
        (found,) = [one for one in self.unheard if str(one) == process]
        self.unheard.remove(found)
        self.post(ev.ProcessDied(found))

    def do_return(self, gpu: str) -> None:
        self.devices[GpuId(gpu)].late.clear()

    def do_read(self, gpu: str) -> None:
        self._answer(self._reading(gpu))

    def do_fail(self, gpu: str) -> None:
        self._answer(ev.ProbeFailed(GpuId(gpu), self.now, "failed"))

    def do_lie(self, gpu: str, lie: str) -> None:
        self.lied = True
        listed = () if lie == "nothing" else self._reading(gpu).processes
        told = (LIES[lie], CAPACITY_BYTES, listed)
        self._answer(ev.MemorySampled(GpuId(gpu), self._reading(gpu).taken_at, *told))

    def _reading(self, gpu: str) -> ev.MemorySampled:
        reading = self.devices[GpuId(gpu)].reading
        assert reading is not None
        return reading

    def _answer(self, told: ev.MemorySampled | ev.ProbeFailed) -> None:
        device = self.devices[told.gpu]
        device.reading = None
        self.post(told)
        if device.again:
            device.ask(self.now)

    # -- time
    def _is_busy(self) -> bool:
        return any(device.reading for device in self.devices.values()) or any(
            client.has_mail() for client in self.clients.values()
        )

    def _next_at(self) -> float | None:
        """Return when something is due."""
        times = [one.protocol.next_deadline() for one in self.clients.values()]
        return self._first([at for at in (self.engine.next_deadline(), *times) if at is not None])

    def _first(self, times: list[float]) -> float | None:
        return min([at for at in times if at < self.now + FAR_S], default=None)

    def _decisive_at(self) -> float | None:
        """Return when something is due that is not done again and again."""
        core = state_of(self.engine)
        times = [at for one in self.clients.values() for at in one.decisive_times()]
        times += [at for (kind, _), at in core.timers.items() if kind not in _PERIODIC]
        for gpu in core.gpus.values():
            debts = gpu.verifications.values()
            times += [one.deadline_at + DYING_S * one.overdue for one in debts]
            unloading = gpu.in_state(LeaseState.UNLOADING)
            times += [
                core.timers[key] for one in unloading if (key := ("revoke", one.id)) in core.timers
            ]
            asked = [one.departure.eviction for one in gpu.in_state(LeaseState.REVOKING)]
            revoke_s = core.settings.revoke_deadline_s
            times += [one.asked_at + revoke_s for one in asked if one and not one.overdue]
        return self._first([at for at in times if at > self.now])

    def do_tick(self) -> None:
        """Time passes to the next deadline, which is served."""
        at = self._next_at()
        assert at is not None
        self.now = max(self.now, at)
        for device in self.devices.values():
            if self.now > device.freed_at + LAG_S:
                device.late.clear()
        for client in self.clients.values():
            client.tick(self)
        due = self.engine.next_deadline()
        if due is not None and due <= self.now:
            self.post(ev.Tick())

    do_late = do_tick

    def do_sleep(self) -> None:
        """Time passes to the next decisive moment; what is said on the way is as it should be."""
        until = self._decisive_at()
        assert until is not None
        for _ in range(SLEEP_EVENTS_MAX):
            self._deliver(mail=True, readings=True)
            at = self._next_at()
            if at is None or at > until:
                return
            self.do_tick()

    # -- what must hold
    def _check_token(self, token: tuple[int, int]) -> None:
        if token <= self.last_token:
            raise Broken(f"token {token} was granted after {self.last_token}")
        self.last_token = token

    def _check(self, core: Core) -> None:
        for client in self.clients.values():
            client.check(core)
        for gpu_id, device in self.devices.items():
            gpu = core.gpus[gpu_id]
            if not self.lied:
                self._check_bytes(core, device)
            head = gpu.queue.head
            if head is None or core.blocked(gpu) or gpu.asked_at is not None:
                continue
            room = admission.measured_room_bytes(gpu, core.now - core.settings.sample_max_age_s)
            needed = admission.measured_need_bytes(gpu, head)
            if admission.fits(gpu, head) and room is not None and room >= needed:
                raise Broken(f"{head.id} fits on {gpu_id} and is not granted")

    def _check_bytes(self, core: Core, device: Device) -> None:
        """What is granted or occupied fits; what a process with a lease holds is charged."""
        total, clients = device.used_bytes(), self.clients.values()
        total += sum(
            one.coming_bytes(device.gpu, device.held.get(one.process, 0)) for one in clients
        )
        if total > CAPACITY_BYTES:
            raise Broken(f"{total} bytes are granted or occupied on {device.gpu}")
        accounts = core.gpus[device.gpu].ledger.accounts
        slack = 0 if device.lists else d.RESERVE_BYTES + d.VERIFY_TOLERANCE_BYTES
        for process, held in device.held.items():
            charged = accounts[process].charged_bytes if process in accounts else 0
            excused = any(one.over for one in clients if one.process == process)
            if held > charged + slack and not excused:
                raise Broken(f"{process} holds {held} bytes on {device.gpu}, {charged} are charged")
