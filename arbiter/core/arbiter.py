"""The engine: events in, effects out. No clock, no sockets, no threads: the same events give the
same effects.

`handle` is one decision tree:
  1. what happened, by `_STEPS`, or what is asked for, by `_REQUESTS`
  2. recovery ends when every lease is accounted for
  3. GPUs are granted (its own numbered tree: `grants`); an acquire that has to wait is answered
  4. the next reading of each GPU is planned
  5. invariants
It must not know how effects are performed, nor that a wire exists.
"""

from collections.abc import Callable, Mapping, Set
from dataclasses import replace
from math import inf
from typing import Any

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core import eviction, invariants, standby
from vram_arbiter.arbiter.core.effects import Effect, Sample
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.arbiter.core.model.refusals import NoSession, Refused
from vram_arbiter.arbiter.core.model.state import Core, Inspection, Turn
from vram_arbiter.arbiter.core.report import status, why
from vram_arbiter.arbiter.core.report.status import PageKey
from vram_arbiter.arbiter.core.requests import operators, recovery, requests, sessions, uses
from vram_arbiter.arbiter.core.scheduling import grants
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.core.verification import schedule
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import StatusReply

DUE_MAX = 64
"""Timers that one tick serves. What is due beyond them is served by the next one, at once, so that
thousands of waits that end together do not hold the loop."""
IDLE_PROBE_S = 10.0
"""How long after the last client a GPU is still read in the background."""


def _on_reading(core: Core, reading: ev.MemorySampled) -> None:
    schedule.on_reading(core, reading)
    gpu = core.gpus.get(reading.gpu)
    if not core.serving and gpu is not None and gpu.sample is reading:  # it counts
        recovery.account_for_the_empty(core, gpu, reading)


def _on_tick(core: Core, tick: ev.Tick) -> None:
    for _ in range(DUE_MAX):
        due = core.timers.pop_due(core.now)
        if due is None:
            return
        kind, subject = due
        _DUE[kind](core, subject)


_STEPS: Mapping[type, Callable[[Core, Any], None]] = {
    # connections
    ev.ClientConnected: sessions.on_connected,
    ev.ClientLeft: sessions.on_left,
    ev.ProcessDied: sessions.on_died,
    # the machine
    ev.MemorySampled: _on_reading,
    ev.ProbeFailed: schedule.on_probe_failed,
    ev.JournalFailed: sessions.on_journal_failed,
    ev.Recovered: recovery.on_recovered,
    ev.Resumed: recovery.on_resumed,
    ev.SettingsChanged: operators.on_settings,
    # time
    ev.Tick: _on_tick,
}
_REQUESTS: Mapping[type, Callable[[Core, ev.Asked, Any], None]] = {
    w.Acquire: requests.acquire,
    w.Reacquire: requests.reacquire,
    w.Cancel: requests.cancel,
    w.Ready: requests.ready,
    w.UseBegin: uses.begin,
    w.UseEnd: uses.end,
    w.Renew: requests.renew,
    w.Oom: requests.oom,
    w.RevokeAck: requests.revoke_ack,
    w.Unloading: requests.unloading,
    w.Release: requests.release,
    w.Reattach: recovery.reattach,
    **dict.fromkeys(operators.TO_LEASE, operators.order_lease),
    **dict.fromkeys(operators.TO_ALL, operators.order_all),
}
"""Each raises Refused before it has changed anything."""
_DUE: Mapping[str, Callable[[Core, str], None]] = {
    "ttl": sessions.expire,
    "wait": requests.on_wait_timeout,
    "revoke": eviction.on_ladder_due,
    "verify": schedule.on_poll_due,
    "probe": schedule.on_probe_due,
    "users": uses.on_users_due,
    "away": standby.on_away_due,
    "recover": Core.account_for,
    # a residency ended, a waiter aged, or the GPU has been quiet for long enough
    "plan": lambda core, gpu: core.gpus[GpuId(gpu)].wake(),
    "return": lambda core, gpu: core.gpus[GpuId(gpu)].wake(),
}
"""By kind of timer."""


