"""The daemon: the only place where real parts are put together, with the order of start and of
stop.

Start: folders and locks → journal → cards → core (told what the journal remembers; its processes
are watched) → socket → READY. A failure on the way undoes what was done. Stop: no more requests →
nothing more is decided → files are written → socket goes. Leases survive a stop: their holders keep
what they have and re-attach. Must not decide anything about leases.
"""

import asyncio
import contextlib
import gc
import logging
import os
import resource
import secrets
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vram_arbiter.arbiter import log as telemetry
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.events import ProcessDied, Recovered, Tick
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.arbiter.eventlog.writer import Recorder, freezer
from vram_arbiter.arbiter.host.executor import Executor
from vram_arbiter.arbiter.host.gpu.fake import open_cards
from vram_arbiter.arbiter.host.gpu.pids import PidMap
from vram_arbiter.arbiter.host.gpu.probe import Card, GpuProbe
from vram_arbiter.arbiter.host.gpu.unified import choose
from vram_arbiter.arbiter.host.history import CLEAN_END, History
from vram_arbiter.arbiter.host.journal import Journal, Opened, may_pass, unavailable
from vram_arbiter.arbiter.host.memory import park_budget_bytes
from vram_arbiter.arbiter.host.prober import Prober, within
from vram_arbiter.arbiter.host.process_tree import Known
from vram_arbiter.arbiter.host.process_watch import ProcessWatch
from vram_arbiter.arbiter.host.records import check_record
from vram_arbiter.arbiter.host.suspend import SuspendWatch
from vram_arbiter.arbiter.host.systemd import Notifier
from vram_arbiter.arbiter.inbox import Inbox
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.arbiter.rpc.peer import group_id
from vram_arbiter.arbiter.rpc.session import SessionSettings, SessionTable
from vram_arbiter.schemas.config.arbiter import ArbiterConfig, GpuConfig
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime.connection import Limits
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint, runtime_dir, socket_path
from vram_arbiter.schemas.runtime.folders import LockFile, private_folder, socket_folder
from vram_arbiter.schemas.runtime.procfs import boot_id, start_ticks
from vram_arbiter.schemas.runtime.router import Router
from vram_arbiter.schemas.runtime.telemetry import setup as otel
from vram_arbiter.schemas.runtime.telemetry.commands import TRACEPARENT_VARIABLE
from vram_arbiter.schemas.units import format_bytes

if TYPE_CHECKING:
    from vram_arbiter.arbiter.host.telemetry.traced import Traced

log = logging.getLogger(__name__)

EXIT_OK = 0
EXIT_DEFECT = 70
"""EX_SOFTWARE: an invariant was violated or the core raised."""
PROBE_START_S = 30.0
"""Without persistence mode the NVIDIA driver needs seconds to initialise its cards."""
OPEN_FILES = 65_536
DESCRIPTOR_RESERVE = 128
"""For the daemon's own files: journal, history, event log, readings, telemetry."""
SWITCH_S = 0.0005
"""How long the loop may keep the interpreter from a thread that reads a card, which asks for it
some twenty times per reading: with Python's own 5 ms a client that floods the loop makes every
reading take a tenth of a second.
"""
TOKEN_SECRET_BYTES = 16
STATUS_EVERY_S = 5.0
KEEP_LEARNT_EVERY_S = 10.0


@dataclass(frozen=True, slots=True)
class Places:
    """Where everything is: flags first, then the configuration, then the environment."""

    endpoint: str
    socket: Path
    runtime: Path
    state: Path


def find_places(config: ArbiterConfig, environ: Mapping[str, str], uid: int) -> Places:
    """Raises ConfigError for an endpoint that the daemon does not serve."""
    endpoint = config.wire.endpoint or arbiter_endpoint(environ, uid)
    socket = Path(socket_path(endpoint))
    try:
        runtime = Path(runtime_dir(environ, uid))
    except ConfigError:  # without a login session; then the endpoint was given
        runtime = socket.parent
    if config.state.dir is not None:
        state = Path(config.state.dir)
    elif under_systemd := environ.get("STATE_DIRECTORY"):
        state = Path(under_systemd.split(":")[0])
    elif config.gpu.source.startswith("fake:"):
        state = runtime / "state"  # a simulated card is as short-lived as the runtime folder
    else:
        home = environ.get("XDG_STATE_HOME") or str(
            Path(environ.get("HOME", "/")) / ".local" / "state"
        )
        state = Path(home) / "vram-arbiter"
    return Places(endpoint, socket, runtime.absolute(), state.absolute())


