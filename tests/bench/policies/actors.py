"""Actors of a simulation: consumers that behave as clients do.

A consumer acquires when there is work and its model is not resident, marks a use per job, lets uses
in progress end when it is revoked, unloads, releases. Must not know the scheduler.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from tests.bench.policies.outcome import Tally
from tests.bench.policies.scenarios import Job, Plan
from vram_arbiter.arbiter.core.events import Asked, ClientConnected, Event
from vram_arbiter.schemas.ids import ClientId, LeaseId, ProcessKey, RequestId, Token, UseId
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.pushes import (
    AnyPush,
    DeniedPush,
    GrantedPush,
    RevokePush,
    RevokeWithdrawnPush,
)
from vram_arbiter.schemas.wire.views import LeaseView

START_S = 1000.0
"""The clock at the beginning."""
OOM_RETRY_S = 1.0
"""Pause before a load that failed for lack of memory is retried."""
FOREVER_S = 1e9
"""TTL of simulated leases: simulated consumers never forget to renew."""


class Gpu(Protocol):
    """The GPU as a process sees it."""

    names: dict[ProcessKey, str]

    def set(self, process: ProcessKey, count: int, now: float) -> bool: ...


class Stage(Protocol):
    """Surroundings of an actor. `holders_exit`: models are processes that end when they are
    unloaded, so nothing stays on the GPU."""

    now: float
    holders_exit: bool

    @property
    def gpu(self) -> Gpu: ...

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
        self.consumer = plan.consumer
        self.followers: Sequence[tuple[Actor, Sequence[Job]]] = ()
        self._stage = stage
        self._plan = plan
        self._process = ProcessKey(1000 + number, 1)
        self._tally = tally
        self._state = "none"  # none, waiting, loading, held, leaving
        self._asked: RequestId | None = None  # the acquire that is not answered yet
        self._lease = LeaseId("")
        self._token = Token(0, 0)
        self._job: Job | None = None  # the one with the times and bytes of the present lease
        self._held_at = 0.0
        self._revoked = False
        self._pending: deque[_Work] = deque()
        self._using: dict[UseId, _Work] = {}
        self._use_requests: dict[RequestId, UseId] = {}
        self._uses = 0
        self._round = 0  # number of the lease: plans of an earlier one are void
        self._given = 0  # jobs handed to followers

    # -- work
    def begin(self) -> None:
        """Connect, and plan the arrivals."""
        stage = self._stage
        stage.gpu.names[self._process] = self.consumer
        stage.post(ClientConnected(self.client, self._process, 1000, self.consumer, self.client))
        for job in self._plan.jobs:
            stage.at(START_S + job.due_s, _later(self.arrive, job))

    def arrive(self, job: Job) -> None:
        """A job is there."""
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
        if self._state == "held" and not self._revoked and self._pending and not self._using:
            self._use(self._pending.popleft())

    def _use(self, work: _Work) -> None:
        if not work.served:
            work.served = True
            self._tally.waits_s.append(max(0.0, self._held_at - work.arrived_at))
        self._uses += 1
        use, turn = UseId(f"u{self._uses}"), self._round
        self._using[use] = work
        request = self._stage.next_request()
        self._use_requests[request] = use
        begin = w.UseBegin(self._lease, self._token, use)
        self._stage.post(Asked(self.client, request, begin))
        self._stage.at(self._stage.now + work.job.use_s, _later(self._end_use, use, turn))

    def _end_use(self, use: UseId, turn: int) -> None:
        work = self._using.pop(use, None)
        if work is None or turn != self._round:
            return
        self._say(w.UseEnd, use)
        self._pass_on()
        if self._revoked:
            self._leave()
            return
        self._go()
        if work.job.release_after_s is not None and not self._pending and not self._using:
            uses, at = self._uses, self._stage.now + work.job.release_after_s
            self._stage.at(at, lambda: self._release_if_idle(turn, uses))

    def _pass_on(self) -> None:
        """A job is over, done or failed: each follower gets its next one."""
        for actor, jobs in self.followers:
            if self._given < len(jobs):
                job = jobs[self._given]
                self._stage.at(self._stage.now + job.due_s, _later(actor.arrive, job))
        self._given += 1

    def _release_if_idle(self, turn: int, uses: int) -> None:
        if (turn, uses) == (self._round, self._uses) and not self._pending:
            self._leave()

    # -- the lease
    def _acquire(self, job: Job) -> None:
        self._state, self._job = "waiting", job
        self._asked = asked = self._stage.next_request()
        spec = replace(job.spec, ttl_s=FOREVER_S)
        acquire = w.Acquire(f"n{asked}", spec, job.wait_timeout_s)
        self._stage.post(Asked(self.client, asked, acquire))

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
            case RevokePush(lease_id) if lease_id == self._lease and not self._revoked:
                self._revoked = True
                self._say(w.RevokeAck)
                if not self._using:
                    self._leave()
            case RevokeWithdrawnPush(lease_id) if lease_id == self._lease and self._state == "held":
                self._revoked = False
                self._go()
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
        assert lease.token is not None, f"{lease.lease_id} has no token"
        self._state = "loading"
        self._lease, self._token = LeaseId(lease.lease_id), lease.token
        self._round += 1
        turn, now, peak = self._round, self._stage.now, self._job.spec.footprint.load_peak_bytes
        if self._stage.gpu.set(self._process, peak, now):
            self._stage.at(now + self._job.load_s, lambda: self._loaded(turn))
        else:
            self._tally.ooms += 1
            self._stage.at(now, lambda: self._out_of_memory(turn))

    def _out_of_memory(self, turn: int) -> None:
        """Fail the load, as a program that crashed and is restarted."""
        if turn == self._round:
            self._release()
            self._stage.at(self._stage.now + OOM_RETRY_S, self._again)

    def _again(self) -> None:
        self._state = "none"
        self._go()

    def _loaded(self, turn: int) -> None:
        if turn != self._round or self._job is None:
            return
        steady = self._job.spec.footprint.steady_bytes
        self._stage.gpu.set(self._process, steady, self._stage.now)
        self._state, self._held_at = "held", self._stage.now
        self._say(w.Ready)
        if self._revoked:
            self._leave()
        self._go()

    def _leave(self) -> None:
        """Leave: unloading, then released."""
        if self._state != "held" or self._job is None:
            return
        self._state, turn = "leaving", self._round
        self._say(w.Unloading)
        self._stage.at(self._stage.now + self._job.unload_s, lambda: self._unloaded(turn))

    def _unloaded(self, turn: int) -> None:
        if turn != self._round or self._job is None:
            return
        kept = 0 if self._stage.holders_exit else self._job.spec.footprint.residue_bytes
        self._stage.gpu.set(self._process, kept, self._stage.now)
        self._release()
        self._again()

    def _release(self) -> None:
        self._round += 1
        self._revoked = False
        self._say(w.Release)

    def _say(self, kind: Callable[..., w.AnyRequest], *rest: object) -> None:
        """Send a request about the lease."""
        request = kind(self._lease, self._token, *rest)
        self._stage.post(Asked(self.client, self._stage.next_request(), request))


def _later[*T](call: Callable[[*T], None], *arguments: *T) -> Callable[[], None]:
    return lambda: call(*arguments)
