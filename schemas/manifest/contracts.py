"""The blocks of a manifest that say what a skill needs, runs on and is: sensors, actuators,
weights, budgets, kinds' own blocks.

What goes into and comes out of a policy is in `io_contracts`. No block looks at another: rules
across blocks are the manifest's.
"""

import json
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue, field_validator, model_validator

from vram_arbiter.schemas.control import CARTESIAN_MODES, GRIPPER_MODES, ControlMode
from vram_arbiter.schemas.findings import Problem, misplaced, raise_if
from vram_arbiter.schemas.manifest.vocabulary import (
    DetectorEngine,
    DetectorMode,
    Dtype,
    GripperConvention,
    Modality,
    QuantizationBackend,
)
from vram_arbiter.schemas.plain import JsonObject

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
PositiveInt = Annotated[int, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]
NonEmpty = Annotated[str, Field(min_length=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector3 = tuple[Finite, Finite, Finite]


class ManifestBlock(BaseModel):
    """Base of every block: immutable, and an unknown field is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


# -- what the skill needs of the robot
class SensorRequirement(ManifestBlock):
    """One sensor, by the policy's feature key, or `count` sensors of a modality. Sizes in
    pixels."""

    modality: Modality
    vla_feature_key: str | None = None
    min_width: PositiveInt | None = None
    min_height: PositiveInt | None = None
    count: Annotated[int, Field(ge=1)] = 1


class ControlModeSemantics(ManifestBlock):
    """How the numbers of one actuator are meant."""

    mode: Literal["absolute", "delta"]
    gripper_convention: GripperConvention | None = None
    joint_order: tuple[str, ...] | None = None
    reference_frame: str | None = None


class ActuatorRequirement(ManifestBlock):
    """One actuator that the skill commands. Grippers state their convention, cartesian ones their
    frame, others neither."""

    kind: ControlMode
    n_dof: PositiveInt | None = None
    vla_action_key: str | None = None
    control_mode_semantics: ControlModeSemantics

    @model_validator(mode="after")
    def _check(self) -> Self:
        rules = {
            "gripper_convention": "R" if self.kind in GRIPPER_MODES else "F",
            "reference_frame": "R" if self.kind in CARTESIAN_MODES else "F",
        }
        problems = misplaced(self.control_mode_semantics, rules, self.kind.value)
        raise_if([problem.below(("control_mode_semantics",)) for problem in problems])
        return self


class EmbodimentExtra(ManifestBlock):
    """Sensors and actuators of a robot that no list knows (`embodiment_tags: [custom]`)."""

    sensors: Annotated[tuple[SensorRequirement, ...], Field(min_length=1)]
    actuators: Annotated[tuple[ActuatorRequirement, ...], Field(min_length=1)]


class SafetyEnvelope(ManifestBlock):
    """Limits that the skill accepts below the robot's own. Metres, seconds, newtons, radians."""

    workspace_box_min_xyz: Vector3 | None = None
    workspace_box_max_xyz: Vector3 | None = None
    no_go_zones: tuple[JsonObject, ...] = ()
    max_ee_speed_m_s: float = 0.5
    max_ee_accel_m_s2: float = 1.0
    max_joint_speed_factor: float = 0.7
    max_force_n: float = 50.0
    max_torque_nm: float = 10.0
    deadman_required: bool = True
    e_stop_topic: str = "/safety/e_stop"
    e_stop_qos: Literal["reliable"] = "reliable"
    contact_force_threshold_n: float = 30.0
    cycle_time_violation_threshold_ms: float = 5.0
    human_in_loop_required: tuple[str, ...] = ()
    max_cartesian_step_m: float | None = None
    max_cartesian_step_rad: float | None = None
    max_ee_angular_speed_rad_s: float | None = None
    max_base_linear_speed_m_s: float | None = None
    max_base_angular_speed_rad_s: float | None = None
    self_collision_margin_m: float = 0.0


# -- what it runs on
class Quantization(ManifestBlock):
    """Number format of the weights and what makes it.

    `extra` of the field: `scheme`, `quantizer`, `compute_dtype`, `min_params_to_quantize`,
    `skip_modules`, `loader`, `trust_remote_code`.
    """

    dtype: Dtype = Dtype.FP32
    backend: QuantizationBackend = QuantizationBackend.PYTORCH
    per_channel: bool = False
    calibration_dataset: str | None = None
    extra: dict[str, JsonValue] = {}


class LatencyBudget(ManifestBlock):
    """Time limits: of one chunk, of warming up, of loading (ms), and of one whole goal (s)."""

    per_chunk_ms: Positive
    warmup_ms: Positive | None = None
    load_ms: Positive | None = None
    max_execution_s: Positive | None = None


# -- the kinds' own blocks
class RosIntegration(ManifestBlock):
    """The ROS 2 action or service that a `ros_action` or `ros_service` skill wraps."""

    package: Annotated[str, Field(min_length=1, max_length=200)]
    interface_type: Annotated[str, Field(min_length=1, max_length=200)]
    interface_name: Annotated[
        str,
        Field(max_length=200, pattern=r"^/.*$", description="a full ROS name that starts with '/'"),
    ]
    result_trajectory_field: Annotated[str, Field(max_length=200)] | None = None
    default_goal_json: Annotated[str, Field(min_length=2, max_length=10_000)]
    definition: Annotated[str, Field(max_length=100_000)] = ""
    """Text of a service's `.srv` file, where it is not of std_srvs; definitions of messages that
    ROS 2 lacks follow, each behind 80 `=` and `MSG: package/Type`."""
    ros_dependencies: tuple[str, ...] = ()
    goal_builder: Literal["joint", "pose", "look_at"] | None = None

    @field_validator("default_goal_json")
    @classmethod
    def _is_json_object(cls, text: str) -> str:
        try:
            goal = json.loads(text)
        except ValueError as error:
            raise ValueError(f"must be the text of a JSON object: {error}") from error
        if not isinstance(goal, dict):
            raise ValueError(f"must be the text of a JSON object, not a {type(goal).__name__}")
        return text


class DetectorContract(ManifestBlock):
    """Vocabulary and input of a detector. `input_size` is width × height, `max_side` the longest
    edge, in pixels."""

    labels: Annotated[tuple[str, ...], Field(min_length=1)]
    input_size: tuple[PositiveInt, PositiveInt] = (640, 640)
    score_threshold: Share = 0.5
    engine: DetectorEngine | None = None
    mode: DetectorMode = DetectorMode.CONTINUOUS
    max_side: PositiveInt | None = None


class SegmenterContract(ManifestBlock):
    """Limits of a promptable segmenter."""

    engine: Literal["sam2_hf"]
    max_prompt_points: Annotated[int, Field(ge=1)] = 8
    multimask: bool = True
    min_mask_area_px: Annotated[int, Field(ge=1)] = 64


class RewardContract(ManifestBlock):
    """How a progress monitor looks and what its numbers mean."""

    progress_range: tuple[float, float] = (0.0, 1.0)
    success_threshold: Share = 0.5
    preference: bool = False
    backend: Literal["robometer", "topreward"] = "robometer"
    frame_window_s: Positive
    target_fps: Positive
    num_bins: PositiveInt = 100
    instruction_required: bool = True
    check_floor: Share = 0.4
    plateau_window_s: Positive = 3.0
    plateau_tolerance: Annotated[float, Field(ge=0)] = 0.05
    default_patience_s: Positive = 30.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        (low, high), problems = self.progress_range, []
        if not high > low:
            said = f"must be [low, high] with high > low, not [{low}, {high}]"
            problems.append(Problem(("progress_range",), said))
        if self.check_floor > (most := self.success_threshold):
            said = f"must not exceed success_threshold ({most}), not {self.check_floor}"
            problems.append(Problem(("check_floor",), said))
        raise_if(problems)
        return self


class PlaybookContract(ManifestBlock):
    """When a written procedure applies, where its text is, and when it is done."""

    trigger: Annotated[str, Field(min_length=1, max_length=500)]
    body_uri: NonEmpty
    composes_tools: Annotated[tuple[str, ...], Field(min_length=1)]
    done_predicate: Annotated[str, Field(min_length=1, max_length=500)]
    max_steps: PositiveInt
