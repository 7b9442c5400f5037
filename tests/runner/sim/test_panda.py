"""The simulated Panda on its mobile base: the model's places, a pick by the 12-slot contract."""

import random
from collections.abc import Iterator
from importlib.util import find_spec

import pytest

if find_spec("mink") is None:
    pytest.skip("needs the full install", allow_module_level=True)

from training.record_counter import MANIFEST, pick
from vram_arbiter.runner.robots.models import load_model
from vram_arbiter.runner.sim.arm_env import ArmEnvironment, SimulatedTime
from vram_arbiter.runner.sim.navigate import standoff_pose
from vram_arbiter.runner.sim.scene import load_mujoco
from vram_arbiter.runner.sim.worlds import panda_world
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.sidecars.adapters.scripted_pick import Phase, ScriptedPickAdapter

pytestmark = [
    pytest.mark.heavy,
    pytest.mark.skipif(
        find_spec("robosuite") is None, reason="needs robosuite's files: .ci/setup full"
    ),
]


@pytest.fixture
def panda() -> Iterator[ArmEnvironment]:
    world = panda_world(None)
    yield world
    world.arm.close()


def grab_target(world: ArmEnvironment, seed: int) -> list[Phase]:
    """Grab the target of a seed from 2 cm beside the grasp spot; return the phases of the chunks.

    Observations, chunks, rows and the gate are those of a goal; only the socket is left out.
    """
    manifest = load_manifest(MANIFEST)
    env, rng, policy = world.arm, random.Random(seed), ScriptedPickAdapter(manifest)
    world.reset(seed)
    x, y, _ = env.ground_truth().objects[env.target].position_map
    goal = standoff_pose((x, y), env.config)
    env.place((goal.x_m + 0.02, goal.y_m - 0.02, goal.yaw_rad + rng.uniform(-0.05, 0.05)))
    gate = SimulatedTime(world._gate.for_skill(manifest, ()), env)
    phases = []
    for asked in pick(world, manifest, policy, env.target):
        phases.append(policy._phase)
        action, refused = gate.check(asked, world.observe(0, None))
        assert action is not None, refused
        world.step(action)
    return phases


def test_the_scene_has_the_frames_of_the_model_that_contracts_are_solved_on(
    panda: ArmEnvironment,
) -> None:
    """Frames of another place would bend every Cartesian step, without an error."""
    mujoco, env = load_mujoco(), panda.arm
    env.reset(0)
    env.place((0.0, 0.0, 0.0))
    model = load_model(panda.robot)
    data = mujoco.MjData(model)
    for name, angle in env.joint_state().items():
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_forward(model, data)
    for link in ("panda_link0", "panda_link4", "panda_link7"):
        assert env._data.body(link).xpos == pytest.approx(data.body(link).xpos, abs=1e-3)
    # robosuite's grip site lies 6.9 mm before the tool center point of the robot's description
    tool = data.site("panda_hand_tcp").xpos
    assert env._data.site("panda_grip_site").xpos == pytest.approx(tool, abs=8e-3)
    assert set(env.seen_objects("front")) == {thing.name for thing in env.layout.objects}


def test_the_episodes_video_shows_robot_and_objects(panda: ArmEnvironment) -> None:
    """Regression: its camera stood behind the kitchen's wall, and the video showed that wall."""
    panda.arm.reset(0)
    seen = panda.arm.seen_objects("overview")
    assert set(seen) == {thing.name for thing in panda.arm.layout.objects}


def test_the_base_drives_and_stays_before_the_counter(panda: ArmEnvironment) -> None:
    env = panda.arm
    env.reset(0)
    env.place((0.0, 0.0, 0.0))
    for _ in range(30):
        env.step(None, (0.3, 0.1, 0.2))
    x, y, yaw = env.base_pose()
    assert (x, y) == pytest.approx((0.29, 0.13), abs=0.03)
    assert yaw == pytest.approx(0.2, abs=0.02)
    ahead = standoff_pose((9.0, 0.0), env.config).x_m + env.config.base_front_of_mount_m
    assert ahead < env.config.table_edge_x_m


def test_the_script_grabs_by_the_twelve_slots_through_the_gate(panda: ArmEnvironment) -> None:
    phases = grab_target(panda, 2)
    assert panda.arm.held_object() == panda.arm.target
    assert phases == sorted(phases, key=list(Phase).index)
    assert set(phases) == set(Phase), "the base is driven first, then the arm moves"


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(10))
def test_ten_seeds(panda: ArmEnvironment, seed: int) -> None:
    grab_target(panda, seed)
    assert panda.arm.held_object() == panda.arm.target
