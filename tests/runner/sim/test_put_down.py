"""`so101-put-down` in the simulator, through the gate: what was grasped stands where it stood, and
the arm is out of the way.
"""

import asyncio
import random
from importlib.util import find_spec
from pathlib import Path

import pytest

if find_spec("mujoco") is None:
    pytest.skip("needs the full install", allow_module_level=True)

from vram_arbiter.runner.protocols import Act, Done, Goal
from vram_arbiter.runner.sim.config import ARM_JOINTS, REST_POSE
from vram_arbiter.runner.sim.expert import GrabExpert
from vram_arbiter.runner.sim.tasks import stand_before
from vram_arbiter.runner.sim.worlds import so101_world
from vram_arbiter.runner.skills.trajectory import FollowJointTrajectory
from vram_arbiter.schemas.manifest import load_manifest

pytestmark = pytest.mark.heavy

MANIFEST = load_manifest(Path(__file__).parents[3] / "configs/rskills/so101-put-down/rskill.yaml")
TICKS_MAX = 300


@pytest.mark.parametrize("shape", ["cube", "ball", "cylinder"])
def test_what_was_grasped_stands_again_where_the_arm_takes_things_from(shape: str) -> None:
    environment = so101_world(None)
    env = environment.arm
    try:
        environment.reset(7)
        env.reset(7, names=(f"red {shape}", "blue cube"))
        stand_before(env, env.target, random.Random(shape), error_m=0.005)
        expert = GrabExpert(env, env.target)
        while not expert.done:
            environment.step(environment.action_of(environment.toward(expert.act())))
        assert env.held_object() == env.target

        skill = FollowJointTrajectory(
            MANIFEST, environment.limits_for(MANIFEST), period_s=1 / 30, sent=environment.sent
        )
        asyncio.run(skill.start(Goal("g", MANIFEST.name)))
        gate = environment.gate(skill)
        carried_m: list[float] = []
        for tick in range(TICKS_MAX):
            seen = environment.observe(tick, None)
            outcome = skill.step(seen)
            if isinstance(outcome, Done):
                break
            assert isinstance(outcome, Act)
            allowed, problems = gate.check(outcome.action, seen)
            assert allowed is not None, problems
            # the gate counts a first step from where a joint is: the grip is back within a tenth of
            # a second
            assert not problems or (
                tick < 4 and all(one.startswith("gripper") for one in problems)
            ), problems
            environment.step(allowed)
            if tick < 30:
                carried_m.append(env.ground_truth().objects[env.target].lift_m)
        else:
            pytest.fail(f"not done after {TICKS_MAX} ticks")

        truth = env.ground_truth()
        x, y, _ = truth.objects[env.target].position_base
        spot_x, spot_y = env.config.grasp_spot_in_base_m
        assert min(carried_m) > 0.03, "it is carried down, not dropped"
        assert truth.held is None
        assert abs(truth.objects[env.target].lift_m) < 0.003
        assert (abs(x - spot_x) < 0.02, abs(y - spot_y) < 0.02) == (True, True), (x, y)
        rest = dict(zip(ARM_JOINTS, REST_POSE, strict=True))
        assert env.joint_state() == pytest.approx(rest, abs=0.05)
    finally:
        env.close()
