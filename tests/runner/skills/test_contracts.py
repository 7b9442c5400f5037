"""Contracts against robots: what a vector's numbers do to a twin with physics, what a state vector
says of it, and a finding for whatever the robot cannot do.
"""

import asyncio
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.runner.manual_clock import ManualClock
from tests.runner.small_robots import FedCamera, hardware_runner, moving, robot_of
from tests.support.deployment import load_robot
from tests.support.paths import ROOT
from vram_arbiter.runner.protocols import Goal, MobileBase, RobotDescription, SkillEnded
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.robots.factory import make_hal
from vram_arbiter.runner.robots.mobile import with_base
from vram_arbiter.runner.robots.so101 import so101
from vram_arbiter.runner.robots.so101_kinematics import kinematics_for
from vram_arbiter.runner.safety.gate import RobotGate
from vram_arbiter.runner.skills.actions import Stepper
from vram_arbiter.runner.skills.kinematics import ArmModel, Pose3
from vram_arbiter.runner.skills.motion import joint_positions
from vram_arbiter.runner.skills.rotations import matrix_of, numbers, turn
from vram_arbiter.runner.skills.sidecar_policy import SidecarPolicy
from vram_arbiter.runner.skills.wiring import Wiring, wire_up
from vram_arbiter.schemas.errors import ModelError, StateStale
from vram_arbiter.schemas.manifest import (
    Kind,
    ManifestError,
    RSkillManifest,
    load_manifest,
    parse_manifest,
)
from vram_arbiter.schemas.manifest.contracts import SafetyEnvelope
from vram_arbiter.schemas.manifest.vocabulary import Rotation
from vram_arbiter.schemas.world import WorldState

np: Any = pytest.importorskip("numpy")  # the base install has none
pytestmark = pytest.mark.heavy  # MuJoCo, mink

HZ = 30.0
PANDA = ROOT / "configs/robots/panda-mobile-twin.yaml"
FIELD = sorted((ROOT.parent / "shared" / "reference" / "manifests").glob("*.yaml"))
HEAD = """
name: "test/contract"
version: "1.0.0"
kind: vla
model_family: act
embodiment_tags: [any]
sensors_required: [{modality: rgb, vla_feature_key: observation.images.front}]
weights_uri: "local://models/none"
chunk_size: 8
latency_budget: {per_chunk_ms: 100.0}
min_vram_gb: {fp32: 1.0}
description: "A contract of this test."
actions: [grasp]
"""
JOINTS = "actuators_required: [{kind: joint_position, control_mode_semantics: {mode: absolute}}]\n"
# the contracts of the field's two policies for this robot, word for word
FIELD_SLOTS = """
actuators_required: [{kind: joint_position, control_mode_semantics: {mode: delta}}]
state_contract:
  layout: "LAYOUT"
  dim: 16
  bindings:
    eef_frame: "panda_hand_tcp"
    base_frame: "base_link"
    world_frame: "odom"
    gripper_qpos_joints: ["panda_gripper"]
    quaternion_convention: "xyzw"
action_contract:
  dim: 12
  slots:
    - {range: [0, 5],   control_mode: "cartesian_delta",  ee: "panda_gripper", frame: "panda_link0"}
    - {range: [6, 6],   control_mode: "gripper_position", ee: "panda_gripper"}
    - {range: [7, 9], control_mode: joint_velocity, joint_names: [base_x, base_y, base_yaw]}
    - {range: [10, 10], discard: true}
    - {range: [11, 11], control_mode: "composite_mode"}
"""


def skill(text: str) -> RSkillManifest:
    return parse_manifest(HEAD + text)


def tool_skill(frame: str, more: str = "") -> RSkillManifest:
    return skill(
        JOINTS
        + "action_contract:\n  dim: 6\n  cartesian_delta_scale: [1, 1, 1, 1, 1, 1]\n"
        + "  slots: [{range: [0, 5], control_mode: cartesian_delta, ee: panda_gripper,"
        + f" frame: {frame}}}]\n{more}"
    )


