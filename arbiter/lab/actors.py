"""Actors of a simulation: consumers that behave as clients do.

A consumer acquires when there is work and its model is not resident, marks a use per job, lets uses
in progress end when it is revoked, unloads, releases. Must not know the scheduler.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from vram_arbiter.arbiter.core.events import (
    AcquireRequested,
    ClientConnected,
    Event,
    ProcessDied,
    ReadyReported,
    ReleaseReported,
    RevokeAcknowledged,
    UnloadStarted,
    UseBegan,
    UseEnded,
)
from vram_arbiter.arbiter.lab.gpu import START_S, SimulatedGpu
from vram_arbiter.arbiter.lab.outcome import Tally
from vram_arbiter.arbiter.lab.workload import Job, Plan
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token, UseId
from vram_arbiter.schemas.wire.pushes import AnyPush, DeniedPush, GrantedPush, RevokePush
from vram_arbiter.schemas.wire.views import LeaseView

OOM_RETRY_S = 1.0
"""Pause before a load that failed for lack of memory is retried."""
FOREVER_S = 1e9
"""TTL of simulated leases: simulated consumers never forget to renew."""


class Stage(Protocol):
    """Surroundings of an actor."""

    now: float
    gpus: dict[GpuId, SimulatedGpu]
    holders_exit: bool

    def at(self, when: float, call: Callable[[], None]) -> None: ...

    def post(self, event: Event) -> None: ...

    def next_request(self) -> RequestId: ...


@dataclass(slots=True)
class _Work:
    """A job that has arrived."""

    job: Job
    arrived_at: float
    served: bool = False  # its wait is counted


class Actor:
    """One process with at most one lease; jobs are done in their order."""

    def __init__(self, stage: Stage, plan: Plan, number: int, tally: Tally) -> None:
        self.client = ClientId(f"s{number:04d}")
        self.followers: Sequence[tuple[Actor, Sequence[Job]]] = ()
        self._stage = stage
        self._plan = plan
        self._process = ProcessKey(1000 + number, 1)
        self._tally = tally
        self._state = "none"  # none, waiting, loading, held, leaving, gone
        self._asked: RequestId | None = None  # the acquire that is not answered yet
        self._lease = LeaseId("")
        self._token = Token(0, 0)
        self._gpu = GpuId("")
        # the plan with the model, times and bytes of the present lease
        self._job = plan.jobs[0] if plan.jobs else None
        self._held_at = 0.0
        self._revoked = False
        self._pending: deque[_Work] = deque()
        self._settling: dict[UseId, _Work] = {}
        self._using: dict[UseId, _Work] = {}
        self._use_requests: dict[RequestId, UseId] = {}
        self._numbers = 0
        self._round = 0  # number of the lease: plans of an earlier one are void
        self._given = 0  # jobs handed to followers
        self._departs = False

    # -- work
    def begin(self) -> None:
        stage, plan = self._stage, self._plan
        for gpu in stage.gpus.values():
            gpu.names[self._process] = plan.consumer
        stage.post(ClientConnected(self.client, self._process, 1000, plan.consumer, self.client))
        if plan.resident and plan.jobs:
            self._acquire(plan.jobs[0])
        for job in plan.jobs:
            stage.at(START_S + job.due_s, _later(self.arrive, job))
        if plan.leaves_s is not None:
            stage.at(START_S + plan.leaves_s, self._depart)

    def arrive(self, job: Job) -> None:
        if self._state == "gone":
            return
        self._tally.jobs += 1
        self._pending.append(_Work(job, self._stage.now))
        self._go()

    def finish(self) -> None:
        """End the run: jobs that still wait have waited so long."""
        if self._state == "held":
            return
        for work in self._pending:
            if not work.served:
                self._tally.waits_s.append(self._stage.now - work.arrived_at)
                self._tally.unserved += 1

    def _go(self) -> None:
        if self._state == "none" and self._pending:
            self._acquire(self._pending[0].job)
        while self._state == "held" and not self._revoked and self._pending:
            if (self._using or self._settling) and not self._pending[0].job.alongside:
                return
            self._start(self._pending.popleft())

    def _start(self, work: _Work) -> None:
        fresh = work.arrived_at < self._held_at
        if not work.served:
            work.served = True
            self._tally.waits_s.append(max(0.0, self._held_at - work.arrived_at))
        self._numbers += 1
        use = UseId(f"u{self._numbers}")
        self._settling[use] = work
        settle_s = work.job.settle_s if fresh else 0.0
        self._stage.at(self._stage.now + settle_s, _later(self._begin_use, use, self._round))

    def _begin_use(self, use: UseId, turn: int) -> None:
        work = self._settling.pop(use, None)
        if work is None or turn != self._round:
            return
        if work.job.use_s is None:
            self._over(work)
            return
        self._using[use] = work
        request = self._stage.next_request()
        self._use_requests[request] = use
        self._stage.post(UseBegan(self.client, request, self._lease, self._token, use, ""))
        self._stage.at(self._stage.now + work.job.use_s, _later(self._end_use, use, turn))

    def _end_use(self, use: UseId, turn: int) -> None:
        work = self._using.pop(use, None)
        if work is None or turn != self._round:
            return
        self._say(UseEnded, use)
        self._over(work)

    def _over(self, work: _Work) -> None:
        self._pass_on()
        if self._revoked and not self._using:
            self._leave(self._plan.heed_s)
            return
        self._go()
        if work.job.release_after_s is not None and self._idle():
            turn, started = self._round, self._numbers
            self._stage.at(
                self._stage.now + work.job.release_after_s, lambda: self._let_go(turn, started)
            )
        elif self._departs:
            self._depart()

    def _pass_on(self) -> None:
        """End a job, done or failed: its followers get their next one."""
        for actor, jobs in self.followers:
            if self._given < len(jobs):
                job = jobs[self._given]
                self._stage.at(self._stage.now + job.due_s, _later(actor.arrive, job))
        self._given += 1

    def _idle(self) -> bool:
        return not (self._pending or self._settling or self._using)

    def _let_go(self, turn: int, started: int) -> None:
        if (
            (turn, started) == (self._round, self._numbers)
            and self._state == "held"
            and self._idle()
        ):
            self._leave(0.0)
        if self._departs:
            self._depart()

    def _depart(self) -> None:
        """End the process as soon as it has nothing left to do."""
        self._departs = True
        if self._idle() and self._state in ("none", "held"):
            self._state = "gone"
            self._round += 1
            for gpu in self._stage.gpus.values():
                gpu.set(self._process, 0, self._stage.now)
            self._stage.post(ProcessDied(self._process))

    # -- the lease
    def _acquire(self, job: Job) -> None:
        self._state, self._job = "waiting", job
        self._asked = self._stage.next_request()
        spec = replace(job.spec, ttl_s=FOREVER_S)
        self._stage.post(
            AcquireRequested(self.client, self._asked, f"n{self._asked}", spec, job.wait_timeout_s)
        )

    def answered(self, request: RequestId, lease: LeaseView | None) -> None:
        """Handle a reply. Only the reply of the acquire matters."""
        if request != self._asked or lease is None:
            return
        self._asked = None
        self._lease = LeaseId(lease.lease_id)
        if lease.state == "loading":
            self._granted(lease)

    def refused(self, request: RequestId) -> None:
        """Handle a refusal of the acquire, or of a use that came after the revoke."""
        if request == self._asked:
            self._asked = None
            self._tally.denied += 1
            self._give_up()
        elif (use := self._use_requests.get(request)) in self._using and use is not None:
            self._pending.appendleft(self._using.pop(use))

    def told(self, body: AnyPush) -> None:
        """Handle a push."""
        match body:
            case GrantedPush(lease):
                self._granted(lease)
            case DeniedPush(lease_id) if lease_id == self._lease:
                self._give_up()
            case RevokePush(lease_id) if lease_id == self._lease and self._state in (
                "held",
                "loading",
            ):
                self._asked_to_leave()
            case _:
                pass

    def _give_up(self) -> None:
        self._state = "none"
        if self._pending:
            work = self._pending.popleft()
            if not work.served:
                self._tally.waits_s.append(self._stage.now - work.arrived_at)
            self._pass_on()
        self._go()

    def _granted(self, lease: LeaseView) -> None:
        assert self._job is not None, "granted without a job"
        self._state = "loading"
        assert lease.token is not None, f"{lease.lease_id} has no token"
        assert lease.gpu is not None, f"{lease.lease_id} has no GPU"
        self._lease = LeaseId(lease.lease_id)
        self._token = lease.token
        self._gpu = GpuId(lease.gpu)
        self._round += 1
        turn = self._round
        if not self._stage.gpus[self._gpu].set(
            self._process, self._job.spec.footprint.load_peak_bytes, self._stage.now
        ):
            self._tally.ooms += 1
            self._stage.at(self._stage.now, lambda: self._out_of_memory(turn))
            return
        early = self._plan.resident and self._stage.now <= START_S + 1.0
        self._stage.at(
            self._stage.now + (0.0 if early else self._job.load_s), lambda: self._loaded(turn)
        )

    def _out_of_memory(self, turn: int) -> None:
        """Fail the load, as a program that crashed and is restarted."""
        if turn == self._round:
            self._release()
            self._stage.at(self._stage.now + OOM_RETRY_S, self._again)

    def _again(self) -> None:
        self._state = "none"
        self._go()

    def _loaded(self, turn: int) -> None:
        if turn != self._round or self._state != "loading" or self._job is None:
            return
        job = self._job
        count = (
            job.spec.footprint.steady_bytes if job.measured_bytes is None else job.measured_bytes
        )
        self._stage.gpus[self._gpu].set(self._process, count, self._stage.now)
        self._state, self._held_at = "held", self._stage.now
        self._say(ReadyReported, job.measured_bytes)
        if self._revoked:
            self._leave(self._plan.heed_s)
        self._go()

    def _asked_to_leave(self) -> None:
        if self._revoked:
            return
        self._revoked = True
        self._say(RevokeAcknowledged, None)
        for use in reversed(list(self._settling)):
            self._pending.appendleft(self._settling.pop(use))
        if not self._using and self._state == "held":
            self._leave(self._plan.heed_s)

    def _leave(self, heed_s: float) -> None:
        """Leave: unloading, then released."""
        if self._state != "held":
            return
        self._state = "leaving"
        turn = self._round
        self._stage.at(self._stage.now + heed_s, lambda: self._unload(turn))

    def _unload(self, turn: int) -> None:
        if turn != self._round or self._job is None:
            return
        self._say(UnloadStarted)
        self._stage.at(self._stage.now + self._job.unload_s, lambda: self._unloaded(turn))

    def _unloaded(self, turn: int) -> None:
        if turn != self._round or self._job is None:
            return
        kept = 0 if self._stage.holders_exit else self._job.spec.footprint.residue_bytes
        self._stage.gpus[self._gpu].set(self._process, kept, self._stage.now)
        self._release()
        self._state = "none"
        self._go()
        if self._departs:
            self._depart()

    def _release(self) -> None:
        self._round += 1
        self._revoked = False
        self._settling.clear()
        self._say(ReleaseReported, False)

    def _say(self, event: Callable[..., Event], *rest: object) -> None:
        """Post an event about the lease."""
        request = self._stage.next_request()
        self._stage.post(event(self.client, request, self._lease, self._token, *rest))


def _later[*T](call: Callable[[*T], None], *arguments: *T) -> Callable[[], None]:
    return lambda: call(*arguments)
