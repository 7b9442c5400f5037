"""The `hal` section of a deployment file → an adapter: every mistake names its field, nothing is
opened.
"""

from typing import Any

import pytest
import yaml

from vram_arbiter.runner.robots.factory import make_hal
from vram_arbiter.runner.robots.kinematic import KinematicTwin
from vram_arbiter.runner.robots.units import JointUnit, Scale, scale_of_unit
from vram_arbiter.schemas.config.robot import HalConfig
from vram_arbiter.schemas.errors import ConfigError

HEAVY = pytest.mark.heavy
PANDA = "model: panda_mobile"
JOINT = "joints: {panda_joint1: {max_speed_rad_s: 2.0}}"


def fields(adapter: str, **sections: dict[str, Any]) -> list[tuple[str, str]]:
    with pytest.raises(ConfigError) as caught:
        make_hal(HalConfig(adapter=adapter, **sections))
    assert str(caught.value).startswith("deployment: ")
    return [(field["field"], field["problem"]) for field in caught.value.details["fields"]]


@pytest.mark.parametrize(
    ("adapter", "section", "field", "said"),
    [
        ("so101_mujocu", "", "adapter", "did you mean so101_mujoco"),
        ("lerobot", "", "adapter", "unknown adapter"),
        ("so101_kinematic", "transport: {port: /dev/ttyACM0}", "transport.port", "no transport"),
        ("so101_kinematic", "params: {start_pose: {}}",
         "params.start_pose", "did you mean start_pose_rad"),
        ("so101_kinematic", "params: {start_pose_rad: {elbow: 0.1}}",
         "params.start_pose_rad.elbow", "elbow_flex"),
        ("so101_kinematic", "params: {start_pose_rad: {gripper: .nan}}",
         "params.start_pose_rad.gripper", "finite"),
        ("so101_kinematic", "params: {start_pose_rad: {gripper: 3.0}}",
         "params.start_pose_rad.gripper", "outside"),
        ("lerobot:so101_follower", "params: {joints: {gripper: {unit: furlongs}}}",
         "params.joints.gripper.unit", "deg"),
        ("lerobot:so101_follower", "params: {joints: {gripper: {lower_rad: 1, upper_rad: 0}}}",
         "params.joints.gripper", "lower_rad must be below"),
        ("lerobot:so101_follower", "params: {joints: {gripper: {sing: 1}}}",
         "params.joints.gripper.sing", "sign"),
        ("lerobot:so101_follower", "params: {estop: pray}", "params.estop", "hold"),
        ("mujoco", f"params: {{{JOINT}}}", "params.model", "give the robot's MJCF"),
        ("mujoco", f"params: {{{JOINT}, model: pandas}}", "params.model", "no such file: pandas"),
        pytest.param("mujoco", f"params: {{joints: {{elbow: {{max_speed_rad_s: 1}}}}, {PANDA}}}",
                     "params.model", "has no joint elbow", marks=HEAVY),
        pytest.param("mujoco", f"params: {{{JOINT[:-2]}, lower_rad: 3}}}}, {PANDA}}}",
                     "params.joints.panda_joint1", "is empty", marks=HEAVY),
        pytest.param("mujoco", f"params: {{{JOINT}, {PANDA}, ends: {{a: {{frame: panda_hend}}}}}}",
                     "params.ends.a.frame", "panda_hand", marks=HEAVY),
    ],
)  # fmt: skip
def test_each_mistake_names_its_field(adapter: str, section: str, field: str, said: str) -> None:
    ((found, problem),) = fields(adapter, **(yaml.safe_load(section) or {}))
    assert found == field
    assert said in problem


def test_all_mistakes_are_told_at_once() -> None:
    found = fields("so101_kinematic", params={"start_pose_rad": {"a": 1.0, "b": 2.0}})
    assert [field for field, _ in found] == [
        "params.start_pose_rad.a",
        "params.start_pose_rad.b",
    ]


def test_the_kinematic_twin_is_made_without_moving() -> None:
    hal = make_hal(HalConfig(adapter="so101_kinematic"))
    assert isinstance(hal, KinematicTwin)
    assert hal.description.simulated
    assert len(hal.description.joints) == 6
    assert [joint.name for joint in hal.description.joints if joint.gripper] == ["gripper"]


@pytest.mark.parametrize("unit", list(JointUnit))
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("angle_rad", [-1.0, -0.2, 0.0, 0.7, 2.0])
def test_units_come_back_as_they_went(unit: JointUnit, sign: int, angle_rad: float) -> None:
    scale = scale_of_unit(unit, -1.0, 2.0, sign, 0.25)
    assert scale.joint(scale.of(angle_rad)) == pytest.approx(angle_rad)


@pytest.mark.parametrize(
    ("scale", "value", "angle_rad"),
    [
        (scale_of_unit(JointUnit.DEG, -2, 2), 90.0, 1.5707963),
        (scale_of_unit(JointUnit.DEG, -2, 2, -1, 0.5), 90.0, -1.0707963),
        (scale_of_unit(JointUnit.RAD, -2, 2, -1), 0.5, -0.5),
        (scale_of_unit(JointUnit.PERCENT, -0.5, 1.5), 0.0, -0.5),
        (scale_of_unit(JointUnit.PERCENT, -0.5, 1.5), 75.0, 1.0),
        (scale_of_unit(JointUnit.PERCENT, -0.5, 1.5, -1), 100.0, -0.5),
        (scale_of_unit(JointUnit.SIGNED_PERCENT, -1.0, 3.0), 0.0, 1.0),
        (scale_of_unit(JointUnit.SIGNED_PERCENT, -1.0, 3.0), 100.0, 3.0),
        # beyond its range is told, not hidden
        (scale_of_unit(JointUnit.PERCENT, 0.0, 1.0), 110.0, 1.1),
    ],
)
def test_units_mean_what_they_say(scale: Scale, value: float, angle_rad: float) -> None:
    assert scale.joint(value) == pytest.approx(angle_rad)
