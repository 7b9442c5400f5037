"""The daemon: the only place where real parts are put together, with the order of start and stop.

Start: folders and locks → journal → GPUs → engine (told what the journal remembers; its processes
are watched) → socket → READY. A failure on the way undoes what was done. Stop: no more requests →
nothing more is decided → files are written → socket goes. Leases survive a stop: their holders keep
what they have and reattach. Must not decide anything about leases.
"""

import asyncio
import contextlib
import gc
import logging
import os
import platform
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.events import ProcessDied
from vram_arbiter.arbiter.core.settings import GpuInfo
from vram_arbiter.arbiter.eventlog.snapshot import to_plain
from vram_arbiter.arbiter.eventlog.writer import Recorder
from vram_arbiter.arbiter.host.executor import Executor
from vram_arbiter.arbiter.host.gpu.open import open_probe
from vram_arbiter.arbiter.host.gpu.probe import GpuProbe
from vram_arbiter.arbiter.host.heartbeat import beat
from vram_arbiter.arbiter.host.history import CLEAN_END, History
from vram_arbiter.arbiter.host.journal import Journal
from vram_arbiter.arbiter.host.observer import Observer
from vram_arbiter.arbiter.host.prober import Prober
from vram_arbiter.arbiter.host.process import leave_no_zombies, memory_bytes, raise_limits
from vram_arbiter.arbiter.host.process_watch import ProcessWatch
from vram_arbiter.arbiter.host.records import record_of
from vram_arbiter.arbiter.host.sensors import SensorReader
from vram_arbiter.arbiter.inbox import Inbox, SuspendWatch
from vram_arbiter.arbiter.log import log_event
from vram_arbiter.arbiter.places import Places, find_places, take_folders
from vram_arbiter.arbiter.recovery import recover, report, try_records
from vram_arbiter.arbiter.reload import Reload, Source
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.arbiter.rpc.peer import group_id
from vram_arbiter.arbiter.rpc.registry import SessionSettings
from vram_arbiter.arbiter.rpc.session import SessionTable
from vram_arbiter.arbiter.settings import budget, core_settings, router_limits, session_settings
from vram_arbiter.schemas.config.arbiter import ArbiterConfig
from vram_arbiter.schemas.errors import AlreadyRunning, ConfigError
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.folders import LockFile
from vram_arbiter.schemas.runtime.procfs import boot_id, cgroup_root, start_ticks
from vram_arbiter.schemas.runtime.router import Router
from vram_arbiter.schemas.runtime.systemd import Notifier
from vram_arbiter.schemas.runtime.threads import answered_within
from vram_arbiter.schemas.units import format_bytes
from vram_arbiter.schemas.wire.views import DaemonView

log = logging.getLogger(__name__)

EXIT_OK = 0
EXIT_ALREADY_RUNNING = 3
EXIT_DEFECT = 70
"""EX_SOFTWARE: an invariant was violated or the engine raised."""
PROBE_START_S = 30.0
"""Without persistence mode the NVIDIA driver needs seconds to initialize its GPUs."""
KEEP_LEARNT_EVERY_S = 10.0
GUESTS_EVERY_S = 0.25
"""How often guests are looked at for silence, where there may be any."""