def open_probe(config: GpuConfig, runtime: Path) -> tuple[GpuProbe, str]:
    """(backend, its name) for `gpu.source`. Raises NoGpu or ConfigError. A simulated card is never
    a fallback: it has to be asked for."""
    kind, _, what = config.source.partition(":")
    if kind == "fake":
        return open_cards(what, runtime), "fake"
    host_proc = None if config.host_proc is None else Path(config.host_proc)
    pids = PidMap(config.pids, host_proc)
    return choose("nvml" if kind == "nvml" else "unified" if kind == "unified" else "auto", pids)


def budget(cards: Sequence[Card], config: ArbiterConfig, source: str = "") -> tuple[GpuInfo, ...]:
    """What of each card is leased out. Raises ConfigError for a cap on a card that is not there, or
    a reserve larger than a card."""
    caps = dict(config.gpu.capacity_bytes)
    found = []
    for card in cards:
        by_id, by_index = caps.pop(card.id, None), caps.pop(str(card.index), None)
        capacity = min(size for size in (card.total_bytes, by_id, by_index) if size is not None)
        reserve = max(config.gpu.reserve_bytes, card.margin_bytes)
        if capacity <= reserve:
            raise ConfigError(
                f"gpu.reserve_bytes ({format_bytes(reserve)}) leaves nothing of {card.name} "
                f"({format_bytes(capacity)})",
                hint="lower the reserve or raise the cap",
            )
        found.append(
            GpuInfo(
                id=card.id,
                index=card.index,
                name=card.name,
                capacity_bytes=capacity,
                reserve_bytes=reserve,
                source=source,
                noise_bytes=card.noise_bytes,
                total_bytes=card.total_bytes,
            )
        )
    if caps:
        known = ", ".join(f"{card.index} ({card.id})" for card in cards)
        raise ConfigError(
            f"gpu.capacity_bytes names no card of this machine: {', '.join(caps)}",
            hint=f"cards: {known}",
        )
    return tuple(found)


def core_settings(config: ArbiterConfig, gpus: tuple[GpuInfo, ...], opened: Opened) -> Settings:
    return Settings(
        epoch=opened.epoch,
        gpus=gpus,
        learnt=dict(opened.learnt),
        footprints=dict(opened.footprints),
        policy=config.scheduling.policy,
        ageing_s_per_point=config.scheduling.ageing_s_per_point,
        thrash_window_s=config.scheduling.thrash_window_s,
        thrash_hold_max_s=config.scheduling.thrash_hold_max_s,
        revoke_resend_s=config.revoke.resend_s,
        revoke_remind_s=config.revoke.remind_s,
        revoke_deadline_s=config.revoke.deadline_s,
        terminate_grace_s=config.revoke.terminate_grace_s,
        verify_timeout_s=config.verify.timeout_s,
        verify_poll_s=config.verify.poll_s,
        verify_poll_until_s=config.verify.poll_until_s,
        verify_confirm_s=config.verify.confirm_s,
        verify_slow_poll_s=config.verify.slow_poll_s,
        verify_tolerance_bytes=max(
            config.verify.tolerance_bytes, *(gpu.noise_bytes for gpu in gpus)
        ),
        sample_max_age_s=config.probe.sample_max_age_s,
        probe_period_s=config.probe.period_s,
        load_probe_s=config.probe.load_s,
        fence_grace_s=config.lease.fence_grace_s,
        waiters_max=config.limits.waiters_max,
        leases_per_client_max=config.limits.leases_per_client_max,
        uses_per_lease_max=config.limits.uses_per_lease_max,
        process_share=config.limits.process_share,
        user_share=config.limits.user_share,
        priority_reserve=config.limits.priority_reserve,
        token_secret=secrets.token_hex(TOKEN_SECRET_BYTES),
        host_ram_budget_bytes=park_budget_bytes(config.host.park_budget_bytes),
    )


@dataclass(frozen=True, slots=True)
class Parts:
    """What runs between start and stop."""

    gpus: tuple[GpuInfo, ...]
    inbox: Inbox
    sessions: SessionTable
    history: History
    journal: Journal
    executor: Executor