class Bench:
    """A twin behind its gate, driven row by row as a policy skill does it."""

    def __init__(self, hal: HalBase, clock: ManualClock, safety: SafetyEnvelope | None) -> None:
        self.hal, self.clock = hal, clock
        self.robot = hal.description
        self.gate = RobotGate(
            self.robot,
            rate_hz=HZ,
            kinematics=kinematics_for(self.robot),
            envelopes={"safety": safety},
            sent=hal.sent,
            now_ns=clock.now_ns,
        )
        self.model = ArmModel(self.robot)
        self.said: list[str] = []
        hal.connect()

    def world(self) -> WorldState:
        world = WorldState(stamp_ns=self.clock.now_ns(), joint_state=self.hal.read_state())
        return with_base(world, self.robot.base) if self.robot.base is not None else world

    def measured(self) -> dict[str, float]:
        return joint_positions(self.world(), self.robot.joint_names)

    def tool(self, within: str = "") -> Pose3:
        return self.model.pose(self.robot.ends[0].frame, self.measured(), within=within)

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds * HZ)):
            self.clock.advance(1 / HZ)
            self.hal.read_state()

    def play(self, wiring: Wiring, actions: list[list[float]]) -> None:
        stepper = Stepper(
            wiring.actions,
            self.robot,
            wiring.model,
            period_s=1 / HZ,
            longest={n: 0.98 * v / HZ for n, v in self.gate.limits.speeds_rad_s.items()},
        )
        for row in wiring.actions.rows(np.array(actions)):
            world = self.world()
            step = stepper.step(row, {**self.measured(), **self.hal.sent()})
            self.said += [step.problem] if step.problem else []
            if step.withheld:
                self.clock.advance(1 / HZ)
                continue
            twist = None if step.twist is None else (step.twist,)
            action = moving(**step.targets).model_copy(update={"body_twist": twist})
            allowed, problems = self.gate.check(action, world)
            self.said += problems
            if allowed is not None:
                self.hal.send_action(allowed)
            self.clock.advance(1 / HZ)


@pytest.fixture
def panda() -> Iterator[Bench]:
    clock = ManualClock()
    file = load_robot(PANDA.read_text(encoding="utf-8"), PANDA.name)
    bench = Bench(make_hal(file.hal, clock=clock), clock, file.safety)
    yield bench
    bench.hal.disconnect()


# -- actions
@pytest.mark.parametrize("frame", ["panda_link0", "panda_hand_tcp"])
def test_a_cartesian_delta_moves_the_tool_by_it(panda: Bench, frame: str) -> None:
    """In the axes of the frame, from where the last step led: a lag of the servos adds up to
    nothing.
    """
    before = panda.tool()
    axes = panda.model.pose(frame, panda.measured()).matrix
    wiring = wire_up(tool_skill(frame), panda.robot, None)
    turning = 0.0 if frame == "panda_hand_tcp" else 0.01
    panda.play(wiring, [[0.004, -0.003, 0.002, 0.0, 0.0, turning]] * 20)
    panda.wait(1.0)
    after = panda.tool()
    assert panda.said == []
    assert after.xyz - before.xyz == pytest.approx(axes @ [0.08, -0.06, 0.04], abs=2e-3)
    turned = numbers(after.matrix @ before.matrix.T, Rotation.AXIS_ANGLE)
    assert turned == pytest.approx(axes @ [0.0, 0.0, 20 * turning], abs=0.01)


def test_the_fields_vector_drives_arm_or_base_by_its_mode(panda: Bench) -> None:
    """Robosuite's units come from the deployment: the manifests of the field do not state them.

    A row moves the base where its composite mode is 1, the arm where it is -1, the gripper in both.
    """
    wiring = wire_up(skill(FIELD_SLOTS.replace("LAYOUT", "human300_16d")), panda.robot, None)
    before = panda.tool()
    closing_up = [0, 0, 0.06, 0, 0, 0, 1.0, 0.3, 0.0, 0.5, 0.7]
    panda.play(wiring, [[*closing_up, -1.0]] * 30)
    panda.wait(0.5)
    assert panda.tool().xyz - before.xyz == pytest.approx([0, 0, 30 * 0.06 * 0.05], abs=3e-3)
    world = panda.world()
    assert world.base_pose.xyz == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    panda.play(wiring, [[*closing_up, 1.0]] * 30)
    panda.wait(0.5)  # the base has stopped by itself: a command stands for a fifth of a second
    assert panda.said == []
    assert panda.tool().xyz - before.xyz == pytest.approx([0, 0, 30 * 0.06 * 0.05], abs=3e-3)
    assert panda.measured()["panda_gripper"] == pytest.approx(0.0, abs=2e-3)
    world = panda.world()
    # a recording's columns: each has a target
    assert world.joint_state.name == panda.robot.joint_names
    assert world.base_pose is not None
    assert world.base_twist is not None
    turned = 0.5 * (1.0 + 0.2)
    assert world.base_pose.xyz[:2] == pytest.approx(
        (0.6 * math.sin(turned), 0.6 * (1 - math.cos(turned))), abs=0.03
    )
    assert 2 * math.asin(world.base_pose.quat_xyzw[2]) == pytest.approx(turned, abs=0.05)
    assert world.base_twist == pytest.approx((0.0,) * 6, abs=0.02)


