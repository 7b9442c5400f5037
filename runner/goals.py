"""The goal server: one goal at a time, its feedback, exactly one result, whatever happens to the client or the skill.

Speaks `schemas.goals` on a `RouterServer`. The arm is given to a skill on the control thread and taken back by cancel, deadline, failure
or end; a client that went away finds its result under `result`. It knows no model and no simulator.

A goal: accept (or refuse) → resident skill → `start` → the arm → `finish` → result. The deadline counts from acceptance and
covers all of it: status `deadline` is no success.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import msgpack
from pydantic import ValidationError

from clients.serve import Message, Peer, RouterServer, reason_of
from runner import frames
from runner.catalogue import Catalogue
from runner.clock import Clock
from runner.control import ControlThread
from runner.protocols import Goal, Progress, Skill, SkillEnded
from runner.skills.residency import Residency
from schemas import meters, telemetry, tracing
from schemas.errors import (
    BadRequest,
    BadState,
    EstopRequested,
    GoalRejected,
    InternalError,
    LimitExceeded,
    RobotFault,
    UnknownOp,
    VramError,
)
from schemas.goals import (
    RUNNER_REQUEST,
    CancelGoal,
    EstopRunner,
    FeedbackPush,
    GetFrame,
    GetGroundTruth,
    GetResult,
    GetSkills,
    GetState,
    PingRunner,
    ResultPush,
    SendGoal,
    ShutdownRunner,
)
from schemas.world import WorldState

log = logging.getLogger(__name__)

RESULTS_KEPT = 64
LISTENERS_MAX = 16  # of one goal: a client that comes back again and again takes its own old places
FEEDBACK_PERIOD_S = 0.2  # at most five a second
ESTOP_S = 1.0  # a control loop that has not obeyed by then hangs
READS_MAX = 16  # requests that wait for the control thread; more are refused, so that an emergency stop is always read
LOOP_SILENT_S = 1.0  # a control loop that has not looked at the world for so long hangs
FINISHING = "finishing"
FINISH_S = 8.0  # a skill that has not finished by then is left to itself; nobody waits longer for a result
FEEDBACK_QUIET_S = 1.0  # said again after this long even if nothing changed
OPS = ("goal", "cancel", "result", "frame", "state", "skills", "ground_truth", "ping", "estop", "shutdown")

Status = Literal["succeeded", "failed", "canceled", "deadline"]


class Robot(frames.FrameSource, Protocol):
    """What the server reads of the runner. The attributes are replaced whole by the control thread, never changed in place."""

    progress: Progress
    world: WorldState | None
    caption: tuple[str, ...]
    rate_hz: float
    tick_idx: int
    deadline_misses: int
    estop: EstopRequested | None

    def request_estop(self, reason: str) -> None: ...

    def obey_estop(self) -> EstopRequested | None: ...


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
    phase: str = "acquiring"
    so_far: dict[str, Any] = field(
        default_factory=dict
    )  # what became of its actions, once the arm was taken back
    began_s: float = 0.0
    sent: Progress | None = None
    sent_s: float = field(default=float("-inf"))


class GoalServer:
    """`await GoalServer(...).serve()` until `shutdown` or cancellation; then the running goal is canceled and answered.

    `estop_s`: a control loop that has not obeyed an emergency stop by then is said to hang.
    """

    def __init__(
        self,
        endpoint: str,
        control: ControlThread,
        robot: Robot,
        catalogue: Catalogue,
        clock: Clock,
        *,
        ground_truth: Callable[[], dict[str, Any]] | None = None,
        identity: dict[str, Any] | None = None,
        on_bound: Callable[[], None] | None = None,
        stopping: asyncio.Event | None = None,
        estop_s: float = ESTOP_S,
    ) -> None:
        self._endpoint = endpoint
        self._control = control
        self._robot = robot
        self._catalogue = catalogue
        self._clock = clock
        self._ground_truth = ground_truth
        self._identity = identity or {}
        self._on_bound = on_bound
        self._estop_s = estop_s
        self._residency = Residency()
        self._running: _Running | None = None
        self._results: OrderedDict[str, ResultPush] = OrderedDict()
        self._server: RouterServer | None = None
        self._reads = 0
        self.stopping = stopping or asyncio.Event()
        self.bound = asyncio.Event()

    async def serve(self) -> None:
        """Raises AlreadyRunning when another runner serves the endpoint."""
        async with RouterServer(self._endpoint, lambda error: _refusal(None, error)) as server:
            self._server = server
            serving = asyncio.create_task(server.serve(self._handle))
            stopping = asyncio.create_task(self.stopping.wait())
            ended = asyncio.ensure_future(asyncio.wait([self._control.ended]))
            self.bound.set()
            if self._on_bound is not None:
                self._on_bound()
            try:
                await asyncio.wait([serving, stopping, ended], return_when=asyncio.FIRST_COMPLETED)
            finally:
                self.stopping.set()  # whatever ended it: no goal is accepted any more
                await self._cancel_running()
                await self._residency.close()
                for task in (serving, stopping, ended):
                    task.cancel()
                await asyncio.gather(serving, stopping, ended, return_exceptions=True)
            if serving.done() and not serving.cancelled() and (error := serving.exception()) is not None:
                raise error

    def result_of(self, goal_id: str) -> ResultPush | None:
        """How a goal ended; None while it has not, or if it never was accepted."""
        return self._results.get(goal_id)

    # -- requests ------------------------------------------------------------------------------------------------------
    async def _handle(self, peer: Peer, message: Message) -> None:
        request_id = message.get("id") if isinstance(message.get("id"), int) else None
        try:
            reply = await self._answer(peer, _parse(message))
        except VramError as error:
            await self._send(peer, _refusal(request_id, error))
        except Exception as error:
            log.exception("request failed")
            await self._send(
                peer,
                _refusal(request_id, InternalError(f"{type(error).__name__}: {error}", hint="see the log")),
            )
        else:
            await self._send(peer, {"re": request_id, "ok": True, **reply})
            if message.get("op") == "shutdown":
                self.stopping.set()

    async def _answer(self, peer: Peer, request: Any) -> Message:
        match request:
            case SendGoal():
                return self._accept(peer, request)
            case CancelGoal():
                return self._cancel(request.goal_id)
            case GetResult():
                return self._result(request.goal_id)
            case GetFrame():
                with self._waiting_read():
                    reply = await frames.fetch(
                        self._control,
                        self._robot,
                        self._clock,
                        request.camera,
                        request.max_age_ms,
                        request.encoding,
                    )
                return dict(reply)
            case GetState():
                return self._state()
            case GetSkills():
                return {
                    "skills": self._catalogue.as_wire(),
                    "body": self._catalogue.body_as_wire(),
                    "resident": _text(self._residency.resident),
                }
            case GetGroundTruth():
                if self._ground_truth is None:
                    raise UnknownOp("only a simulator knows the truth", details={"known": [*OPS]})
                with self._waiting_read():
                    return await self._control.call(self._ground_truth)
            case PingRunner():
                return {
                    "pid": os.getpid(),
                    "goal_id": self._running.goal.goal_id if self._running else None,
                } | (self._identity)
            case EstopRunner():
                return await self._estop(request.reason or "on request")
            case ShutdownRunner():
                return {}
        raise UnknownOp("unknown request", details={"known": [*OPS]})

    @contextlib.contextmanager
    def _waiting_read(self) -> Iterator[None]:
        """Around what waits for the control thread. Raises LimitExceeded when too many do."""
        if self._reads >= READS_MAX:
            raise LimitExceeded(
                f"{READS_MAX} requests wait for the control loop",
                hint="ask again, and for fewer pictures at once",
                details={"limit": READS_MAX},
            )
        self._reads += 1
        try:
            yield
        finally:
            self._reads -= 1

    async def _estop(self, reason: str) -> Message:
        """Latched before anything else. Raises InternalError when the control loop does not say that it has obeyed, RobotFault when
        the motors could not be told."""
        log.critical("emergency stop: %s", reason)
        self._robot.request_estop(reason)
        error = self._robot.estop
        if (running := self._running) is not None and error is not None:
            running.stopped_by = error
            self._stop(running)
        try:
            async with asyncio.timeout(self._estop_s):
                error = await self._control.call(self._robot.obey_estop)
        except TimeoutError:
            raise InternalError(
                f"the control loop has not obeyed the emergency stop within {self._estop_s:.0f} s",
                hint="cut the robot's power; the loop hangs, and moves nothing if it comes back",
            ) from None
        if error is not None and not error.details.get("told", True):
            raise RobotFault(
                error.message, hint="cut the robot's power; the runner goes on trying", details=error.details
            )
        message = error.message if error is not None else ""
        return {"reason": reason, "message": message, "robot": self._identity.get("robot")}

    def _accept(self, peer: Peer, request: SendGoal) -> Message:
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
                f"goal {request.goal_id} has ended", hint="ask for its result, or send a new goal_id"
            )
        if self.stopping.is_set():
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
        running.task = asyncio.create_task(self._execute(running, make), name=f"goal {goal.goal_id}")
        return {"goal_id": goal.goal_id, "accepted": True}

    def _cancel(self, goal_id: str) -> Message:
        running = self._running
        if running is None or running.goal.goal_id != goal_id:
            if goal_id in self._results:
                return {"goal_id": goal_id, "status": self._results[goal_id]["status"]}
            raise BadRequest(f"there is no goal {goal_id}", hint="it never was accepted, or ended long ago")
        self._stop(running)
        return {"goal_id": goal_id}

    @staticmethod
    def _stop(running: _Running) -> None:
        """At most one cancellation reaches the task, and none when its end is decided: what it does to end cleanly is not interrupted."""
        if running.task is not None and not running.canceled and running.phase != FINISHING:
            running.canceled = True
            if running.begun:  # a task that is cancelled before its first step would never answer
                running.task.cancel()

    def _result(self, goal_id: str) -> Message:
        if (result := self._results.get(goal_id)) is not None:
            return {key: value for key, value in result.items() if key != "push"}
        if self._running is not None and self._running.goal.goal_id == goal_id:
            raise BadState(f"goal {goal_id} is still running", hint="wait for its result")
        raise BadRequest(f"there is no goal {goal_id}", hint=f"the last {RESULTS_KEPT} results are kept")

    def _state(self) -> Message:
        robot, running = self._robot, self._running
        return {
            "world": self._world(),
            "goal": running.goal.goal_id if running else None,
            "rskill_id": running.goal.rskill_id if running else None,
            "phase": running.phase if running else "idle",
            "resident": _text(self._residency.resident),
            "rate_hz": robot.rate_hz,
            "ticks": robot.tick_idx,
            "deadline_misses": robot.deadline_misses,
            "estop": robot.estop.message if robot.estop is not None else None,
            "cameras": list(robot.camera_names()),
        }

    def _world(self) -> dict[str, Any] | None:
        """The newest world state. What was fresh when the control loop last looked is not fresh while it hangs."""
        robot = self._robot
        if (world := robot.world) is None:
            return None
        told = world.model_dump(mode="json", exclude={"image_frames"})
        limit_s = max(LOOP_SILENT_S, 3 / robot.rate_hz if robot.rate_hz else 0.0)
        if (self._clock.now_ns() - world.stamp_ns) / 1e9 > limit_s:
            told["diagnostics"] = dict.fromkeys(world.diagnostics, "stale")
        return told

    # -- a goal --------------------------------------------------------------------------------------------------------
    async def _execute(self, running: _Running, make: Callable[[], Skill]) -> None:
        """All of it is one span, `rskill.goal`: the caller's child, and the parent of activation and ticks."""
        goal = running.goal
        running.begun = True
        attributes = {telemetry.ATTR_SKILL: goal.rskill_id, telemetry.ATTR_GOAL: goal.goal_id}
        if goal.revision:
            attributes[telemetry.ATTR_REVISION] = goal.revision
        with tracing.span(telemetry.SPAN_GOAL, goal.traceparent, attributes) as span:
            running.goal = replace(goal, traceparent=tracing.traceparent())
            status = await self._carry_out(running, make)
            span.set_attribute(telemetry.ATTR_OUTCOME, status)
            labels = {telemetry.ATTR_SKILL: goal.rskill_id, telemetry.ATTR_OUTCOME: status}
            meters.count(telemetry.METRIC_GOALS, labels)

    async def _carry_out(self, running: _Running, make: Callable[[], Skill]) -> Status:
        goal = running.goal
        log.info("goal %s: %s %s", goal.goal_id, goal.rskill_id, goal.prompt)
        telling = asyncio.create_task(self._tell(running))
        status: Status = "failed"
        error: VramError | None = None
        data: dict[str, Any] = {}
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
        except asyncio.CancelledError:  # our own cancel, or the server's end: the result still goes out
            status, error = ("failed", running.stopped_by) if running.stopped_by else ("canceled", None)
            data = running.so_far
        except Exception as raised:
            log.exception("goal %s failed", goal.goal_id)
            error = InternalError(f"{type(raised).__name__}: {raised}", hint="see the runner's log")
        running.phase = FINISHING
        if running.skill is not None:
            await self._finish(running.skill)
        telling.cancel()
        await asyncio.gather(telling, return_exceptions=True)
        await self._conclude(running, status, error, data)
        return status

    @staticmethod
    async def _finish(skill: Skill) -> None:
        """The goal's result is what it is, whatever happens here; the lease's use ends with our connection at the latest."""
        try:
            async with asyncio.timeout(FINISH_S):
                await skill.finish()
        except (VramError, TimeoutError) as error:
            log.warning(
                "%s did not finish cleanly: %s", skill.key, str(error) or f"not within {FINISH_S:.0f} s"
            )
        except Exception:
            log.exception("%s did not finish cleanly", skill.key)

    async def _run(self, running: _Running, make: Callable[[], Skill]) -> SkillEnded:
        """Raises what acquiring and starting raise; the arm is taken back whenever this ends."""
        goal = running.goal
        key, _, _ = self._catalogue.find(goal.rskill_id, goal.revision)
        self._caption(running)
        with tracing.span(telemetry.SPAN_ACTIVATE, attributes={telemetry.ATTR_SKILL: str(key)}):
            running.skill = skill = await self._residency.acquire(key, make)
            running.phase = "starting"
            self._caption(running)
            await self._residency.start(skill, goal)

        def begun() -> None:
            running.phase = "running"
            self._caption(running)

        return await self._control.run_skill(skill, goal, begun, running.so_far.update)

    async def _conclude(
        self, running: _Running, status: Status, error: VramError | None, data: dict[str, Any]
    ) -> None:
        goal = running.goal
        message = {
            "succeeded": "",
            "failed": str(error) if error else "failed",
            "canceled": "canceled on request",
            "deadline": f"not done within {goal.deadline_s:.0f} s",
        }[status]
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
            await self._send(peer, dict(result))

    async def _cancel_running(self) -> None:
        if (running := self._running) is not None and running.task is not None:
            self._stop(running)
            await asyncio.gather(running.task, return_exceptions=True)

    # -- progress ------------------------------------------------------------------------------------------------------
    async def _tell(self, running: _Running) -> None:
        while True:
            progress = self._robot.progress if running.phase == "running" else Progress(0.0, running.phase)
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
                    await self._send(peer, dict(feedback))
            await asyncio.sleep(FEEDBACK_PERIOD_S)

    def _caption(self, running: _Running) -> None:
        goal = running.goal
        self._robot.caption = (
            (f"{goal.rskill_id}: {running.phase}", goal.prompt)
            if goal.prompt
            else (f"{goal.rskill_id}: {running.phase}",)
        )

    async def _send(self, peer: Peer, message: Message) -> None:
        if self._server is not None:
            await self._server.send(peer, message)


