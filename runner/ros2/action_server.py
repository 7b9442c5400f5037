"""Server of one ROS 2 action over DDS, as rmw_cyclonedds speaks it. Needs no ROS installation.

Besides its three services (see `service_client`) an action has two topics, `feedback` and `status`.
A thread of its own waits for requests; everything else happens on the event loop.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, Protocol, Self

from vram_arbiter.runner.ros2.service_client import action_services
from vram_arbiter.runner.sensors.dds_thread import DdsThread
from vram_arbiter.runner.sensors.ros2_dds import (
    announce,
    dds_problems,
    dds_topic,
    full_topic,
    reader_of,
    writer_of,
)
from vram_arbiter.runner.sensors.ros2_types import action_of, cdr_of, read, sample_of, write
from vram_arbiter.schemas.errors import ConfigError, VramError
from vram_arbiter.schemas.plain import JsonMap, JsonObject

if TYPE_CHECKING:
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader

log = logging.getLogger(__name__)

REQUESTS_KEPT: Final = 16  # in DDS, until the thread has come to them
REQUESTS_MAX: Final = 256  # that are being answered; results of goals that run among them
GOALS_KEPT: Final = 64  # that ended: their results may still be asked for
LAST_S: Final = 1.0  # at the end, for replies to leave and to be received
STATUS = "action_msgs/msg/GoalStatusArray"


class Status(IntEnum):
    """Of action_msgs/GoalStatus."""

    UNKNOWN = 0
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


class CancelCode(IntEnum):
    """Of action_msgs/CancelGoal."""

    NONE = 0
    UNKNOWN_GOAL = 2
    TERMINATED = 3


class Execution(Protocol):
    """One accepted goal."""

    def feedback(self) -> AsyncIterator[JsonObject]: ...

    async def result(self) -> tuple[Status, JsonObject]:
        """Return how it ended, and the action's result."""
        ...

    async def cancel(self) -> None: ...


Accept = Callable[[str, JsonObject], Awaitable[Execution]]
"""Takes a goal's id, 32 hexadecimal digits, and its fields. Raises VramError: it is rejected."""


@dataclass(slots=True)
class _Goal:
    goal_id: str
    accepted_s: float  # by the wall clock, as ROS 2 counts
    execution: Execution
    result: asyncio.Future[JsonObject]
    status: Status = Status.EXECUTING
    ended: bool = False

    def info(self) -> JsonObject:
        return {"goal_id": _uuid(self.goal_id), "stamp": _stamp(self.accepted_s)}


