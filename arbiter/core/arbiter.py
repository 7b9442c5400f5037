"""The engine: events in, effects out. No clock, no sockets, no threads: the same events give the
same effects.

`handle` is one decision tree:
  1. what happened
     1.1 connections: hello, bye, death of a process
     1.2 requests: acquire, reacquire and cancel · ready, uses, renew, oom · revoke_ack, unloading,
     release · reattach · operators
     1.3 the machine: a reading, a failed reading, a failed journal write, a journal from before the
     restart, a resume from suspend
     1.4 time: every timer that is due
  2. recovery ends when everybody is accounted for
  3. waits that could never end are denied; GPUs are granted (its own numbered tree: `grants`),
     and the answer to an acquire that has to wait
  4. background readings
  5. invariants
It must not know how effects are performed, nor that a wire exists.
"""

from collections.abc import Callable, Mapping, Set
from typing import Any

from vram_arbiter.arbiter.core import invariants
from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.events import (
    AcquireRequested,
    CancelRequested,
    ClientConnected,
    ClientLeft,
    Event,
    JournalFailed,
    MemorySampled,
    OomReported,
    OperatorAsked,
    ProbeFailed,
    ProcessDied,
    Reacquired,
    ReadyReported,
    Reattached,
    Recovered,
    ReleaseReported,
    Renewed,
    ResizeAsked,
    Resumed,
    RevokeAcknowledged,
    Tick,
    UnloadStarted,
    UseBegan,
    UseEnded,
    UseYielded,
)
from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.features.gangs import Gangs
from vram_arbiter.arbiter.core.features.parking import HostRam
from vram_arbiter.arbiter.core.features.resizing import Resizing
from vram_arbiter.arbiter.core.features.standby import Standby
from vram_arbiter.arbiter.core.inspection import Inspection
from vram_arbiter.arbiter.core.model.refusals import Refused
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.model.turn import Turn
from vram_arbiter.arbiter.core.report import explain, figures
from vram_arbiter.arbiter.core.requests import (
    expiry,
    operators,
    recovery,
    refusals,
    requests,
    resume,
    sessions,
    uses,
)
from vram_arbiter.arbiter.core.scheduling import deadlock, grants
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.core.verification import schedule
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import StatusReply

DUE_MAX = 64
"""Timers that one Tick serves. What is due beyond them is served by the next one, at once, so that
thousands of waits that end together do not hold the loop."""


def _on_reading(core: Core, sample: MemorySampled) -> None:
    schedule.on_reading(core, sample)
    if core.recovering is not None:
        recovery.account_for_the_empty(core, sample)


_FACTS: Mapping[type, Callable[[Core, Any], None]] = {
    # 1.1 connections
    ClientConnected: sessions.on_connected,
    ClientLeft: sessions.on_left,
    ProcessDied: sessions.on_died,
    # 1.3 the machine
    MemorySampled: _on_reading,
    ProbeFailed: schedule.on_probe_failed,
    JournalFailed: sessions.on_journal_failed,
    Recovered: recovery.on_recovered,
    Resumed: resume.on_resumed,
}
_REQUESTS: Mapping[type, Callable[[Core, Any], None]] = {
    AcquireRequested: requests.acquire,
    CancelRequested: requests.cancel,
    ReadyReported: requests.ready,
    UseBegan: uses.begin,
    UseEnded: uses.end,
    UseYielded: uses.yield_,
    Renewed: requests.renew,
    OomReported: requests.oom,
    RevokeAcknowledged: requests.revoke_ack,
    UnloadStarted: requests.unloading,
    ReleaseReported: requests.release,
    Reattached: recovery.on_reattached,
    OperatorAsked: operators.on_operator,
}
"""1.2, beside those of features: each raises Refused before it has changed anything."""
_DUE: Mapping[str, Callable[[Core, str], None]] = {
    "ttl": expiry.on_expiry_due,
    "wait": requests.on_wait_timeout,
    "revoke": eviction.on_ladder_due,
    "overstay": eviction.on_overstay_due,
    "verify": schedule.on_poll_due,
    "probe": schedule.on_probe_due,
    "users": uses.on_users_due,
    "recover": recovery.on_recover_due,
    "plan": grants.on_plan_due,
}
"""1.4: kinds of timers; the other kinds are a feature's own."""


