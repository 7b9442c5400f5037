"""Hashes of ROS 2's types, as another implementation of REP 2011 (ros2-pyterfaces 0.3.0) computes
them from definitions of its own.
"""

import pytest

pytestmark = pytest.mark.heavy
pytest.importorskip("rosbags")

from vram_arbiter.runner.sensors.ros2_types import (  # noqa: E402
    read,
    service_of,
    type_hash,
    write,
)

HASHES = {
    "std_msgs/msg/Bool": "feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9",
    "sensor_msgs/msg/JointState": (
        "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
    ),
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "sensor_msgs/msg/CompressedImage": (
        "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a"
    ),
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "action_msgs/srv/CancelGoal_Request": (
        "3d3c84653c1f96918086887e1dcb236faec88b81a5b14fd4cf4840065bcdf8af"
    ),
    "control_msgs/action/FollowJointTrajectory_SendGoal_Request": (
        "179c93691f1f6d1d115881ff88c3917b7cc6eac2ba4bf56766cc7c4389e19ef1"
    ),
    "openral_msgs/action/ExecuteRskill_GetResult_Response": (
        "30d6b2d8bedf9c8702d1eabb00ab3a37145b4aef2f5bc77d3a1b3c9363b64d46"
    ),
    "action_msgs/msg/GoalStatusArray": (
        "6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e"
    ),
}


@pytest.mark.parametrize(("kind", "digest"), HASHES.items())
def test_hashes_are_those_of_another_implementation(kind: str, digest: str) -> None:
    assert type_hash(kind) == f"RIHS01_{digest}"


SERVICES = {
    "Empty_Request": "458eaf200a3f63d9cc53d19436edebc0c140ef4c93ca75d5bd4ce19fd7759e35",
    "Empty_Response": "0a2858b3f60df644a61d0fa44cfc923a3d3628e0ad9c8ad8534b1a2c92a413dc",
    "SetBool_Request": "c62fbb99d94e1b25e8ef9e109f9581956bb1b3361a45a4e5810c36a90d29932e",
    "SetBool_Response": "d0814e7f7b4880ab77e9c57426c7aa1562ab69f11eef8e2e968812f9cbd0b059",
    "Trigger_Request": "d010825374ce8918e72bfd826c82603e60f45419e932ea976f807b74a863a199",
    "Trigger_Response": "2d946c21e2fc3f1e9ca6986a8191d85fcc70097a8bb7771a053564bc47009cdf",
}
"""As ROS 2 Jazzy's std_srvs 5.3.6 installs them (`share/std_srvs/srv/*.json`)."""


@pytest.mark.parametrize(("kind", "digest"), SERVICES.items())
def test_hashes_of_services_are_those_that_ros_installs(kind: str, digest: str) -> None:
    name = service_of(f"std_srvs/{kind.partition('_')[0]}")
    assert type_hash(f"{name}_{kind.partition('_')[2]}") == f"RIHS01_{digest}"


def test_what_ros_does_not_set_to_zero_has_its_default() -> None:
    """rosbags drops defaults: a pose without an orientation would be no rotation at all."""
    pose = read("geometry_msgs/msg/Pose", write("geometry_msgs/msg/Pose", {}))
    assert pose["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
