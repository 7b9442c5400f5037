"""Trajectories as a ROS 2 action: an independent participant, with types and codec of Cyclone DDS
alone, sends what MoveIt sends, and reads feedback and the action's own error codes.
"""

import argparse
import asyncio
import uuid
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

import pytest

from tests.runner.goal_bench import goals_served
from tests.support.dds import NETWORK
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.cli import ros2
from vram_arbiter.runner.goals.catalogue import Catalogue
from vram_arbiter.runner.ros2.action_server import ActionServer
from vram_arbiter.runner.ros2.trajectory_action import Code, TrajectoryGoals, action_name
from vram_arbiter.runner.safety.limits import own_limits
from vram_arbiter.runner.skills.ros_standins import TRAJECTORY
from vram_arbiter.runner.skills.trajectory import FollowJointTrajectory
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import Kind, load_manifest

pytestmark = [pytest.mark.anyio, pytest.mark.heavy]
pytest.importorskip("cyclonedds")

from tests.runner.ros2.independent import Commander, Time_  # noqa: E402
from tests.runner.ros2.test_state_topics import JointState_, Listener  # noqa: E402
from tests.runner.ros2.trajectory_messages import (  # noqa: E402
    PREFIX,
    Duration_,
    Feedback_,
    Goal_,
    MultiPoint_,
    MultiTrajectory_,
    Point_,
    Result_,
    Tolerance_,
    Trajectory_,
)
from tests.runner.sensors.ros2_node import Header_  # noqa: E402

DOMAIN = 82
RATE_HZ = 100.0
RSKILL = "vram-arbiter/so101-move"
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6

NO_TIME = Duration_(0, 0)


class Planner(Commander):
    def __init__(self, name: str, domain: int = DOMAIN) -> None:
        super().__init__(domain, name, PREFIX, Goal_, Result_, Feedback_)

    async def follow(
        self,
        *points: tuple[float, tuple[float, ...]],
        joints: tuple[str, ...] = ("shoulder_pan", "wrist_flex"),
        within: float = 0.0,
        multi: tuple[str, ...] = (),
    ) -> Any:
        """Send points, each its time (s) and positions, with velocities; return the goal's id.
        `within` is a path tolerance of the first joint."""
        stamped = [
            Point_(at, [0.3] * len(at), [0.1] * len(at), [], Duration_(int(s), int(s % 1 * 1e9)))
            for s, at in points
        ]
        header = Header_(Time_(0, 0), "")
        several = [MultiPoint_([], [], [], NO_TIME) for _ in multi]
        path = [Tolerance_(joints[0], within, 0.0, 0.0)] if within else []
        return await self.send(
            Trajectory_(header, list(joints), stamped),
            MultiTrajectory_(header, list(multi), several),
            path,
            [],
            [],
            [],
            NO_TIME,
        )

    async def outcome(self, goal_id: Any) -> tuple[int, int, str]:
        told = await self.ended(goal_id)
        return told.status, told.result.error_code, told.result.error_string


@pytest.fixture
def env(make_env: Any) -> Any:
    class Arm(make_env):  # type: ignore[misc]
        stuck = False

        def step(self, arm_target: Any, base_velocity: Any = None) -> None:
            super().step(None if self.stuck else arm_target, base_velocity)

    return Arm()


Served = Callable[[], AbstractAsyncContextManager[Planner]]


@pytest.fixture
def runner(
    make_runner: Any,
    kinematic: Any,
    endpoint: str,
    navigate_manifest: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[], AbstractAsyncContextManager[Any]]:
    """A runner that plays trajectories."""
    monkeypatch.setenv("CYCLONEDDS_URI", NETWORK)
    skills = [load_manifest(navigate_manifest.parents[1] / "so101-move/rskill.yaml")]
    limits = own_limits(kinematic)

    def serve() -> AbstractAsyncContextManager[Any]:
        catalogue = Catalogue(
            skills,
            {Kind.ROS_ACTION: lambda m: FollowJointTrajectory(m, limits, period_s=1 / RATE_HZ)},
        )
        return goals_served(endpoint, make_runner(rate_hz=RATE_HZ), catalogue)

    return serve


@pytest.fixture
def served(runner: Any, endpoint: str) -> Served:
    name = f"/n{uuid.uuid4().hex}/follow_joint_trajectory"

    @asynccontextmanager
    async def serving() -> Any:
        async with (
            runner(),
            RunnerClient(endpoint) as client,
            ActionServer(TRAJECTORY, name, DOMAIN, TrajectoryGoals(client, RSKILL).accept),
        ):
            assert (await action_name(client, RSKILL)).endswith("/follow_joint_trajectory")
            with pytest.raises(ConfigError, match="--trajectories a/other"):
                await action_name(client, "a/other")
            yield Planner(name)

    return serving