def test_joints_in_the_policys_order_in_degrees_with_a_gripper_in_percent() -> None:
    """The vector of lerobot's own SO-101 recordings, joints reversed; actions come back as state.

    Regression: a gripper of 0..100 was taken for degrees, and `joint_order` was ignored in the
    vectors.
    """
    clock = ManualClock()
    robot = so101(simulated=True)
    order = tuple(reversed(robot.joint_names))
    manifest = skill(
        "actuators_required:\n"
        "  - {kind: joint_position, control_mode_semantics: {mode: absolute,"
        f" joint_order: [{', '.join(order)}]}}}}\n"
        "  - {kind: gripper_position, control_mode_semantics: {mode: absolute,"
        " gripper_convention: percent_open}}\n"
        "action_contract: {dim: 6, representation: joint_positions, joint_units: degrees}\n"
        "state_contract: {dim: 6}\n"
    )
    wiring = wire_up(manifest, robot, None)
    told = [25.0, -90.0, 45.0, 30.0, -60.0, 10.0]
    (row,) = wiring.actions.rows(np.array([told]))
    targets = dict(zip(wiring.joints, row, strict=True))
    lower, upper = -0.17453, 1.74533
    assert targets["gripper"] == pytest.approx(lower + 0.25 * (upper - lower))
    assert targets["wrist_roll"] == pytest.approx(math.radians(-90.0))
    assert targets["shoulder_pan"] == pytest.approx(math.radians(10.0))
    hal = make_hal(load_robot("robot_id: a\nhal: {adapter: so101_kinematic}", "r").hal, clock=clock)
    hal.connect()
    hal.send_action(moving(**targets))
    clock.advance(5.0)
    world = WorldState(stamp_ns=clock.now_ns(), joint_state=hal.read_state())
    measured = joint_positions(world, robot.joint_names)
    assert wiring.state.vector(world, measured, None) == pytest.approx(told)


@pytest.mark.parametrize(
    ("mode", "words", "row", "moved"),
    [
        ("delta", "", [0.1, 0.0], {"shoulder_pan": 0.1, "wrist_roll": 0.0}),
        (
            "absolute",
            ", control_mode: joint_velocity",
            [0.0, -1.5],
            {"shoulder_pan": 0.0, "wrist_roll": -1.5 / HZ},
        ),
    ],
)
def test_joint_steps_and_speeds_start_at_the_last_target(
    mode: str, words: str, row: list[float], moved: dict[str, float]
) -> None:
    manifest = skill(
        "actuators_required: [{kind: joint_position, control_mode_semantics:"
        f" {{mode: {mode}}}}}]\n"
        "action_contract:\n  dim: 4\n  slots:\n"
        f"    - {{range: [0, 1], joint_names: [shoulder_pan, wrist_roll]"
        f"{words or ', control_mode: joint_position'}}}\n"
        "    - {range: [2, 2], control_mode: gripper_binary, ee: gripper,"
        " gripper_convention: binary_close_one}\n"
        "    - {range: [3, 3], terminate: true}\n"
    )
    robot = so101(simulated=True)
    wiring = wire_up(manifest, robot, None)
    stepper = Stepper(wiring.actions, robot, None, period_s=1 / HZ)
    start = dict.fromkeys(robot.joint_names, 0.25)
    (made,) = wiring.actions.rows(np.array([[*row, 1.0, 0.0]]))
    step = stepper.step(made, start)
    expected = {name: 0.25 + by for name, by in moved.items()}
    assert step.targets == pytest.approx({**expected, "gripper": -0.17453})
    assert not step.terminated
    (last,) = wiring.actions.rows(np.array([[*row, 0.0, 1.0]]))
    step = stepper.step(last, start)
    assert step.targets["gripper"] == pytest.approx(1.74533)
    assert step.terminated


