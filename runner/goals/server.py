"""Goal server: the requests of the runner's socket and their answers.

Speaks `schemas.goals` on a `RouterServer`. `runner.goals.one_goal` runs goals,
`runner.goals.frames` serves pictures; the emergency stop has a socket and a thread of its own
(`runner.safety.estop`). Must not know models or simulators.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import uuid
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Final

from pydantic import Discriminator, TypeAdapter

from vram_arbiter.clients.net.server import Peer, RouterServer, parsed, refusal
from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.goals import frames
from vram_arbiter.runner.goals.catalogue import Catalogue
from vram_arbiter.runner.goals.one_goal import OneGoal
from vram_arbiter.runner.recording.recorder import Marked, Verdict
from vram_arbiter.runner.safety.estop import OBEY_S, EstopServer
from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES
from vram_arbiter.schemas.errors import (
    BadRequest,
    BadState,
    GoalRejected,
    InternalError,
    LimitExceeded,
    UnknownOp,
    VramError,
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
    ResultPush,
    RunnerRequest,
    SendGoal,
    ShutdownRunner,
    TakeOverGoal,
)
from vram_arbiter.schemas.plain import Message

log = logging.getLogger(__name__)

READS_MAX = 16  # requests that wait for the control thread; a limit keeps room in its mailbox
# of the time, for the goal socket: the control thread waits for the interpreter lock meanwhile
WORK_SHARE = 0.25
LOOP_SILENT_S = 1.0  # a control loop that has not looked at the world for so long hangs
RUNNER_REQUEST: Final[TypeAdapter[RunnerRequest]] = TypeAdapter(
    Annotated[RunnerRequest, Discriminator("op")]
)
OPS = (
    "goal", "cancel", "result", "frame", "state", "skills", "ground_truth", "reset", "mark",
    "take_over", "ping", "shutdown",
)  # fmt: skip


class GoalServer:
    """`await GoalServer(...).serve()` until `shutdown` or cancellation; cancels the active goal.

    `estop_s`: a control loop that has not obeyed an emergency stop by then is reported as hanging.
    `realtime` runs the emergency stop's thread before other programs. `reset` begins a
    simulator's scene again, on the control thread, and returns its seed. `mark` is the recording's.
    """

    def __init__(
        self,
        endpoint: str,
        control: ControlThread,
        catalogue: Catalogue,
        clock: Clock,
        *,
        ground_truth: Callable[[], Message] | None = None,
        identity: Message | None = None,
        reset: Callable[[int | None], int] | None = None,
        mark: Callable[[str, Verdict], Marked] | None = None,
        on_bound: Callable[[], None] | None = None,
        stopping: asyncio.Event | None = None,
        estop_s: float = OBEY_S,
        realtime: bool = False,
    ) -> None:
        self._endpoint = endpoint
        self._control = control
        self._robot = control.runner
        self._catalogue = catalogue
        self._clock = clock
        self._ground_truth = ground_truth
        self._identity = identity or {}
        self._reset = reset
        self._mark = mark
        self._on_bound = on_bound
        self._estop_s = estop_s
        self._realtime = realtime
        self._server: RouterServer | None = None
        self._reads = 0
        self._session = uuid.uuid4().hex[:12]
        self.stopping = stopping or asyncio.Event()
        self._goals = OneGoal(control, catalogue, clock, self._send, self.stopping)
        self.bound = asyncio.Event()

    async def serve(self) -> None:
        """Serve until the end. Raises AlreadyRunning when another runner serves the endpoint."""
        loop = asyncio.get_running_loop()

        def on_stop(reason: str, pid: int, uid: int) -> None:
            with contextlib.suppress(
                RuntimeError
            ):  # the loop has ended: the stop is latched all the same
                loop.call_soon_threadsafe(self._stopped, reason, pid, uid)

        async with contextlib.AsyncExitStack() as stack:
            server = await stack.enter_async_context(
                RouterServer(
                    self._endpoint,
                    lambda error: refusal(None, error),
                    message_max_bytes=MESSAGE_MAX_BYTES,
                    work_share=WORK_SHARE,
                )
            )
            stack.enter_context(
                EstopServer(
                    self._endpoint,
                    self._robot,
                    on_stop=on_stop,
                    robot_id=str(self._identity.get("robot", "")),
                    obey_s=self._estop_s,
                    realtime=self._realtime,
                )
            )
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
                await self._goals.close()
                for task in (serving, stopping, ended):
                    task.cancel()
                await asyncio.gather(serving, stopping, ended, return_exceptions=True)
            if (
                serving.done()
                and not serving.cancelled()
                and (error := serving.exception()) is not None
            ):
                raise error

    def result_of(self, goal_id: str) -> ResultPush | None:
        """Return how a goal ended; None while it has not, or if it never was accepted."""
        return self._goals.result_of(goal_id)

    # -- requests
    async def _handle(self, peer: Peer, message: Message) -> None:
        request_id = message.get("id") if isinstance(message.get("id"), int) else None
        try:
            if "id" not in message:
                raise BadRequest("the request has no id", hint="a number that its reply repeats")
            reply = await self._answer(peer, parsed(message, RUNNER_REQUEST, OPS))
        except VramError as error:
            await self._send(peer, refusal(request_id, error))
        except Exception as error:
            log.exception("request failed")
            await self._send(
                peer,
                refusal(
                    request_id,
                    InternalError(f"{type(error).__name__}: {error}", hint="see the log"),
                ),
            )
        else:
            await self._send(peer, {"re": request_id, "ok": True, **reply})
            if message.get("op") == "shutdown":
                self.stopping.set()

    async def _answer(self, peer: Peer, request: Any) -> Message:
        match request:
            case SendGoal(session=session):
                if session not in ("", self._session):
                    raise GoalRejected(
                        f"goal {request.goal_id} is for session {session} of a runner, and this is"
                        f" session {self._session}",
                        hint="the runner was started again: begin the task anew",
                    )
                return self._goals.accept(peer, request)
            case CancelGoal():
                return self._goals.cancel(request.goal_id)
            case GetResult():
                return self._goals.result(request.goal_id)
            case GetFrame():
                with self._waiting_read():
                    reply = await frames.fetch(
                        self._control,
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
                    "resident": _text(self._goals.resident),
                    "session": self._session,
                }
            case GetGroundTruth():
                if self._ground_truth is None:
                    raise UnknownOp("only a simulator knows the truth", details={"known": [*OPS]})
                with self._waiting_read():
                    return await self._control.call(self._ground_truth)
            case ResetWorld():
                if (reset := self._reset) is None:
                    raise UnknownOp("only a simulator is reset", details={"known": [*OPS]})
                if (goal := self._goals.goal) is not None:
                    hint = "wait for its result or cancel it"
                    raise BadState(f"goal {goal.goal_id} is running", hint=hint)
                with self._waiting_read():
                    seed = await self._control.call(lambda: reset(request.seed))
                    await self._control.call(lambda: None)  # after the reset's tick
                return {"seed": seed}
            case MarkEpisode():
                if (mark := self._mark) is None:
                    hint = "start the runner with --record DIR, or save_dir in its file"
                    raise BadState("this runner records nothing", hint=hint)
                with self._waiting_read():
                    return {
                        **await asyncio.to_thread(lambda: mark(request.goal_id, request.verdict))
                    }
            case TakeOverGoal():
                return await self._goals.take_over(request.do, request.goal_id)
            case PingRunner():
                goal = self._goals.goal
                return {
                    "pid": os.getpid(),
                    "goal_id": goal.goal_id if goal else None,
                } | self._identity
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

    def _stopped(self, reason: str, pid: int, uid: int) -> None:
        """Log an emergency stop and end the goal; the stop's own thread has latched it already."""
        log.critical("emergency stop by process %d of uid %d: %s", pid, uid, reason)
        if (error := self._robot.estop) is not None:
            self._goals.stop(error)

    def _state(self) -> Message:
        robot, goal = self._robot, self._goals.goal
        return {
            "world": self._world(),
            "goal": goal.goal_id if goal else None,
            "rskill_id": goal.rskill_id if goal else None,
            "phase": self._goals.phase,
            "resident": _text(self._goals.resident),
            "rate_hz": robot.rate_hz,
            "ticks": robot.tick_idx,
            "deadline_misses": robot.deadline_misses,
            "estop": robot.estop.message if robot.estop is not None else None,
            "cameras": list(robot.camera_names()),
            "session": self._session,
            "recorded": self._mark is not None,
        }

    def _world(self) -> Message | None:
        """Return the newest world state.

        While the control loop hangs nothing in it counts as fresh.
        """
        robot = self._robot
        if (world := robot.world) is None:
            return None
        told = world.model_dump(mode="json", exclude={"image_frames"})
        limit_s = max(LOOP_SILENT_S, 3 / robot.rate_hz if robot.rate_hz else 0.0)
        if (self._clock.now_ns() - world.stamp_ns) / 1e9 > limit_s:
            told["diagnostics"] = dict.fromkeys(world.diagnostics, "stale")
        return told

    async def _send(self, peer: Peer, message: Message) -> None:
        if self._server is not None:
            await self._server.send(peer, message)


def _text(key: object) -> str | None:
    return None if key is None else str(key)
