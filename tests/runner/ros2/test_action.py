"""Actions that a ROS 2 server executes: an independent participant, with types and codec of
Cyclone DDS alone, accepts, rejects, succeeds, aborts and is canceled.
"""

import asyncio
import threading
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from tests.support.dds import NETWORK
from tests.support.waiting import PATIENCE_S
from vram_arbiter.runner.protocols import Done, Goal, Hold
from vram_arbiter.runner.ros2.served_skills import RosAction
from vram_arbiter.runner.sensors.ros2_types import read, write
from vram_arbiter.schemas.errors import BadRequest, Cancelled, GoalRejected, ModelError
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.world import JointState, WorldState

pytestmark = [pytest.mark.heavy, pytest.mark.anyio]
pytest.importorskip("cyclonedds")

from cyclonedds.domain import DomainParticipant  # noqa: E402
from cyclonedds.idl.types import float64, uint16  # noqa: E402

from tests.runner.ros2.independent import (  # noqa: E402
    CancelRequest_,
    CancelResponse_,
    Quaternion_,
    Time_,
    action_of,
    server_of,
    struct,
    valid,
)
from tests.runner.sensors.ros2_node import Header_  # noqa: E402

DOMAIN = 80
PREFIX = "nav2_msgs.action.dds_.NavigateToPose_"
WORLD = WorldState(stamp_ns=0, joint_state=JointState(name=(), position=(), stamp_ns=0))


Point_ = struct("geometry_msgs.msg.dds_.Point_", x=float64, y=float64, z=float64)
Pose_ = struct("geometry_msgs.msg.dds_.Pose_", position=Point_, orientation=Quaternion_)
PoseStamped_ = struct("geometry_msgs.msg.dds_.PoseStamped_", header=Header_, pose=Pose_)
Goal_ = struct("nav2_msgs.action.dds_.NavigateToPose_Goal_", pose=PoseStamped_, behavior_tree=str)
Result_ = struct("nav2_msgs.action.dds_.NavigateToPose_Result_", error_code=uint16, error_msg=str)
SendRequest_, SendResponse_, ResultRequest_, ResultResponse_ = action_of(PREFIX, Goal_, Result_)


@dataclass
class Navigator:
    """Accepts goals ahead of the robot (x >= 0); x = 1 succeeds, x = 2 aborts, others drive on
    until they are canceled."""

    name: str
    goals: list[Any] = field(default_factory=list)
    canceled: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        participant, path = DomainParticipant(DOMAIN), f"{self.name}/_action/"
        self._send = server_of(participant, path + "send_goal", SendRequest_, SendResponse_)
        self._result = server_of(participant, path + "get_result", ResultRequest_, ResultResponse_)
        self._cancel = server_of(participant, path + "cancel_goal", CancelRequest_, CancelResponse_)
        self._pending: dict[bytes, Any] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(0.01):
            for asked in valid(self._send[0]):
                x = asked.goal.pose.pose.position.x
                self.goals.append(asked.goal)
                told = SendResponse_(asked.guid, asked.seq, x >= 0, Time_(0, 0))
                self._send[1].write(SendResponse_(asked.guid + 1, asked.seq, False, Time_(0, 0)))
                self._send[1].write(told)  # after another client's
            for asked in valid(self._result[0]):
                self._pending[bytes(asked.goal_id.uuid)] = asked
                x = self.goals[-1].pose.pose.position.x
                if x in (1.0, 2.0):
                    self._answer(
                        asked, 4 if x == 1.0 else 6, Result_(int(x) - 1, "no way" * (x > 1))
                    )
            for asked in valid(self._cancel[0]):
                goal_id = bytes(asked.goal_info.goal_id.uuid)
                self.canceled.append(goal_id)
                self._cancel[1].write(CancelResponse_(asked.guid, asked.seq, 0, [asked.goal_info]))
                if (waiting := self._pending.pop(goal_id, None)) is not None:
                    self._answer(waiting, 5, Result_(0, ""))

    def _answer(self, asked: Any, status: int, result: Result_) -> None:
        self._result[1].write(ResultResponse_(asked.guid, asked.seq, status, result))