@pytest.mark.parametrize(
    ("kind", "mode", "convention", "value", "wanted"),
    [
        ("gripper_position", "absolute", "normalized_open_unit", 0.75, 0.75),
        ("gripper_position", "delta", "normalized_open_unit", 0.25, 0.75),
        ("gripper_binary", "absolute", "normalized_open_symmetric", 0.1, 1.0),
    ],
)
def test_a_gripper_among_joint_steps_goes_as_its_own_actuator_says(
    kind: str, mode: str, convention: str, value: float, wanted: float
) -> None:
    """Six joints in one vector: five deltas, and a gripper told where to be, or switched."""
    robot = so101(simulated=True)
    manifest = skill(
        "actuators_required:\n  - {kind: joint_position, control_mode_semantics: {mode: delta}}\n"
        f"  - {{kind: {kind}, control_mode_semantics:"
        f" {{mode: {mode}, gripper_convention: {convention}}}}}\naction_contract: {{dim: 6}}\n"
    )
    wiring = wire_up(manifest, robot, None)
    lower, span = -0.17453, 1.74533 + 0.17453
    start = {**dict.fromkeys(robot.joint_names, 0.0), "gripper": lower + 0.5 * span}
    (row,) = wiring.actions.rows(np.array([[0.1, 0, 0, 0, 0, value]]))
    step = Stepper(wiring.actions, robot, None, period_s=1 / HZ).step(row, start)
    assert step.targets["shoulder_pan"] == pytest.approx(0.1)
    assert step.targets["gripper"] == pytest.approx(lower + wanted * span)


@pytest.mark.parametrize("rotation", [*Rotation, None])
def test_a_cartesian_pose_is_where_the_tool_goes(panda: Bench, rotation: Rotation | None) -> None:
    width = 3 + (rotation.width if rotation is not None else 0)
    manifest = skill(
        JOINTS + f"action_contract:\n  dim: {width}\n  slots:\n    - {{range: [0, {width - 1}],"
        " control_mode: cartesian_pose, ee: panda_gripper, frame: base_link"
        + (f", rotation: {rotation}}}\n" if rotation is not None else "}\n")
    )
    wiring = wire_up(manifest, panda.robot, None)
    here = panda.tool("base_link")
    goal = Pose3(here.xyz + np.array([0.01, 0.02, -0.015]), turn([0.0, 0.05, 0.1]) @ here.matrix)
    row = [*goal.xyz, *(numbers(goal.matrix, rotation) if rotation is not None else ())]
    panda.play(wiring, [row] * 15)
    panda.wait(1.0)
    there = panda.tool("base_link")
    assert there.xyz == pytest.approx(goal.xyz, abs=2e-3)
    wanted = goal if rotation is not None else here
    assert there.matrix == pytest.approx(wanted.matrix, abs=0.02)


def test_a_representation_without_slots_moves_the_robots_one_tool(panda: Bench) -> None:
    words = (
        "actuators_required:\n"
        "  - {kind: cartesian_delta,\n"
        "     control_mode_semantics: {mode: delta, reference_frame: FRAME}}\n"
        "  - {kind: gripper_position, control_mode_semantics: {mode: absolute,"
        " gripper_convention: normalized_open_unit}}\n"
        "action_contract: {dim: 7, representation: delta_ee_6d_plus_gripper,"
        " cartesian_delta_scale: [0.1, 0.1, 0.1, 1, 1, 1]}\n"
    )
    wiring = wire_up(skill(words.replace("FRAME", "panda_link0")), panda.robot, None)
    before = panda.tool().xyz
    panda.play(wiring, [[0.0, 0.05, 0.0, 0.0, 0.0, 0.0, 0.5]] * 10)
    panda.wait(0.5)
    assert panda.tool().xyz - before == pytest.approx([0.0, 0.05, 0.0], abs=2e-3)
    assert panda.measured()["panda_gripper"] == pytest.approx(0.02, abs=2e-3)
    assert findings(skill(words.replace("FRAME", "map")), panda.robot)[0].startswith(
        "action_contract.frame: no frame 'map'"
    )


def test_raw_numbers_are_clipped_to_the_slots_bounds(panda: Bench) -> None:
    text = FIELD_SLOTS.replace("LAYOUT", "rc365").replace(
        'frame: "panda_link0"', 'frame: "panda_link0", input_bounds: [-1, 1]'
    )
    (row,) = wire_up(skill(text), panda.robot, None).actions.rows(
        np.array([[3.0, -3.0, 0.5, 0, 0, 2.0, 0, 0, 0, 0, 0, 5.0]])
    )
    assert row[:6] == pytest.approx((0.05, -0.05, 0.025, 0.0, 0.0, 0.5))


