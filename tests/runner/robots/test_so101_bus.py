"""lerobot's own SO-101 driver, byte for byte over a serial port, behind our adapter: the arm as it
is shipped, but for the motors.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.runner.small_robots import moving
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.robots.factory import make_hal
from vram_arbiter.runner.robots.so101 import RANGES_RAD
from vram_arbiter.schemas.config.robot import HalConfig
from vram_arbiter.schemas.errors import EstopRequested, RobotFault

from .servo_bus import PRESENT, ServoBus

pytestmark = pytest.mark.heavy

NAMES = tuple(RANGES_RAD)
COUNTS_PER_RAD = 4095 / (2 * math.pi)  # as lerobot counts


@pytest.fixture
def hal(bus: ServoBus, calibrated: Path, clock: Any) -> Iterator[HalBase]:
    made = make_hal(config(bus, calibrated), clock=clock)
    made.connect()
    yield made
    made.disconnect()


def config(bus: ServoBus, folder: Path, **params: Any) -> HalConfig:
    transport = {
        "port": bus.path,
        "id": "arm",
        "calibration_dir": str(folder),
        "num_read_retries": 20,
    }
    return HalConfig(adapter="lerobot:so101_follower", transport=transport, params=params)


def test_the_description_is_the_arms(hal: HalBase) -> None:
    assert hal.description.name == "so101"
    assert not hal.description.simulated
    assert hal.description.joint_names == NAMES


def test_angles_are_read_from_the_servos_counts(hal: HalBase, bus: ServoBus) -> None:
    bus.put(1, PRESENT, 2047 + 652)  # a turn has 4096 counts
    bus.put(6, PRESENT, 4095)  # open
    state = hal.read_state()
    assert state.name == NAMES
    assert state.position[0] == pytest.approx(1.0, abs=0.002)
    assert state.position[1:5] == pytest.approx((0.0,) * 4, abs=0.002)
    assert state.position[5] == pytest.approx(RANGES_RAD["gripper"][1])


def test_targets_reach_the_servos(hal: HalBase, bus: ServoBus) -> None:
    hal.send_action(moving(elbow_flex=-0.5, gripper=RANGES_RAD["gripper"][0]))
    # answered after the writes before it
    assert hal.read_state().position[2] == pytest.approx(-0.5, abs=0.002)
    assert bus.get(3, PRESENT) == pytest.approx(2047 - 0.5 * COUNTS_PER_RAD, abs=2)
    assert bus.get(6, PRESENT) == 0
    assert bus.get(1, PRESENT) == pytest.approx(2047, abs=1)  # was not named


def test_a_range_that_the_file_narrows_limits_a_joint_and_does_not_stretch_it(
    bus: ServoBus, calibrated: Path
) -> None:
    """lerobot counts the gripper in percent of its calibrated range: 0.8 rad are 0.8 rad, however
    far it may open here.
    """
    hal = make_hal(config(bus, calibrated, joints={"gripper": {"upper_rad": 0.8}}))
    hal.connect()
    assert hal.description.joints[5].upper_rad == 0.8
    low, high = RANGES_RAD["gripper"]
    hal.send_action(moving(gripper=0.8))
    assert hal.read_state().position[5] == pytest.approx(0.8, abs=0.002)
    assert bus.get(6, PRESENT) == pytest.approx(4095 * (0.8 - low) / (high - low), abs=2)
    hal.disconnect()


def test_the_stop_holds_and_the_end_lets_go(hal: HalBase, bus: ServoBus) -> None:
    hal.send_action(moving(shoulder_pan=0.3))
    with pytest.raises(EstopRequested, match="hold the present pose"):
        hal.estop("test")
    assert hal.read_state().position[0] == pytest.approx(0.3, abs=0.002)
    assert all(bus.torque(servo) for servo in range(1, 7))
    assert bus.get(1, PRESENT) == pytest.approx(2047 + 0.3 * COUNTS_PER_RAD, abs=2)
    with pytest.raises(EstopRequested):
        hal.send_action(moving(shoulder_pan=0.0))
    hal.disconnect()
    assert not any(bus.torque(servo) for servo in range(1, 7))


def test_a_cable_that_is_out_is_a_fault(hal: HalBase, bus: ServoBus) -> None:
    bus.cut()
    with pytest.raises(RobotFault, match="so101 does not answer"):
        hal.read_state()
    hal.disconnect()
    assert not hal._robot.is_connected  # the port is free again


def test_an_arm_without_its_calibration_is_let_go_again(bus: ServoBus, tmp_path: Path) -> None:
    hal = make_hal(config(bus, tmp_path))
    with pytest.raises(RobotFault, match="lerobot-calibrate"):
        hal.connect()
    assert not any(bus.torque(servo) for servo in range(1, 7))


def test_a_port_that_is_not_there_is_a_fault(tmp_path: Path) -> None:
    pytest.importorskip(
        "scservo_sdk", reason="Feetech's driver is missing: pip install 'vram-arbiter[so101]'"
    )
    hal = make_hal(
        HalConfig(
            adapter="lerobot:so101_follower",
            transport={"port": str(tmp_path / "ttyACM9"), "calibration_dir": str(tmp_path)},
        )
    )
    with pytest.raises(RobotFault, match="does not connect"):
        hal.connect()