class Arbiter:
    """The one owner of all leases. Not thread-safe: one task calls it."""

    def __init__(self, settings: Settings, now: float) -> None:
        self._resizing = Resizing()
        self._gangs = Gangs()
        self._standby = Standby(HostRam(settings.host_ram_budget_bytes))
        features = (self._resizing, self._gangs, self._standby)
        self._core = Core(settings, now, features)
        for gpu_id in self._core.gpus:
            self._core.timers.set(("probe", gpu_id), now)  # the first reading

    def handle(self, event: Event, now: float) -> list[Effect]:
        """What is to be done, in order. Raises InvariantViolation or IllegalTransition on a defect
        of the engine: stop then."""
        core = self._core
        core.now = max(core.now, now)
        self._happened(event)  # 1
        recovery.serve_if_accounted(core)  # 2
        deadlock.resolve(core)  # 3
        for feature in core.hooked["settle"]:
            feature.settle(core)
        grants.schedule(core)
        requests.answer_queued(core)
        self._keep_reading()  # 4
        invariants.check(core)  # 5
        turn, core.turn = core.turn, Turn()
        return turn.effects

    def check_all(self) -> None:
        """Every invariant over everything, and the tables that the check of each event stands on.
        For tests' drivers: O(leases)."""
        invariants.check_all(self._core)

    def inspect(self) -> Inspection:
        """Return a read-only view of the records, for tests and offline tools."""
        return Inspection.of(self._core)

    def next_deadline(self) -> float | None:
        """When a Tick is due (monotonic seconds); None: nothing is planned."""
        return self._core.timers.next_at()

    def status(
        self,
        now: float,
        reader: ProcessKey | None = None,
        after: explain.PageKey | None = None,
        limit: int | None = None,
    ) -> StatusReply:
        """Return a page of the status. `reader`: the process that asks; None: an operator, for all
        tokens."""
        self._core.now = max(self._core.now, now)
        return explain.status(self._core, self._standby.host.status(), reader, after, limit)

    def why(self, consumer: str, now: float) -> WhyReply:
        """Explain why a consumer is not running."""
        self._core.now = max(self._core.now, now)
        return explain.why(self._core, consumer)

    def stale(self, now: float) -> list[GpuId]:
        """GPUs that have to be read before their state can be shown (`schedule.stale`)."""
        self._core.now = max(self._core.now, now)
        return schedule.stale(self._core)

    def figures(self) -> dict[str, Any]:
        """The present in numbers (`figures.figures`)."""
        return figures.figures(self._core)

    def learnt(self) -> dict[str, dict[str, float]]:
        """Medians of what was learnt, in the shape of `Settings.learnt`."""
        return explain.medians(self._core)

    def footprints(self) -> dict[str, dict[str, list[int]]]:
        """What models really took, in the shape of `Settings.footprints`."""
        return self._core.footprints.kept()

    def owners(self, gpu: GpuId) -> Set[ProcessKey]:
        """Processes with an account on a card: they hold a lease there, one of theirs is measured
        away, or they keep a residue.

        Empty for an unknown card. As it is at that moment: it changes with the next event.
        """
        known = self._core.gpus.get(gpu)
        return frozenset() if known is None else known.ledger.accounts.keys()

    def clients(self) -> Set[ProcessKey]:
        """Processes with a connection, observers too. As it is at that moment."""
        return self._core.connected.keys()

    def concerns(self, client: ClientId) -> bool:
        """Whether a lease, a request or a use is this client's (`sessions.concerns`)."""
        return sessions.concerns(self._core, client)

    def _happened(self, event: Event) -> None:
        if (fact := _FACTS.get(type(event))) is not None:  # 1.1, 1.3
            fact(self._core, event)
        elif isinstance(event, Tick):  # 1.4
            self._run_due()
        else:  # 1.2
            self._requested(event)

    def _requested(self, event: Any) -> None:
        core = self._core
        try:
            if isinstance(event, Reacquired):
                self._standby.reacquire(core, event)
            elif isinstance(event, ResizeAsked):
                self._resizing.resize(core, event)
            else:
                _REQUESTS[type(event)](core, event)
        except Refused as refused:
            core.refuse(event.client, event.request, refused.refusal)
            if isinstance(event, AcquireRequested | Reacquired | ResizeAsked):
                refusals.note(core, event, refused.refusal)

    def _run_due(self) -> None:
        core = self._core
        for _ in range(DUE_MAX):
            due = core.timers.pop_due(core.now)
            if due is None:
                return
            kind, subject = due
            if kind in _DUE:
                _DUE[kind](core, subject)
            else:
                owner = next(one for one in core.features if kind in one.timers)
                owner.on_timer(core, kind, subject)

    def _keep_reading(self) -> None:
        core = self._core
        for gpu in core.turn.touched.values():
            if gpu.sees_loads():
                core.read_again(gpu, core.settings.load_probe_s)
            elif ("probe", gpu.info.id) not in core.timers and core.active(gpu):
                core.read_again(gpu, core.settings.probe_period_s)
