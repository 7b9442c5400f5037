"""The simulated machine: processes that live, hang and die, GPUs, a wire, and a daemon that can be
killed and started again.

Clients are brought by the caller (the daemon's tree must not import them): a client opens a `Link`
for a `SimProcess` and runs on that process's loop. After every step of the clock the world looks at
what must hold whatever happens; the first breach ends the run:

    * the core never raises (its own invariants are on), and no task of anybody fails
    * tokens grow over all grants, also across restarts
    * on the physical GPU: what processes were granted or still occupy never exceeds the capacity,
    and nobody shares an exclusive GPU
    * no lost wake-up: whenever the core rests, the head of a queue does not fit
"""

import contextlib
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.support.engine_state import state_of
from tests.support.full_check import forgotten_waiter
from tests.support.simulation.clock import TRACE_LINES, Clock, ProcessLoop, new_loop
from tests.support.simulation.daemon import Happening, Machine, SimDaemon
from tests.support.simulation.device import Device, ProbeFaults
from tests.support.simulation.wire import Link, SimWire
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import GpuId, ProcessKey
from vram_arbiter.schemas.runtime.peercred import Peer

DEATH_SEEN_S = (0.0002, 0.02)  # pidfd
CAPACITY_BYTES = 8 * d.GIB
OVERHEAD_BYTES = 100 * d.MIB  # the driver's own

QUICK: Mapping[str, float] = {
    "ageing_s_per_point": 1.0,
    "revoke_deadline_s": 8.0,
    "verify_timeout_s": 4.0,
    "fence_grace_s": 2.0,
    "host_ram_budget_bytes": 6 * d.GIB,
}
"""Shorter than in production, so that a minute of simulated time sees several of each."""


class SimFailure(AssertionError):
    """Something that must hold did not. The message has the seed and the last lines of the
    trace."""


@dataclass(frozen=True, slots=True)
class Entitlement:
    """A lease as its holder believes it: what it may put on the GPU now."""

    process: ProcessKey
    lease_id: str
    gpu: GpuId
    bytes: int
    residue_bytes: int
    exclusive: bool


@dataclass(slots=True)
class SimProcess:
    """One process: its loop, its sockets, its key."""

    key: ProcessKey
    name: str
    loop: ProcessLoop
    peer: Peer
    links: list[Link] = field(default_factory=list)
    on_kill: list[Callable[[], None]] = field(default_factory=list)

    @property
    def alive(self) -> bool:
        return not self.loop.dead


