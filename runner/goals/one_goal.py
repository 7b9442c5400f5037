"""One goal at a time, from its acceptance to its one result.

A goal: accept (or refuse) → resident skill → `start` → the robot → `finish` → result. The deadline
counts from acceptance and covers all of it; status `deadline` is not a success. The skill gets the
robot on the control thread and loses it by cancel, deadline, failure or success; a client that
disconnected finds its result again. Must not know a socket: messages go through `Tell`.
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from typing import Literal

from vram_arbiter.clients.net.server import Peer
from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.goals.catalogue import Catalogue
from vram_arbiter.runner.goals.take_over import OPERATOR, TakeOver
from vram_arbiter.runner.protocols import Goal, GoalData, Progress, Skill, SkillEnded, SkillKey
from vram_arbiter.runner.skills import teleop
from vram_arbiter.runner.skills.residency import Residency
from vram_arbiter.schemas.errors import (
    BadRequest,
    BadState,
    GoalRejected,
    InternalError,
    UnknownSkill,
    VramError,
)
from vram_arbiter.schemas.goals import FeedbackPush, ResultPush, SendGoal
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.msgpack_codec import pack
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

log = logging.getLogger(__name__)

RESULTS_KEPT = 64
LISTENERS_MAX = 16  # of one goal: a client that comes back again and again takes its own old places
FEEDBACK_PERIOD_S = 0.2  # at most five a second
FEEDBACK_QUIET_S = 1.0  # said again after this long even if nothing changed
FINISHING = "finishing"
FINISH_S = (
    8.0  # a skill that has not finished by then is abandoned; the result does not wait longer
)

Status = Literal["succeeded", "failed", "canceled", "deadline"]
Tell = Callable[[Peer, Message], Awaitable[None]]


@dataclass(slots=True)
class _Running:
    goal: Goal
    key: str
    peers: list[Peer]
    task: asyncio.Task[None] | None = None
    begun: bool = False
    canceled: bool = False
    stopped_by: VramError | None = None
    skill: Skill | None = None
    hands: TakeOver | None = None  # once the skill is started
    phase: str = "acquiring"
    so_far: GoalData = field(
        default_factory=dict
    )  # what became of its actions, once the arm was taken back
    began_s: float = 0.0
    sent: Progress | None = None
    sent_s: float = field(default=float("-inf"))


class OneGoal:
    """`accept` begins a goal; `close` cancels the active one and releases the resident skill.

    No goal is accepted once `stopping` is set.
    """

    def __init__(
        self,
        control: ControlThread,
        catalogue: Catalogue,
        clock: Clock,
        tell: Tell,
        stopping: asyncio.Event,
    ) -> None:
        self._control = control
        self._robot = control.runner
        self._catalogue = catalogue
        self._clock = clock
        self._tell_peer = tell
        self._stopping = stopping
        self._residency = Residency()
        self._running: _Running | None = None
        self._results: OrderedDict[str, ResultPush] = OrderedDict()

    @property
    def goal(self) -> Goal | None:
        """The one that runs."""
        return self._running.goal if self._running is not None else None

    @property
    def phase(self) -> str:
        return self._running.phase if self._running is not None else "idle"

    @property
    def resident(self) -> SkillKey | None:
        return self._residency.resident

    def result_of(self, goal_id: str) -> ResultPush | None:
        """Return how a goal ended; None while it has not, or if it never was accepted."""
        return self._results.get(goal_id)

    def stop(self, error: VramError) -> None:
        """Fail the active goal, if there is one, with this error."""
        if (running := self._running) is not None:
            running.stopped_by = error
            self._stop(running)

    async def close(self) -> None:
        """Cancel and answer the active goal."""
        if (running := self._running) is not None and running.task is not None:
            self._stop(running)
            await asyncio.gather(running.task, return_exceptions=True)
        await self._residency.close()

    # -- what a client asks
    def accept(self, peer: Peer, request: SendGoal) -> Message:
        """Accept or refuse a goal and return the reply.

        Raises EstopRequested, GoalRejected and what the catalogue raises.
        """
        if self._robot.estop is not None:
            raise self._robot.estop
        if (running := self._running) is not None:
            if running.goal.goal_id == request.goal_id and running.key == _identity(request):
                if all(peer.identity != known.identity for known in running.peers):
                    running.peers.append(peer)  # the same client on a new connection
                    del running.peers[:-LISTENERS_MAX]
                return {"goal_id": request.goal_id, "accepted": True}
            raise GoalRejected(
                f"goal {running.goal.goal_id} ({running.goal.rskill_id}) is running",
                hint="wait for its result or cancel it",
                details={"goal_id": running.goal.goal_id},
            )
        if request.goal_id in self._results:
            raise GoalRejected(
                f"goal {request.goal_id} has ended",
                hint="ask for its result, or send a new goal_id",
            )
        if self._stopping.is_set():
            raise GoalRejected("the runner is stopping", hint="start it again")
        _, make, manifest = self._catalogue.find(request.rskill_id, request.revision)
        goal = Goal(
            goal_id=request.goal_id,
            rskill_id=request.rskill_id,
            revision=request.revision,
            prompt=request.prompt,
            params=request.goal_params,
            deadline_s=self._catalogue.deadline_s(manifest, request.deadline_s),
            max_ticks=request.max_ticks,
            traceparent=request.traceparent,
        )
        running = _Running(goal, _identity(request), [peer], began_s=self._clock.now_s())
        self._running = running
        running.task = asyncio.create_task(
            self._execute(running, make), name=f"goal {goal.goal_id}"
        )
        return {"goal_id": goal.goal_id, "accepted": True}

    def cancel(self, goal_id: str) -> Message:
        """Cancel a goal and return the reply; the result still comes. Raises BadRequest."""
        running = self._running
        if running is None or running.goal.goal_id != goal_id:
            if goal_id in self._results:
                return {"goal_id": goal_id, "status": self._results[goal_id]["status"]}
            raise BadRequest(
                f"there is no goal {goal_id}", hint="it never was accepted, or ended long ago"
            )
        self._stop(running)
        return {"goal_id": goal_id}

    @staticmethod
    def _stop(running: _Running) -> None:
        """Cancel the goal's task, at most once, and not while it finishes: ending cleanly is
        protected.
        """
        if running.task is not None and not running.canceled and running.phase != FINISHING:
            running.canceled = True
            if running.begun:  # a task that is canceled before its first step would never answer
                running.task.cancel()

    def result(self, goal_id: str) -> Message:
        """Return a goal's result as a reply. Raises BadState while it runs, BadRequest."""
        if (result := self._results.get(goal_id)) is not None:
            return {key: value for key, value in result.items() if key != "push"}
        if self._running is not None and self._running.goal.goal_id == goal_id:
            raise BadState(f"goal {goal_id} is still running", hint="wait for its result")
        raise BadRequest(
            f"there is no goal {goal_id}", hint=f"the last {RESULTS_KEPT} results are kept"
        )

    async def take_over(self, do: Literal["take", "give_back", "end"], goal_id: str) -> Message:
        """Change the hands of the goal that runs and return the reply.

        Raises BadState, and what keeps the teleoperator from starting.
        """
        running = self._running
        if running is None or running.hands is None or goal_id not in ("", running.goal.goal_id):
            raise BadState(f"goal {goal_id or '?'} does not move the robot")
        match do:
            case "take":
                await running.hands.take(await self._operator())
            case "give_back":
                running.hands.give_back()
            case "end":
                await running.hands.end()
        return {"goal_id": running.goal.goal_id}

    async def _operator(self) -> Skill:
        """Return the operator's skill. Raises BadState for a robot without a teleoperator."""
        try:
            key, make, _ = self._catalogue.find(teleop.NAME)
        except UnknownSkill as error:
            hint = "name one under `teleop` in the robot's file"
            raise BadState(f"there is no teleoperator: {error.message}", hint=hint) from error
        return await self._residency.acquire(key, make)

    # -- a goal
    async def _execute(self, running: _Running, make: Callable[[], Skill]) -> None:
        """Run a goal within one span, `rskill.goal`: parent of activation and ticks."""
        goal = running.goal
        running.begun = True
        attributes = {telemetry.ATTR_SKILL: goal.rskill_id, telemetry.ATTR_GOAL: goal.goal_id}
        if goal.revision:
            attributes[telemetry.ATTR_REVISION] = goal.revision
        with tracing.span(telemetry.SPAN_GOAL, goal.traceparent, attributes) as span:
            running.goal = replace(goal, traceparent=tracing.traceparent())
            status, error = await self._carry_out(running, make)
            labels = {telemetry.ATTR_SKILL: goal.rskill_id, telemetry.ATTR_OUTCOME: status}
            if error is not None or status == "deadline":
                code = "deadline" if error is None else error.code
                labels[telemetry.ATTR_ERROR_TYPE] = code
                tracing.failed(span, code)
            tracing.note(labels)
            meters.count(telemetry.METRIC_GOALS, labels)

    async def _carry_out(
        self, running: _Running, make: Callable[[], Skill]
    ) -> tuple[Status, VramError | None]:
        goal = running.goal
        log.info("goal %s: %s %s", goal.goal_id, goal.rskill_id, goal.prompt)
        telling = asyncio.create_task(self._tell(running))
        status: Status = "failed"
        error: VramError | None = None
        data: GoalData = {}
        try:
            if running.canceled:
                raise asyncio.CancelledError
            async with asyncio.timeout(goal.deadline_s):
                ended = await self._run(running, make)
            data, error = dict(ended.data), ended.error
            status = "succeeded" if error is None else "failed"
        except TimeoutError:
            status, error, data = "deadline", None, running.so_far
        except VramError as raised:
            error = raised
        except (
            asyncio.CancelledError
        ):  # our own cancel, or the server's end: the result still goes out
            status, error = (
                ("failed", running.stopped_by) if running.stopped_by else ("canceled", None)
            )
            data = running.so_far
        except Exception as raised:
            log.exception("goal %s failed", goal.goal_id)
            error = InternalError(f"{type(raised).__name__}: {raised}", hint="see the runner's log")
        before = _before_motion(running)
        running.phase = FINISHING
        if running.hands is not None:
            await running.hands.close()
        if running.skill is not None:
            await self._finish(running.skill)
        telling.cancel()
        await asyncio.gather(telling, return_exceptions=True)
        await self._conclude(running, status, error, data, before)
        return status, error

    @staticmethod
    async def _finish(skill: Skill) -> None:
        """Finish the skill.

        Errors are logged only: the result is decided, and the use of the lease ends with the
        connection at the latest.
        """
        try:
            async with asyncio.timeout(FINISH_S):
                await skill.finish()
        except (VramError, TimeoutError) as error:
            log.warning(
                "%s did not finish cleanly: %s",
                skill.key,
                str(error) or f"not within {FINISH_S:.0f} s",
            )
        except Exception:
            log.exception("%s did not finish cleanly", skill.key)

    async def _run(self, running: _Running, make: Callable[[], Skill]) -> SkillEnded:
        """Run the skill to its end; the robot is taken back in any case.

        Raises what acquiring and starting raise.
        """
        goal = running.goal
        key, _, _ = self._catalogue.find(goal.rskill_id, goal.revision)
        self._caption(running)
        with tracing.span(telemetry.SPAN_ACTIVATE, attributes={telemetry.ATTR_SKILL: str(key)}):
            running.skill = skill = await self._residency.acquire(key, make)
            running.phase = "starting"
            self._caption(running)
            await self._residency.start(skill, goal)

        def show(phase: str) -> None:
            running.phase = phase
            self._caption(running)

        hands = TakeOver(
            control=self._control,
            goal=goal,
            skill=skill,
            start=self._residency.start,
            finish=self._finish,
            show=show,
            fail=self.stop,
            operated=goal.rskill_id == teleop.NAME,
        )

        def begun() -> None:
            running.hands = hands
            show("running")

        return await self._control.run_skill(hands.relay, goal, begun, running.so_far.update)

    async def _conclude(
        self,
        running: _Running,
        status: Status,
        error: VramError | None,
        data: GoalData,
        before: str,
    ) -> None:
        goal = running.goal
        message = {
            "succeeded": "",
            "failed": str(error) if error else "failed",
            "canceled": "canceled on request",
            "deadline": f"not done within {goal.deadline_s:g} s",
        }[status] + before
        result = ResultPush(
            push="result",
            goal_id=goal.goal_id,
            status=status,
            success=status == "succeeded",
            code=error.code if error else "",
            message=message,
            data={**_sendable(data), "elapsed_s": round(self._clock.now_s() - running.began_s, 3)},
        )
        self._results[goal.goal_id] = result
        while len(self._results) > RESULTS_KEPT:
            self._results.popitem(last=False)
        self._running = None
        self._robot.caption = (f"idle, after {goal.rskill_id}: {status}",)
        log.info("goal %s: %s %s", goal.goal_id, status, message)
        for peer in running.peers:
            await self._tell_peer(peer, dict(result))

    # -- progress
    async def _tell(self, running: _Running) -> None:
        while True:
            progress = self._robot.progress
            if running.phase == OPERATOR:
                progress = replace(progress, state=OPERATOR)
            elif running.phase != "running":
                starting = "" if running.skill is None else running.skill.phase
                progress = Progress(0.0, running.phase, detail=starting)
            now_s = self._clock.now_s()
            if progress != running.sent or now_s - running.sent_s >= FEEDBACK_QUIET_S:
                running.sent, running.sent_s = progress, now_s
                feedback = FeedbackPush(
                    push="feedback",
                    goal_id=running.goal.goal_id,
                    progress=progress.fraction,
                    state=progress.state,
                    tick_idx=progress.tick_idx,
                    detail=progress.detail,
                )
                for peer in running.peers:
                    await self._tell_peer(peer, dict(feedback))
            await asyncio.sleep(FEEDBACK_PERIOD_S)

    def _caption(self, running: _Running) -> None:
        goal = running.goal
        self._robot.caption = (
            (f"{goal.rskill_id}: {running.phase}", goal.prompt)
            if goal.prompt
            else (f"{goal.rskill_id}: {running.phase}",)
        )


def _before_motion(running: _Running) -> str:
    """Return what a goal waited for that ends before its motion, to be added to its message."""
    if running.phase == "acquiring":
        return "; its skill had not begun to start"
    if running.phase == "starting" and running.skill is not None and running.skill.phase:
        return f"; its model was {running.skill.phase}"
    return ""


def _identity(request: SendGoal) -> str:
    """Return what makes a repeated goal the same goal."""
    return repr(replace(request, id=0, traceparent=None))


def _sendable(data: GoalData) -> GoalData:
    """Return the skill's data if a wire can carry it: a result must reach its client."""
    try:
        pack(data)
    except (TypeError, ValueError, OverflowError):
        return {"unsendable": repr(data)[:500]}
    return data
