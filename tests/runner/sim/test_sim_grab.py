"""The scripted expert grabs every shape, and misses show as misses."""

import math
import random
from importlib.util import find_spec

import numpy as np
import pytest

if find_spec("mujoco") is None:
    pytest.skip("needs the full install", allow_module_level=True)

from tests.support.tabletop import run_expert
from vram_arbiter.runner.robots.so101 import TOOL, so101
from vram_arbiter.runner.sim.config import ARM_JOINTS, REST_POSE, SceneConfig
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.expert import OPEN_RAD, GrabExpert
from vram_arbiter.runner.sim.tasks import stand_before
from vram_arbiter.runner.skills.kinematics import ArmModel, Pose3

pytestmark = pytest.mark.heavy


@pytest.mark.parametrize("shape", ["cube", "ball", "cylinder"])
def test_expert_grabs_after_imperfect_navigation(sim_env: SimEnv, shape: str) -> None:
    for seed in range(8):
        sim_env.reset(seed, names=(f"red {shape}", "blue ball", "green cube"))
        stand_before(sim_env, f"red {shape}", random.Random(seed))
        assert run_expert(sim_env, GrabExpert(sim_env, f"red {shape}"))
        truth = sim_env.ground_truth()
        assert truth.held == f"red {shape}"
        assert truth.objects[f"red {shape}"].lift_m > 0.05


def test_a_held_thing_stays_held_while_driving(sim_env: SimEnv) -> None:
    sim_env.reset(1)
    stand_before(sim_env, sim_env.target, random.Random(1))
    run_expert(sim_env, GrabExpert(sim_env, sim_env.target))
    for _ in range(30):
        sim_env.step(None, (-0.2, 0.0, 0.2))
    assert sim_env.held_object() == sim_env.target


def test_a_miss_holds_nothing(sim_env: SimEnv) -> None:
    sim_env.reset(2)
    stand_before(sim_env, sim_env.target, random.Random(2), error_m=0.0)
    expert = GrabExpert(sim_env, sim_env.target, offset_m=(0.0, 0.05), retry=False)
    assert not run_expert(sim_env, expert)
    assert sim_env.held_object() is None


def test_opening_the_gripper_lets_go(sim_env: SimEnv) -> None:
    sim_env.reset(1)
    stand_before(sim_env, sim_env.target, random.Random(1))
    assert run_expert(sim_env, GrabExpert(sim_env, sim_env.target))
    joints = list(sim_env.joint_state().values())
    for _ in range(30):
        sim_env.step([*joints[:5], OPEN_RAD])
    assert sim_env.held_object() is None


def test_inverse_kinematics_reaches_the_grasp_zone(sim_env: SimEnv) -> None:
    """The simulated arm is where its solution said."""
    sim_env.reset(1)
    arm = ArmModel(so101(simulated=True))
    rest = dict(zip(ARM_JOINTS, REST_POSE, strict=True))
    spot = SceneConfig().grasp_spot_in_base_m
    for dx in (-0.04, 0.0, 0.04):
        for dy in (-0.04, 0.0, 0.04):
            point = (spot[0] + dx, spot[1] + dy, 0.215)
            place = np.subtract(point, SceneConfig().mount_in_base_m)
            found = arm.reach(TOOL, Pose3(place, np.eye(3)), rest, turning=False)
            assert found.short_m < 0.002
            sim_env.place(sim_env.base_pose(), [*found.joints.values(), rest["gripper"]])
            reached = math.dist(sim_env.gripper_position(), point)
            assert reached == pytest.approx(found.short_m, abs=1e-4)