class Answers:
    """Stands for a policy's sidecar: the same chunk to every observation."""

    connected = True

    def __init__(self, row: list[float]) -> None:
        self.row = row
        self.states: list[Any] = []

    async def load(self, **_: Any) -> dict[str, Any]:
        return {"lease_id": None, "token": None}

    async def reset(self, *_: Any, **__: Any) -> dict[str, Any]:
        return {"ok": True}

    async def get_action(self, observation: Any, **_: Any) -> dict[str, Any]:
        self.states.append(observation["observation.state"])
        return {"action": np.array([self.row] * 5)}

    async def unload(self) -> None: ...

    async def close(self) -> None: ...


def run_goal(
    panda: Bench, run_async: Callable[[Any], Any], client: Any, manifest: RSkillManifest, ticks: int
) -> list[SkillEnded]:
    """Loop, skill, gate and twin as `vram-runner deploy` composes them."""
    wiring = wire_up(manifest, panda.robot, panda.robot.rest_pose_rad)
    policy = SidecarPolicy(
        manifest,
        wiring,
        client,
        None,
        period_s=1 / HZ,
        wait_s=30.0,
        speeds_rad_s=panda.gate.for_skill(manifest, ()).limits.speeds_rad_s,
        sent=panda.hal.sent,
    )
    runner = hardware_runner(
        panda.hal,
        [(FedCamera("front", panda.clock), 100.0)],
        lambda stepped: panda.gate.for_skill(stepped.manifest, stepped.cameras),
        rate_hz=HZ,
        clock=panda.clock,
    )
    ended: list[SkillEnded] = []

    async def play() -> None:
        runner.activate()
        goal = Goal("g", "test/contract", prompt="go")
        await policy.start(goal)
        runner.begin_skill(policy, goal, ended.append)
        for _ in range(ticks):
            await asyncio.to_thread(runner.tick)
            panda.clock.advance(1 / HZ)
        await policy.finish()
        panda.said += runner.slot.violations
        runner.deactivate()

    run_async(play())
    panda.hal.connect()
    return ended


def test_a_slow_arm_comes_to_its_start_pose(panda: Bench, run_async: Callable[[Any], Any]) -> None:
    """Regression: the way there was planned faster than the envelope allows, so that targets ran
    ahead until the gate withheld them and the goal failed.
    """
    client: Any = Answers([0.0] * 6 + [-1.0] + [0.0] * 5)
    far = "starting_pose: [-1.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785, 0.01]\n"
    slow = "envelope: {max_joint_speed_factor: 0.2}\npolicy_extras: {rollout_steps: 5}\n"
    manifest = skill(FIELD_SLOTS.replace("LAYOUT", "rc365") + far + slow)
    ended = run_goal(panda, run_async, client, manifest, 150)
    assert [(end.error, end.data["withheld"]) for end in ended] == [(None, 0)]
    assert panda.said == []
    assert panda.measured()["panda_joint1"] == pytest.approx(-1.0, abs=0.07)


def test_a_goal_of_the_fields_policy_runs_on_the_robot(
    panda: Bench, run_async: Callable[[Any], Any]
) -> None:
    client: Any = Answers([0.1, 0, 0, 0, 0, 0, 1.0, 0.2, 0, 0, 0, 1.0])
    text = FIELD_SLOTS.replace("LAYOUT", "human300_16d") + "policy_extras: {rollout_steps: 20}\n"
    before = panda.tool().xyz[0]
    ended = run_goal(panda, run_async, client, skill(text), 60)
    assert [(end.error, end.data["steps"], end.data["withheld"]) for end in ended] == [
        (None, 20, 0)
    ]
    assert [state.shape for state in client.states] == [(16,)] * 4
    assert panda.tool().xyz[0] == pytest.approx(before, abs=5e-3), "the mode gives it to the base"
    world = panda.world()
    assert world.base_pose.xyz[0] == pytest.approx(0.2 * (20 / HZ + 0.2), abs=0.03)
    assert client.states[-1][7] > 0.05, "the state tells where the base is"


# -- limits
def test_what_the_arm_cannot_reach_is_withheld_and_said(panda: Bench) -> None:
    wiring = wire_up(tool_skill("panda_link0"), panda.robot, None)
    high = dict.fromkeys(panda.robot.joint_names, 0.0)
    high["panda_joint4"], high["panda_joint6"] = -0.07, 1.6  # nearly stretched, straight up
    stepper = Stepper(wiring.actions, panda.robot, wiring.model, period_s=1 / HZ)
    step = stepper.step((0.0, 0.0, 0.02, 0.0, 0.0, 0.0), high)
    assert step.withheld
    assert "reaches no further" in step.problem
    with pytest.raises(ModelError, match=r"0\.50 m and 0\.00 rad in one step"):
        stepper.step((0.5, 0.0, 0.0, 0.0, 0.0, 0.0), high)