async def test_a_planners_trajectory_is_played_with_feedback(served: Served, env: Any) -> None:
    """Its first point is where the arm is, at time 0, and its points have velocities."""
    async with served() as planner:
        goal_id = await planner.follow((0.0, (0.0, 1.35)), (0.5, (0.2, 1.2)), (1.5, (0.4, 1.0)))
        heard = await planner.heard(goal_id)
        assert heard.joint_names == ["shoulder_pan", "wrist_flex"]
        assert 0.0 <= heard.desired.positions[0] <= 0.4
        assert 0.0 <= heard.actual.positions[0] <= 0.4
        errors = zip(heard.desired.positions, heard.actual.positions, strict=True)
        assert list(heard.error.positions) == pytest.approx([a - b for a, b in errors])
        assert await planner.outcome(goal_id) == (SUCCEEDED, Code.SUCCESSFUL, "")
    assert env.joints["shoulder_pan"] == pytest.approx(0.4)
    assert env.joints["wrist_flex"] == pytest.approx(1.0)
    assert env.joints["elbow_flex"] == pytest.approx(1.05), "joints without points stay"


async def test_what_cannot_be_played_ends_with_the_actions_own_codes(
    served: Served, env: Any
) -> None:
    async with served() as planner:
        refused = {
            "unknown joint elbow;": await planner.follow((1.0, (0.0,)), joints=("elbow",)),
            "time_from_start.sec: Input should be less": await planner.follow((601.0, (0.0, 1.3))),
            "more than 12288 values": await planner.follow(
                *((number / 10, (0.0, 1.35)) for number in range(1, 1900))
            ),
            "an empty one moves nothing": await planner.follow(),
            "several degrees of freedom": await planner.follow((1.0, (0.0, 1.3)), multi=("base",)),
        }
        for said, goal_id in refused.items():
            status, code, text = await planner.outcome(goal_id)
            assert (status, said in text) == (ABORTED, True), text
            assert code == (
                Code.INVALID_JOINTS if said.startswith("unknown joint") else Code.INVALID_GOAL
            )
        assert not any(arm for arm, _ in env.steps), "nothing was moved"

        first = await planner.follow((60.0, (0.3, 1.35)))
        await planner.heard(first)
        status, code, text = await planner.outcome(await planner.follow((1.0, (0.0, 1.3))))
        assert (status, code) == (ABORTED, Code.INVALID_GOAL)
        assert "is running" in text
        assert (await planner.canceled(first)).return_code == 0
        status, code, _ = await planner.outcome(first)
        assert (status, code) == (CANCELED, Code.SUCCESSFUL)


async def test_an_arm_that_leaves_its_path_or_does_not_arrive_has_a_code_each(
    served: Served, env: Any
) -> None:
    async with served() as planner:
        env.stuck = True
        goal_id = await planner.follow((1.0, (0.4, 1.35)), within=0.1)
        status, code, text = await planner.outcome(goal_id)
        assert (status, code) == (ABORTED, Code.PATH_TOLERANCE_VIOLATED)
        assert "shoulder_pan" in text

        status, code, text = await planner.outcome(await planner.follow((0.3, (0.2, 1.35))))
        assert (status, code) == (ABORTED, Code.GOAL_TOLERANCE_VIOLATED)
        assert "from the last point" in text


async def test_the_program_serves_trajectories_beside_goals_and_state(
    runner: Any, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names are fixed, so the test has a domain of its own."""
    domain = 190 + uuid.uuid4().int % 40
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    parser = argparse.ArgumentParser()
    ros2.add_parser(parser.add_subparsers())
    args = parser.parse_args(["ros2", "--trajectories", RSKILL, "--endpoint", endpoint])
    async with runner():
        program = asyncio.create_task(ros2.run(args))
        joints = Listener(domain, "/joint_states", JointState_)
        assert "wrist_flex" in (await joints.heard(1))[0].name
        planner = Planner("/joint_trajectory_controller/follow_joint_trajectory", domain)
        outcome = await planner.outcome(await planner.follow((0.3, (0.1, 1.35))))
        assert outcome == (SUCCEEDED, Code.SUCCESSFUL, "")
        program.cancel()
        await asyncio.gather(program, return_exceptions=True)
