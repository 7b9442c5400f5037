"""Any lerobot robot in rad: units, what it really did, faults, stop.

The robot is one that lerobot itself finds and makes.
"""

import math
import termios
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.runner.small_robots import moving
from vram_arbiter.runner.protocols import EndEffector
from vram_arbiter.runner.robots.factory import make_hal
from vram_arbiter.runner.robots.lerobot_robot import LerobotHal
from vram_arbiter.runner.skills.kinematics import ArmModel
from vram_arbiter.schemas.config.robot import HalConfig
from vram_arbiter.schemas.errors import ConfigError, EstopRequested, RobotFault

pytestmark = pytest.mark.heavy

RANGE = {"lower_rad": -1.0, "upper_rad": 1.0, "max_speed_rad_s": 3.0}
JOINTS: dict[str, Any] = {
    "motor_1": {**RANGE, "lower_rad": -1.5, "upper_rad": 1.5},
    "motor_2": RANGE,
    "motor_3": {**RANGE, "gripper": True},
}
Make = Callable[..., LerobotHal]


@pytest.fixture(autouse=True)
def plugin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "plugin"))


@pytest.fixture
def make_robot(tmp_path: Path, clock: Any) -> Make:
    def made(params: dict[str, Any] | None = None, **transport: Any) -> LerobotHal:
        config = HalConfig(
            adapter="lerobot:memory_robot",
            transport={"calibration_dir": str(tmp_path), "id": "test", **transport},
            params={"joints": JOINTS} if params is None else params,
        )
        hal = make_hal(config, clock=clock)
        assert isinstance(hal, LerobotHal)
        return hal

    return made


def robot_of(hal: LerobotHal) -> Any:
    return hal._robot


def test_it_reads_in_rad_what_lerobot_says_in_its_units(make_robot: Make, clock: Any) -> None:
    hal = make_robot(values=[90.0, -50.0, 25.0])
    hal.connect()
    state = hal.read_state()
    assert state.name == hal.description.joint_names == ("motor_1", "motor_2", "motor_3")
    assert state.position == pytest.approx((math.pi / 2, -0.5, -0.5))
    # lerobot does not say them: nothing is made up
    assert (state.velocity, state.effort) == ((), ())
    assert state.stamp_ns == clock.now_ns()


def test_it_sends_in_lerobots_units_what_is_said_in_rad(make_robot: Make) -> None:
    hal = make_robot()
    hal.connect()
    hal.send_action(moving(motor_1=-math.pi / 4, motor_2=1.0, motor_3=1.0))
    assert robot_of(hal).sent[-1] == pytest.approx(
        {"motor_1": -45.0, "motor_2": 100.0, "motor_3": 100.0}
    )
    assert hal.read_state().position == pytest.approx((-math.pi / 4, 1.0, 1.0))


def test_joints_that_are_left_out_stay_where_they_were_sent(make_robot: Make) -> None:
    hal = make_robot(values=[10.0, 20.0, 30.0])
    hal.connect()
    hal.send_action(moving(motor_1=0.1))
    assert robot_of(hal).sent[-1] == pytest.approx(
        {"motor_1": math.degrees(0.1), "motor_2": 20, "motor_3": 30}
    )
    hal.send_action(moving(motor_2=0.0))
    assert robot_of(hal).sent[-1]["motor_1"] == pytest.approx(math.degrees(0.1))


def test_a_shortened_step_is_remembered_as_it_was_made(make_robot: Make) -> None:
    hal = make_robot(max_relative_target=5.0)
    hal.connect()
    hal.send_action(moving(motor_1=1.0))
    assert hal.sent()["motor_1"] == pytest.approx(math.radians(5.0))
    hal.send_action(moving(motor_2=0.0))  # motor_1 was left out: it does not creep on to 1.0 rad
    assert hal.read_state().position[0] == pytest.approx(math.radians(5.0))


