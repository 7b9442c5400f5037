"""The twins: joints move by the clock, at most as fast as the servos; stop means stop, and
stays.
"""

import importlib.util
from collections.abc import Callable
from typing import Any

import pytest

from tests.runner.small_robots import moving
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.robots.factory import make_hal
from vram_arbiter.schemas.config.robot import HalConfig
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import BadState, EstopRequested, InternalError
from vram_arbiter.schemas.world import Action

HEAVY = pytest.mark.heavy
BOTH = pytest.mark.parametrize(
    "adapter", ["so101_kinematic", pytest.param("so101_mujoco", marks=HEAVY)]
)
MakeHal = Callable[..., HalBase]


def positions(hal: HalBase) -> dict[str, float]:
    state = hal.read_state()
    return dict(zip(state.name, state.position, strict=True))


@pytest.fixture
def make_twin(clock: Any) -> MakeHal:
    def made(adapter: str, **params: Any) -> HalBase:
        hal = make_hal(HalConfig(adapter=adapter, params=params), clock=clock)
        hal.connect()
        return hal

    return made


@BOTH
def test_nothing_is_read_or_sent_without_a_connection(adapter: str, clock: Any) -> None:
    hal = make_hal(HalConfig(adapter=adapter), clock=clock)
    with pytest.raises(BadState, match="not connected"):
        hal.read_state()
    with pytest.raises(BadState, match="not connected"):
        hal.send_action(moving(gripper=0.0))
    hal.disconnect()  # harmless
    hal.connect()
    hal.connect()
    hal.disconnect()
    with pytest.raises(BadState):
        hal.read_state()


@BOTH
def test_it_starts_in_the_rest_pose_and_stays_there(
    adapter: str, make_twin: MakeHal, clock: Any
) -> None:
    hal = make_twin(adapter)
    clock.advance(0.4)
    rest = hal.description.rest_pose_rad
    assert positions(hal) == pytest.approx(dict(rest), abs=0.02)
    state = hal.read_state()
    assert state.stamp_ns == clock.now_ns()
    assert len(state.velocity) == len(state.name) == 6


@BOTH
def test_a_named_joint_moves_and_the_others_stay(
    adapter: str, make_twin: MakeHal, clock: Any
) -> None:
    hal = make_twin(adapter)
    before = positions(hal)
    for _ in range(90):
        hal.send_action(moving(shoulder_pan=0.8))
        clock.advance(1 / 30)
    after = positions(hal)
    assert after["shoulder_pan"] == pytest.approx(0.8, abs=0.02)
    assert {n: v for n, v in after.items() if n != "shoulder_pan"} == pytest.approx(
        {n: v for n, v in before.items() if n != "shoulder_pan"}, abs=0.03
    )
    assert hal.read_state().velocity == pytest.approx((0.0,) * 6, abs=0.05)


@BOTH
def test_what_was_sent_is_known(adapter: str, make_twin: MakeHal) -> None:
    hal = make_twin(adapter)
    assert hal.sent() == {}
    hal.send_action(moving(shoulder_pan=0.4))
    hal.send_action(moving(gripper=0.2))
    with pytest.raises(InternalError):
        hal.send_action(moving(gripper=0.9, tail=0.0))
    assert hal.sent() == {"shoulder_pan": 0.4, "gripper": 0.2}
    hal.disconnect()
    hal.connect()
    assert hal.sent() == {}


@BOTH
def test_it_moves_on_between_the_calls(adapter: str, make_twin: MakeHal, clock: Any) -> None:
    hal = make_twin(adapter)
    hal.send_action(moving(shoulder_pan=1.5))
    clock.advance(0.1)
    first = hal.read_state()
    clock.advance(0.1)
    second = hal.read_state()
    assert 0.0 < first.position[0] < second.position[0] < 1.5
    assert second.velocity[0] > 0.5


def test_a_kinematic_joint_keeps_its_greatest_speed(make_twin: MakeHal, clock: Any) -> None:
    hal = make_twin("so101_kinematic", start_pose_rad={"shoulder_pan": 1.0})
    hal.send_action(moving(shoulder_pan=-1.0, gripper=0.6))
    clock.advance(0.1)
    state = hal.read_state()
    assert state.position[0] == pytest.approx(1.0 - 0.47)
    assert state.velocity[0] == pytest.approx(-4.7)
    assert state.effort == ()  # there is none: nothing is made up