def test_a_step_that_the_joints_are_too_slow_for_is_shortened_and_said(panda: Bench) -> None:
    before = panda.tool().xyz
    wiring = wire_up(tool_skill("panda_link0"), panda.robot, None)
    panda.play(wiring, [[0.0, 0.0, 0.0, 0.0, 0.0, 0.2]])
    assert len(panda.said) == 1
    assert "shortened" in panda.said[0]
    panda.wait(1.0)
    assert panda.tool().xyz == pytest.approx(before, abs=5e-3)


def test_the_gate_still_keeps_the_tool_out_of_zones_and_slow(panda: Bench) -> None:
    """The solver's targets are joint targets like any other."""
    wiring = wire_up(tool_skill("panda_link0"), panda.robot, None)
    before = panda.tool().xyz
    x, y, z = (float(value) for value in before)
    zone = {
        "name": "shelf",
        "min_xyz": [x + 0.03, y - 0.2, z - 0.2],
        "max_xyz": [x + 0.3, y + 0.2, z + 0.2],
    }
    panda.gate = panda.gate.tightened("envelope", SafetyEnvelope(no_go_zones=(zone,)))
    panda.play(wiring, [[0.005, 0.0, 0.0, 0.0, 0.0, 0.0]] * 12)
    panda.wait(0.5)
    assert any("inside the no-go zone shelf" in text for text in panda.said)
    assert panda.tool().xyz[0] - before[0] == pytest.approx(0.03, abs=6e-3)
    panda.said.clear()
    panda.play(wiring, [[0.0, 0.02, 0.0, 0.0, 0.0, 0.0]])
    assert any("the tool would move 20 mm" in text for text in panda.said)
    fast = wire_up(skill(FIELD_SLOTS.replace("LAYOUT", "rc365")), panda.robot, None)
    panda.said.clear()
    panda.play(fast, [[0.0] * 6 + [-1.0, 2.0, 0.0, 0.0, 0.0, 1.0]])
    assert any("base speed 2.00 m/s" in text for text in panda.said)


# -- states
@pytest.mark.parametrize("layout", ["human300_16d", "rc365"])
def test_a_task_space_state_is_poses_and_fingers_in_the_layouts_order(
    panda: Bench, layout: str
) -> None:
    wiring = wire_up(skill(FIELD_SLOTS.replace("LAYOUT", layout)), panda.robot, None)
    panda.play(wiring, [[0.0] * 6 + [0.0, 0.3, 0.1, 0.4, 0.0, 1.0]] * 10)
    panda.wait(0.5)
    world, measured = panda.world(), panda.measured()
    assert world.base_pose is not None
    tool = panda.tool("base_link")
    vector = wiring.state.vector(world, measured, wiring.model)
    pose = [*tool.xyz, *numbers(tool.matrix, Rotation.QUAT_XYZW)]
    base = [*world.base_pose.xyz, *world.base_pose.quat_xyzw]
    fingers = [measured["panda_gripper"], -measured["panda_gripper"]]
    assert abs(base[0]) > 0.05
    wanted = [*pose, *base, *fingers] if layout == "human300_16d" else [*pose, *fingers, *base]
    assert vector == pytest.approx(wanted)
    for missing in (
        {"base_pose": None},
        {"diagnostics": {"base_pose": "stale"}},
        {"base_pose": world.base_pose.model_copy(update={"frame_id": "map"})},
    ):
        with pytest.raises(StateStale, match="base pose"):
            wiring.state.vector(world.model_copy(update=missing), measured, wiring.model)


def test_a_state_of_parts_in_the_given_units_and_orientation(panda: Bench) -> None:
    parts = (
        "state_contract:\n  dim: 20\n  parts:\n"
        "    - {kind: ee_pose, ee: panda_gripper, frame: odom, rotation: rot6d}\n"
        "    - {kind: ee_pose, ee: panda_hand, frame: panda_link0, rotation: euler_xyz}\n"
        "    - {kind: base_twist}\n"
        "    - {kind: joint_positions, joints: [panda_joint4]}\n"
        "    - {kind: joint_velocities, joints: [panda_joint7]}\n"
    )
    wiring = wire_up(tool_skill("panda_link0", parts), panda.robot, None)
    world, measured = panda.world(), panda.measured()
    vector = wiring.state.vector(world, measured, wiring.model)
    tool = panda.tool()
    assert vector[:9] == pytest.approx([*tool.xyz, *tool.matrix[:2].ravel()])
    hand = panda.model.pose("panda_hand", measured, within="panda_link0")
    assert vector[9:12] == pytest.approx(hand.xyz)
    assert matrix_of(vector[12:15], Rotation.EULER_XYZ) == pytest.approx(hand.matrix)
    assert vector[15:18] == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    assert vector[18] == pytest.approx(-2.356, abs=0.01)
    bare = world.joint_state.model_copy(update={"velocity": ()})
    with pytest.raises(StateStale, match="no speed of panda_joint7"):
        wiring.state.vector(world.model_copy(update={"joint_state": bare}), measured, wiring.model)