class ActionServer:
    """`async with ActionServer("openral_msgs/ExecuteRskill", "/execute", 0, accept): …`

    Entering raises ConfigError: a wrong name, or DDS cannot be started. Leaving cancels the goals
    that run and tells their results.
    """

    def __init__(self, interface: str, name: str, domain: int, accept: Accept) -> None:
        try:
            self.name = full_topic(name)
        except ValueError as error:
            raise ConfigError(f"the action's name: {error}") from error
        action = action_of(interface)
        self._kinds = action_services(interface)
        self._feedback_kind = f"{action}_FeedbackMessage"
        self._domain = domain
        self._accept = accept
        self._goals: dict[str, _Goal] = {}
        self._accepting: set[str] = set()
        self._closing = False
        self._tasks: set[asyncio.Task[None]] = set()
        self._running: set[asyncio.Task[None]] = set()
        self._readers: dict[str, DataReader] = {}
        self._writers: dict[str, DataWriter] = {}
        self._node: Any = None  # what tells of it
        self.failed: asyncio.Future[str]

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self.failed = self._loop.create_future()  # DDS failed: why
        with dds_problems(self._domain):
            self._thread = self._open()
        self._publish_status()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._closing = True
        for goal in [goal for goal in self._goals.values() if not goal.ended]:
            await self._cancel(goal)
        await asyncio.gather(*self._running, return_exceptions=True)
        if self._tasks:
            late = (await asyncio.wait(self._tasks, timeout=LAST_S))[1]
            for task in late:
                task.cancel()
        await self._thread.stop()
        await asyncio.to_thread(
            self._writers["/_action/get_result"].wait_for_acks, _duration(LAST_S)
        )
        self._readers.clear()
        self._writers.clear()
        self._node = None

    # -- DDS
    def _open(self) -> DdsThread:
        from cyclonedds.domain import DomainParticipant

        participant = DomainParticipant(self._domain)
        for service, kind in self._kinds.items():
            path = self.name + service
            self._writers[service] = writer_of(
                participant, f"rr{path}Reply", f"{kind}_Response", kept=REQUESTS_KEPT, wait_s=1
            )
            self._readers[service] = reader_of(
                participant, f"rq{path}Request", f"{kind}_Request", kept=REQUESTS_KEPT
            )
        told = dds_topic(f"{self.name}/_action/feedback")
        self._writers["feedback"] = writer_of(
            participant, told, self._feedback_kind, kept=REQUESTS_KEPT
        )
        told = dds_topic(f"{self.name}/_action/status")
        self._writers["status"] = writer_of(participant, told, STATUS, latched=True)
        node = "vram_runner_" + self.name.rpartition("/")[2]
        self._node = announce(participant, node, self._readers.values(), self._writers.values())
        return DdsThread(
            "ros2-action-server",
            participant,
            self._readers.values(),
            (),
            self._woken,
            self._failed,
        )

    def _woken(self) -> None:
        """Hand requests to the event loop. Called on DDS's thread."""
        for service, reader in self._readers.items():
            for sample in reader.take(N=REQUESTS_KEPT):
                if not sample.sample_info.valid_data:
                    continue
                try:
                    request = read(self._kinds[service] + "_Request", cdr_of(sample))
                except ValueError as error:
                    log.warning("a request of %s%s cannot be read: %s", self.name, service, error)
                    continue
                self._loop.call_soon_threadsafe(self._begin, service, request)

    def _failed(self, problem: str) -> None:
        self._loop.call_soon_threadsafe(self._fail, problem)

    def _write(self, topic: str, kind: str, message: JsonMap) -> None:
        cdr = write(kind, message)
        self._writers[topic].write(sample_of(kind, cdr))

    def _fail(self, problem: str) -> None:
        if not self.failed.done():
            self.failed.set_result(problem)

    # -- requests
    def _begin(self, service: str, request: JsonObject) -> None:
        if len(self._tasks) >= REQUESTS_MAX:
            log.warning("%s: %d requests wait: one is dropped", self.name, REQUESTS_MAX)
            return
        task = self._loop.create_task(self._answer(service, request))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, service: str, request: JsonObject) -> None:
        answers = {
            "/_action/send_goal": self._send_goal,
            "/_action/get_result": self._get_result,
            "/_action/cancel_goal": self._cancel_goal,
        }
        reply = await answers[service](request)
        call = {"guid": request["guid"], "seq": request["seq"]}
        self._write(service, self._kinds[service] + "_Response", call | reply)

    async def _send_goal(self, request: JsonObject) -> JsonObject:
        goal_id, now_s = _hex(request["goal_id"]), time.time()
        refused: JsonObject = {"accepted": False, "stamp": _stamp(now_s)}
        if self._closing:
            return refused
        if goal_id in self._goals or goal_id in self._accepting or not int(goal_id, 16):
            log.warning("goal %s is rejected: that id is taken, or stands for all goals", goal_id)
            return refused
        self._accepting.add(goal_id)
        try:
            execution = await self._accept(goal_id, request["goal"])
        except VramError as error:
            log.warning("goal %s is rejected: %s", goal_id, error)
            return refused
        finally:
            self._accepting.discard(goal_id)
        goal = _Goal(goal_id, now_s, execution, self._loop.create_future())
        self._goals[goal_id] = goal
        running = self._loop.create_task(self._run(goal))
        self._running.add(running)
        running.add_done_callback(self._running.discard)
        return refused | {"accepted": True}

    async def _get_result(self, request: JsonObject) -> JsonObject:
        goal = self._goals.get(_hex(request["goal_id"]))
        if goal is None:
            return {"status": Status.UNKNOWN}
        result = await asyncio.shield(goal.result)
        return {"status": goal.status, "result": result}

    async def _cancel_goal(self, request: JsonObject) -> JsonObject:
        """Cancel one goal, all of them, or those that were accepted up to an instant."""
        info = request["goal_info"]
        goal_id = _hex(info["goal_id"])
        until_s = info["stamp"]["sec"] + info["stamp"]["nanosec"] / 1e9
        named = int(goal_id, 16) != 0
        if named and goal_id not in self._goals:
            return {"return_code": CancelCode.UNKNOWN_GOAL}
        everything = not named and not until_s
        meant = [
            goal
            for goal in self._goals.values()
            if everything or goal.goal_id == goal_id or goal.accepted_s <= until_s
        ]
        going = [goal for goal in meant if not goal.ended]
        for goal in going:
            await self._cancel(goal)
        code = CancelCode.TERMINATED if named and not going else CancelCode.NONE
        return {"return_code": code, "goals_canceling": [goal.info() for goal in going]}

    # -- goals
    async def _run(self, goal: _Goal) -> None:
        status = Status.ABORTED
        result: JsonObject = {}
        telling = self._loop.create_task(self._tell(goal))
        try:
            self._publish_status()
            status, result = await goal.execution.result()
        except Exception:
            log.exception("goal %s", goal.goal_id)
        finally:
            telling.cancel()
            for told in await asyncio.gather(telling, return_exceptions=True):
                if isinstance(told, Exception):
                    log.error("goal %s: its feedback ended early: %r", goal.goal_id, told)
            goal.status, goal.ended = status, True
            goal.result.set_result(result)
            ended = [one.goal_id for one in self._goals.values() if one.ended]
            for old in ended[:-GOALS_KEPT]:
                del self._goals[old]
            self._publish_status()

    async def _tell(self, goal: _Goal) -> None:
        async for feedback in goal.execution.feedback():
            message = {"goal_id": _uuid(goal.goal_id), "feedback": feedback}
            self._write("feedback", self._feedback_kind, message)

    async def _cancel(self, goal: _Goal) -> None:
        goal.status = Status.CANCELING
        self._publish_status()
        try:
            await goal.execution.cancel()
        except VramError as error:
            log.error("goal %s cannot be canceled: %s", goal.goal_id, error)

    def _publish_status(self) -> None:
        goals = [{"goal_info": goal.info(), "status": goal.status} for goal in self._goals.values()]
        self._write("status", STATUS, {"status_list": goals})


def _duration(seconds: float) -> int:
    from cyclonedds.util import duration

    return int(duration(seconds=seconds))


def _hex(uuid: JsonObject) -> str:
    return bytes(uuid["uuid"]).hex()


def _uuid(goal_id: str) -> JsonObject:
    return {"uuid": list(bytes.fromhex(goal_id))}


def _stamp(seconds: float) -> JsonObject:
    whole = int(seconds)
    return {"sec": whole, "nanosec": int((seconds - whole) * 1e9)}
