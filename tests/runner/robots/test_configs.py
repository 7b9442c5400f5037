"""The robots that are shipped: their files load, and what they ask of the gate can be kept."""

from pathlib import Path

import pytest

from tests.support.deployment import load_robot
from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.factory import make_hal
from vram_arbiter.runner.safety.gate import RobotGate

FOLDER = Path(__file__).parents[3] / "configs" / "robots"
FILES = sorted(path.name for path in FOLDER.glob("*.yaml"))


def test_there_are_some() -> None:
    assert {"so101-twin.yaml", "so101.yaml", "lerobot-arm.yaml"} <= set(FILES)


@pytest.mark.parametrize("name", FILES)
def test_it_loads(name: str) -> None:
    robot = load_robot((FOLDER / name).read_text(encoding="utf-8"), name)
    assert robot.rate_hz == 30.0
    assert robot.safety is not None


@pytest.mark.heavy
@pytest.mark.parametrize("name", FILES)
def test_its_envelope_can_be_kept(name: str) -> None:
    from vram_arbiter.runner.robots.so101 import so101
    from vram_arbiter.runner.robots.so101_kinematics import kinematics_for

    robot = load_robot((FOLDER / name).read_text(encoding="utf-8"), name)
    # drivers are not installed everywhere: the description will do
    description = RobotDescription(robot.hal.adapter, (), {})
    if "so101" in robot.hal.adapter:
        description = so101(simulated=False)
    elif robot.hal.adapter == "mujoco":
        description = make_hal(robot.hal).description
    known = bool(description.model)
    gate = RobotGate(
        description,
        rate_hz=robot.rate_hz,
        kinematics=kinematics_for(description),
        envelopes={"safety": robot.safety},
    )
    assert gate.unkept == (
        () if known else ("safety.max_ee_speed_m_s (no kinematics of this robot)",)
    )


@pytest.mark.heavy
def test_the_twin_of_the_shipped_file_starts_inside_its_workspace() -> None:
    from vram_arbiter.runner.robots.so101_kinematics import So101Kinematics

    robot = load_robot((FOLDER / "so101-twin.yaml").read_text(encoding="utf-8"), "so101-twin.yaml")
    assert robot.safety is not None
    rest = make_hal(robot.hal).description.rest_pose_rad
    tool = So101Kinematics().points(rest)["tool"]
    low, high = robot.safety.workspace_box_min_xyz, robot.safety.workspace_box_max_xyz
    assert low is not None
    assert high is not None
    assert all(a < value < b for a, value, b in zip(low, tool, high, strict=True))