# -- what a robot cannot do
def findings(manifest: RSkillManifest, robot: RobotDescription) -> list[str]:
    with pytest.raises(ManifestError) as caught:
        wire_up(manifest, robot, None)
    return [str(problem) for problem in caught.value.problems]


def slots(dim: int, *lines: str, more: str = "") -> RSkillManifest:
    text = "".join(f"    - {{{line}}}\n" for line in lines)
    return skill(f"{JOINTS}action_contract:\n  dim: {dim}\n{more}  slots:\n{text}")


SCALE = "  cartesian_delta_scale: [1, 1, 1, 1, 1, 1]\n"
SCALE3 = "  cartesian_delta_scale: [1, 1, 1]\n"
DELTA = "range: [0, 2], control_mode: cartesian_delta, ee: gripper, frame:"
BASE_JOINTS = "control_mode: joint_velocity, joint_names: [base_x, base_y, base_yaw]"
SLOT, BINDINGS = "action_contract.slots[0]", "state_contract.bindings"


@pytest.mark.parametrize(
    ("manifest", "said"),
    [
        (slots(3, "range: [0, 2], control_mode: body_twist, frame: base_link"),
         [f"{SLOT}.control_mode: so101 has no base to drive"]),
        (slots(3, f"range: [0, 2], {BASE_JOINTS}"),
         [f"{SLOT}.joint_names: drives a base (base_x, base_y, base_yaw); so101 has none"]),
        (slots(1, "range: [0, 0], control_mode: joint_position, joint_names: [waist]"),
         [f"{SLOT}: moves waist; the robot has shoulder_pan, shoulder_lift, elbow_flex, "
          "wrist_flex, wrist_roll, gripper"]),
        (slots(6, "range: [0, 5], control_mode: joint_torque"),
         [f"{SLOT}.control_mode: joint_torque cannot be sent: so101 is driven by joint positions"]),
        (slots(3, f"{DELTA} odom", more=SCALE3),
         [f"{SLOT}.frame: no frame 'odom'; the model has "]),
        (slots(3, f"{DELTA} base"),
         ["action_contract.cartesian_delta_scale: is not stated, and a unit of the delta may"]),
        (slots(6, "range: [0, 5], control_mode: cartesian_delta, ee: gripper, frame: base",
               more=SCALE),
         [f"{SLOT}: cartesian_delta of 6 degrees of freedom; the 5 joints that move grasp cannot "
          "follow it"]),
        (slots(4, f"{DELTA} base",
               "range: [3, 3], control_mode: joint_position, joint_names: [elbow_flex]",
               more=SCALE3),
         ["action_contract.slots[1]: commands elbow_flex a second time"]),
        (slots(2, "range: [0, 0], control_mode: gripper_position, ee: gripper",
               "range: [1, 1], control_mode: gripper_position, ee: left_hand,"
               " gripper_convention: percent_open"),
         [f"{SLOT}: gripper_position does not say which number is open",
          "action_contract.slots[1].ee: no end effector 'left_hand'; the robot has gripper"]),
        (slots(7, "range: [0, 6], control_mode: joint_position"),
         [f"{SLOT}.range: covers 7 values for 6 joints"]),
        (skill(JOINTS + "action_contract: {dim: 7}\nstate_contract: {dim: 9}\n"),
         ["action_contract.dim: commands 7 joints, the robot has 6",
          "state_contract.dim: is 9; this robot's state has 6 values"]),
        (skill(JOINTS + "state_contract: {layout: aloha_42d}\n"),
         ["state_contract.layout: 'aloha_42d' is unknown here"]),
        (skill(JOINTS + "state_contract: {layout: human300_16d, bindings: {eef_frame: "
               "panda_hand_tcp, base_frame: base_link, gripper_qpos_joints: [panda_gripper]}}\n"),
         [f"{BINDINGS}: no frame 'panda_hand_tcp'; the model has",
          f"{BINDINGS}: no frame 'base_link'; the model has",
          f"{BINDINGS}: asks for the state of a base; so101 has none",
          f"{BINDINGS}.gripper_qpos_joints: reads panda_gripper; the robot has"]),
    ],
)  # fmt: skip
def test_each_thing_that_the_robot_cannot_do_is_a_finding(
    manifest: RSkillManifest, said: list[str]
) -> None:
    found = findings(manifest, so101(simulated=True))
    if "bindings" in said[0]:
        found = sorted(
            found, key=lambda text: [text.startswith(words) for words in said].index(True)
        )
    assert len(found) == len(said), found
    assert all(text.startswith(words) for text, words in zip(found, said, strict=True)), found


