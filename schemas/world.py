"""What a robot sees, is and does: frames, joint states, world states, actions, ticks, detections.

Plain values that cross process borders. No robot, camera or model is known here, and nothing is
ever filled in: a missing or misshapen value is refused, because a fabricated one moves an arm.
Lengths in metres, angles in radians, stamps in nanoseconds, pixels from the upper left corner.
"""

import base64
import binascii
import math
from enum import StrEnum
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    field_serializer,
    field_validator,
    model_validator,
)

from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.plain import JsonObject

Finite = Annotated[float, Field(allow_inf_nan=False)]
UnitInterval = Annotated[float, Field(ge=0, le=1)]
Milliseconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Nanoseconds = Annotated[int, Field(ge=0)]

Vector3 = tuple[Finite, Finite, Finite]
Quaternion = tuple[Finite, Finite, Finite, Finite]
Twist = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
"""vx, vy, vz in m/s, then wx, wy, wz in rad/s."""
Index = Annotated[int, Field(ge=0, strict=True)]
Box2d = tuple[Finite, Finite, Finite, Finite]
"""x_min, y_min, x_max, y_max in pixels."""
Matrix3 = tuple[Vector3, Vector3, Vector3]
"""3 × 3, row-major."""
Matrix4 = tuple[Quaternion, Quaternion, Quaternion, Quaternion]
"""4 × 4, row-major."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


# -- cameras
class FrameEncoding(StrEnum):
    """How the bytes of a frame are to be read."""

    BGR8 = "bgr8"
    RGB8 = "rgb8"
    MONO8 = "mono8"
    DEPTH16 = "depth16"
    JPEG = "jpeg"
    PNG = "png"
    RAW = "raw"


_BYTES_PER_PIXEL = {
    FrameEncoding.BGR8: 3,
    FrameEncoding.RGB8: 3,
    FrameEncoding.MONO8: 1,
    FrameEncoding.DEPTH16: 2,
}


class SensorFrame(_Frozen):
    """One picture of one camera: its bytes, or the topic where they are.

    Exactly one of `data` and `topic` is set; empty bytes and empty texts count as unset. `handle`
    is of the field's wire, for memory of a device: nothing here makes or takes one.
    `data` is bytes in Python and msgpack, standard base64 in JSON. Uncompressed data must have
    exactly the bytes that width, height and encoding ask for.
    """

    sensor_id: Annotated[str, Field(min_length=1)]
    stamp_monotonic_ns: Nanoseconds
    stamp_wall_ns: Nanoseconds
    encoding: FrameEncoding
    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]
    channels: Annotated[int, Field(gt=0)] = 3
    data: bytes | None = None
    topic: str | None = None
    handle: None = None
    metadata: JsonObject = {}

    @field_validator("data", mode="before")
    @classmethod
    def _decode(cls, value: object) -> object:
        if isinstance(value, str):
            try:
                value = base64.b64decode(value, validate=True)
            except binascii.Error as error:
                raise ValueError(f"must be standard base64: {error}") from error
        elif isinstance(value, bytearray | memoryview):
            value = bytes(value)
        return None if value == b"" else value

    @field_validator("topic", "handle", mode="before")
    @classmethod
    def _empty_is_unset(cls, value: object) -> object:
        return None if value == "" else value

    @field_serializer("data", when_used="json")
    def _encode(self, data: bytes | None) -> str | None:
        return None if data is None else base64.b64encode(data).decode("ascii")

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = [name for name in ("data", "topic") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"exactly one of data and topic must be set, not {', '.join(given) or 'none'}"
            )
        per_pixel = _BYTES_PER_PIXEL.get(self.encoding)
        if self.data is not None and per_pixel is not None:
            needed = self.width * self.height * per_pixel
            if len(self.data) != needed:
                raise ValueError(
                    f"{self.encoding} of {self.width} × {self.height} needs {needed} bytes of "
                    f"data, not {len(self.data)}"
                )
        return self

    def age_s(self, now_monotonic_ns: int) -> float:
        """Seconds since the picture was taken, by the monotonic clock of the same machine."""
        return (now_monotonic_ns - self.stamp_monotonic_ns) / 1e9


class CameraModel(_Frozen):
    """Pinhole camera and where it stands: enough to put a pixel on the support plane.

    `K` is the 3 × 3 intrinsic matrix in pixels, `T_base_camera` the 4 × 4 pose of the camera (x
    right, y down, z forward) in the robot's base frame, `support_plane_z` the height of the table
    or floor in that frame, in metres. `base_pose` is where the base stood by its own odometry when
    the picture was taken: x, y (metres) and yaw (rad); None: it cannot drive, or does not know.
    `fixed`: the camera never moves in the base frame.
    """

    K: Matrix3
    T_base_camera: Matrix4
    support_plane_z: Finite = 0.0
    base_pose: Vector3 | None = None
    fixed: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.K[0][0] <= 0 or self.K[1][1] <= 0:
            raise ValueError("K must have positive focal lengths at [0][0] and [1][1]")
        if self.T_base_camera[3] != (0.0, 0.0, 0.0, 1.0):
            raise ValueError("the last row of T_base_camera must be 0 0 0 1")
        return self

    def ground_point(self, u: float, v: float) -> Vector3 | None:
        """Where the ray through pixel (u, v) meets the support plane, in the base frame; None if it
        never does."""
        ray = ((u - self.K[0][2]) / self.K[0][0], (v - self.K[1][2]) / self.K[1][1], 1.0)
        direction = [sum(row[i] * ray[i] for i in range(3)) for row in self.T_base_camera[:3]]
        origin = [row[3] for row in self.T_base_camera[:3]]
        if abs(direction[2]) < 1e-9:
            return None
        scale = (self.support_plane_z - origin[2]) / direction[2]
        if scale <= 0:
            return None
        return (
            origin[0] + scale * direction[0],
            origin[1] + scale * direction[1],
            self.support_plane_z,
        )


# -- objects
class Pose(_Frozen):
    """Position in metres and unit quaternion x, y, z, w, expressed in `frame_id`."""

    xyz: Vector3
    quat_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)
    frame_id: Annotated[str, Field(min_length=1)]

    @field_validator("quat_xyzw")
    @classmethod
    def _unit(cls, value: Quaternion) -> Quaternion:
        norm = math.sqrt(sum(part * part for part in value))
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"a quaternion has length 1, this one has {norm:.4g}")
        return value


class DetectedObject(_Frozen):
    """An object of the world as last seen. `box_3d`, the field's `bbox_3d`, is x_min, y_min, z_min,
    x_max, y_max, z_max in the frame of `pose`. `track_id` is the tracker's own, a number or a
    word."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_by_name=True, validate_by_alias=True
    )

    label: Annotated[str, Field(min_length=1)]
    confidence: UnitInterval
    pose: Pose | None = None
    box: Box2d | None = None
    box_3d: Annotated[
        tuple[Finite, Finite, Finite, Finite, Finite, Finite] | None,
        Field(validation_alias="bbox_3d"),
    ] = None
    sensor_id: str = ""
    track_id: Index | str | None = None
    stamp_ns: Nanoseconds = 0


