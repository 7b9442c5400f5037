"""The daemon under simulation: the real core, inbox, sessions, codec, executor and journal, on a
simulated loop, wire, clock and GPU.

It can be killed between any two effects of any event: before a record is written, after it and
before the reply is sent, after that. What is in the journal stays; what the sockets had not handed
to the kernel is lost with the process.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack

from tests.support.full_check import check_arbiter
from tests.support.simulation.clock import Clock, new_loop
from tests.support.simulation.device import Device, ProbeFaults, SimProber
from tests.support.simulation.wire import Line, SimWire
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.events import Event, ProcessDied, Recovered, Tick
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.host.executor import Executor
from vram_arbiter.arbiter.host.journal import Journal
from vram_arbiter.arbiter.host.records import processes_of, record_of, records_of
from vram_arbiter.arbiter.inbox import Inbox
from vram_arbiter.arbiter.recovery import try_records
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.arbiter.rpc.registry import SessionSettings
from vram_arbiter.arbiter.rpc.session import SessionTable
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import JournalUnavailable
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey, RequestId
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.pushes import AnyPush
from vram_arbiter.schemas.wire.replies import AnyReply, HistoryReply

CHECK_ALL_EVERY = 4
"""Events: what every event may have broken is checked after each by the core itself, the tables
under that now and then."""


class Crashed(BaseException):
    """kill -9 of the daemon at this very point. No code of the daemon catches it."""


@dataclass(slots=True)
class Happening:
    """One note of the core, as the history would keep it."""

    at: float
    epoch: int
    kind: str
    data: Mapping[str, Any]


@dataclass(slots=True)
class Machine:
    """What outlives the daemon: GPUs, processes, the state folder, the boot."""

    clock: Clock
    wire: SimWire
    devices: dict[GpuId, Device]
    folder: Path
    settings: Callable[[int], Settings]
    probe_faults: dict[GpuId, ProbeFaults]
    boot: int = 1
    alive: dict[int, ProcessKey] = field(default_factory=dict)  # by pid
    history: list[Happening] = field(default_factory=list)
    # by lease, as the journal had it last
    tokens: dict[str, tuple[int, int]] = field(default_factory=dict)
    epochs: list[int] = field(default_factory=list)
    slept_s: float = 0.0  # of a suspend that the daemon has not noticed yet


class SimDaemon:
    """One start of the daemon, until it is killed. `failed` hears of a core that raised."""

    def __init__(self, machine: Machine, failed: Callable[[BaseException], None]) -> None:
        self.machine = machine
        self.clock = machine.clock
        self.loop = new_loop(machine.clock, "daemon")
        self.loop.on_failure = self._loop_failed
        self.journal_full = False
        self.on_crash: Callable[[], None] | None = None
        self.handled = 0
        self.core: Arbiter
        self.sessions: SessionTable
        self.journal: Journal
        self._inbox: Inbox
        self._executor: Executor
        self._prober: SimProber
        self._failed = failed
        self._crash_in: int | None = (
            None  # effects still to be performed; None: no crash is planned
        )
        self._watched: set[ProcessKey] = set()
        self._connected: set[int] = set()

    # -- life
    def start(self) -> None:
        self.loop.enter(self._start)

    def _start(self) -> None:
        machine, clock = self.machine, self.clock
        self.journal = Journal.open(
            machine.folder, f"boot-{machine.boot}", check=record_of, at_least=1
        )
        epoch = self.journal.opened.epoch
        assert not self.journal.problems, f"the journal is whole: {self.journal.problems}"
        machine.epochs.append(epoch)
        settings = machine.settings(epoch)
        try_records(self.journal, settings)
        self.core = Arbiter(settings, clock.now)
        self._inbox = Inbox(
            self.core,
            self._perform,
            self._failed,
            lambda: clock.now,
            self._slept,
            sample=lambda gpu: self._prober.sample(gpu),
        )
        self._prober = SimProber(
            clock, self.loop, machine.devices, machine.probe_faults, self._post
        )
        self.sessions = SessionTable(
            SessionSettings(
                epoch=epoch,
                boot_id=f"boot-{machine.boot}",
                server="simulated",
                heartbeat_s=d.HEARTBEAT_S,
                fence_grace_s=settings.fence_grace_s,
                message_max_bytes=d.MESSAGE_MAX_BYTES,
                sessions_max=d.SESSIONS_MAX,
                processes_max=d.CONNECTIONS_MAX,
                operator_reserve=d.OPERATOR_RESERVE,
                user_share=d.USER_SHARE,
                process_share=d.PROCESS_SHARE,
                subscribers_max=d.SUBSCRIBERS_MAX,
                operators_gid=None,
            ),
            self._inbox,
            lambda after, limit, kinds, done, before: done(HistoryReply((), 0)),
            self,
            lambda: clock.now,
        )
        self._executor = Executor(
            _Outbox(self, self.sessions),
            _Records(self, self.journal),
            _Chronicle(machine, epoch),
            self._sample,
            self._post,
            lambda event: None,
            lambda process, kind: clock.say(f"{kind} for {process}"),
            words,
        )
        records = records_of(self.journal.opened.records)
        clock.say(f"daemon starts, epoch {epoch}, {len(records)} records")
        if records:
            self._post(Recovered(records))
            for process in processes_of(records):
                self.watch(process)
        else:
            self._post(Tick())
        machine.wire.listening(self)

    def kill(self, reason: str) -> None:
        """SIGKILL: the loop never runs again, the journal keeps what was committed."""
        if self.loop.dead:
            return
        self.clock.say(f"daemon killed: {reason}")
        self.loop.kill()
        self._inbox.close()
        self.journal.close()
        self.machine.wire.gone()

    def crash_after(self, effects: int | None) -> None:
        """Plan a crash at a point within the coming effects; None: none any more."""
        self._crash_in = effects

    def crash_point(self, where: str) -> None:
        """Between two effects. Raises Crashed if this is the planned point."""
        if self._crash_in is None:
            return
        self._crash_in -= 1
        if self._crash_in < 0:
            self._crash_in = None
            self.kill(f"at {where}")
            if self.on_crash is not None:
                self.on_crash()
            raise Crashed(where)

    def records(self) -> list[str]:
        """Keys in the journal, but for those that are to be deleted with the next write."""
        rows = self.journal._connection.execute("SELECT key FROM records ORDER BY key").fetchall()
        found = [key.decode() for (key,) in rows]
        return [key for key in found if key not in self._executor.owed]

    # -- in
    def deliver(self, line: Line, payload: bytes) -> None:
        """A message from the wire; waits if the daemon is stopped."""

        def receive() -> None:
            self.clock.say(f"in c{line.serial} {_asked(payload)}")
            if line.serial not in self._connected:
                self._connected.add(line.serial)
                self.sessions.connected(line)
            self.sessions.received(line, payload)

        self.loop.enter(lambda: self._guarded(receive))

    def lost(self, line: Line) -> None:
        """A connection has ended."""

        def disconnect() -> None:
            if line.serial in self._connected:
                self._connected.discard(line.serial)
                self.clock.say(f"end of c{line.serial}")
                self.sessions.disconnected(line, "the peer hung up")

        self.loop.enter(lambda: self._guarded(disconnect))

    def process_died(self, process: ProcessKey) -> None:
        """A pidfd became readable."""
        self.loop.enter(lambda: self._guarded(lambda: self._died(process)))

    def watch(self, process: ProcessKey) -> None:
        if process in self._watched:
            return
        self._watched.add(process)
        if self.machine.alive.get(process.pid) != process:
            self.loop.call_soon(self.process_died, process)

    def take(self, process: ProcessKey, pidfd: int) -> bool:
        """`arbiter.rpc.registry.Watch`."""
        new = process not in self._watched
        self.watch(process)
        return new

    def drop(self, process: ProcessKey) -> None:
        """`arbiter.rpc.registry.Watch`."""
        self._watched.discard(process)

    def _died(self, process: ProcessKey) -> None:
        if process in self._watched:
            self._watched.discard(process)
            self.sessions.process_died(process)
            self._post(ProcessDied(process))

    def _post(self, event: Event) -> None:
        self._guarded(lambda: self._inbox.post(event))

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Crashed:
            self.clock.say("the daemon is gone")

    def _loop_failed(self, error: BaseException) -> None:
        if not isinstance(error, Crashed):
            self._failed(error)

    def _slept(self) -> float:
        slept_s, self.machine.slept_s = self.machine.slept_s, 0.0
        return slept_s

    # -- out
    def _perform(self, effects: Sequence[Effect]) -> None:
        self.handled += 1
        if self.handled % CHECK_ALL_EVERY == 0:
            check_arbiter(self.core)
        self._executor.perform(effects)

    def _sample(self, gpu: GpuId) -> None:
        self.crash_point("sample")
        self._prober.sample(gpu)


class _Outbox:
    """The sessions, with a crash point before and after each message, and a line in the trace."""

    def __init__(self, daemon: SimDaemon, sessions: SessionTable) -> None:
        self._daemon, self._sessions = daemon, sessions

    def reply(self, client: ClientId, request: RequestId, body: AnyReply) -> None:
        self._daemon.crash_point("before a reply")
        self._daemon.clock.say(f"reply {client} {request} {_brief(to_map(body))}")
        self._sessions.reply(client, request, body)
        self._daemon.crash_point("after a reply")

    def refuse(self, client: ClientId, request: RequestId, error: ErrorView) -> None:
        self._daemon.crash_point("before a refusal")
        self._daemon.clock.say(f"refuse {client} {request} {error.code}: {error.message}")
        self._sessions.refuse(client, request, error)

    def push(self, client: ClientId, body: AnyPush) -> None:
        self._daemon.crash_point("before a push")
        self._daemon.clock.say(f"push {client} {_brief(to_map(body))}")
        self._sessions.push(client, body)
        self._daemon.crash_point("after a push")

    def broadcast(self, event: Mapping[str, Any]) -> None:
        self._sessions.broadcast(event)


class _Records:
    """The journal, with a crash point on both sides of every transaction, and a disk that can be
    full."""

    def __init__(self, daemon: SimDaemon, journal: Journal) -> None:
        self._daemon, self._journal = daemon, journal

    def apply(self, changes: Sequence[tuple[str, Mapping[str, Any] | None]]) -> None:
        self._daemon.crash_point("before a journal write")
        if self._daemon.journal_full:
            raise JournalUnavailable("the disk is full", hint="simulated")
        self._journal.apply(changes)
        for _, record in changes:
            if record is not None and "token" in record:
                self._daemon.machine.tokens[record["lease_id"]] = (
                    record["token"][0],
                    record["token"][1],
                )
        written = [
            (key, record.get("state", "kept") if record else "gone") for key, record in changes
        ]
        self._daemon.clock.say(f"journal {written}")
        self._daemon.crash_point("after a journal write")


class _Chronicle:
    """The history, kept by the world: it outlives the daemon and is what checks read."""

    def __init__(self, machine: Machine, epoch: int) -> None:
        self._machine, self._epoch = machine, epoch

    def append(self, kind: str, data: Mapping[str, Any]) -> Mapping[str, Any]:
        history = self._machine.history
        history.append(Happening(self._machine.clock.now, self._epoch, kind, data))
        self._machine.clock.say(f"note {kind} {data.get('lease_id', '')} {data.get('reason', '')}")
        return {"seq": len(history), "at_wall_s": self._machine.clock.now, "kind": kind, **data}


def _asked(payload: bytes) -> str:
    """A request in a few words."""
    message = msgpack.unpackb(payload, raw=False)
    words = [str(message.get("id")), str(message.get("op"))]
    words += [
        str(message[key])
        for key in ("nonce", "lease_id", "use_id", "measured_bytes", "target")
        if key in message
    ]
    words += [
        f"{lease['lease_id']}:{lease.get('state', '')}" for lease in message.get("leases", ())
    ]
    return " ".join(words)


def _brief(body: Mapping[str, Any]) -> str:
    """A body in a few words: what it is, which lease, which state."""
    lease = body.get("lease") or {}
    words = [
        str(body[key]) for key in ("push", "state", "lease_id", "uses", "alive") if key in body
    ]
    words += [str(lease[key]) for key in ("lease_id", "state", "token") if key in lease]
    words += [
        f"{entry.get('lease_id')}{'' if entry['kept'] else ' not'} kept"
        for entry in body.get("leases", ())
        if "kept" in entry
    ]
    return " ".join(words)