class Daemon:
    """`await Daemon(config, environ, version).run()` serves until SIGTERM or SIGINT and returns the
    exit code.

    Raises the operator's errors (ConfigError, AlreadyRunning, NoGpu, ProbeFailed) before it serves.
    """

    def __init__(self, config: ArbiterConfig, environ: Mapping[str, str], version: str) -> None:
        self._config = config
        self._environ = environ
        self._server_name = f"vram-arbiter {version}"
        self._exit_code = EXIT_OK
        self._stop = asyncio.Event()

    async def run(self) -> int:
        notifier = Notifier(self._environ)
        raise_open_files()
        sys.setswitchinterval(SWITCH_S)
        async with contextlib.AsyncExitStack() as undo:
            parts = await self._start(undo)
            for number in (signal.SIGTERM, signal.SIGINT):
                asyncio.get_running_loop().add_signal_handler(number, self._stop.set)
            # modules live as long as we do: no collection has to look at them again, and stop the
            # loop for it
            gc.freeze()
            notifier.ready(status_text(parts.gpus))
            beat = asyncio.get_running_loop().create_task(self._beat(parts, notifier))
            undo.callback(beat.cancel)
            await self._stop.wait()
            notifier.stopping("stopping" if self._exit_code == EXIT_OK else "the core failed")
            if self._exit_code == EXIT_OK:
                keep_learnt(parts)
            facts = {"exit_code": self._exit_code, "leases_kept": True}
            telemetry.log_event(parts.history.append(CLEAN_END, facts))
        return self._exit_code

    async def _start(self, undo: contextlib.AsyncExitStack) -> Parts:
        """1.

        Folders and locks. 2. Journal and history. 3. Cards. 4. Core and the parts around it. 5. The
        past. 6. The socket.
        """
        config, loop = self._config, asyncio.get_running_loop()
        places = find_places(config, self._environ, os.getuid())
        operators = self._group("operators_group")
        members = self._group("group")
        group = operators if members is None else members  # of the socket: it has one
        lock = self._take_folders(places, group, undo)  # 1
        traced = self._open_telemetry(undo)
        boot = boot_id()
        journal = Journal.open(places.state, boot, check=check_record, witness=lock.left)  # 2
        undo.callback(journal.close)
        lock.leave(journal.opened.witness)
        history = History.open(places.state, config.history.max_events, config.history.days)
        history.start(loop)
        undo.callback(history.close)
        probe, gpus = await self._open_cards(places)  # 3

        settings = core_settings(config, gpus, journal.opened)
        try_records(journal, settings)
        made_at = time.monotonic()
        core = Arbiter(settings, made_at)  # 4
        recorder = self._open_recorder(places, settings, core, history)
        if recorder is not None:
            recorder.start(loop, made_at)
            undo.callback(recorder.close)
        inbox = Inbox(
            core,
            lambda effects: executor.perform(effects),
            self._core_failed,
            slept_s=SuspendWatch().slept_s,
            record=None if recorder is None else recorder.record,
            sample=lambda gpu: prober.sample(gpu),
        )
        prober = Prober(
            probe,
            [gpu.id for gpu in gpus],
            config.probe.deadline_s,
            loop,
            inbox.post,
            lambda gpu: Known(core.owners(gpu), core.clients()),
        )
        undo.callback(prober.close)
        undo.callback(inbox.close)

        def died(process: ProcessKey) -> None:
            sessions.process_died(process)
            inbox.post(ProcessDied(process))

        watch = ProcessWatch(loop, start_ticks, died)
        undo.callback(watch.close)
        wire = self._session_settings(journal.opened.epoch, boot, operators)
        sessions = SessionTable(
            wire,
            inbox,
            history.read,
            watch,
            time.monotonic,
            problems=lambda: problems(journal, history),
        )
        executor = Executor(
            sessions,
            journal,
            history,
            prober.sample,
            inbox.post,
            telemetry.log_event if traced is None else traced.log_event,
            watch.signal,
            words,
            None if traced is None else traced.leases,
        )

        self._tell_start(history, journal, places, gpus)  # 5
        if journal.opened.records:
            inbox.post(Recovered(journal.opened.records))
            for process in processes_of(journal.opened.records):
                watch.add(process)
        else:
            inbox.post(Tick())  # lets the core ask for its first readings
        if traced is not None:
            traced.watch(
                loop,
                lambda: (
                    None
                    if inbox.closed
                    else {**inbox.figures(), "journal_healthy": not journal.problem}
                ),
            )
        router = Router(places.socket, sessions, self._router_limits(), group)  # 6
        undo.push_async_callback(router.aclose)
        router.bind()
        router.start(loop)
        undo.callback(inbox.close)  # while answers leave nothing more is decided
        undo.callback(router.stop_receiving)
        return Parts(gpus, inbox, sessions, history, journal, executor)

    def _take_folders(
        self, places: Places, group: int | None, undo: contextlib.AsyncExitStack
    ) -> LockFile:
        """Returns the socket's lock."""
        if self._config.gpu.source.startswith("fake:") or places.state.parent == places.runtime:
            private_folder(places.runtime, group)
        socket_folder(places.socket.parent, self._environ, group)
        socket_lock = LockFile(
            places.socket.with_name(places.socket.name + ".lock"), str(places.socket)
        )
        socket_lock.acquire()
        undo.callback(socket_lock.release)
        try:
            if self._config.state.dir is None:
                places.state.parent.mkdir(
                    mode=0o700, parents=True, exist_ok=True
                )  # such as ~/.local/state
            private_folder(places.state)
            lock = LockFile(places.state / "lock", str(places.state))
            lock.acquire()
            undo.callback(lock.release)
        except (ConfigError, OSError) as error:
            cause = error.__cause__ if isinstance(error, ConfigError) else error
            if cause is not None and may_pass(cause):  # a person need not start the daemon again
                raise unavailable(places.state, cause) from error
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"the state folder {places.state} cannot be made: {error}") from error
        return socket_lock

    def _open_telemetry(self, undo: contextlib.AsyncExitStack) -> "Traced | None":
        """None: it was not asked for, and nothing of it is imported. Raises ConfigError."""
        chosen = self._config.telemetry
        installed = otel.set_up(
            "vram-arbiter",
            environ=self._environ,
            endpoint=chosen.endpoint,
            prometheus_port=chosen.prometheus_port,
            sample_ratio=chosen.sample_ratio,
        )
        if not installed.on:
            return None
        undo.callback(installed)
        if installed.prometheus_port is not None:
            log.info(
                "telemetry: Prometheus endpoint on loopback, port %d", installed.prometheus_port
            )
        from vram_arbiter.arbiter.host.telemetry.traced import Traced

        version = self._server_name.partition(" ")[2]
        traced = Traced(self._environ.get(TRACEPARENT_VARIABLE), version)
        undo.push(lambda _, error, __: traced.close(self._exit_code, error))
        return traced

    async def _open_cards(self, places: Places) -> tuple[GpuProbe, tuple[GpuInfo, ...]]:
        chosen = self._config.gpu
        probe, source = await within(
            PROBE_START_S, lambda: open_probe(chosen, places.runtime), "the GPU driver"
        )
        try:
            cards = await within(PROBE_START_S, probe.cards, "the GPU driver")
            return probe, budget(cards, self._config, source)
        except BaseException:
            probe.close()
            raise

    def _open_recorder(
        self, places: Places, settings: Settings, core: Arbiter, history: History
    ) -> Recorder | None:
        if not self._config.record.enabled:
            return None
        return Recorder(
            places.state,
            settings,
            self._server_name.partition(" ")[2],
            max_bytes=self._config.record.max_bytes,
            file_bytes=self._config.record.file_bytes,
            freeze_engine=freezer(core),
            told=lambda kind, facts: telemetry.log_event(history.append(kind, facts)),
        )

    def _group(self, key: Literal["group", "operators_group"]) -> int | None:
        """Number of a group of the configuration. Raises ConfigError."""
        name: str | None = getattr(self._config.wire, key)
        if name is None:
            return None
        if (number := group_id(name)) is None:
            raise ConfigError(
                f"wire.{key}: no group {name!r} on this machine", hint=f"groupadd --system {name}"
            )
        return number

    def _router_limits(self) -> Limits:
        """A connection may take three descriptors: its socket, and two pidfds if it is the only one
        of its process."""
        limits = self._config.limits
        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        return Limits(
            message_max_bytes=limits.message_max_bytes,
            connections_max=min(limits.connections_max, max(4, (soft - DESCRIPTOR_RESERVE) // 3)),
            descriptor_reserve=DESCRIPTOR_RESERVE,
            user_share=limits.user_share,
            process_share=limits.process_share,
        )

    def _session_settings(self, epoch: int, boot_id: str, operators: int | None) -> SessionSettings:
        limits = self._config.limits
        return SessionSettings(
            epoch=epoch,
            boot_id=boot_id,
            server=self._server_name,
            heartbeat_s=self._config.wire.heartbeat_s,
            grace_s=self._config.lease.fence_grace_s,
            message_max_bytes=limits.message_max_bytes,
            sessions_max=limits.sessions_max,
            processes_max=self._router_limits().connections_max,
            operator_reserve=limits.operator_reserve,
            user_share=limits.user_share,
            process_share=limits.process_share,
            rate_per_s=limits.rate_per_client_per_s,
            process_rate_per_s=limits.rate_per_process_per_s,
            subscribers_max=limits.subscribers_max,
            operators_gid=operators,
        )

    def _tell_start(
        self, history: History, journal: Journal, places: Places, gpus: Sequence[GpuInfo]
    ) -> None:
        found = journal.opened
        if found.put_aside is not None:
            facts = {"file": str(found.put_aside), "problem": found.problem}
            telemetry.log_event(history.append("journal_put_aside", facts))
        if found.doubt:
            telemetry.log_event(history.append("journal_doubted", {"why": found.doubt}))
        started = {
            "server": self._server_name,
            "epoch": found.epoch,
            "endpoint": places.endpoint,
            "state_dir": str(places.state),
            "gpus": [
                {
                    "gpu": g.id,
                    "name": g.name,
                    "capacity_bytes": g.capacity_bytes,
                    "source": g.source,
                }
                for g in gpus
            ],
            "records": len(found.records),
            "records_of_earlier_boot": found.voided,
        }
        telemetry.log_event(history.append("started", started))

    def _core_failed(self, error: BaseException) -> None:
        """Nothing is decided any more; the journal holds what was granted, and the next start
        recovers it."""
        log.critical("stopping: %s: %s", type(error).__name__, error)
        self._exit_code = EXIT_DEFECT
        self._stop.set()

    async def _beat(self, parts: Parts, notifier: Notifier) -> None:
        """Feeds the watchdog only with an event that has just passed through the core and the
        executor, on this very thread: whatever is stuck there starves it."""
        period_s = min(STATUS_EVERY_S, (notifier.watchdog_s or 3 * STATUS_EVERY_S) / 3)
        said, kept_at = "", time.monotonic()
        while True:
            await asyncio.sleep(period_s)
            if notifier.watchdog_s is not None and parts.inbox.pulse():
                notifier.watchdog()
            parts.sessions.sweep()
            parts.journal.settle()
            parts.executor.settle()
            wrong = problems(parts.journal, parts.history)
            text = "; ".join([*wrong, status_text(parts.gpus), f"{len(parts.sessions)} clients"])
            if text != said and notifier.status(text):
                said = text
            if time.monotonic() - kept_at >= KEEP_LEARNT_EVERY_S and not parts.inbox.closed:
                keep_learnt(parts)
                kept_at = time.monotonic()


def keep_learnt(parts: Parts) -> None:
    """So that a kill loses no more than the last few seconds of learning."""
    parts.journal.keep("learnt", parts.inbox.learnt())
    parts.journal.keep("footprints", parts.inbox.footprints())


def status_text(gpus: Sequence[GpuInfo]) -> str:
    return (
        f"serving {', '.join(f'{gpu.name} ({format_bytes(gpu.capacity_bytes)})' for gpu in gpus)}"
    )


def problems(journal: Journal, history: History) -> list[str]:
    """What an operator should know of the daemon's own files, in words."""
    return [problem for problem in (*journal.problems, history.problem) if problem]


def try_records(journal: Journal, settings: Settings) -> None:
    """Let a core that is thrown away read the journal's records; what it cannot read is put aside
    instead of stopping every start."""
    if not journal.opened.records:
        return
    now = time.monotonic()
    try:
        Arbiter(settings, now).handle(Recovered(journal.opened.records), now)
    except Exception as error:
        log.exception("the core cannot read the journal's records")
        journal.put_aside(f"{type(error).__name__}: {error}")


def processes_of(records: Mapping[str, Mapping[str, Any]]) -> list[ProcessKey]:
    """The processes that the journal's records belong to, and those that use what belongs to
    others; each once."""
    found = set()
    for record in records.values():
        users = [(user[0], user[1]) for user in record.get("users", ())]
        for pid, ticks in [(record.get("pid"), record.get("start_ticks")), *users]:
            if isinstance(pid, int) and isinstance(ticks, int) and pid > 0:
                found.add(ProcessKey(pid, ticks))
    return sorted(found)


def raise_open_files() -> None:
    """A connection and a pidfd per client need more than the usual soft limit of 1,024
    descriptors."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = OPEN_FILES if hard == resource.RLIM_INFINITY else min(OPEN_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
