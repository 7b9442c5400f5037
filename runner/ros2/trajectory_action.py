"""Trajectories for a runner as ROS 2's action `control_msgs/FollowJointTrajectory`.

A plain client of the runner's goal socket, as `goal_action`: one of its skills plays the trajectory
through the safety gate. The action can only explain itself in a result, so a goal that is refused
is accepted and aborted at once, with the action's error code.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from vram_arbiter.clients.runner import Goal, RunnerClient
from vram_arbiter.runner.goals.catalogue import START_S
from vram_arbiter.runner.ros2.action_server import Execution, Status
from vram_arbiter.runner.ros2.goal_action import ENDINGS
from vram_arbiter.runner.sensors.ros2_messages import stamp_of
from vram_arbiter.runner.sensors.ros2_types import RosMessage
from vram_arbiter.runner.sensors.world_state import JOINT_STATE
from vram_arbiter.runner.skills.ros_goals import checked
from vram_arbiter.runner.skills.ros_standins import TRAJECTORY, interface_of
from vram_arbiter.runner.skills.trajectory import TrajectoryParams, position_at
from vram_arbiter.schemas.errors import (
    BadRequest,
    ConfigError,
    GoalRejected,
    PathToleranceViolated,
    StateStale,
    VramError,
)
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import JsonObject


class Code(IntEnum):
    """Of control_msgs/FollowJointTrajectory's result."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


CODES: Final[Mapping[str, Code]] = {
    "": Code.SUCCESSFUL,
    PathToleranceViolated.code: Code.PATH_TOLERANCE_VIOLATED,
    GoalRejected.code: Code.GOAL_TOLERANCE_VIOLATED,
}
"""By the code of a runner's result; the action has none for what else ends a motion."""
# of each point, empty: a goal's message has a limit
NOT_SENT: Final[Any] = {
    "trajectory": {"points": {"__all__": {"velocities", "accelerations", "effort"}}, "header": True}
}
UNSUPPORTED: Final = ("component_path_tolerance", "component_goal_tolerance")


async def action_name(client: RunnerClient, rskill_id: str) -> str:
    """Return the name under which a skill's trajectories are asked for, its `interface_name`.

    Raises ConfigError: it is not installed, or plays no trajectories; and what the client raises.
    """
    for found in (await client.skills())["skills"]:
        manifest = RSkillManifest.model_validate(found)
        ros = manifest.ros_integration
        if manifest.name == rskill_id and ros and interface_of(manifest) == TRAJECTORY:
            return ros.interface_name
    raise ConfigError(
        f"--trajectories {rskill_id}: the runner has no skill of that name that plays {TRAJECTORY}",
        hint="install one with `vram-runner --skills`, such as so101-move",
    )


class TrajectoryGoals:
    """Accepts goals of the action for a skill of the runner of `client`."""

    def __init__(self, client: RunnerClient, rskill_id: str) -> None:
        self._client, self._rskill_id = client, rskill_id

    async def accept(self, goal_id: str, goal: RosMessage) -> Execution:
        """Send a goal to the runner; one that it refuses ends at once. Never raises VramError."""
        names = goal["trajectory"]["joint_names"]
        try:
            here = await _positions(self._client)
            if unknown := sorted({*names} - {*here}):
                text = f"unknown joint {unknown[0]}; the robot has {', '.join(here)}"
                return _Refused(Code.INVALID_JOINTS, text)
            asked = params_of(goal)
            sent = await self._client.send_goal(
                self._rskill_id,
                goal_params=asked.model_dump(exclude=NOT_SENT),
                deadline_s=START_S + asked.last_s + asked.arrive_s,
                goal_id=goal_id,
            )
        except VramError as error:
            return _Refused(Code.INVALID_GOAL, str(error))
        return _Trajectory(self._client, sent, asked, tuple(here[name] for name in names))


def params_of(goal: RosMessage) -> TrajectoryParams:
    """Return the skill's parameters for a goal.

    A point at time 0 is where the arm is, and the way between points is straight: that point,
    velocities and accelerations are left out. Raises BadRequest.
    """
    several = [name for name in UNSUPPORTED if goal[name]]
    if several or goal["multi_dof_trajectory"]["points"]:
        part = (several or ["multi_dof_trajectory"])[0]
        raise BadRequest(f"{part}: joints of several degrees of freedom are not supported")
    kept = ("positions", "effort", "time_from_start")
    points = [{name: point[name] for name in kept} for point in goal["trajectory"]["points"]]
    if points and not any(points[0]["time_from_start"].values()):
        del points[0]
    tolerances = ("path_tolerance", "goal_tolerance", "goal_time_tolerance")
    named = {"joint_names": goal["trajectory"]["joint_names"], "points": points}
    return checked(TrajectoryParams, {"trajectory": named} | {one: goal[one] for one in tolerances})


async def _positions(client: RunnerClient) -> dict[str, float]:
    """Return the joints' positions. Raises StateStale, and what the client raises."""
    world = (await client.state())["world"]
    if world is None or world["diagnostics"].get(JOINT_STATE, "ok") != "ok":
        raise StateStale("the robot does not say where its joints are")
    joints = world["joint_state"]
    return dict(zip(joints["name"], joints["position"], strict=True))


@dataclass(frozen=True, slots=True)
class _Refused:
    """A goal that ended before it began."""

    code: Code
    text: str

    async def feedback(self) -> AsyncIterator[JsonObject]:
        return
        yield

    async def result(self) -> tuple[Status, JsonObject]:
        return Status.ABORTED, {"error_code": self.code, "error_string": self.text}

    async def cancel(self) -> None:
        """It has ended."""


@dataclass(frozen=True, slots=True)
class _Trajectory:
    """A goal that the runner accepted, which begins at `start` (rad)."""

    client: RunnerClient
    goal: Goal
    asked: TrajectoryParams
    start: tuple[float, ...]

    async def feedback(self) -> AsyncIterator[JsonObject]:
        names, points = self.asked.trajectory.joint_names, self.asked.trajectory.points
        async for push in self.goal.feedback():
            if push["state"] != "running":
                continue
            elapsed_s = push["progress"] * self.asked.last_s
            desired = position_at(points, self.start, elapsed_s)
            try:
                positions = await _positions(self.client)
            except StateStale:
                continue
            actual = tuple(positions[name] for name in names)
            yield {
                "header": {"stamp": stamp_of(time.time_ns())},
                "joint_names": names,
                "desired": {
                    "positions": desired,
                    "time_from_start": stamp_of(int(elapsed_s * 1e9)),
                },
                "actual": {"positions": actual},
                "error": {"positions": [a - b for a, b in zip(desired, actual, strict=True)]},
            }

    async def result(self) -> tuple[Status, JsonObject]:
        try:
            result = await self.goal.result()
        except VramError as error:
            return await _Refused(Code.INVALID_GOAL, str(error)).result()
        code = CODES.get(result["code"], Code.INVALID_GOAL)
        if result["status"] == "deadline":
            code = Code.GOAL_TOLERANCE_VIOLATED
        return ENDINGS[result["status"]], {"error_code": code, "error_string": result["message"]}

    async def cancel(self) -> None:
        await self.goal.cancel()