class World:
    """One simulated machine. `entitlements` is the clients' side of the truth, set by whoever
    brings the clients."""

    def __init__(
        self,
        seed: int,
        folder: Path,
        *,
        gpus: int = 1,
        capacity_bytes: int = CAPACITY_BYTES,
        settings: Mapping[str, Any] = QUICK,
        lines_max: int | None = TRACE_LINES,
    ) -> None:
        self.seed = seed
        self.clock = Clock(seed, lines_max)
        self.wire = SimWire(self.clock)
        self.gpus = tuple(
            GpuInfo(GpuId(f"GPU-{index}"), index, f"simulated {index}", capacity_bytes)
            for index in range(gpus)
        )
        self.devices = {
            info.id: Device(self.clock, info.id, capacity_bytes, OVERHEAD_BYTES)
            for info in self.gpus
        }
        overrides = dict(settings)
        self.machine = Machine(
            self.clock,
            self.wire,
            self.devices,
            folder,
            lambda epoch: Settings(epoch=epoch, gpus=self.gpus, **overrides),
            {gpu: ProbeFaults() for gpu in self.devices},
        )
        self.daemon: SimDaemon | None = None
        self.processes: dict[ProcessKey, SimProcess] = {}
        self.faults: Counter[str] = Counter()
        self.entitlements: Callable[[], Iterator[Entitlement]] = lambda: iter(())
        self.failure: str | None = None
        self.distrusted_until = (
            0.0  # a probe says that less is used than is: what is measured means nothing so long
        )
        self._pids = 100
        self._touched = False
        self._handled = -1
        self._notes_seen = 0
        self._last_token = (0, 0)
        self.clock.after_step = self._after_step

    # -- failing
    @property
    def distrusted(self) -> bool:
        return self.clock.now < self.distrusted_until

    def fail(self, what: str) -> None:
        """Remember the first breach; the clock's next return to us ends the run."""
        if self.failure is None:
            self.clock.say(f"BREACH {what}")
            self.failure = what

    def raise_failure(self) -> None:
        if self.failure is not None:
            lines = "\n".join(self.clock.trace.lines)
            raise SimFailure(f"{lines}\nseed {self.seed}: {self.failure}")

    # -- processes
    def spawn(self, name: str, pid: int | None = None, uid: int = 1000) -> SimProcess:
        """A new process; a pid may be one that a dead process had."""
        if pid is None:
            self._pids += 1
            pid = self._pids
        key = ProcessKey(pid, int(self.clock.now * 100))
        loop = new_loop(self.clock, f"{name}:{pid}")
        process = SimProcess(key, name, loop, Peer(key, uid, uid, -1))
        loop.on_failure = lambda error: self.fail(
            f"{name} ({key}): {type(error).__name__}: {error}"
        )
        self.processes[key] = process
        self.machine.alive[pid] = key
        for device in self.devices.values():
            device.names[key] = name
        self.clock.say(f"process {name} {key} starts")
        return process

    def open_link(
        self,
        process: SimProcess,
        received: Callable[[dict[str, Any]], None],
        hung_up: Callable[[], None],
    ) -> Link:
        link = Link(self.wire, process.loop, process.peer, received, hung_up)
        process.links = [known for known in process.links if not known.closed]
        process.links.append(link)
        return link

    def kill(self, process: SimProcess) -> None:
        """SIGKILL, also of a stopped process. The kernel takes its sockets and its memory; the
        daemon's pidfd becomes readable."""
        if not process.alive:
            return
        self.clock.say(f"process {process.name} {process.key} dies")
        process.loop.kill()
        for link in process.links:
            link.close()
        for callback in process.on_kill:
            callback()
        if self.machine.alive.get(process.key.pid) == process.key:
            del self.machine.alive[process.key.pid]
        for device in self.devices.values():
            device.bury(process.key)
        seen = self.clock.random.uniform(*DEATH_SEEN_S)
        self.clock.after(seen, lambda: self._tell_death(process.key))
        self.touch()

    def _tell_death(self, key: ProcessKey) -> None:
        if self.daemon is not None:
            self.daemon.process_died(key)

    # -- the daemon
    def start_daemon(self) -> None:
        assert self.daemon is None or self.daemon.loop.dead, "the daemon runs already"
        self.daemon = SimDaemon(self.machine, self._core_failed)
        self._handled = -1
        self.daemon.start()

    def kill_daemon(self, reason: str = "SIGKILL") -> None:
        if self.daemon is not None:
            self.daemon.kill(reason)

    @property
    def serving(self) -> bool:
        return self.daemon is not None and not self.daemon.loop.dead

    def reboot(self) -> None:
        """Power cut: every process is gone, the GPUs are empty, the boot id is new. The journal's
        file survives."""
        self.kill_daemon("power cut")
        for process in list(self.processes.values()):
            self.kill(process)
        for device in self.devices.values():
            device.held.clear()
            device.late.clear()
        self.machine.boot += 1

    def _core_failed(self, error: BaseException) -> None:
        self.fail(f"the core raised {type(error).__name__}: {error}")

    # -- what must hold
    def touch(self) -> None:
        """Somebody's belief or bytes changed: look at the GPUs after this step."""
        self._touched = True

    def _after_step(self) -> None:
        if self._touched:
            self._touched = False
            self._check_devices()
        history = self.machine.history
        while self._notes_seen < len(history):
            self._check_note(history[self._notes_seen])
            self._notes_seen += 1
        if (
            self.daemon is not None
            and not self.daemon.loop.dead
            and self.daemon.handled != self._handled
        ):
            self._handled = self.daemon.handled
            self._check_wake_up(self.daemon)
        self.raise_failure()

    def _check_note(self, note: Happening) -> None:
        if note.kind != "granted":
            return
        token = self.machine.tokens[str(note.data["lease_id"])]
        if token <= self._last_token:
            self.fail(f"token {token} was granted after {self._last_token}")
        self._last_token = token

    def _check_devices(self) -> None:
        granted: dict[GpuId, list[Entitlement]] = {gpu: [] for gpu in self.devices}
        for entitlement in self.entitlements():
            if entitlement.gpu not in granted:
                self.fail(
                    f"{entitlement.process} believes that {entitlement.lease_id} is on "
                    f"{entitlement.gpu}"
                )
                return
            granted[entitlement.gpu].append(entitlement)
        for gpu, device in self.devices.items():
            self._check_device(device, granted[gpu])

    def _check_device(self, device: Device, granted: list[Entitlement]) -> None:
        """Granted or still occupied: per lease the larger of the two, and one context for each
        process. What a process did not free counts towards its next lease: its allocator hands it
        out again.
        """
        held: dict[tuple[ProcessKey, str], int] = {}
        contexts: dict[ProcessKey, int] = {}
        leaks: dict[ProcessKey, int] = {}
        for block in device.blocks():
            if block.tag == "context":
                contexts[block.process] = block.count
            elif block.tag == "leak":
                leaks[block.process] = block.count
            elif block.tag not in ("excess", "stranger"):
                held[block.process, block.tag] = block.count
        weights = dict(held)
        for e in granted:
            key = (e.process, e.lease_id)
            weights[key] = max(weights.get(key, 0), e.bytes - e.residue_bytes)
            contexts[e.process] = max(contexts.get(e.process, 0), e.residue_bytes)
        total = sum(contexts.values())
        for process in dict.fromkeys([*(owner for owner, _ in weights), *leaks]):
            promised = sum(count for (owner, _), count in weights.items() if owner == process)
            there = sum(count for (owner, _), count in held.items() if owner == process)
            total += max(promised, there + leaks.get(process, 0))
        if total > device.total_bytes and not self.distrusted:
            self.fail(
                f"{device.gpu}: {total} bytes are granted or occupied, it has "
                f"{device.total_bytes}: {weights}, contexts {contexts}, leaks {leaks}"
            )
        for exclusive in (e for e in granted if e.exclusive):
            others = [e.lease_id for e in granted if e.lease_id != exclusive.lease_id]
            if others:
                self.fail(f"{device.gpu}: {others} beside the exclusive {exclusive.lease_id}")

    def _check_wake_up(self, daemon: SimDaemon) -> None:
        if waiter := forgotten_waiter(state_of(daemon.core)):
            self.fail(f"lost wake-up: {waiter} fits and is not granted")

    # -- running
    def run(self, seconds: float, done: Callable[[], bool] | None = None) -> bool:
        """Let simulated time pass. Raises SimFailure at the first breach. With `done`: whether it
        came to hold."""
        held = self.clock.run_until(self.clock.now + seconds, done)
        self.raise_failure()
        return held


@contextlib.contextmanager
def state_folder() -> Iterator[Path]:
    """A folder for journals, in memory where the machine has one: the journal's own fsync is not
    under test here."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(
        prefix="vram-sim-", dir=memory if memory.is_dir() else None
    ) as folder:
        yield Path(folder)
