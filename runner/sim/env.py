"""One simulated robot before one table: step it, look through its cameras, ask for the truth.

The whole episode follows from the seed. An env belongs to one thread: MuJoCo's EGL contexts are
bound to the thread that made them. Must not know policies, skills, goals or the arbiter.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from vram_arbiter.runner.planar import drive
from vram_arbiter.runner.sim.config import (
    BASE_JOINTS,
    CONTROL_DT_S,
    SceneConfig,
    wrap_angle,
)
from vram_arbiter.runner.sim.layout import Layout, make_layout
from vram_arbiter.runner.sim.scene import SO101, SimBody, build_model, load_mujoco
from vram_arbiter.schemas.world import CameraModel

if TYPE_CHECKING:
    from mujoco import Renderer

HELD_LIFT_M = (
    0.03  # a thing is held when its centre is this far above where it would rest on the table
)
MAX_BASE_SPEED_M_S = 0.5
MAX_BASE_TURN_RAD_S = 1.2
CENTRE_HEIGHT_M = 0.0165  # mean height of an object's centre above the table, over the vocabulary
SETTLE_STEPS = 6


@dataclasses.dataclass(frozen=True, slots=True)
class ObjectTruth:
    """An object's center in the map and base frames (m), its turn about the vertical, its lift."""

    name: str
    position_map: tuple[float, float, float]
    position_base: tuple[float, float, float]
    yaw_base_rad: float
    lift_m: float
    touching_fingers: int


@dataclasses.dataclass(frozen=True, slots=True)
class GroundTruth:
    """What is really so, for evaluation, datasets and the demo's verdict; no skill may read it."""

    objects: dict[str, ObjectTruth]
    base_pose: tuple[float, float, float]
    held: str | None
    target: str


@dataclasses.dataclass(frozen=True, slots=True)
class SeenObject:
    """An object in an image: its box (x_min, y_min, x_max, y_max; pixels, max exclusive) and
    size.
    """

    name: str
    box: tuple[int, int, int, int]
    pixels: int


