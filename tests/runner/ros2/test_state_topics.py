"""A runner's joints, base and fixed cameras as topics: an independent participant, with types and
codec of Cyclone DDS alone, reads them.
"""

import asyncio
import time
import uuid
from pathlib import Path
from typing import Any

import pytest

from tests.runner.goal_bench import goal_bench
from tests.support.dds import NETWORK
from tests.support.waiting import PATIENCE_S, eventually
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.planar import planar_pose
from vram_arbiter.runner.ros2.state_topics import StateTopics
from vram_arbiter.schemas.errors import FrameStale

pytestmark = [pytest.mark.anyio, pytest.mark.heavy]
pytest.importorskip("cyclonedds")

from cyclonedds.core import Policy, Qos  # noqa: E402
from cyclonedds.domain import DomainParticipant  # noqa: E402
from cyclonedds.idl.types import float64, sequence  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402
from cyclonedds.util import duration  # noqa: E402

from tests.runner.ros2.independent import Transform_, struct, valid  # noqa: E402
from tests.runner.sensors.ros2_node import Header_  # noqa: E402

JointState_ = struct(
    "sensor_msgs.msg.dds_.JointState_",
    header=Header_,
    name=sequence[str],
    position=sequence[float64],
    velocity=sequence[float64],
    effort=sequence[float64],
)
Stamped_ = struct(
    "geometry_msgs.msg.dds_.TransformStamped_",
    header=Header_,
    child_frame_id=str,
    transform=Transform_,
)
TFMessage_ = struct("tf2_msgs.msg.dds_.TFMessage_", transforms=sequence[Stamped_])


class Listener:
    """Reads a topic as ROS's listeners do: all that was sent, of /tf_static also before."""

    def __init__(self, domain: int, name: str, kind: type) -> None:
        quality = Qos(
            Policy.Reliability.Reliable(duration(seconds=10)),
            Policy.Durability.TransientLocal
            if name == "/tf_static"
            else Policy.Durability.Volatile,
            Policy.History.KeepLast(100),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        participant: Any = DomainParticipant(domain)
        self.reader: Any = DataReader(
            participant, Topic(participant, "rt" + name, kind), qos=quality
        )

    async def heard(self, count: int) -> list[Any]:
        """Return the next messages, as many as these."""
        told: list[Any] = []
        async with asyncio.timeout(PATIENCE_S):
            while len(told) < count:
                told += valid(self.reader)
                await asyncio.sleep(0.01)
        return told


class Robot:
    """Tells the state that a test gives it, as `RunnerClient` does."""

    def __init__(self) -> None:
        self.stamp_ns = time.monotonic_ns()
        self.diagnostics: dict[str, str] = {}
        self.pictures: dict[str, Any] = {}

    async def state(self) -> Any:
        joints = {
            "name": ["pan", "lift"],
            "position": [0.5, -1.0],
            "velocity": [0.1, 0.0],
            "effort": [],
            "stamp_ns": self.stamp_ns,
        }
        base = planar_pose(1.0, 2.0, 3.0, "map").model_dump(mode="json")
        world = {"joint_state": joints, "base_pose": base, "diagnostics": self.diagnostics}
        return {"world": world, "cameras": ["front", "wrist"]}

    async def frame(self, camera: str) -> Any:
        if camera not in self.pictures:
            raise FrameStale("no picture yet")
        return self.pictures[camera]


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """Names of the topics are fixed, so each test has a domain of its own."""
    monkeypatch.setenv("CYCLONEDDS_URI", NETWORK)
    return 90 + uuid.uuid4().int % 100


@pytest.fixture
def robot() -> Robot:
    return Robot()


async def read(topics: StateTopics, name: str) -> None:
    """Wait until a topic's writer has a reader."""
    writer = topics._writers[name]
    await eventually(lambda: writer.get_publication_matched_status().current_count)


async def test_a_state_is_published_once_and_never_when_it_is_stale(
    domain: int, robot: Robot
) -> None:
    topics = StateTopics(robot, domain, rate_hz=20)  # type: ignore[arg-type]
    joints, tf = Listener(domain, "/joint_states", JointState_), Listener(domain, "/tf", TFMessage_)
    await read(topics, "/joint_states")
    await read(topics, "/tf")

    before_s, robot.stamp_ns = time.time(), time.monotonic_ns()
    await topics.publish()
    await topics.publish()  # nothing new
    robot.stamp_ns, robot.diagnostics = time.monotonic_ns(), {"joint_state": "stale"}
    await topics.publish()
    robot.stamp_ns, robot.diagnostics = time.monotonic_ns() - 2 * 10**9, {"joint_state": "ok"}
    await topics.publish()
    robot.stamp_ns = last_ns = time.monotonic_ns()
    await topics.publish()

    first, last = await joints.heard(2)
    assert (first.name, list(first.position)) == (["pan", "lift"], [0.5, -1.0])
    assert (list(first.velocity), list(first.effort)) == ([0.1, 0.0], [])
    assert abs(first.header.stamp.sec - before_s) < 5, "wall time, of the measurement"
    wall_ns = time.time_ns() - (time.monotonic_ns() - last_ns)
    told_ns = last.header.stamp.sec * 10**9 + last.header.stamp.nanosec
    assert abs(told_ns - wall_ns) < 10**8
    (place, _) = [message.transforms[0] for message in await tf.heard(2)]
    assert (place.header.frame_id, place.child_frame_id) == ("map", "base_link")
    assert (place.transform.translation.x, place.transform.translation.y) == (1.0, 2.0)
    assert place.transform.rotation.w == pytest.approx(0.0707372)
    assert not valid(joints.reader), "two of five states were new and fresh"


async def test_fixed_cameras_are_told_once_to_listeners_that_come_later_too(
    domain: int, robot: Robot
) -> None:
    # looks along the base's x: the picture's right is -y, its down -z
    rows = [[0, 0, 1, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 0.3], [0, 0, 0, 1]]
    topics = StateTopics(robot, domain, rate_hz=20)  # type: ignore[arg-type]
    robot.stamp_ns = time.monotonic_ns()
    robot.pictures["wrist"] = {"camera_model": {"fixed": False, "T_base_camera": rows}}
    await topics.publish()
    robot.pictures["front"] = {"camera_model": {"fixed": True, "T_base_camera": rows}}
    robot.stamp_ns = time.monotonic_ns()
    await topics.publish()
    (message,) = await Listener(domain, "/tf_static", TFMessage_).heard(1)
    (place,) = message.transforms
    assert (place.header.frame_id, place.child_frame_id) == ("base_link", "front")
    moved, turned = place.transform.translation, place.transform.rotation
    assert (moved.x, moved.y, moved.z) == (0.1, 0.2, 0.3)
    assert [turned.x, turned.y, turned.z, turned.w] == pytest.approx([-0.5, 0.5, -0.5, 0.5])


async def test_a_runners_joints_are_published(
    make_runner: Any, env: Any, endpoint: str, navigate_manifest: Path, domain: int
) -> None:
    async with (
        goal_bench(make_runner, env, endpoint, navigate_manifest),
        RunnerClient(endpoint) as client,
    ):
        listener = Listener(domain, "/joint_states", JointState_)
        publishing = asyncio.create_task(StateTopics(client, domain, rate_hz=50).run())
        told = await listener.heard(3)
        publishing.cancel()
        await asyncio.gather(publishing, return_exceptions=True)
    stamps = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in told]
    assert stamps == sorted(set(stamps))
    assert set(told[-1].name) == set(env.joint_state())
