"""The engine: events in, effects out. No clock, no sockets, no threads: the same events give the
same effects.

`handle` is one decision tree:
  1. what happened
     1.1 connections: hello, bye, death of a process
     1.2 requests: acquire, reacquire and cancel · ready, uses, renew, oom · revoke_ack, unloading,
     release · reattach · operators
     1.3 the machine: a reading, a failed reading, a failed journal write, a journal from before the
     restart, a resume from suspend, changed constants
     1.4 time: every timer that is due
  2. recovery ends when every lease is accounted for
  3. waits that could never end are denied; broken gangs end; GPUs are granted (its own numbered
     tree: `grants`); an acquire that has to wait is answered
  4. the next reading of each GPU is planned
  5. invariants
It must not know how effects are performed, nor that a wire exists.
"""

from collections.abc import Callable, Iterable, Mapping, Set
from dataclasses import replace
from typing import Any

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core import eviction, invariants
from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.features.gangs import Gangs
from vram_arbiter.arbiter.core.features.resizing import Resizing
from vram_arbiter.arbiter.core.features.standby import Standby
from vram_arbiter.arbiter.core.inspection import Inspection
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.arbiter.core.model.refusals import NoSession, Refused
from vram_arbiter.arbiter.core.model.state import Core, Turn
from vram_arbiter.arbiter.core.report import status, why
from vram_arbiter.arbiter.core.report.status import PageKey
from vram_arbiter.arbiter.core.requests import operators, recovery, requests, sessions, uses
from vram_arbiter.arbiter.core.scheduling import deadlock, grants
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.core.verification import schedule
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import StatusReply

DUE_MAX = 64
"""Timers that one tick serves. What is due beyond them is served by the next one, at once, so that
thousands of waits that end together do not hold the loop."""
IDLE_PROBE_S = 10.0
"""How long after the last client a GPU is still read in the background."""

type _Step = Callable[[Core, Any], None]

_FACTS: Mapping[type, _Step] = {
    # 1.1 connections
    ev.ClientConnected: sessions.on_connected,
    ev.ClientLeft: sessions.on_left,
    ev.ProcessDied: sessions.on_died,
    # 1.3 the machine
    ev.ProbeFailed: schedule.on_probe_failed,
    ev.JournalFailed: sessions.on_journal_failed,
    ev.Recovered: recovery.on_recovered,
    ev.Resumed: recovery.on_resumed,
    ev.SettingsChanged: operators.on_settings,
}
_REQUESTS: Mapping[type, _Step] = {
    ev.CancelRequested: requests.cancel,
    ev.ReadyReported: requests.ready,
    ev.UseBegan: uses.begin,
    ev.UseEnded: uses.end,
    ev.UseYielded: uses.yield_,
    ev.Renewed: requests.renew,
    ev.OomReported: requests.oom,
    ev.RevokeAcknowledged: requests.revoke_ack,
    ev.UnloadStarted: requests.unloading,
    ev.ReleaseReported: requests.release,
    ev.Reattached: recovery.on_reattached,
    ev.OperatorAsked: operators.on_operator,
}
"""1.2, beside those of features: each raises Refused before it has changed anything."""
_DUE: Mapping[str, Callable[[Core, str], None]] = {
    "ttl": sessions.expire,
    "wait": requests.on_wait_timeout,
    "revoke": eviction.on_ladder_due,
    "overstay": eviction.on_overstay_due,
    "verify": schedule.on_poll_due,
    "probe": schedule.on_probe_due,
    "users": uses.on_users_due,
    "recover": recovery.account_for,
    "plan": grants.on_plan_due,
    "return": grants.on_plan_due,
}
"""1.4, beside those of features, by kind of timer."""