class Daemon:
    """`await Daemon(config, environ, version).run()` serves until SIGTERM or SIGINT and returns the
    exit code.

    Raises the operator's errors (ConfigError, AlreadyRunning, NoGpu, ProbeFailed) before it serves.
    """

    # from the start on
    _loop: asyncio.AbstractEventLoop
    _locks: tuple[LockFile, ...]
    _journal: Journal
    _history: History
    _gpus: tuple[GpuInfo, ...]
    _engine: Arbiter
    _inbox: Inbox
    _watch: ProcessWatch
    _sessions: SessionTable
    _executor: Executor
    _reload: Reload

    def __init__(
        self,
        config: ArbiterConfig,
        environ: Mapping[str, str],
        version: str,
        source: Source,
        http: str | None = None,
    ) -> None:
        """`source`: where SIGHUP reads the configuration again. `http`: where an observer beside
        the daemon serves the status page."""
        self._config = config
        self._source = source
        self._environ = environ
        self._version = version
        self._http = http
        self._server = f"vram-arbiter {version}"
        self._exit_code = EXIT_OK
        self._stop = asyncio.Event()

    async def run(self) -> int:
        notifier = Notifier(self._environ)
        async with contextlib.AsyncExitStack() as undo:
            await self._start(undo)
            for number in (signal.SIGTERM, signal.SIGINT):
                self._loop.add_signal_handler(number, self._stop.set)
            self._loop.add_signal_handler(signal.SIGHUP, self._reload.ask)
            leave_no_zombies()
            gc.freeze()  # modules stay: no collection has to look at them again
            notifier.ready(self._status_text())
            for serves in (
                beat(notifier, self._inbox.pulse, self._chores(), self._status_line),
                self._reload.serve(notifier, self._status_line),
                self._keep_learnt_regularly(),
                self._end_silent_guests(),
            ):
                task = self._loop.create_task(serves)
                task.add_done_callback(self._background_ended)
                undo.callback(task.cancel)
            await self._stop.wait()
            failed = self._exit_code == EXIT_DEFECT
            notifier.stopping("the core failed" if failed else "stopping")
            if self._exit_code == EXIT_OK:
                self._keep_learnt()
            self._say(CLEAN_END, {"exit_code": self._exit_code, "leases_kept": True})
        return self._exit_code

    # -- start
    async def _start(self, undo: contextlib.AsyncExitStack) -> None:
        """1. Folders, locks and files. 2. GPUs and the engine. 3. The parts around it. 4. The past.
        5. The socket.
        """
        config, self._loop = self._config, asyncio.get_running_loop()
        places = find_places(config, self._environ, os.getuid())
        operators = group_id("wire.operators_group", config.wire.operators_group)
        members = group_id("wire.group", config.wire.group)
        group = operators if members is None else members  # of the socket: it has one
        guests = group_id("wire.guests_group", config.wire.guests_group)
        limits = router_limits(config, raise_limits())
        self._locks = take_folders(places, config, self._environ, group, undo)  # 1
        boot = boot_id()
        self._open_files(places, boot, self._locks[0], undo)
        probe = await self._open_engine(places, undo)  # 2
        sessions = session_settings(
            config,
            epoch=self._journal.opened.epoch,
            boot_id=boot,
            server=self._server,
            processes_max=limits.connections_max,
            operators_gid=operators,
            guests_gid=guests,
            cgroup_root=cgroup_root(),
        )
        self._connect_parts(probe, sessions, undo)  # 3
        self._tell_past(places)  # 4
        router = Router(places.socket, self._sessions, limits, group)  # 5
        undo.push_async_callback(router.aclose)
        router.bind()
        router.start(self._loop)
        undo.callback(self._inbox.close)  # while answers leave nothing more is decided
        undo.callback(router.stop_receiving)
        if self._http is not None:
            observer = Observer(self._http, places.endpoint)
            observer.start(self._loop)
            undo.callback(observer.close)

    def _open_files(
        self, places: Places, boot: str, lock: LockFile, undo: contextlib.AsyncExitStack
    ) -> None:
        """Journal and history."""
        journal = Journal.open(places.state, boot, check=record_of, witness=lock.left)
        undo.callback(journal.close)
        lock.leave(journal.opened.witness)
        kept = self._config.history
        history = History.open(places.state, kept.max_events, kept.days)
        history.start(self._loop)
        undo.callback(history.close)
        self._journal, self._history = journal, history

    async def _open_engine(self, places: Places, undo: contextlib.AsyncExitStack) -> GpuProbe:
        """GPUs, the engine, its event log, and the inbox that owns it."""
        config, opened = self._config, self._journal.opened
        probe, self._gpus = await self._open_gpus(places)
        settings = core_settings(config, self._gpus, opened)
        try_records(self._journal, settings)
        made_at = time.monotonic()
        self._engine = Arbiter(settings, made_at)
        recorder = None
        if config.record.enabled:
            recorder = Recorder(
                places.state,
                settings,
                self._version,
                max_bytes=config.record.max_bytes,
                file_bytes=config.record.file_bytes,
                state=partial(to_plain, self._engine),
                told=self._say,
            )
            recorder.start(self._loop, made_at)
            undo.callback(recorder.close)
        self._inbox = Inbox(
            self._engine,
            _too_early,
            self._failed,
            slept_s=SuspendWatch().slept_s,
            record=None if recorder is None else recorder.record,
        )
        return probe

    def _connect_parts(
        self, probe: GpuProbe, settings: SessionSettings, undo: contextlib.AsyncExitStack
    ) -> None:
        """Readings, deaths of processes and sessions post to the inbox; the executor performs what
        comes out of it."""
        inbox, loop = self._inbox, self._loop
        prober = Prober(
            probe,
            [gpu.id for gpu in self._gpus],
            self._config.probe.deadline_s,
            loop,
            inbox.post,
            self._engine.owners,
            self._engine.clients,
            self._engine.claims,
        )
        undo.callback(prober.close)
        sensors = SensorReader(probe, [gpu.id for gpu in self._gpus])
        undo.callback(sensors.close)
        undo.callback(inbox.close)
        self._reload = Reload(self._config, self._source, inbox, self._history, self._say)
        self._watch = ProcessWatch(loop, start_ticks, self._process_died)
        undo.callback(self._watch.close)
        self._sessions = SessionTable(
            settings,
            inbox,
            self._history.read,
            self._watch,
            time.monotonic,
            self._problems,
            self._view,
            sensors.ask,
            sensors.known,
        )
        self._executor = Executor(
            self._sessions,
            self._journal,
            self._history,
            prober.sample,
            inbox.post,
            log_event,
            self._watch.signal,
            words,
        )
        inbox.perform, inbox.sample = self._executor.perform, prober.sample

    def _tell_past(self, places: Places) -> None:
        """Tell history and log what was found, and the engine what the journal remembers."""
        found, say = self._journal.opened, self._say
        report(found, say)
        listed = [
            {"gpu": g.id, "name": g.name, "capacity_bytes": g.capacity_bytes, "source": g.source}
            for g in self._gpus
        ]
        started = {
            "server": self._server,
            "epoch": found.epoch,
            "endpoint": places.endpoint,
            "state_dir": str(places.state),
            "gpus": listed,
            "records": len(found.records),
            "records_of_earlier_boot": found.voided,
        }
        say("started", started)
        recover(found, self._inbox, self._watch)

    async def _open_gpus(self, places: Places) -> tuple[GpuProbe, tuple[GpuInfo, ...]]:
        opening = partial(open_probe, self._config.gpu, places.runtime)
        probe, source = await answered_within(PROBE_START_S, opening, "the GPU driver")
        try:
            gpus = await answered_within(PROBE_START_S, probe.gpus, "the GPU driver")
            return probe, budget(gpus, self._config, source)
        except BaseException:
            probe.close()
            raise

    # -- serving
    def _process_died(self, process: ProcessKey) -> None:
        self._sessions.process_died(process)
        self._inbox.post(ProcessDied(process))

    def _background_ended(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            self._failed(error)

    def _failed(self, error: BaseException) -> None:
        """Nothing is decided anymore; the journal holds what was granted, and the next start
        recovers it. Without its chores the daemon would decay unseen."""
        self._end(EXIT_DEFECT, f"{type(error).__name__}: {error}")

    def _end(self, exit_code: int, why: str) -> None:
        log.critical("stopping: %s", why)
        self._exit_code = exit_code
        self._stop.set()

    def _keep_locks(self) -> None:
        """Where the socket and the locks were deleted, a second arbiter may grant the same memory.
        This one then ends: holders find the other one on the socket, and reattach."""
        for lock in self._locks:
            try:
                if lock.keep():
                    log.warning("the lock file %s was deleted; locked again", lock.path)
            except AlreadyRunning as error:
                self._end(EXIT_ALREADY_RUNNING, f"{error}; {lock.path} was deleted")
                return
            except ConfigError as error:  # its folder is gone: no second one can have it either
                log.debug("%s", error)

    def _say(self, kind: str, facts: JsonMap) -> None:
        """A fact of the daemon itself, in its history and its log."""
        log_event(self._history.append(kind, facts))

    async def _keep_learnt_regularly(self) -> None:
        while True:
            await asyncio.sleep(KEEP_LEARNT_EVERY_S)
            if not self._inbox.closed:
                self._keep_learnt()

    async def _end_silent_guests(self) -> None:
        while self._config.wire.guests_group is not None:
            await asyncio.sleep(GUESTS_EVERY_S)
            self._sessions.end_silent_guests()

    def _keep_learnt(self) -> None:
        """So that a kill loses no more than the last few seconds of learning."""
        self._journal.keep("learnt", self._engine.learnt())
        self._journal.keep("footprints", self._engine.footprints())

    def _problems(self) -> list[str]:
        """What an operator should know of the daemon's own files, in words."""
        reload = self._reload
        own = (*self._journal.problems, self._history.problem, reload.problem, reload.pending)
        return [found for found in own if found]

    def _chores(self) -> tuple[Callable[[], None], ...]:
        return (
            self._keep_locks,
            self._sessions.sweep,
            self._journal.settle,
            self._executor.settle,
        )

    def _view(self) -> DaemonView:
        """What observers are told of the daemon itself."""
        writes, times = self._executor.writes, os.times()
        return DaemonView(
            server=self._server,
            python=platform.python_version(),
            journal_healthy=not self._journal.problem,
            journal_doubted=self._journal.doubted,
            config_refused=bool(self._reload.problem),
            journal_writes=writes.count,
            journal_write_s=writes.seconds,
            journal_failures=writes.failures,
            refusals=dict(self._sessions.refused),
            cpu_user_s=times.user,
            cpu_system_s=times.system,
            memory_bytes=memory_bytes(),
        )

    def _status_line(self) -> str:
        clients = f"{len(self._sessions)} clients"
        return "; ".join([*self._problems(), self._status_text(), clients])

    def _status_text(self) -> str:
        named = (f"{gpu.name} ({format_bytes(gpu.capacity_bytes)})" for gpu in self._gpus)
        return f"serving {', '.join(named)}"


def _too_early(effects: Sequence[Effect]) -> None:
    raise RuntimeError("an event came before the executor was there")
