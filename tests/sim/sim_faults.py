"""What goes wrong, chosen by chance: one table of faults, each a few lines. A new feature adds its
faults as rows."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from tests.sim.sim_clients import Cast, Program
from tests.support.simulation.device import ProbeFaults, SimOutOfMemory
from tests.support.simulation.wire import QUEUE_MAX, WireFaults
from tests.support.simulation.world import World
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import ProcessKey

FAULT_PAUSE_S = 1.4  # on average
DAEMON_AWAY_S = (0.05, 0.3, 1.5, 4.0, 15.0)
FROZEN_S = (0.3, 3.0, 9.0, 20.0)
STRANGER = ProcessKey(66, 1)
DISTRUST_S = 25.0  # the fault itself, and what was granted upon it


@dataclass(frozen=True, slots=True)
class Slot:
    """A place for a program: how to start it (on a given pid, or any)."""

    start: Callable[[int | None], Program]


class Nemesis:
    """Brings faults upon a world until it is told to stop."""

    def __init__(self, world: World, cast: Cast, slots: list[Slot]) -> None:
        self.world, self.cast, self.slots = world, cast, slots
        self.clock, self.random = world.clock, world.clock.random
        self.running: list[Program] = [slot.start(None) for slot in slots]
        self.stopped = False
        self.table: list[tuple[int, Callable[[], None]]] = [
            (8, self.kill_process),
            (8, self.freeze_process),
            (8, self.end_a_wait),
            (6, self.cut_link),
            (3, self.cut_link_silently),
            (3, self.slow_reader),
            (3, self.kill_daemon),
            (9, self.kill_daemon_at_a_step),
            (3, self.stop_daemon),
            (4, self.fill_disk),
            (4, self.fail_probe),
            (3, self.hang_probe),
            (2, self.lag_probe),
            (3, self.exaggerate),
            (1, self.understate),
            (3, self.hide_processes),
            (5, self.stowaway),
            (4, self.delay_messages),
            (4, self.duplicate_messages),
            (4, self.slow_device),
            (2, self.suspend),
            (1, self.power_cut),
        ]
        self._plan()

    # -- when
    def _plan(self) -> None:
        self.clock.after(self.random.expovariate(1 / FAULT_PAUSE_S), self._strike)

    def _strike(self) -> None:
        if self.stopped:
            return
        fault = self.random.choices(
            [fault for _, fault in self.table], [weight for weight, _ in self.table]
        )[0]
        self._count(fault.__name__)
        fault()
        self._plan()

    def _count(self, name: str) -> None:
        self.world.faults[name] += 1
        self.clock.say(f"fault {name}")

    def _for_a_while(self, undo: Callable[[], None], longest_s: float = 4.0) -> None:
        self.clock.after(self.random.random() * longest_s, undo)

    def calm(self) -> None:
        """No more faults; everything that is broken works again."""
        self.stopped = True
        world = self.world
        self.cast.stopping = True
        world.wire.faults = WireFaults()
        for faults in world.machine.probe_faults.values():
            self._heal(faults)
        for device in world.devices.values():
            device.lag_s = min(device.lag_s, 0.1)
            device.free(STRANGER, "stranger")
        for process in world.processes.values():
            if process.alive and process.loop.frozen:
                process.loop.thaw()
            for link in process.links:
                link.queue_max = QUEUE_MAX
        if not world.serving:
            world.start_daemon()
        daemon = world.daemon
        assert daemon is not None, "a daemon was started"
        daemon.journal_full = False
        daemon.crash_after(None)
        if daemon.loop.frozen:
            daemon.loop.thaw()
        if not self.running[-1].process.alive:  # the operator: somebody has to end a drain
            self.running[-1] = self.slots[-1].start(None)

    def _heal(self, faults: ProbeFaults) -> None:
        faults.failing, faults.hanging, faults.behind_s, faults.factor = "", False, 0.0, 1.0
        faults.unlisted = faults.unnamed_bytes = faults.forgets_the_dead = False
        faults.blind_to.clear()

    # -- processes
    def kill_process(self) -> None:
        index = self.random.randrange(len(self.slots))
        program = self.running[index]
        if not program.process.alive:
            return
        self.world.kill(program.process)
        pid = program.process.key.pid if self.clock.chance(0.3) else None  # pids are reused
        self.clock.after(self.random.uniform(0.01, 3.0), lambda: self._respawn(index, pid))

    def _respawn(self, index: int, pid: int | None) -> None:
        if self.running[index].process.alive or self.stopped:
            return
        if pid in self.world.machine.alive:
            pid = None
        self.running[index] = self.slots[index].start(pid)

    def freeze_process(self) -> None:
        loop = self.random.choice(self.running).loop
        if loop.dead or loop.frozen:
            return
        loop.freeze()
        self.clock.after(
            self.random.choice(FROZEN_S),
            lambda: loop.thaw() if loop.frozen and not loop.dead else None,
        )

    def end_a_wait(self, tries: int = 20) -> None:
        """The next waiter that a holder in use is revoked for gives up, or dies."""
        if self.stopped:
            return
        asks = [ask for ask in self.cast.asks if not ask.outcome and ask.process.alive]
        asks = [ask for ask in asks if ask.process.key in self._waited_for()]
        if not asks:
            if tries:
                self.clock.after(0.2, lambda: self.end_a_wait(tries - 1))
            return
        self._count("wait_ended_for_a_revoked_holder")
        ask = self.random.choice(asks)
        if self.clock.chance(0.7):
            ask.give_up()
            return
        index = next(n for n, one in enumerate(self.running) if one.process is ask.process)
        self.world.kill(ask.process)
        self.clock.after(self.random.uniform(0.01, 3.0), lambda: self._respawn(index, None))

    def _waited_for(self) -> set[ProcessKey]:
        """Return the processes that wait for a holder that is revoked, and in use."""
        daemon = self.world.daemon
        if daemon is None or not self.world.serving:
            return set()
        core = daemon.core.inspect()
        revoked = [
            one.departure.eviction
            for one in core.leases.values()
            if one.state is LeaseState.REVOKING and one.uses
        ]
        waiters = [
            core.waiting.get(asked.wanted_by) for asked in revoked if asked and asked.wanted_by
        ]
        return {waiter.process for waiter in waiters if waiter is not None}

    # -- the wire
    def cut_link(self) -> None:
        if links := self.world.wire.open_links():
            self.random.choice(links).cut(told=True)

    def cut_link_silently(self) -> None:
        if links := self.world.wire.open_links():
            self.random.choice(links).cut(told=False)

    def slow_reader(self) -> None:
        """Its process stops reading, and its queue is short: what comes beyond is dropped."""
        links = self.world.wire.open_links()
        if not links:
            return
        link = self.random.choice(links)
        link.queue_max = 3
        if not link.loop.frozen:
            link.loop.freeze()

        def undo() -> None:
            link.queue_max = QUEUE_MAX
            if link.loop.frozen and not link.loop.dead:
                link.loop.thaw()

        self._for_a_while(undo, 6.0)

    def delay_messages(self) -> None:
        faults = self.world.wire.faults
        faults.delayed, faults.delay_s = 0.3, self.random.choice((0.02, 0.3, 1.5))

        def undo() -> None:
            faults.delayed = 0.0

        self._for_a_while(undo)

    def duplicate_messages(self) -> None:
        faults = self.world.wire.faults
        faults.duplicated = 0.3

        def undo() -> None:
            faults.duplicated = 0.0

        self._for_a_while(undo)

    # -- the daemon
    def kill_daemon(self) -> None:
        if self.world.serving:
            self.world.kill_daemon()
            self._restart_later()

    def kill_daemon_at_a_step(self) -> None:
        daemon = self.world.daemon
        if daemon is None or not self.world.serving:
            return

        def crashed() -> None:
            self._count("daemon_crashed_at_a_step")
            self._restart_later()

        daemon.on_crash = crashed
        daemon.crash_after(self.random.randrange(12))

    def _restart_later(self) -> None:
        self.clock.after(self.random.choice(DAEMON_AWAY_S), self._restart)

    def _restart(self) -> None:
        if not self.world.serving:
            self.world.start_daemon()

    def stop_daemon(self) -> None:
        """SIGSTOP: messages and timers wait."""
        daemon = self.world.daemon
        if daemon is None or daemon.loop.dead or daemon.loop.frozen:
            return
        loop = daemon.loop
        loop.freeze()
        seconds = self.random.choice((0.1, 1.0, 5.0, 12.0))
        self.clock.after(seconds, lambda: loop.thaw() if loop.frozen and not loop.dead else None)

    def fill_disk(self) -> None:
        daemon = self.world.daemon
        if daemon is None:
            return
        daemon.journal_full = True

        def undo() -> None:
            daemon.journal_full = False

        self._for_a_while(undo, 3.0)

    def suspend(self) -> None:
        """The laptop sleeps: the clock stands still, the daemon learns of it before its
        next event."""
        self.world.machine.slept_s = self.random.choice((3.0, 600.0))

    def power_cut(self) -> None:
        self.world.reboot()
        self.clock.after(2.0, self._restart)
        for index in range(len(self.slots)):
            self.clock.after(self.random.uniform(2.0, 5.0), partial(self._respawn, index, None))

    # -- GPUs and probes
    def _spoil(self, spoil: Callable[[ProbeFaults], None]) -> None:
        faults = self.random.choice(list(self.world.machine.probe_faults.values()))
        spoil(faults)
        self._for_a_while(lambda: self._heal(faults))

    def fail_probe(self) -> None:
        def spoil(faults: ProbeFaults) -> None:
            faults.failing = "the driver says no"

        self._spoil(spoil)

    def hang_probe(self) -> None:
        def spoil(faults: ProbeFaults) -> None:
            faults.hanging = True

        self._spoil(spoil)

    def lag_probe(self) -> None:
        """Shows the GPU as it was: also what has been taken meanwhile is not there yet."""

        def spoil(faults: ProbeFaults) -> None:
            faults.behind_s = self.random.choice((0.05, 0.5, 1.5))

        self._spoil(spoil)
        self._distrust()

    def exaggerate(self) -> None:
        """A lie in the careful direction."""

        def spoil(faults: ProbeFaults) -> None:
            faults.factor = self.random.choice((1.1, 1.5, 10.0))

        self._spoil(spoil)

    def understate(self) -> None:
        """A lie in the dangerous direction: nobody can be safe from it, but everybody must come out
        of it."""

        def spoil(faults: ProbeFaults) -> None:
            faults.factor = self.random.choice((0.0, 0.5))

        self._spoil(spoil)
        self._distrust()

    def _distrust(self) -> None:
        self.world.distrusted_until = max(self.world.distrusted_until, self.clock.now + DISTRUST_S)

    def hide_processes(self) -> None:
        def spoil(faults: ProbeFaults) -> None:
            faults.unlisted = self.clock.chance(0.5)
            faults.unnamed_bytes = self.clock.chance(0.5)
            faults.forgets_the_dead = self.clock.chance(0.5)
            if living := [process for process in self.world.processes.values() if process.alive]:
                faults.blind_to.add(self.random.choice(living).key)

        self._spoil(spoil)

    def stowaway(self) -> None:
        device = self.random.choice(list(self.world.devices.values()))
        if device.held.get((STRANGER, "stranger")):
            device.free(STRANGER, "stranger")
            return
        try:
            device.allocate(
                STRANGER, "stranger", self.random.choice((100 * d.MIB, 700 * d.MIB, 3 * d.GIB))
            )
        except SimOutOfMemory:
            self.clock.say("no room for a stowaway")

    def slow_device(self) -> None:
        device = self.random.choice(list(self.world.devices.values()))
        device.lag_s = self.random.choice((0.0, 0.1, 0.8, 1.5))
