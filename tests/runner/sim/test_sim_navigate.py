"""Navigation reaches its pose and never drives into the table."""

import math
from importlib.util import find_spec

import pytest

if find_spec("mujoco") is None:
    pytest.skip("needs the full install", allow_module_level=True)

from vram_arbiter.runner.sim.config import SceneConfig
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.navigate import (
    PlanarController,
    Pose2D,
    front_reach_m,
    standoff_pose,
    to_map,
)

pytestmark = pytest.mark.heavy


def drive_to(sim_env: SimEnv, controller: PlanarController, limit: int = 300) -> int:
    for step in range(limit):
        pose = Pose2D(*sim_env.base_pose())
        if controller.reached(pose):
            return step
        sim_env.step(None, controller.command(pose))
        assert (
            pose.x_m + front_reach_m(sim_env.config, pose.yaw_rad) < sim_env.config.table_edge_x_m
        )
    return limit


@pytest.mark.parametrize("seed", range(3))
def test_reaches_the_standoff_of_every_object(sim_env: SimEnv, seed: int) -> None:
    sim_env.reset(seed)
    for truth in sim_env.ground_truth().objects.values():
        goal = standoff_pose(truth.position_map[:2], sim_env.config)
        assert drive_to(sim_env, PlanarController(goal, sim_env.config)) < 200
        for _ in range(6):
            sim_env.step(None)
        x, y, yaw = sim_env.base_pose()
        assert math.dist((x, y), (goal.x_m, goal.y_m)) < 0.01
        assert abs(yaw) < 0.02
        spot = sim_env.ground_truth().objects[truth.name].position_base
        assert math.dist(spot[:2], sim_env.config.grasp_spot_in_base_m) < 0.02


def test_a_target_deep_on_the_table_stops_before_the_edge(sim_env: SimEnv) -> None:
    sim_env.reset(0)
    goal = standoff_pose((5.0, 0.0), sim_env.config)
    drive_to(sim_env, PlanarController(goal, sim_env.config))
    assert (
        sim_env.base_pose()[0] + front_reach_m(sim_env.config, 0.0) < sim_env.config.table_edge_x_m
    )


def test_a_goal_inside_the_table_is_never_driven_to(sim_env: SimEnv) -> None:
    sim_env.reset(0)
    assert (
        drive_to(sim_env, PlanarController(Pose2D(1.0, 0.0, 0.0), sim_env.config), limit=150) == 150
    )


def test_a_goal_that_turns_is_reached(sim_env: SimEnv) -> None:
    sim_env.reset(0)
    assert drive_to(sim_env, PlanarController(Pose2D(-0.2, 0.3, 1.2), sim_env.config)) < 200


def test_to_map_turns_and_shifts() -> None:
    assert to_map(Pose2D(1.0, 2.0, math.pi / 2), 0.5, 0.25) == pytest.approx((0.75, 2.5))


def test_the_front_reach_grows_with_the_turn() -> None:
    config = SceneConfig()
    assert front_reach_m(config, 0.3) > front_reach_m(config, 0.0)