def test_a_world_without_frames_ranges_or_a_base_says_so() -> None:
    manifest = skill(
        JOINTS.replace("]\n", "")
        + ", {kind: gripper_position, control_mode_semantics: {mode: absolute,"
        " gripper_convention: percent_open}}]\n"
        "action_contract: {dim: 2, joint_units: range_m100_100}\n"
    )
    robot = robot_of("a", "b")
    assert findings(manifest, robot)[0] == (
        "action_contract: range_m100_100: the range of a is not known"
    )
    moving = slots(
        3, "range: [0, 2], control_mode: cartesian_delta, ee: hand, frame: base", more=SCALE3
    )
    assert findings(moving, robot) == [
        "action_contract.slots[0].control_mode: cartesian_delta needs a model of this world for"
        " its kinematics; there is none"
    ]


def test_an_arm_on_a_base_has_the_bases_frame_below_it() -> None:
    """Of the simulated arm only the arm itself is modelled."""
    base = MobileBase(0.5, 1.2, mount_m=(0.1, 0.0, 0.4))
    model = ArmModel(so101(simulated=True, base=base))
    rest = so101(simulated=True).rest_pose_rad
    alone, mounted = model.pose("grasp", rest), model.pose("grasp", rest, within="base_link")
    assert mounted.xyz - alone.xyz == pytest.approx([0.1, 0.0, 0.4])
    assert "base_link" in model.frames


def test_cartesian_commands_without_the_solver_are_refused(
    monkeypatch: pytest.MonkeyPatch, panda: Bench
) -> None:
    monkeypatch.setitem(sys.modules, "mink", None)
    assert findings(tool_skill("panda_link0"), panda.robot) == [
        "action_contract: frames need mink and SciPy (import of mink halted; None in sys.modules):"
        " pip install 'vram-arbiter[runner]'"
    ]


def test_a_state_of_the_base_alone_needs_scipy_before_the_first_tick(
    monkeypatch: pytest.MonkeyPatch, panda: Bench
) -> None:
    """Regression: where only the base's pose was read, a tick imported SciPy, or missed it."""
    monkeypatch.setitem(sys.modules, "scipy.spatial.transform", None)
    based = skill(
        JOINTS + "state_contract:\n  parts:\n"
        "    - {kind: base_pose, frame: odom, rotation: quat_xyzw}\n"
    )
    (said,) = findings(based, panda.robot)
    assert said.startswith("state_contract: frames need mink and SciPy")


@pytest.mark.parametrize(
    ("name", "widths"),
    [("libero-pi05-nf4", (7, 8)), ("so100-smolvla-base", (6, 6)), ("so101-grab", (6, 6))],
)
def test_shipped_policies_fit_a_shipped_robot(
    panda: Bench, name: str, widths: tuple[int, int]
) -> None:
    manifest = load_manifest(ROOT / "configs/rskills" / name / "rskill.yaml")
    robot = panda.robot if name.startswith("libero") else so101(simulated=True)
    wiring = wire_up(manifest, robot, robot.rest_pose_rad)
    assert (wiring.actions.dim, wiring.state.width) == widths


@pytest.mark.skipif(not FIELD, reason="the field's own manifests do not lie beside this repository")
@pytest.mark.parametrize("path", FIELD, ids=lambda path: path.stem)
def test_the_fields_policies_fit_the_robot_that_they_are_made_for(path: Path) -> None:
    manifest = load_manifest(path)
    file = load_robot(PANDA.read_text(encoding="utf-8"), PANDA.name)
    if manifest.kind is Kind.VLA:
        wiring = wire_up(manifest, make_hal(file.hal).description, None)
        assert (wiring.actions.dim, wiring.state.width) == (12, 16)