# -- the robot's state
class JointState(_Frozen):
    """Positions (rad or m), velocities and efforts by joint name. The latter two are empty or as
    long as `name`."""

    name: tuple[str, ...]
    position: tuple[Finite, ...]
    velocity: tuple[Finite, ...] = ()
    effort: tuple[Finite, ...] = ()
    stamp_ns: Nanoseconds

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(set(self.name)) != len(self.name):
            raise ValueError("joint names must be unique")
        for field in ("position", "velocity", "effort"):
            values = getattr(self, field)
            if len(values) != len(self.name) and (values or field == "position"):
                raise ValueError(f"{field} has {len(values)} values for {len(self.name)} joints")
        return self


Diagnostic = Literal["ok", "warn", "error", "stale"]

DETECTOR_PREFIX = "detector:"
"""Of a continuous detector's name in `diagnostics`; its camera's name follows."""


class WorldState(_Frozen):
    """One snapshot of everything that a skill may look at. `diagnostics` says which component is
    not to be trusted."""

    stamp_ns: Nanoseconds
    joint_state: JointState
    base_pose: Pose | None = None
    base_twist: Twist | None = None
    ee_poses: dict[str, Pose] = {}
    contact_forces: dict[str, tuple[Finite, ...]] = {}
    images: dict[str, str] = {}  # sensor → topic
    image_frames: dict[str, SensorFrame] | None = None  # sensor → the frame itself
    point_clouds: dict[str, str] = {}
    tactile: dict[str, str] = {}
    detected_objects: tuple[DetectedObject, ...] = ()
    battery_pct: Annotated[float, Field(ge=0, le=100)] | None = None
    diagnostics: dict[str, Diagnostic] = {}
    collision_primitives: tuple[JsonObject, ...] = ()
    occupancy_grid: JsonObject | None = None

    @property
    def stale(self) -> tuple[str, ...]:
        """Components that must not be acted upon."""
        return tuple(
            sorted(name for name, state in self.diagnostics.items() if state in ("stale", "error"))
        )


# -- actions
Rows = tuple[tuple[Finite, ...], ...]

PAYLOAD_OF_MODE: dict[ControlMode, str] = {
    ControlMode.JOINT_POSITION: "joint_targets",
    ControlMode.JOINT_VELOCITY: "joint_velocities",
    ControlMode.JOINT_TORQUE: "joint_torques",
    ControlMode.JOINT_TRAJECTORY: "joint_targets",
    ControlMode.CARTESIAN_POSE: "cartesian_pose",
    ControlMode.CARTESIAN_DELTA: "cartesian_delta",
    ControlMode.CARTESIAN_TWIST: "cartesian_twist",
    ControlMode.BODY_TWIST: "body_twist",
    ControlMode.FOOT_PLACEMENT: "foot_placements",
    ControlMode.GRIPPER_BINARY: "gripper",
    ControlMode.GRIPPER_POSITION: "gripper",
    ControlMode.DEX_HAND_JOINT: "dex_hand_joints",
    ControlMode.COMPOSITE_MODE: "composite_mode",
}
"""Which field of `Action` carries the rows of a mode."""


