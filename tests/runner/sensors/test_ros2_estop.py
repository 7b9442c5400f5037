"""The emergency stop's ROS 2 topic: an independent participant presses, the listener stops the
robot. Types and codec of the button are Cyclone DDS's alone.
"""

import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from tests.support.dds import NETWORK
from tests.support.deployment import load_robot
from tests.support.waiting import until
from vram_arbiter.runner.sensors.ros2_estop import estop_topic, listened_topic, said
from vram_arbiter.schemas.config.robot import RobotEnvironment
from vram_arbiter.schemas.errors import ConfigError

pytestmark = pytest.mark.heavy
pytest.importorskip("cyclonedds")

Press = Callable[..., None]


@pytest.fixture(autouse=True)
def network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", NETWORK)
    monkeypatch.setenv("ROS_DOMAIN_ID", "79")


@pytest.fixture
def topic() -> str:
    return f"/cell_{uuid.uuid4().hex}/e_stop"


@pytest.fixture
def press(topic: str) -> Iterator[Press]:
    """`press(True, False)` publishes both, once a reader is there."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.annotations import final
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    @dataclass
    @final
    class Bool_(IdlStruct, typename="std_msgs.msg.dds_.Bool_"):
        data: bool

    participant = DomainParticipant(79)
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=10)),
        Policy.History.KeepLast(5),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    writer: Any = DataWriter(participant, Topic(participant, "rt" + topic, Bool_), qos=qos)

    def publish(*values: bool) -> None:
        until(lambda: writer.get_publication_matched_status().current_count)
        for value in values:
            writer.write(Bool_(data=value))

    yield publish
    del participant  # with its writer it leaves the domain


def test_true_stops_the_robot_also_when_the_button_is_let_go_at_once(
    topic: str, press: Press
) -> None:
    stopped: list[str] = []
    with estop_topic(topic, stopped.append):
        press(False, False)
        press(True, False, False)
        until(lambda: stopped)
    assert stopped == [f"{topic} says stop"]


def test_a_listener_that_breaks_down_stops_the_robot(topic: str, press: Press) -> None:
    """The thread ends with its first error of any kind: nothing would hear the button again."""
    stopped: list[str] = []

    def stop(reason: str) -> None:
        stopped.append(reason)
        if len(stopped) == 1:
            raise ZeroDivisionError("a defect")

    with estop_topic(topic, stop):
        press(True)
        until(lambda: len(stopped) == 2)
    assert stopped[1] == f"the listener on {topic} broke down: ZeroDivisionError: a defect"


def test_what_cannot_be_read_stops_too() -> None:
    assert said(b"\x00\x01\x00\x00\x00") == ""
    assert said(b"\x00\x01\x00\x00\x01\x00\x00\x00") == "says stop"
    for damaged in (b"", b"\x00\x01\x00\x00", b"\x00\x01\x00\x00\x07", b"\xff\x01\x00\x00\x00"):
        assert said(damaged) == "sent what cannot be read"


def test_only_a_topic_that_the_file_gives_is_listened_to(topic: str) -> None:
    def robot(safety: str) -> RobotEnvironment:
        return load_robot(f"robot_id: a\nhal: {{adapter: so101_kinematic}}\n{safety}", "r.yaml")

    assert listened_topic(robot("")) is None
    assert listened_topic(robot("safety: {max_joint_speed_factor: 0.5}")) is None
    assert listened_topic(robot(f"safety: {{e_stop_topic: {topic}}}")) == topic
    wrong = estop_topic("front door", lambda reason: None)
    with pytest.raises(ConfigError, match=r"safety\.e_stop_topic: expected a ROS topic"):
        wrong.__enter__()