def _parse(message: Message) -> Any:
    if message.get("op") not in OPS:
        raise UnknownOp(
            f"unknown op {message.get('op')!r}", hint=f"one of {', '.join(OPS)}", details={"known": [*OPS]}
        )
    if (
        message["op"] == "estop"
    ):  # whatever else is in it: nobody is refused an emergency stop for a long reason
        return EstopRunner(op="estop", id=0, reason=reason_of(message))
    try:
        return RUNNER_REQUEST.validate_python(message)
    except ValidationError as error:
        fields = [
            {"path": ".".join(map(str, item["loc"][1:])), "problem": item["msg"]}
            for item in error.errors(include_url=False, include_input=False)
        ]
        text = "; ".join(f"{item['path']}: {item['problem']}" for item in fields)
        raise BadRequest(f"{message['op']}: {text}", details={"fields": fields}) from error


def _refusal(request_id: int | None, error: VramError) -> Message:
    return {"re": request_id, "ok": False, "error": error.to_wire()}


def _identity(request: SendGoal) -> str:
    """What makes a repeated goal the same goal."""
    return request.model_dump_json(exclude={"id", "traceparent"})


def _sendable(data: dict[str, Any]) -> dict[str, Any]:
    """A skill's own words, if a wire carries them; a result reaches its client whatever they are."""
    try:
        msgpack.packb(data)
    except (TypeError, ValueError, OverflowError):
        return {"unsendable": repr(data)[:500]}
    return data


def _text(key: object) -> str | None:
    return None if key is None else str(key)