class Arbiter:
    """The one owner of all leases. Not thread-safe: one task calls it. Its state is data only."""

    def __init__(self, settings: Settings, now: float) -> None:
        self._core = Core(settings, now)
        for gpu_id in self._core.gpus:
            self._core.timers.set(("probe", gpu_id), now)  # the first reading

    def handle(self, event: ev.Event, now: float) -> list[Effect]:
        """Return what is to be done, in order.

        Raises InvariantViolation or IllegalTransition on a defect of the engine: stop then.
        """
        core = self._core
        core.now = max(core.now, now)
        if isinstance(event, ev.Asked):  # 1
            self._asked(event)
        else:
            _STEPS[type(event)](core, event)
        if not core.serving and not core.recovering:  # 2
            core.serve()
        gpus = core.gpus.values()
        if any(gpu.dirty for gpu in gpus):  # 3
            grants.schedule(core)
        if core.turn.unanswered is not None:
            requests.answer_queued(core, core.turn.unanswered)
        for gpu in gpus:  # 4
            if gpu.touched:
                self._keep_reading(gpu)
        core.turn.effects += map(Sample, core.readings)
        core.readings.clear()
        invariants.check(core)  # 5
        for gpu in gpus:
            gpu.touched = False
        turn, core.turn = core.turn, Turn()
        return turn.effects

    def _asked(self, asked: ev.Asked) -> None:
        core, request = self._core, asked.request
        if asked.client not in core.clients:
            core.refuse(asked.client, asked.id, NoSession())
            return
        try:
            _REQUESTS[type(request)](core, asked, request)
        except Refused as refused:
            core.refuse(asked.client, asked.id, refused.refusal)
            if isinstance(request, (w.Acquire, w.Reacquire)):
                requests.note_refused(core, asked.client, request, refused.refusal)

    def _keep_reading(self, gpu: Gpu) -> None:
        """Plan the next poll of a GPU, and its next reading while a load or a client, a lease or a
        waiter is there."""
        core, timers, settings = self._core, self._core.timers, self._core.settings
        probe, poll, due_at = ("probe", gpu.info.id), ("verify", gpu.info.id), inf
        if gpu.verifications:
            timers.set(poll, min([v.next_poll_at for v in gpu.verifications.values()]))
        elif poll in timers:
            timers.cancel(poll)
        lists = gpu.sample is not None and gpu.sample.processes is not None
        if lists and gpu.residents.by_state[LeaseState.LOADING]:
            due_at = core.now + settings.probe_load_s
        elif probe not in timers and (
            core.clients
            or gpu.residents
            or gpu.verifications
            or gpu.queue.head
            or core.recovering
            or core.now - core.last_client_at <= IDLE_PROBE_S
        ):
            due_at = core.now + settings.probe_period_s
        if due_at < timers.get(probe, inf):
            timers.set(probe, due_at)

    # -- questions
    def inspect(self) -> Inspection:
        """Return a read-only view of the records, for tests and offline tools."""
        return self._core.inspect()

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
        page = status.status(self._core, reader, after, limit)
        if details:
            shown = why.details(self._core, [lease.lease_id for lease in page.leases])
            page = replace(page, details=shown)
        return page

    def why(self, consumer: str, now: float) -> WhyReply:
        """Explain why a consumer is not running."""
        self._core.now = max(self._core.now, now)
        return why.why(self._core, consumer)

    def stale(self, now: float) -> list[GpuId]:
        """GPUs that have to be read before their state can be shown (`schedule.stale`)."""
        self._core.now = max(self._core.now, now)
        core = self._core
        return schedule.stale(core.gpus.values(), core.now - core.settings.sample_max_age_s)

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

    def claims(self, gpu: GpuId) -> Mapping[str, tuple[ProcessKey, str]]:
        """Process and consumer of the leases on a GPU, or away or waiting for it, by the cgroup
        that they name. Of leases that name the same one, the oldest has it."""
        found: dict[str, tuple[ProcessKey, str]] = {}
        for lease in self._core.leases.values():
            places = lease.request.gpus if lease.gpu is None else (lease.gpu,)
            if lease.spec.cgroup is not None and gpu in places:
                found.setdefault(lease.spec.cgroup, (lease.process, lease.spec.consumer))
        return found

    def concerns(self, client: ClientId) -> bool:
        """Whether a lease, a request or a use is this client's (`sessions.concerns`)."""
        return sessions.concerns(self._core, client)
