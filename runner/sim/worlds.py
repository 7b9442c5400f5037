"""Worlds that the runner can simulate (`--env`), with their cameras, joints and skills.

`so101` is our own scene, `gym:ID` any gymnasium environment, a preset one of the field's. Nothing
is simulated here: `World.make` does that, on the control thread.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from vram_arbiter.runner.goals.catalogue import Maker, sidecar_endpoint
from vram_arbiter.runner.protocols import GoalData, MobileBase, RobotDescription, Skill
from vram_arbiter.runner.robots.body import SIMULATED
from vram_arbiter.runner.robots.so101 import so101
from vram_arbiter.runner.robots.so101_kinematics import kinematics_for
from vram_arbiter.runner.sim.arm_env import ArmEnvironment
from vram_arbiter.runner.sim.config import ARM_JOINTS, CONTROL_HZ, REST_POSE, SceneConfig
from vram_arbiter.runner.sim.env import MAX_BASE_SPEED_M_S, MAX_BASE_TURN_RAD_S, SimEnv
from vram_arbiter.runner.sim.environment import Environment
from vram_arbiter.runner.sim.gym_config import RENDER, GymConfig
from vram_arbiter.runner.sim.gym_env import GymEnv
from vram_arbiter.runner.sim.presets import PRESETS, preset_of
from vram_arbiter.runner.skills.ros_standins import NAVIGATE, TRAJECTORY, StandIn, StandIns
from vram_arbiter.schemas.body import Body
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import ConfigError, ManifestInvalid
from vram_arbiter.schemas.manifest import Kind, RSkillManifest

SO101: Final = "so101"
GYM: Final = "gym:"
OVERVIEW: Final = "overview"  # for people; where a scene has none, another camera
OBSERVATION_CAMERAS: Final = ("front", "wrist")  # the first is the default one


@dataclass(frozen=True, slots=True)
class World:
    """One choice of `--env`.

    `cameras` None: those of the environment. `arm`, `scene`, `environment` and `robot` are those of
    our own scene. `joints` are what a policy sees and moves, in the policy's order; `rest` is its
    start (rad), None: wherever a reset leaves the world.
    """

    name: str
    make: Callable[[], Environment]
    cameras: tuple[str, ...] | None
    video_camera: str
    video_every: int  # ticks
    joints: tuple[str, ...]
    rest: Mapping[str, float] | None
    body: Body | None
    identity: GoalData = field(default_factory=dict)
    scene: SceneConfig | None = None
    arm: SimEnv | None = None
    environment: ArmEnvironment | None = None
    robot: RobotDescription | None = None
    control_hz: float = float(CONTROL_HZ)  # its steps a second
    max_steps: int | None = None  # of an episode of a benchmark; None: as it is asked for
    instruction: str = ""  # the task in words; our own scene's is its task's, by the seed


def so101_world(scene_file: Path | None) -> World:
    """Return our own scene as a world. Raises ConfigError for a scene that cannot be read."""
    scene = SceneConfig.load(scene_file)
    arm = SimEnv(scene)  # renders only on the control thread, from its first reset on
    cameras = tuple(name for name in OBSERVATION_CAMERAS if name in scene.cameras)
    base = MobileBase(MAX_BASE_SPEED_M_S, MAX_BASE_TURN_RAD_S, mount_m=scene.mount_in_base_m)
    robot = so101(simulated=True, base=base)
    environment = ArmEnvironment(arm, robot, kinematics=kinematics_for(robot), cameras=cameras)
    return World(
        name=SO101,
        make=lambda: environment,
        cameras=cameras,
        video_camera=next(
            (name for name in (OVERVIEW, *scene.cameras) if name in scene.cameras), OVERVIEW
        ),
        video_every=3,  # ten pictures a second at 30 Hz
        joints=ARM_JOINTS,
        rest=dict(zip(ARM_JOINTS, REST_POSE, strict=True)),
        body=SIMULATED,
        identity={"robot": "so101-mobile", "scene": str(scene_file or "built-in")},
        scene=scene,
        arm=arm,
        environment=environment,
        robot=robot,
    )


def gym_world(env_id: str, config: GymConfig, *, render: bool | None) -> World:
    """`render` as in `GymEnv`. What is wrong with the id shows when the world is made."""
    tags = config.embodiment_tags
    return World(
        name=GYM + env_id,
        make=lambda: GymEnv(env_id, config, render=render),
        cameras=None,
        video_camera=RENDER,
        video_every=1,
        joints=config.actions if config.control_mode is ControlMode.JOINT_POSITION else (),
        rest=None,
        body=Body(embodiment_tags=tags) if tags else None,
        identity={"robot": GYM + env_id, "scene": env_id},
        instruction=config.instruction,
    )


def world_of(
    env: str,
    *,
    scene: Path | None = None,
    env_config: Path | None = None,
    success: str | None = None,
    render: bool | None = None,
) -> World:
    """Return the world of `--env` and its flags. Raises ConfigError for flags that contradict."""
    if env == SO101:
        if env_config is not None or success is not None:
            raise ConfigError(
                "--env-config and --success are for --env gym:ID; the scene file is --scene"
            )
        return so101_world(scene)
    preset = preset_of(env)
    if preset is None and (not env.startswith(GYM) or env == GYM):
        known = ", ".join(PRESETS)
        raise ConfigError(
            f"unknown --env {env}", hint=f"so101, {known}, or gym:ID, e.g. gym:CartPole-v1"
        )
    if scene is not None:
        raise ConfigError(f"--scene is for --env {SO101}; a gymnasium environment has --env-config")
    config = GymConfig() if preset is None else preset.config
    if env_config is not None:
        config = GymConfig.load(env_config)
    if success is not None:
        config = config.with_success(success)
    if preset is None:
        return gym_world(env.removeprefix(GYM), config, render=render)
    return replace(
        gym_world(preset.env_id, config, render=render),
        name=env,
        control_hz=preset.control_hz,
        max_steps=preset.max_steps,
        instruction=config.instruction or preset.instruction,
    )


def makers_of(
    world: World,
    given: Mapping[str, str],
    arbiter: Any,
    *,
    period_s: float,
    wait_s: float,
    latency_steps: int | None = None,
) -> dict[Kind, Maker]:
    """Return the makers of the skills that can act in this world; as `SidecarPolicy`."""
    from vram_arbiter.clients.sidecar.policy import PolicyClient
    from vram_arbiter.runner.skills.navigate import Navigate
    from vram_arbiter.runner.skills.sidecar_policy import SidecarPolicy
    from vram_arbiter.runner.skills.trajectory import FollowJointTrajectory
    from vram_arbiter.runner.skills.wiring import wire_up

    def make_policy(manifest: RSkillManifest) -> Skill:
        if not world.joints:
            raise ManifestInvalid(
                f"{manifest.name} moves joints, and {world.name} names none",
                hint="name them in the environment's file: `joints`, `actions`,"
                " control_mode joint_position",
            )
        wiring = wire_up(manifest, world.robot or world.joints, world.rest)
        client = PolicyClient(sidecar_endpoint(manifest.name, given, os.environ))
        speeds, sent = None, None
        if world.environment is not None:
            speeds, sent = (
                world.environment.limits_for(manifest).speeds_rad_s,
                world.environment.sent,
            )
        return SidecarPolicy(
            manifest,
            wiring,
            client,
            arbiter,
            period_s=period_s,
            wait_s=wait_s,
            latency_steps=latency_steps,
            speeds_rad_s=speeds,
            sent=sent,
        )

    scene, environment = world.scene, world.environment
    if scene is None or environment is None:
        return {Kind.VLA: make_policy}
    joint, twist = ControlMode.JOINT_POSITION, ControlMode.BODY_TWIST
    known = {
        NAVIGATE: StandIn(
            lambda manifest: Navigate(manifest, scene, period_s=period_s), frozenset({twist, joint})
        ),
        TRAJECTORY: StandIn(
            lambda manifest: FollowJointTrajectory(
                manifest, environment.limits_for(manifest), period_s=period_s, sent=environment.sent
            ),
            frozenset({joint}),
        ),
    }
    return {Kind.VLA: make_policy, Kind.ROS_ACTION: StandIns(known, world.joints)}
