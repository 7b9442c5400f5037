"""What comes next on one GPU: the next steps for a waiter, and when it is loaded.

Reads only. The plan costs a search for victims per instant.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from math import inf

from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Timers
from vram_arbiter.arbiter.core.scheduling.admission import fits, joining, leaving
from vram_arbiter.arbiter.core.scheduling.victims import Choice
from vram_arbiter.schemas.ids import LeaseId, ProcessKey
from vram_arbiter.schemas.wire.codes import Block
from vram_arbiter.schemas.wire.explained import Because, NextAction, Step

ASK_TIMES_MAX = 16
"""Number of future eviction times to examine."""

WEIGHED_MAX = 400
"""Holders weighed over all of these times: beside many holders fewer times are examined."""

BEHIND_MAX = 4
"""Places of a queue for which an estimate is made: each costs a search for victims."""

_PHASES_LEFT = {
    LeaseState.REVOKING: ("drain_s", "unload_s", "verify_s"),
    LeaseState.UNLOADING: ("unload_s", "verify_s"),
    LeaseState.VERIFYING: ("verify_s",),
}
"""Learned phases that a leaving lease has before it."""


@dataclass(frozen=True, slots=True)
class Outlook:
    """One GPU at one moment, as far as it tells what comes next."""

    gpu: Gpu
    choice: Choice
    timers: Timers
    first: Lease | None  # the request that the GPU serves
    block: Block | None  # why nothing is granted there
    recovered_at: float | None  # when the last known holder has to be back after a restart

    # -- plan
    def steps(self, waiter: Lease) -> tuple[Step, ...]:
        """Return the next steps for a request, the nearest first, those without an instant last."""
        request = waiter.request
        found = self._steps_of_head(waiter) if self.first is waiter else []
        if request.wait_timeout_s is not None:
            at = request.arrived_at + request.wait_timeout_s
            found.append(self._step(NextAction.GIVE_UP, waiter, at, Because.TIMEOUT))
        return tuple(sorted(found, key=lambda step: inf if step.in_s is None else step.in_s))

    def _steps_of_head(self, waiter: Lease) -> list[Step]:
        gpu = self.gpu
        if self.block is Block.RECOVERING:
            return [self._step(NextAction.SERVE, None, self.recovered_at, Because.ACCOUNTED)]
        if gpu.failed_at is not None or gpu.sample is None:
            return [self._next_reading(Because.UNREADABLE)]
        found = self._ends_of_loads()
        found += [self._of_leaving(waiter, one) for one in gpu.leaving()]
        if found or self.block:
            return found
        if fits(gpu, waiter, leaving(gpu)):
            return [self._next_reading(Because.MEASUREMENT)]
        return self._asks(waiter)

    def _asks(self, waiter: Lease) -> list[Step]:
        """Return which holders will be revoked, and when: at the first instant at which a
        sufficient set may be."""
        gpu, going = self.gpu, leaving(self.gpu)
        times = sorted({self.choice.now, *self.choice.ask_times(gpu, waiter)})
        for at in times[: max(1, min(ASK_TIMES_MAX, WEIGHED_MAX // (1 + len(gpu.residents))))]:
            chosen = self.choice.victims(gpu, waiter, going, at)
            if chosen is not None:
                return [
                    self._step(NextAction.ASK, victim, at, self._ripens(waiter, victim, at))
                    for victim in chosen
                ]
        if missing := [lease for lease in gpu.in_state(LeaseState.HELD) if not lease.attached]:
            last = max(missing, key=lambda lease: lease.expires_at)
            return [self._step(NextAction.WAIT, last, last.expires_at, Because.NOT_BACK)]
        return [self._step(NextAction.WAIT, None, None, Because.NO_VICTIM)]

    def _ripens(self, waiter: Lease, victim: Lease, at: float) -> Because:
        """Return why a holder can be revoked at an instant and not before."""
        if at <= self.choice.now:
            return Because.NEXT_READING
        if at == self.choice.residency_ends_at(victim, waiter):
            return Because.RESIDENCY
        return Because.AGEING if victim.uses else Because.TOGETHER

    def _of_leaving(self, waiter: Lease, holder: Lease) -> Step:
        """Return the step of a holder whose room is being made."""
        verification = self.gpu.verifications.get(holder.id)
        if verification is not None:
            latest_s = max(0.0, verification.deadline_at - self.choice.now) or None
            because = Because.VERDICT if latest_s else Because.MEASURED_GONE
            step = self._step(NextAction.MEASURE, holder, verification.next_poll_at, because)
            return replace(step, latest_s=latest_s)
        eviction = holder.departure.eviction
        if eviction is None or eviction.overdue:
            because = Because.HANGING if holder.departure.hangs else Because.LEAVING
            return self._step(NextAction.WAIT, holder, None, because)
        unloads = holder.state is LeaseState.UNLOADING
        at = (
            holder.since if unloads else eviction.asked_at
        ) + self.choice.settings.revoke_deadline_s
        step = self._step(NextAction.DEADLINE, holder, at, Because.WAITS_ON)
        return replace(step, waiter=waiter.spec.consumer)

    def _ends_of_loads(self) -> list[Step]:
        steps: list[Step] = []
        for lease in self.gpu.in_state(LeaseState.LOADING):
            end = lease.granted_at + (
                self.choice.costs.learnt_s(lease.spec.consumer, "load_s") or 0.0
            )
            at = end if end > self.choice.now else None
            steps.append(self._step(NextAction.LOADED, lease, at, Because.ONE_LOAD))
        return steps

    def _next_reading(self, because: Because) -> Step:
        times = [self.timers.get((kind, self.gpu.info.id)) for kind in ("verify", "probe")]
        at = min((time for time in times if time is not None), default=None)
        return self._step(NextAction.READ, None, at, because)

    def _step(
        self, action: NextAction, lease: Lease | None, at: float | None, because: Because
    ) -> Step:
        """Return a step with, or of, a lease. `at` None: no instant is planned."""
        consumer, lease_id = ("", None) if lease is None else (lease.spec.consumer, lease.id)
        return Step(
            action,
            consumer,
            lease_id,
            None if at is None else max(0.0, at - self.choice.now),
            because,
        )

    # -- estimate
    def eta_s(self, waiter: Lease, steps: Sequence[Step]) -> float | None:
        """Return the seconds until a request is loaded, if every phase takes as long as usual.

        None: a phase on the way was never seen, or nothing is planned.
        """
        load_s = self.choice.costs.learnt_s(waiter.spec.consumer, "load_s")
        if load_s is None:
            return None
        emptied_s = self._emptied_s()
        if emptied_s or (emptied_s is not None and fits(self.gpu, waiter)):
            turn_s = self._loaded_s()
            return None if turn_s is None else max(emptied_s, turn_s) + load_s
        left_s = 0.0
        asked = [step for step in steps if step.action is NextAction.ASK]
        for step in asked:
            usual_s = self.choice.costs.usual_s(step.consumer, _PHASES_LEFT[LeaseState.REVOKING])
            if usual_s is None:
                return None
            left_s = max(left_s, (step.in_s or 0.0) + usual_s)
        return load_s + left_s if asked else None

    def eta_behind_s(self, lease: Lease) -> float | None:
        """Return the seconds until a request behind others is loaded: they load first, one by one.

        None: as for `eta_s`, or one of those ahead has to leave for it, at a time that nothing
        tells.
        """
        gpu = self.gpu
        queued = list(islice(gpu.queue, BEHIND_MAX))
        if lease not in queued:
            return None
        head, *others = together = queued[: queued.index(lease) + 1]
        if any(one.spec.exclusive for one in together):
            return None
        steps = self.steps(head)
        going = leaving(gpu)
        for step in steps:
            if step.action is NextAction.ASK and step.lease_id:
                victim = gpu.residents[LeaseId(step.lease_id)]
                going[victim.id] = victim.residue_bytes
        joins: Counter[ProcessKey] = Counter()
        for one in together:
            joins.update(dict(joining(one)))
        if gpu.ledger.total_if(going, joins.items()) > gpu.ledger.budget_bytes:
            return None
        loads = [self.choice.costs.learnt_s(one.spec.consumer, "load_s") for one in others]
        known = [self.eta_s(head, steps), *loads]
        return sum(one for one in known if one is not None) if None not in known else None

    def _loaded_s(self) -> float | None:
        """Return the seconds until the loads in progress are over; None: one was never seen, or
        takes longer than usual."""
        times = [step.in_s for step in self._ends_of_loads()]
        return (
            None if None in times else max((one for one in times if one is not None), default=0.0)
        )

    def _emptied_s(self) -> float | None:
        """Return the seconds until the last of the leaving holders is measured gone."""
        slowest_s = 0.0
        for one in self.gpu.leaving():
            usual_s = self.choice.costs.usual_s(one.spec.consumer, _PHASES_LEFT[one.state])
            if usual_s is None:
                return None
            slowest_s = max(slowest_s, usual_s - (self.choice.now - one.since))
        return slowest_s