@BOTH
def test_an_emergency_stop_latches(adapter: str, make_twin: MakeHal, clock: Any) -> None:
    hal = make_twin(adapter)
    hal.send_action(moving(shoulder_pan=1.5))
    clock.advance(0.1)
    with pytest.raises(EstopRequested, match="emergency stop: hand in the way"):
        hal.estop("hand in the way")
    clock.advance(0.3)  # the physical arm has to brake first
    still = positions(hal)["shoulder_pan"]
    with pytest.raises(EstopRequested, match="hand in the way"):
        hal.send_action(moving(shoulder_pan=1.5))
    with pytest.raises(EstopRequested, match="hand in the way"):
        hal.estop("another reason")
    clock.advance(1.0)
    assert positions(hal)["shoulder_pan"] == pytest.approx(still, abs=0.02)
    assert still < 1.0
    hal.disconnect()
    with pytest.raises(EstopRequested):
        hal.connect()


@BOTH
@pytest.mark.parametrize(
    "action",
    [
        Action(
            control_mode=ControlMode.JOINT_POSITION,
            horizon=2,
            joint_targets=((0.0,), (1.0,)),
            joint_names=("gripper",),
        ),
        Action(control_mode=ControlMode.BODY_TWIST, body_twist=((0.1, 0.0, 0.0, 0.0, 0.0, 0.0),)),
        moving(sixth_finger=1.0),
        Action(control_mode=ControlMode.JOINT_POSITION, joint_targets=((0.0, 1.0),)),
    ],
)
def test_what_no_gate_lets_through_is_not_sent(
    adapter: str, action: Action, make_twin: MakeHal, clock: Any
) -> None:
    hal = make_twin(adapter)
    with pytest.raises(InternalError):
        hal.send_action(action)
    clock.advance(0.2)
    assert positions(hal) == pytest.approx(dict(hal.description.rest_pose_rad), abs=0.02)


@HEAVY
def test_the_description_is_that_of_the_published_model() -> None:
    from vram_arbiter.runner.sim.scene import arm_mjcf_path, load_mujoco

    model = load_mujoco().MjModel.from_xml_path(str(arm_mjcf_path()))
    joints = make_hal(HalConfig(adapter="so101_mujoco")).description.joints
    assert [joint.name for joint in joints] == [model.joint(i).name for i in range(model.njnt)]
    for joint in joints:
        low, high = model.actuator(joint.name).ctrlrange
        assert (joint.lower_rad, joint.upper_rad) == (pytest.approx(low), pytest.approx(high))


@HEAVY
def test_physics_tells_efforts_and_a_table_stops_the_arm(make_twin: MakeHal, clock: Any) -> None:
    hal = make_twin("so101_mujoco")
    for _ in range(60):  # down through the table top
        hal.send_action(moving(shoulder_lift=1.2, elbow_flex=0.2, wrist_flex=1.0))
        clock.advance(1 / 30)
    state = hal.read_state()
    lift = state.name.index("shoulder_lift")
    assert state.position[lift] < 1.1  # never reached
    assert abs(state.effort[lift]) > 0.5  # the servo pushes against the table
    assert all(abs(effort) <= 3.36 for effort in state.effort)  # the MJCF's torque limit


@HEAVY
def test_a_long_pause_is_not_simulated_second_by_second(make_twin: MakeHal, clock: Any) -> None:
    hal = make_twin("so101_mujoco")
    hal.send_action(moving(shoulder_pan=0.5))
    clock.advance(3600.0)
    assert positions(hal)["shoulder_pan"] == pytest.approx(0.5, abs=0.1)
    assert hal.read_state().stamp_ns == clock.now_ns()


def test_without_mujoco_the_file_is_told_what_to_install() -> None:
    if importlib.util.find_spec("mujoco") is not None:
        pytest.skip("MuJoCo is installed here; `make test-core` runs this one")
    from vram_arbiter.schemas.errors import ConfigError

    with pytest.raises(ConfigError, match="pip install"):
        make_hal(HalConfig(adapter="so101_mujoco"))