class SimEnv:
    """A robot on a planar base, stepped at 30 Hz.

    Arm targets are joint positions (rad, m) in the order of `robot.joints`; base velocities are
    (vx, vy, wz) in the base's own frame, in m/s and rad/s. Call `close` (or use `with`) in the
    thread that rendered.
    """

    def __init__(self, config: SceneConfig | None = None, robot: SimBody = SO101) -> None:
        self.config = config or SceneConfig()
        self.robot = robot
        self._renderers: dict[str, Renderer] = {}
        self._layout: Layout | None = None
        self._model: Any = None
        self._data: Any = None
        self.steps = 0  # control steps since the reset

    # -- life
    def reset(self, seed: int, *, names: tuple[str, ...] | None = None) -> None:
        """Build the scene of a seed and let it settle; the arm is at rest, the base at its
        start.
        """
        mujoco = load_mujoco()

        self.close()
        self._layout = make_layout(seed, self.config, names=names)
        self._model = build_model(self._layout, self.config, self.robot)
        self._data = mujoco.MjData(self._model)
        self._substeps = round(CONTROL_DT_S / self.config.timestep_s)
        joints = [self.robot.prefix + name for name in self.robot.joints]
        self._arm_q = [int(self._model.joint(n).qposadr[0]) for n in joints]
        self._arm_v = [int(self._model.joint(n).dofadr[0]) for n in joints]
        self._arm_u = [int(self._model.actuator(n).id) for n in joints]
        self._arm_range = self._model.actuator_ctrlrange[self._arm_u].copy()
        self._base_q = [int(self._model.joint(n).qposadr[0]) for n in BASE_JOINTS]
        self._base_u = [int(self._model.actuator(n).id) for n in BASE_JOINTS]
        self._base_body = int(self._model.body("base_link").id)
        self._fingers = tuple(int(self._model.geom(n).id) for n in self.robot.fingers)
        self._geom_of = {o.name: int(self._model.geom(o.name).id) for o in self._layout.objects}
        self.place(self._layout.base_start, self.robot.rest_pose)
        for _ in range(SETTLE_STEPS):
            self.step(None, None)
        self.steps = 0

    def place(self, base_pose: Sequence[float], arm: Sequence[float] | None = None) -> None:
        """Teleport base (x, y, yaw) and optionally the arm; for datasets, tests and evaluation
        only.
        """
        mujoco = load_mujoco()

        data = self._data
        data.qpos[self._base_q] = data.ctrl[self._base_u] = base_pose
        if arm is not None:
            data.qpos[self._arm_q] = data.ctrl[self._arm_u] = arm
            data.qvel[self._arm_v] = 0.0
        mujoco.mj_forward(self._model, self._data)

    def close(self) -> None:
        """Give the rendering contexts back. The env can be reset again afterwards."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # -- acting
    def step(
        self,
        arm_target: Mapping[str, float] | Sequence[float] | None,
        base_velocity: Sequence[float] | None = None,
    ) -> None:
        """Advance 1/30 s. None keeps the last arm target, or stands still.

        Joint targets are clipped to the servos' ranges, base speeds to the platform's. Raises
        ValueError for a wrong number of values or one that is not finite, and KeyError for a
        missing joint; nothing has moved then.
        """
        mujoco = load_mujoco()

        twist = [0.0, 0.0, 0.0]
        if base_velocity is not None:
            twist = _finite(base_velocity, 3, "a base velocity (vx, vy, wz)")
        if isinstance(arm_target, Mapping):
            arm_target = [arm_target[name] for name in self.robot.joints]
        if arm_target is not None:
            values = _finite(arm_target, len(self.robot.joints), "an arm target in rad")
            self._data.ctrl[self._arm_u] = values
            self._data.ctrl[self._arm_u] = self._data.ctrl[self._arm_u].clip(*self._arm_range.T)
        speed = math.hypot(twist[0], twist[1])
        shrink = min(1.0, MAX_BASE_SPEED_M_S / speed) if speed > 0 else 1.0
        turn = min(max(twist[2], -MAX_BASE_TURN_RAD_S), MAX_BASE_TURN_RAD_S)
        velocity = (shrink * twist[0], shrink * twist[1], turn)
        for _ in range(self._substeps):
            drive(self._data.ctrl, self._base_u, velocity, self.config.timestep_s)
            mujoco.mj_step(self._model, self._data)
        mujoco.mj_forward(self._model, self._data)
        self.steps += 1

    # -- state the robot itself knows
    @property
    def time_s(self) -> float:
        """Simulated seconds since the scene was built."""
        return float(self._data.time)

    @property
    def target(self) -> str:
        """Name of the object this episode is about."""
        return self.layout.target

    @property
    def layout(self) -> Layout:
        """The seeded layout of the running episode. Raises RuntimeError before the first reset."""
        if self._layout is None:
            raise RuntimeError("call reset(seed) before using the simulator")
        return self._layout

    def joint_state(self) -> dict[str, float]:
        """Measured arm joint angles in rad, by name, in the order of `robot.joints`."""
        return dict(zip(self.robot.joints, self._data.qpos[self._arm_q].tolist(), strict=True))

    def joint_velocity(self) -> dict[str, float]:
        """Measured arm joint velocities in rad/s, by name."""
        return dict(zip(self.robot.joints, self._data.qvel[self._arm_v].tolist(), strict=True))

    def base_pose(self) -> tuple[float, float, float]:
        """Odometry: x, y (m) and yaw (rad) of the base in the map frame."""
        x, y, yaw = self._data.qpos[self._base_q].tolist()
        return x, y, wrap_angle(yaw)

    def gripper_position(self) -> tuple[float, float, float]:
        """Return the grasp point between the fingers, in the base frame (forward kinematics)."""
        return self._to_base(self._data.site(self.robot.grasp_site).xpos)

    # -- cameras
    def render(self, camera: str) -> Any:
        """RGB image, uint8, height × width × 3. Raises KeyError for an unknown camera."""
        mujoco = load_mujoco()

        spec = self.config.cameras[camera]
        renderer = self._renderer(camera)
        renderer.update_scene(self._data, camera)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = int(spec.shadows)
        return renderer.render().copy()

    def camera_model(self, camera: str) -> CameraModel:
        """Intrinsics and present pose of a camera in the base frame.

        The support plane is the one through the middles of things that stand on the table, so that
        the ray through the middle of a box meets it where the thing is.
        """
        import numpy as np

        spec = self.config.cameras[camera]
        focal = spec.height_px / 2.0 / math.tan(math.radians(spec.fovy_deg) / 2.0)
        seen = self._data.camera(camera)
        # MuJoCo looks along -z with y up; the pinhole convention is z forward, y down.
        axes = np.asarray(seen.xmat).reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
        rotation = self._base_rotation().T @ axes
        position = self._to_base(seen.xpos)
        rows = [(*(float(v) for v in rotation[i]), position[i]) for i in range(3)]
        return CameraModel(
            K=(
                (focal, 0.0, spec.width_px / 2.0),
                (0.0, focal, spec.height_px / 2.0),
                (0.0, 0.0, 1.0),
            ),
            T_base_camera=(rows[0], rows[1], rows[2], (0.0, 0.0, 0.0, 1.0)),
            support_plane_z=self.config.table_top_z_m + CENTRE_HEIGHT_M,
            base_pose=self.base_pose(),
            fixed=spec.parent == "base",
        )

    def seen_objects(self, camera: str) -> dict[str, SeenObject]:
        """Truth about an image: boxes of the objects' visible pixels, by segmentation."""
        import numpy as np

        renderer = self._renderer(camera)
        renderer.enable_segmentation_rendering()
        renderer.update_scene(self._data, camera)
        ids = renderer.render()[:, :, 0].copy()
        renderer.disable_segmentation_rendering()
        seen = {}
        for name, geom in self._geom_of.items():
            ys, xs = np.nonzero(ids == geom)
            if len(xs):
                box = (int(xs.min()), int(ys.min()), int(xs.max()) + 1, int(ys.max()) + 1)
                seen[name] = SeenObject(name, box, len(xs))
        return seen

    def _renderer(self, camera: str) -> Any:
        mujoco = load_mujoco()

        spec = self.config.cameras[camera]
        if camera not in self._renderers:
            self._model.vis.quality.offsamples = spec.samples
            self._renderers[camera] = mujoco.Renderer(self._model, spec.height_px, spec.width_px)
        return self._renderers[camera]

    # -- truth
    def ground_truth(self) -> GroundTruth:
        """Return where everything really is, and what the gripper really holds."""
        objects = {o.name: self._truth(o.name, o.rest_z_m) for o in self.layout.objects}
        held = [t for t in objects.values() if t.touching_fingers == 2 and t.lift_m >= HELD_LIFT_M]
        name = max(held, key=lambda t: t.lift_m).name if held else None
        return GroundTruth(objects, self.base_pose(), name, self.target)

    def held_object(self) -> str | None:
        """Return the object between both fingers with its center at least 3 cm above its rest; else
        None.
        """
        return self.ground_truth().held

    def _truth(self, name: str, rest_z_m: float) -> ObjectTruth:
        body = self._data.body(name)
        position = tuple(float(v) for v in body.xpos)
        turn = self._base_rotation().T @ body.xmat.reshape(3, 3)
        touching = {
            finger
            for contact in self._data.contact
            for finger in self._fingers
            if {int(contact.geom1), int(contact.geom2)} == {finger, self._geom_of[name]}
        }
        return ObjectTruth(
            name=name,
            position_map=(position[0], position[1], position[2]),
            position_base=self._to_base(body.xpos),
            yaw_base_rad=math.atan2(float(turn[1, 0]), float(turn[0, 0])),
            lift_m=position[2] - self.config.table_top_z_m - rest_z_m,
            touching_fingers=len(touching),
        )

    def _base_rotation(self) -> Any:
        return self._data.xmat[self._base_body].reshape(3, 3)

    def _to_base(self, point: Any) -> tuple[float, float, float]:
        local = self._base_rotation().T @ (point - self._data.xpos[self._base_body])
        return float(local[0]), float(local[1]), float(local[2])


def _finite(values: Sequence[float], count: int, what: str) -> list[float]:
    numbers = [float(value) for value in values]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{what} is {count} finite numbers, not {numbers}")
    return numbers