class Arbiter:
    """The one owner of all leases. Not thread-safe: one task calls it. Its state is data only."""

    def __init__(self, settings: Settings, now: float) -> None:
        self._resizing = Resizing()
        self._gangs = Gangs()
        self._standby = Standby(settings.host_ram_budget_bytes)
        features = (self._resizing, self._gangs, self._standby)
        self._core = Core(settings, now, features)
        for gpu_id in self._core.gpus:
            self._core.timers.set(("probe", gpu_id), now)  # the first reading

    def handle(self, event: ev.Event, now: float) -> list[Effect]:
        """Return what is to be done, in order.

        Raises InvariantViolation or IllegalTransition on a defect of the engine: stop then.
        """
        core = self._core
        core.now = max(core.now, now)
        match event:  # 1
            case ev.ClientRequest():  # 1.2
                self._requested(event)
            case ev.MemorySampled():  # 1.3
                self._on_reading(event)
            case ev.Tick():  # 1.4
                self._on_tick()
            case _:  # 1.1, 1.3
                _FACTS[type(event)](core, event)
        if not core.serving and not core.recovering:  # 2
            recovery.serve(core)
        if core.turn.suspects:  # 3
            deadlock.resolve(core)
        if self._gangs.by_name:
            self._gangs.settle(core)
        if core.turn.dirty:
            grants.schedule(core)
        if core.turn.unanswered:
            requests.answer_queued(core)
        self._keep_reading()  # 4
        invariants.check(core)  # 5
        turn, core.turn = core.turn, Turn()
        return turn.effects

    def _requested(self, event: ev.ClientRequest) -> None:
        core = self._core
        if event.client not in core.clients:
            core.refuse(event.client, event.request, NoSession())
            return
        try:
            match event:
                case ev.AcquireRequested():
                    self._acquire(event)
                case ev.Reacquired():
                    self._standby.reacquire(core, event)
                case ev.ResizeAsked():
                    self._resizing.resize(core, event)
                case _:
                    _REQUESTS[type(event)](core, event)
        except Refused as refused:
            core.refuse(event.client, event.request, refused.refusal)
            if isinstance(event, ev.AcquireRequested | ev.Reacquired | ev.ResizeAsked):
                requests.note_refused(core, event, refused.refusal)

    def _acquire(self, event: ev.AcquireRequested) -> None:
        """Queue a lease. A lease that is away comes back for it; a gang waits until it is whole."""
        core = self._core
        spec = event.spec
        if self._standby.away and self._standby.acquire(core, event):
            return
        if spec.gang is None:
            lease = requests.acquire(core, event)
        else:
            lease = self._gangs.acquire(core, event, spec.gang.id, spec.gang.size)
        if lease is not None and (spec.standby or spec.park_bytes):
            self._standby.watch(lease)

    def _on_reading(self, reading: ev.MemorySampled) -> None:
        core = self._core
        schedule.on_reading(core, reading)
        gpu = core.gpus.get(reading.gpu)
        if gpu is None or gpu.sample is not reading:
            return  # it does not count
        if self._resizing.resizes:
            self._resizing.on_reading(core, gpu, reading)
        if not core.serving:
            recovery.account_for_the_empty(core, gpu, reading)

    def _on_tick(self) -> None:
        core = self._core
        for _ in range(DUE_MAX):
            due = core.timers.pop_due(core.now)
            if due is None:
                return
            kind, subject = due
            match kind:
                case "shrink":
                    self._resizing.on_shrink_due(core, subject)
                case "gang":
                    self._gangs.on_gang_due(core, subject)
                case "away":
                    self._standby.on_away_due(core, subject)
                case _:
                    _DUE[kind](core, subject)

    def _keep_reading(self) -> None:
        """Plan the next reading of each GPU that the event touched, while a load or a client, a
        lease or a waiter is there."""
        core, settings = self._core, self._core.settings
        for gpu in core.turn.touched.values():
            lists = gpu.sample is not None and gpu.sample.processes is not None
            if lists and gpu.residents.by_state[LeaseState.LOADING]:
                core.read_again(gpu, settings.probe_load_s)
            elif ("probe", gpu.info.id) not in core.timers and (
                core.clients
                or gpu.residents
                or gpu.verifications
                or gpu.queue.head
                or core.recovering
                or core.now - core.last_client_at <= IDLE_PROBE_S
            ):
                core.read_again(gpu, settings.probe_period_s)

    # -- questions
    def inspect(self) -> Inspection:
        """Return a read-only view of the records, for tests and offline tools."""
        return Inspection.of(self._core)

    def next_deadline(self) -> float | None:
        """When a tick is due (monotonic seconds); None: nothing is planned."""
        return self._core.timers.next_at()

    def status(
        self,
        now: float,
        reader: ProcessKey | None = None,
        after: PageKey | None = None,
        limit: int | None = None,
        *,
        details: bool = False,
    ) -> StatusReply:
        """Return a page of the status. `reader`: the process that asks; None: an operator, for all
        tokens. `details`: with those of each lease."""
        self._core.now = max(self._core.now, now)
        page = status.status(self._core, self._standby.host_ram(), reader, after, limit)
        if details:
            shown = why.details(self._core, [lease.lease_id for lease in page.leases])
            page = replace(page, details=shown)
        return page

    def leases(self, ids: Iterable[LeaseId], now: float) -> StatusReply:
        """Return the status with these leases alone, without tokens."""
        self._core.now = max(self._core.now, now)
        host_ram = self._standby.host_ram()
        return status.status(self._core, host_ram, ProcessKey(0, 0), only=ids)

    def why(self, consumer: str, now: float) -> WhyReply:
        """Explain why a consumer is not running."""
        self._core.now = max(self._core.now, now)
        return why.why(self._core, consumer)

    def stale(self, now: float) -> list[GpuId]:
        """GPUs that have to be read before their state can be shown (`schedule.stale`)."""
        self._core.now = max(self._core.now, now)
        return schedule.stale(self._core)

    def learnt(self) -> dict[str, dict[str, float]]:
        """Return the learned durations, in the shape of `Settings.learnt`."""
        return self._core.costs.medians()

    def footprints(self) -> dict[str, dict[str, list[int]]]:
        """What models really took, in the shape of `Settings.footprints`."""
        return self._core.footprints.kept()

    def owners(self, gpu: GpuId) -> Set[ProcessKey]:
        """Processes with an account on a GPU: they hold a lease there, one of theirs is measured
        away, or they keep a residue.

        Empty for an unknown GPU. As it is at that moment: it changes with the next event.
        """
        known = self._core.gpus.get(gpu)
        return frozenset() if known is None else known.ledger.accounts.keys()

    def clients(self) -> Set[ProcessKey]:
        """Processes with a connection, observers too. As it is at that moment."""
        return self._core.connected.keys()

    def concerns(self, client: ClientId) -> bool:
        """Whether a lease, a request or a use is this client's (`sessions.concerns`)."""
        return sessions.concerns(self._core, client)