@pytest.fixture
def navigator(monkeypatch: pytest.MonkeyPatch) -> Iterator[Navigator]:
    monkeypatch.setenv("CYCLONEDDS_URI", NETWORK)
    server = Navigator(f"/n{uuid.uuid4().hex}/navigate_to_pose")
    yield server
    server.close()


@pytest.fixture
def navigation(navigator: Navigator, navigate_manifest: Any) -> RosAction:
    manifest = load_manifest(navigate_manifest)
    assert manifest.ros_integration is not None
    ros = {
        "interface_name": navigator.name,
        "package": "nav2_msgs",
        "interface_type": "NavigateToPose",
        "default_goal_json": '{"pose": {"header": {"frame_id": "map"}}}',
    }
    return RosAction(
        manifest.model_copy(
            update={"ros_integration": manifest.ros_integration.model_copy(update=ros)}
        ),
        DOMAIN,
    )


def goal(x: Any, **more: Any) -> Goal:
    params = {"pose": {"pose": {"position": {"x": x}}}, **more}
    return Goal("g", "a/nav", params=params)


async def ended(navigation: RosAction) -> Any:
    async with asyncio.timeout(PATIENCE_S):
        while isinstance(step := navigation.step(WORLD), Hold):
            await asyncio.sleep(0.01)
    return step


async def test_goals_succeed_abort_are_rejected_and_are_canceled(
    navigation: RosAction, navigator: Navigator
) -> None:
    try:
        await navigation.start(goal(1.0))
        assert await ended(navigation) == Done({"result": {"error_code": 0, "error_msg": ""}})
        seen = navigator.goals[0].pose
        assert (seen.header.frame_id, seen.pose.orientation.w) == ("map", 1.0)  # ROS's default
        await navigation.finish()

        await navigation.start(goal(2.0))
        with pytest.raises(ModelError, match=r"status 6, error code 1: no way"):
            await ended(navigation)
        await navigation.finish()

        with pytest.raises(GoalRejected):
            await navigation.start(goal(-1.0))
        with pytest.raises(
            BadRequest, match=r"goal_params: pose\.pose\.position\.x: expected a nu"
        ):
            await navigation.start(goal("far"))
        with pytest.raises(BadRequest, match="goal_params: unknown field tree"):
            await navigation.start(goal(1.0, tree="x"))

        await navigation.start(goal(5.0))
        assert isinstance(navigation.step(WORLD), Hold)
        await navigation.finish()  # canceled by a person, the deadline or the emergency stop
        assert len(navigator.canceled) == 1
    finally:
        await navigation.release()


async def test_a_goal_that_the_server_itself_cancels_is_not_a_success(
    navigation: RosAction, navigator: Navigator
) -> None:
    try:
        await navigation.start(goal(5.0))
        await navigation._client.call(
            "/_action/cancel_goal", {"goal_info": {"goal_id": navigation._goal_id}}
        )
        with pytest.raises(Cancelled, match="status 5"):
            await ended(navigation)
    finally:
        await navigation.release()


def test_a_trajectory_goal_round_trips_and_is_never_read_in_part() -> None:
    kind = "control_msgs/action/FollowJointTrajectory_Goal"
    sent = {
        "trajectory": {
            "joint_names": ["a", "bc"],
            "points": [{"positions": [0.5, -1.0], "time_from_start": {"sec": 1, "nanosec": 5}}],
        },
        "goal_tolerance": [{"name": "a", "position": 0.01}],
        "goal_time_tolerance": {"sec": 2},
    }
    cdr = write(kind, sent)
    back = read(kind, cdr)
    assert back["trajectory"]["points"][0]["positions"] == [0.5, -1.0]
    assert (back["goal_tolerance"][0]["position"], back["goal_time_tolerance"]["sec"]) == (0.01, 2)
    for cut in range(4, len(cdr) - 1, 7):
        with pytest.raises(ValueError, match="cannot be read"):
            read(kind, cdr[:cut])
