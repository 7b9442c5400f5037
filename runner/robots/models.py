"""MuJoCo models of robots, for frames and kinematics."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.sim.scene import arm_spec, load_mujoco
from vram_arbiter.schemas.errors import ConfigError

SO101_MODEL = "so101"


def frames_of(model: Any) -> tuple[str, ...]:
    """Return the names of a model's frames: its bodies and sites."""
    named = [model.body(i).name for i in range(model.nbody)]
    named += [model.site(i).name for i in range(model.nsite)]
    return tuple(name for name in named if name)


def load_model(robot: RobotDescription) -> Any:
    """Return the compiled `mujoco.MjModel` of a robot whose `model` is given.

    Raises ConfigError: MuJoCo is missing, the file cannot be read, or it lacks a joint.
    """
    if importlib.util.find_spec("mujoco") is None:
        raise ConfigError(
            f"the frames of {robot.name} need MuJoCo: pip install 'vram-arbiter[runner]'"
        )
    mujoco = load_mujoco()
    if robot.model == SO101_MODEL:
        return arm_spec(mujoco).compile()
    try:
        model = mujoco.MjModel.from_xml_path(robot.model)
    except (ValueError, OSError) as error:
        raise ConfigError(f"the model {Path(robot.model).name} cannot be read: {error}") from error
    kind = mujoco.mjtObj.mjOBJ_JOINT
    wanted = [*robot.joint_names, *(robot.base.joints if robot.base else ())]
    if missing := [name for name in wanted if mujoco.mj_name2id(model, kind, name) < 0]:
        raise ConfigError(
            f"the model {Path(robot.model).name} has no joint {', '.join(missing)}",
            hint="name joints as the model does, each a hinge or a slide",
        )
    return model