def test_the_files_word_goes_before_lerobots(make_robot: Make) -> None:
    joints = {
        **JOINTS,
        "motor_1": {**JOINTS["motor_1"], "unit": "rad", "sign": -1, "offset_rad": 0.5},
    }
    hal = make_robot({"joints": joints}, values=[0.25, 0.0, 0.0])
    hal.connect()
    assert hal.read_state().position[0] == pytest.approx(0.25)
    hal.send_action(moving(motor_1=0.5))
    assert robot_of(hal).sent[-1]["motor_1"] == pytest.approx(0.0)


def test_a_model_gives_it_frames_and_the_file_its_policies_units(
    make_robot: Make, tmp_path: Path
) -> None:
    """A real arm takes cartesian commands as its twin does."""
    model = tmp_path / "three.xml"
    model.write_text(
        "<mujoco><worldbody>"
        + "".join(
            f"<body name='link_{i}' pos='0.1 0 0'><joint name='motor_{i}' axis='0 0 1'/>"
            "<geom size='0.01' mass='0.1'/>"
            for i in (1, 2, 3)
        )
        + "</body>" * 3
        + "</worldbody></mujoco>"
    )
    params = {
        "joints": JOINTS,
        "model": str(model),
        "ends": {"hand": {"frame": "link_3", "gripper": "motor_3"}},
        "frames": {"tool0": "link_3"},
        "units": {"cartesian_delta_scale": [0.1, 0.1, 0.1]},
    }
    robot = make_robot(params).description
    assert robot.ends == (EndEffector("hand", "link_3", "motor_3"),)
    assert robot.units.cartesian_delta_scale == (0.1, 0.1, 0.1)
    pose = ArmModel(robot).pose("tool0", {"motor_1": math.pi / 2})
    assert pose.xyz == pytest.approx([0.1, 0.2, 0.0])
    with pytest.raises(ConfigError, match="no frame 'link_4'; did you mean link_3"):
        make_robot({**params, "frames": {"tool0": "link_4"}})
    with pytest.raises(ConfigError, match="give the MJCF file"):
        make_robot({**params, "model": ""})


