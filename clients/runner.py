"""Client of the runner: goals with feedback and result, frames, state. Speaks `schemas.goals`;
knows no robot and no GPU."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import uuid
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import TYPE_CHECKING, Literal, Self, cast

from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients.estop import Stopped, stop
from vram_arbiter.clients.net.link import is_listening
from vram_arbiter.clients.net.rpc_client import RpcClient
from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES
from vram_arbiter.schemas.errors import (
    BadState,
    GoalRejected,
    RunnerUnreachable,
    from_wire,
)
from vram_arbiter.schemas.goals import (
    CancelGoal,
    GetFrame,
    GetGroundTruth,
    GetResult,
    GetSkills,
    GetState,
    MarkEpisode,
    PingRunner,
    ResetWorld,
    RunnerRequest,
    SendGoal,
    ShutdownRunner,
    TakeOverGoal,
)
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.runtime.endpoints import program_endpoint

if TYPE_CHECKING:
    from vram_arbiter.schemas.goals import FeedbackPush, FrameReply, ResultPush

log = logging.getLogger(__name__)

CALL_TIMEOUT_S = 10.0
CONNECT_TIMEOUT_S = 10.0
RESET_TIMEOUT_S = 60.0  # scenes are built, pictures rendered
WAIT_QUIETLY_S = 2.0  # for a runner that is starting; then the log says so
MARK_TIMEOUT_S = 90.0  # the dataset's writer may be closing an episode's files
RESULT_POLL_S = 1.0  # while waiting for a result push: ask, in case contact was lost meanwhile
ENDED = ("succeeded", "failed", "canceled", "deadline")
FEEDBACK_MAX = 1000  # kept for a reader that is late; the oldest go first
TAKE_OVER_TIMEOUT_S = 30.0  # the teleoperator connects, and the policy's use ends

Verdict = Literal["success", "failure", "discard"]
Hands = Literal["take", "give_back", "end"]


class Goal:
    """An accepted goal. Its result comes exactly once and stays."""

    def __init__(self, client: RunnerClient, goal_id: str) -> None:
        self.goal_id = goal_id
        self._client = client
        self._feedback: asyncio.Queue[FeedbackPush | None] = asyncio.Queue()
        self._result: asyncio.Future[ResultPush] = asyncio.get_running_loop().create_future()
        self._news = asyncio.Event()  # the result is there, or contact was lost

    @property
    def done(self) -> bool:
        return self._result.done()

    async def feedback(self) -> AsyncIterator[FeedbackPush]:
        """Progress until the result is there. One reader."""
        while (item := await self._feedback.get()) is not None:
            yield item
        self._feedback.put_nowait(None)  # a second reader ends too

    async def result(self, timeout_s: float | None = None) -> ResultPush:
        """Raises TimeoutError (the goal goes on), RunnerUnreachable as soon as the runner is gone,
        BadRequest when it forgot the goal."""
        async with asyncio.timeout(timeout_s):
            while not self._result.done():
                self._news.clear()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._news.wait(), RESULT_POLL_S)
                if not self._result.done():
                    await self._client.check_result(self)
        return self._result.result()

    async def cancel(self) -> None:
        """Ask for the end; the result (status `canceled`) still comes."""
        await self._client.ask_about(CancelGoal(goal_id=self.goal_id))

    def fed(self, push: FeedbackPush) -> None:
        if self._feedback.qsize() >= FEEDBACK_MAX:
            self._feedback.get_nowait()
        self._feedback.put_nowait(push)

    def ended(self, result: ResultPush) -> None:
        if not self._result.done():
            self._result.set_result(result)
            self._news.set()
            self._feedback.put_nowait(None)

    def contact_lost(self) -> None:
        """Make `result` ask for what may have passed by."""
        self._news.set()


class RunnerClient:
    """`async with RunnerClient() as runner`. Connects at the first call; replaces its socket after
    a loss of contact."""

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        timeout_s: float = CALL_TIMEOUT_S,
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
    ) -> None:
        self.endpoint = endpoint or program_endpoint("runner", os.environ, os.getuid())
        self._timeout_s = timeout_s
        self._connect_timeout_s = connect_timeout_s
        self._rpc = RpcClient(
            self.endpoint,
            program="runner",
            lost=self._lost,
            pushed=self._pushed,
            dropped=self._dropped,
            request_max_bytes=MESSAGE_MAX_BYTES,
        )
        self._goals: dict[str, Goal] = {}
        self._drop = asyncio.Event()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Goals go on without us."""
        self._rpc.drop(self._lost("the client was closed"))

    @property
    def connected(self) -> bool:
        """Whether the runner that answered last still holds the connection."""
        return self._rpc.proven

    async def until_lost(self) -> None:
        """Wait until the runner that answered last hangs up; without one return at once."""
        while self.connected:
            self._drop.clear()
            await self._drop.wait()

    # -- goals -------------------------------------------------------------------------------------
    async def send_goal(
        self,
        rskill_id: str,
        *,
        revision: str = "",
        prompt: str = "",
        goal_params: JsonMap | None = None,
        deadline_s: float = 0.0,
        max_ticks: int | None = None,
        goal_id: str | None = None,
        traceparent: str | None = None,
        session: str = "",
    ) -> Goal:
        """Start a skill; returns once it is accepted. `deadline_s` 0 takes the manifest's;
        `max_ticks` None sets no limit in ticks. The goal's spans join the present trace, or the one
        of `traceparent`. A runner of another `session` refuses it.

        Raises GoalRejected (another goal runs), EstopRequested, UnknownSkill, RunnerUnreachable.
        """
        name = goal_id or f"goal-{uuid.uuid4().hex[:12]}"
        if name in self._goals:
            raise GoalRejected(f"goal {name} runs already", hint="choose another goal_id")
        goal = self._goals[name] = Goal(
            self, name
        )  # before the answer: pushes may come right behind it
        request = SendGoal(
            goal_id=name,
            rskill_id=rskill_id,
            session=session,
            revision=revision,
            prompt=prompt,
            goal_params=goal_params or {},
            deadline_s=deadline_s,
            max_ticks=max_ticks,
            traceparent=traceparent or traces.present(),
        )
        try:
            await self.call(request)
        except BaseException:
            del self._goals[name]
            raise
        return goal

    async def check_result(self, goal: Goal) -> None:
        """Ask for a result that may have passed us by while contact was lost."""
        try:
            reply = await self.ask_about(GetResult(goal_id=goal.goal_id))
        except BadState:
            return  # it runs; the error of a runner that forgot the goal is the caller's
        if reply.get("status") in ENDED:
            self._end(cast("ResultPush", reply))

    async def ask_about(self, request: CancelGoal | GetResult) -> Message:
        """Ask the runner that accepted the goal: another one that starts does not know it.

        Raises RunnerUnreachable at once where no process serves the socket any more.
        """
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + self._connect_timeout_s
        while not self._rpc.proven:  # in slices: a socket may vanish while its runner ends
            if not is_listening(self.endpoint):
                raise self._lost("it has ended")
            try:
                await self._exchange(PingRunner(), RESULT_POLL_S)
            except RunnerUnreachable:
                if loop.time() > deadline_s:
                    raise
        return await self.call(request)

    # -- reads -------------------------------------------------------------------------------------
    async def frame(
        self,
        camera: str = "",
        max_age_ms: float = 500.0,
        *,
        encoding: Literal["jpeg", "png"] = "jpeg",
    ) -> FrameReply:
        """Latest frame ("" takes the first camera). Raises FrameStale when none is young enough."""
        request = GetFrame(camera=camera, max_age_ms=max_age_ms, encoding=encoding)
        return cast("FrameReply", await self.call(request))

    async def state(self) -> Message:
        return await self.call(GetState())

    async def ground_truth(self) -> Message:
        """Simulator only: what is really there. For judges, never for planners."""
        return await self.call(GetGroundTruth())

    async def skills(self) -> Message:
        return await self.call(GetSkills())

    async def reset(self, seed: int | None = None) -> Message:
        """Simulator only: begin the scene again, or that of `seed`; returns once it stands.

        Raises BadState while a goal runs."""
        return await self.call(ResetWorld(seed=seed), timeout_s=RESET_TIMEOUT_S)

    async def mark(self, verdict: Verdict, goal_id: str = "") -> Message:
        """Mark the episode of the goal that runs, or of the last one; "discard" removes it.

        Raises BadState when nothing is recorded, BadRequest for another goal."""
        request = MarkEpisode(verdict=verdict, goal_id=goal_id)
        return await self.call(request, timeout_s=MARK_TIMEOUT_S)

    async def take_over(self, do: Hands, goal_id: str = "") -> Message:
        """Take the robot for the operator, give it back to the goal's skill, or end the goal as
        done.

        Raises BadState where that cannot be, and what keeps the teleoperator from starting."""
        request = TakeOverGoal(do=do, goal_id=goal_id)
        return await self.call(request, timeout_s=TAKE_OVER_TIMEOUT_S)

    async def ping(self, *, timeout_s: float = 1.0) -> Message:
        return await self._exchange(PingRunner(), timeout_s)

    async def estop(self, reason: str = "") -> Stopped:
        """Emergency stop, on its own socket and a thread of its own. Returns once the motors have
        been told; raises what `clients.estop.stop` raises."""
        executor = ThreadPoolExecutor(1, "estop")
        try:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(
                executor, lambda: stop(self.endpoint, reason, timeout_s=self._timeout_s)
            )
        finally:
            executor.shutdown(wait=False)

    async def shutdown(self) -> None:
        await self._exchange(ShutdownRunner(), self._timeout_s)

    async def call(self, request: RunnerRequest, *, timeout_s: float | None = None) -> Message:
        """Any request of `schemas.goals`. Raises its typed error, RunnerUnreachable, or
        UntrustedServer before anything is said."""
        if not self._rpc.proven:
            await self._await_runner()
        return await self._exchange(request, self._timeout_s if timeout_s is None else timeout_s)

    # -- steps -------------------------------------------------------------------------------------
    async def _await_runner(self) -> None:
        """Wait until a runner answers: one that is starting does not serve yet."""
        quiet_s = min(WAIT_QUIETLY_S, self._connect_timeout_s)
        try:
            await self._exchange(PingRunner(), quiet_s)
        except RunnerUnreachable:
            rest_s = self._connect_timeout_s - quiet_s
            if rest_s <= 0:
                raise
            log.warning("waiting for a runner at %s, %.0f s more", self.endpoint, rest_s)
            await self._exchange(PingRunner(), rest_s)

    async def _exchange(self, request: RunnerRequest, timeout_s: float) -> Message:
        try:
            reply: Message = await self._rpc.exchange(asdict(request), timeout_s)
        except TimeoutError:
            raise RunnerUnreachable(
                f"no runner answers {request.op} at {self.endpoint} within {timeout_s:g} s",
                hint="start `vram-runner`, or see its log",
            ) from None
        if not reply.get("ok"):
            raise from_wire(reply.get("error") or {})
        return reply

    def _pushed(self, message: Message) -> None:
        match message["push"]:
            case "feedback":
                if goal := self._goals.get(message["goal_id"]):
                    goal.fed(cast("FeedbackPush", message))
            case "result":
                self._end(cast("ResultPush", message))

    def _dropped(self) -> None:
        self._drop.set()
        for goal in self._goals.values():
            goal.contact_lost()

    def _end(self, result: ResultPush) -> None:
        if goal := self._goals.pop(result["goal_id"], None):
            goal.ended(result)

    def _lost(self, reason: str) -> RunnerUnreachable:
        return RunnerUnreachable(
            f"contact to {self.endpoint} lost: {reason}", hint="is the runner alive?"
        )
