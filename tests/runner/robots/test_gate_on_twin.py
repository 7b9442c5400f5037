"""The gate on the arm with physics: what passes can be followed, what is kept away from stays
away.
"""

import math
from typing import Any

import pytest

from tests.runner.small_robots import moving
from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.robots.factory import make_hal
from vram_arbiter.runner.robots.so101_kinematics import So101Kinematics, kinematics_for
from vram_arbiter.runner.safety.gate import RobotGate
from vram_arbiter.schemas.config.robot import HalConfig
from vram_arbiter.schemas.manifest.contracts import SafetyEnvelope
from vram_arbiter.schemas.world import WorldState

pytestmark = pytest.mark.heavy


@pytest.fixture
def hal(clock: Any) -> HalBase:
    made = make_hal(HalConfig(adapter="so101_mujoco"), clock=clock)
    made.connect()
    return made


def gate_of(hal: HalBase, **envelope: Any) -> RobotGate:
    safety = SafetyEnvelope(**envelope)
    kinematics = kinematics_for(hal.description)
    return RobotGate(
        hal.description, rate_hz=30.0, kinematics=kinematics, envelopes={"safety": safety}
    )


def drive(
    hal: HalBase, gate: RobotGate, clock: Any, ticks: int, wanted: dict[str, float]
) -> tuple[list[tuple[str, ...]], list[dict[str, float]]]:
    """A policy that always wants the same pose, a little nearer each tick, as a chunk of steps
    would have it.
    """
    said, states = [], []
    names = hal.description.joint_names
    step = dict(zip(names, hal.read_state().position, strict=True))
    for _ in range(ticks):
        state = hal.read_state()
        states.append(dict(zip(state.name, state.position, strict=True)))
        for name, value in wanted.items():
            step[name] += min(max(value - step[name], -0.08), 0.08)
        action = moving(**{name: step[name] for name in names})
        allowed, problems = gate.check(
            action, WorldState(stamp_ns=clock.now_ns(), joint_state=state)
        )
        said.append(problems)
        if allowed is not None:
            hal.send_action(allowed)
        clock.advance(1 / 30)
    return said, states


def test_kinematics_agree_with_the_simulators() -> None:
    from vram_arbiter.runner.sim.env import SimEnv

    pose = {
        "shoulder_pan": 0.3, "shoulder_lift": -0.4, "elbow_flex": 0.5, "wrist_flex": 0.7,
        "wrist_roll": 0.2,
    }  # fmt: skip
    with SimEnv() as env:
        env.reset(1)
        env.place(env.base_pose(), [*pose.values(), 0.0])
        theirs, mount = env.gripper_position(), env.config.mount_in_base_m
    ours = So101Kinematics().points(pose)["tool"]
    assert ours == pytest.approx([a - b for a, b in zip(theirs, mount, strict=True)], abs=1e-6)


def test_only_robots_that_are_known_have_kinematics() -> None:
    assert kinematics_for(RobotDescription("lerobot:hope_jr", (), {})) is None


def test_an_allowed_motion_is_followed(hal: HalBase, clock: Any) -> None:
    said, states = drive(hal, gate_of(hal), clock, 60, {"shoulder_pan": 0.6, "gripper": 1.0})
    assert states[-1]["shoulder_pan"] == pytest.approx(0.6, abs=0.03)
    assert states[-1]["gripper"] == pytest.approx(1.0, abs=0.03)
    assert not any("stale" in line for problems in said for line in problems)


def test_the_tool_never_leaves_the_workspace(hal: HalBase, clock: Any) -> None:
    arm = So101Kinematics()
    start = arm.points(dict(zip(*(hal.read_state().name, hal.read_state().position), strict=True)))[
        "tool"
    ]
    wall_y = start[1] + 0.08
    gate = gate_of(
        hal, workspace_box_max_xyz=(9.0, wall_y, 9.0), workspace_box_min_xyz=(-9.0, -9.0, -9.0)
    )
    side = 1.2 if arm.points({"shoulder_pan": 0.5})["tool"][1] > start[1] else -1.2
    said, states = drive(hal, gate, clock, 60, {"shoulder_pan": side})
    assert any("outside the workspace" in problems[0] for problems in said if problems)
    reached = max(arm.points(state)["tool"][1] for state in states)
    assert start[1] + 0.04 < reached < wall_y + 0.015  # the servo's overshoot


def test_the_tool_keeps_its_speed(hal: HalBase, clock: Any) -> None:
    arm = So101Kinematics()
    _, states = drive(hal, gate_of(hal, max_ee_speed_m_s=0.2), clock, 60, {"shoulder_pan": 1.0})
    tools = [arm.points(state)["tool"] for state in states]
    speeds = [math.dist(a, b) * 30 for a, b in zip(tools, tools[3:], strict=False)]
    assert max(speeds) / 3 < 0.25  # over three ticks: what a servo's ringing leaves of 0.2 m/s


def test_a_table_is_not_pressed_into(hal: HalBase, clock: Any) -> None:
    """The arm goes down onto the table: without kinematics of the table, the torque tells."""
    gate = gate_of(hal, max_torque_nm=1.0)
    efforts = []
    names = hal.description.joint_names
    step = dict(zip(names, hal.read_state().position, strict=True))
    for _ in range(120):
        state = hal.read_state()
        efforts.append(abs(state.effort[names.index("shoulder_lift")]))
        step["shoulder_lift"] = min(step["shoulder_lift"] + 0.03, 1.4)
        step["elbow_flex"] = max(step["elbow_flex"] - 0.02, 0.2)
        action = moving(**{name: step[name] for name in names})
        allowed, _ = gate.check(action, WorldState(stamp_ns=clock.now_ns(), joint_state=state))
        if allowed is not None:
            hal.send_action(allowed)
        clock.advance(1 / 30)
    assert max(efforts[-30:]) < 1.5