@pytest.mark.parametrize(
    ("transport", "params", "field", "said"),
    [
        ({"prot": "x"}, {}, "transport.prot", "did you mean port"),
        ({"cameras": {"front": {}}}, {}, "transport.cameras", "sensors"),
        ({"values": "many"}, {}, "transport.values", ""),
        ({"extra_feature": "x.vel"}, {}, "adapter", "x.vel"),
        ({}, {"joints": {"motor_9": RANGE}}, "params.joints.motor_9", "no such joint"),
        ({}, {"joints": {}}, "params.joints.motor_1", "lower_rad, upper_rad, max_speed_rad_s"),
        ({"bus": False}, {"joints": JOINTS}, "params.joints.motor_1", "unit"),
        ({"bus": False},
         {"joints": {name: {**joint, "unit": "deg"} for name, joint in JOINTS.items()},
          "estop": "torque_off"},
         "params.estop", "use hold"),
        ({}, {"joints": JOINTS, "rest_pose_rad": {"elbow": 0}}, "params.rest_pose_rad.elbow",
         "no such"),
    ],
)  # fmt: skip
def test_each_mistake_names_its_field(
    make_robot: Make, transport: Any, params: Any, field: str, said: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        make_robot(params, **transport)
    found = caught.value.details["fields"][0]
    assert found["field"] == field
    assert said in found["problem"]


def test_an_unknown_robot_is_told_with_what_lerobot_knows() -> None:
    with pytest.raises(ConfigError, match="did you mean so101_follower"):
        make_hal(HalConfig(adapter="lerobot:so101_folower"))


def test_a_connection_that_fails_half_way_is_taken_back_and_tried_again(make_robot: Make) -> None:
    hal = make_robot(lost_answers=2)
    hal.connect()
    assert robot_of(hal).is_connected
    assert hal.read_state().position[0] == 0.0
    lost = make_robot(lost_answers=100)
    with pytest.raises(RobotFault, match="motor 3 is missing"):
        lost.connect()
    assert not robot_of(lost).is_connected


def test_an_uncalibrated_robot_asks_nobody_on_the_terminal(make_robot: Make) -> None:
    hal = make_robot(calibrated=False)
    with pytest.raises(RobotFault, match="lerobot-calibrate"):
        hal.connect()
    assert not robot_of(hal).is_connected


@pytest.mark.parametrize(
    "fault",
    [
        ConnectionError("no status packet"),
        RuntimeError("motor 3 is missing"),
        OSError(5, "I/O"),
        termios.error(5, "Input/output error"),
    ],
)
def test_faults_of_the_bus_are_typed(make_robot: Make, fault: Exception) -> None:
    """Regression: `termios.error` of a pulled cable is no OSError and none of lerobot's, so the
    runner neither worked nor ended.
    """
    hal = make_robot()
    robot_of(hal).fault = fault
    with pytest.raises(RobotFault, match="does not connect"):
        hal.connect()
    robot_of(hal).fault = None
    hal.connect()
    robot_of(hal).fault = fault
    with pytest.raises(RobotFault, match="does not answer"):
        hal.read_state()
    with pytest.raises(RobotFault, match="does not move"):
        hal.send_action(moving(motor_1=0.1))
    with pytest.raises(EstopRequested, match="the motors are off"):
        hal.estop("smoke")
    hal.disconnect()  # a cable that is out does not keep the program from ending
    assert not robot_of(hal).is_connected


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None, "twelve"])
def test_a_position_that_is_no_number_is_never_acted_upon(make_robot: Make, value: Any) -> None:
    hal = make_robot()
    hal.connect()
    robot_of(hal).values["motor_2"] = value
    with pytest.raises(RobotFault, match="motor_2"):
        hal.read_state()


def test_a_joint_that_is_not_reported_is_not_zero(make_robot: Make) -> None:
    hal = make_robot()
    hal.connect()
    del robot_of(hal).values["motor_2"]
    with pytest.raises(RobotFault, match="does not report motor_2"):
        hal.read_state()


@pytest.mark.parametrize(("how", "torque"), [("hold", True), ("torque_off", False)])
def test_an_emergency_stop_holds_or_lets_go_as_the_file_says(
    make_robot: Make, how: str, torque: bool
) -> None:
    hal = make_robot({"joints": JOINTS, "estop": how}, values=[10.0, 0.0, 50.0])
    hal.connect()
    hal.send_action(moving(motor_1=1.0))
    robot_of(hal).values["motor_1"] = 40.0  # it is still on its way
    with pytest.raises(EstopRequested):
        hal.estop("test")
    assert robot_of(hal).bus.torque is torque
    if torque:
        # here, not where it was going
        assert robot_of(hal).sent[-1]["motor_1"] == pytest.approx(40.0)
    with pytest.raises(EstopRequested):
        hal.send_action(moving(motor_1=0.0))


def test_a_stop_that_cannot_hold_switches_off(make_robot: Make) -> None:
    hal = make_robot()
    hal.connect()
    robot_of(hal).values["motor_1"] = float("nan")
    with pytest.raises(EstopRequested, match="the motors are off"):
        hal.estop("test")
    assert robot_of(hal).bus.torque is False


def test_a_stop_that_does_not_reach_the_motors_says_so(make_robot: Make) -> None:
    bare = {name: {**joint, "unit": "deg"} for name, joint in JOINTS.items()}
    hal = make_robot({"joints": bare}, bus=False)
    hal.connect()
    robot_of(hal).fault = ConnectionError("cable")
    with pytest.raises(EstopRequested, match="the motors may still be on") as caught:
        hal.estop("test")
    assert "cable" in caught.value.details["halted"]
