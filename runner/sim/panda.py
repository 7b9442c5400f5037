"""The Franka Panda on its Omron mobile base in the simulated scene, from the wheel `robosuite`.

Kinematics, inertias, gripper and collision meshes are the wheel's (MIT); its visual meshes (220,000
faces) are left out, as the SO-101's are. Joint servos take the place of its torque motors. Names in
the model are those of `configs/robots/models/panda_mobile.xml`, whose frames are at the same
places.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any, Final

from vram_arbiter.runner.sim.config import SceneConfig
from vram_arbiter.runner.sim.scene import (
    ROBOT_BITS,
    SEEN_ONLY,
    ArmModelMissing,
    SimBody,
    add_geom,
    load_mujoco,
)

PREFIX: Final = "panda_"
INSTALL: Final = "pip install --no-deps robosuite==1.5.2"
"""Without its dependencies: its pins of mink and OpenCV are not ours; only its files are read."""
REST_POSE: Final = (0.0, -1.35, 0.0, -2.55, 0.0, 1.20, 0.785, 0.04)  # rad, the gripper m
KP, GRIPPER_N = 2000.0, 40.0  # N m/rad; the force of both fingers
_SHELL, _DARK = (0.86, 0.87, 0.90), (0.35, 0.36, 0.40)  # the SO-101's: the scene VLM knows them


def _mjcf(*parts: str) -> Any:
    """Read an MJCF file of the wheel. Raises ArmModelMissing."""
    found = importlib.util.find_spec("robosuite")
    for folder in (found.submodule_search_locations or []) if found is not None else []:
        path = Path(folder).joinpath("models", "assets", *parts)
        if path.is_file():
            return load_mujoco().MjSpec.from_file(str(path))
    raise ArmModelMissing(f"the Panda's model is missing: {INSTALL}")


def _bare(spec: Any) -> Any:
    """Leave out actuators, cameras, sensors and visual meshes; nothing collides by itself."""
    for item in (*spec.actuators, *spec.cameras, *spec.sensors):
        spec.delete(item)
    for geom in [geom for geom in spec.geoms if geom.group == 1]:
        spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in [mesh for mesh in spec.meshes if mesh.name not in used]:
        spec.delete(mesh)
    for geom in spec.geoms:
        geom.group, geom.material = 1, ""
        geom.rgba = [*_SHELL, 1]
        for field, value in SEEN_ONLY.items():
            setattr(geom, field, value)
    for site in spec.sites:
        site.group = 4  # not drawn
    for body in spec.bodies:
        body.gravcomp = 1.0  # the servos hold the robot's own weight; what is grasped still pulls
    return spec


def _arm() -> Any:
    spec = _bare(_mjcf("robots", "panda", "robot.xml"))
    for joint in spec.joints:
        joint.armature = 0.1
        actuator = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=load_mujoco().mjtTrn.mjTRN_JOINT
        )
        actuator.set_to_position(kp=KP, dampratio=1.0)
        actuator.ctrllimited, actuator.ctrlrange = True, joint.range
    return spec


def _gripper() -> Any:
    """Return the gripper as one joint, `gripper`: the way of a finger, which the other mirrors."""
    mujoco = load_mujoco()
    spec = _bare(_mjcf("grippers", "panda_gripper.xml"))
    leader = spec.joint("finger_joint1")
    leader.name = "gripper"
    mirror = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1="finger_joint2",
        name2="gripper",
    )
    mirror.data[:2] = 0.0, -1.0
    actuator = spec.add_actuator(
        name="gripper", target="gripper", trntype=mujoco.mjtTrn.mjTRN_JOINT
    )
    actuator.set_to_position(kp=1000.0)
    actuator.ctrllimited, actuator.ctrlrange = True, leader.range
    actuator.forcelimited, actuator.forcerange = True, [-GRIPPER_N, GRIPPER_N]
    for geom in spec.geoms:
        solid = geom.name.endswith("pad_collision") or geom.name == "hand_collision"
        for field, value in (ROBOT_BITS if solid else SEEN_ONLY).items():
            setattr(geom, field, value)
        if geom.name.startswith("finger"):
            geom.rgba = [*_DARK, 1]
            geom.condim, geom.priority, geom.friction = 6, 1, [2.0, 0.05, 0.002]
    return spec


def _attach(spec: Any, base: Any, config: SceneConfig) -> None:
    """Put the Omron's platform, the camera's mast, the arm and its gripper on the planar base."""
    platform = _bare(_mjcf("bases", "omron_mobile_base.xml"))
    for joint in list(platform.joints):
        platform.delete(joint)
    for geom in platform.geoms:
        if geom.name == "pedestal_feet_col":
            for field, value in ROBOT_BITS.items():
                setattr(geom, field, value)
    spec.attach(platform, frame=base.add_frame(), prefix="omron_")
    eye = config.cameras["front"].pos_m
    mast = [0.0, eye[1], 0.38, eye[0] - 0.03, eye[1], eye[2]]
    add_geom(base, "CAPSULE", (0.3, 0.3, 0.33), SEEN_ONLY, size=[0.012, 0, 0], fromto=mast)
    spec.attach(_arm(), frame=base.add_frame(pos=list(config.mount_in_base_m)), prefix=PREFIX)
    spec.attach(_gripper(), frame=spec.body(PANDA_MOBILE.hand).add_frame(), prefix=PREFIX)


PANDA_MOBILE: Final = SimBody(
    joints=(*(f"{PREFIX}joint{number}" for number in range(1, 8)), f"{PREFIX}gripper"),
    rest_pose=REST_POSE,
    attach=_attach,
    hand=f"{PREFIX}right_hand",
    grasp_site=f"{PREFIX}grip_site",
    fingers=(f"{PREFIX}finger1_pad_collision", f"{PREFIX}finger2_pad_collision"),
)