class Action(_Frozen):
    """One step (`horizon` 1) or a chunk of steps for one control mode.

    Exactly the field of `PAYLOAD_OF_MODE` is set, with `horizon` rows; rows are equally long.
    Joint positions may come with `body_twist`: a robot that drives while its arm moves.
    `gripper` runs from 0 (closed) to 1 (open). `joint_names` says which joints the columns move;
    without it they are all joints in the robot's order.
    """

    control_mode: ControlMode
    horizon: Annotated[int, Field(ge=1)] = 1
    joint_targets: Rows | None = None
    joint_velocities: Rows | None = None
    joint_torques: Rows | None = None
    cartesian_pose: tuple[Pose, ...] | None = None
    cartesian_delta: Rows | None = None
    cartesian_twist: Rows | None = None
    body_twist: tuple[Twist, ...] | None = None
    foot_placements: tuple[JsonObject, ...] | None = None
    gripper: tuple[UnitInterval, ...] | None = None
    dex_hand_joints: Rows | None = None
    composite_mode: tuple[Annotated[float, Field(ge=-1, le=1)], ...] | None = None
    confidence: UnitInterval = 1.0
    stamp_ns: Nanoseconds = 0
    ee_name: str | None = None
    frame_id: str | None = None
    joint_names: tuple[str, ...] | None = None
    safety_overrides: JsonObject = {}

    @model_validator(mode="after")
    def _check(self) -> Self:
        wanted = PAYLOAD_OF_MODE[self.control_mode]
        given = [
            name
            for name in dict.fromkeys(PAYLOAD_OF_MODE.values())
            if getattr(self, name) is not None
        ]
        driving = self.control_mode is ControlMode.JOINT_POSITION and "body_twist" in given
        if given != [wanted] and not (driving and given == [wanted, "body_twist"]):
            raise ValueError(
                f"control_mode {self.control_mode} is carried by {wanted} alone, not by "
                f"{', '.join(given) or 'nothing'}"
            )
        rows = self.rows
        if len(rows) != self.horizon:
            raise ValueError(f"{wanted} has {len(rows)} rows, horizon says {self.horizon}")
        if driving and len(self.body_twist or ()) != self.horizon:
            raise ValueError(f"body_twist must have {self.horizon} rows, as horizon says")
        widths = {len(row) for row in rows if isinstance(row, tuple)}
        if len(widths) > 1:
            raise ValueError(f"the rows of {wanted} have different lengths: {sorted(widths)}")
        if self.joint_names is not None and widths and widths != {len(self.joint_names)}:
            raise ValueError(
                f"joint_names has {len(self.joint_names)} names for rows of {widths.pop()}"
            )
        return self

    @property
    def rows(self) -> tuple[Any, ...]:
        """The payload of the control mode, one entry a step."""
        payload: tuple[Any, ...] = getattr(self, PAYLOAD_OF_MODE[self.control_mode])
        return payload


# -- what a runner reports
class TickResult(_Frozen):
    """One turn of a runner's loop: where the time went and what became of the action.

    A tick without `step_idx` stepped no world: it reset it, or there was nothing to do. All indices
    count from 0, steps in their episode. `success` is the world's own word, of that moment.
    """

    stamp_ns: Nanoseconds
    tick_idx: Index
    tick_ms: Milliseconds
    late_ms: Milliseconds = 0.0  # behind its slot when it began
    sensors_ms: Milliseconds = 0.0
    world_state_ms: Milliseconds = 0.0
    inference_ms: Milliseconds = 0.0
    safety_ms: Milliseconds = 0.0
    hal_ms: Milliseconds = 0.0
    chunk_index: Index | None = None
    safety_violations: tuple[str, ...] = ()
    action_applied: bool = True
    deadline_missed: bool = False
    step_idx: Index | None = None
    episode_idx: Index | None = None
    terminated: bool | None = None
    truncated: bool | None = None
    success: bool | None = None
    trace_context: dict[str, str] | None = None


class RunResult(_Frozen):
    """A whole run of a runner. `success` is None where it was not judged."""

    n_ticks: Annotated[int, Field(ge=0)]
    success: bool | None = None
    budget_violations: Annotated[int, Field(ge=0)] = 0
    avg_inference_ms: Milliseconds = 0.0
    p99_inference_ms: Milliseconds = 0.0
    avg_tick_ms: Milliseconds = 0.0
    p99_tick_ms: Milliseconds = 0.0
    trace_id: str | None = None
    save_dir: str | None = None
    metadata: JsonObject = {}
