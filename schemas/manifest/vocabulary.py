"""The words that an rSkill manifest may use: its closed sets, as the field writes them.

Sets that grew over time are the union of what was ever published, so that older and newer files
load alike. A robot that is not listed here says `custom` and describes itself (`embodiment_extra`).
"""

from enum import StrEnum
from typing import Literal


class Kind(StrEnum):
    """What an rSkill is; decides which other fields it must and must not have
    (`schemas.manifest.kinds`)."""

    VLA = "vla"
    WAM = "wam"
    ROS_ACTION = "ros_action"
    ROS_SERVICE = "ros_service"
    DETECTOR = "detector"
    SEGMENTER = "segmenter"
    VLM = "vlm"
    REWARD = "reward"
    PLAYBOOK = "playbook"


class Role(StrEnum):
    """Layer that runs the skill: s0 reflexes, s1 closed-loop policies, s2 slow reasoning."""

    S0 = "s0"
    S1 = "s1"
    S2 = "s2"


class License(StrEnum):
    """Terms of the weights."""

    APACHE_2_0 = "apache-2.0"
    MIT = "mit"
    BSD = "bsd"
    PERMISSIVE_RESEARCH = "permissive_research"
    NVIDIA_NON_COMMERCIAL = "nvidia_non_commercial"
    NVIDIA_OPEN_MODEL = "nvidia_open_model"
    RLWRLD_NON_COMMERCIAL = "rlwrld_non_commercial"
    CC_BY_NC_SA_4_0 = "cc-by-nc-sa-4.0"
    PROPRIETARY = "proprietary"
    UNKNOWN = "unknown"


COMMERCIAL_LICENSES = frozenset(
    {License.APACHE_2_0, License.MIT, License.BSD, License.NVIDIA_OPEN_MODEL}
)


class ModelFamily(StrEnum):
    """Family of the policy; decides which adapter drives it."""

    SMOLVLA = "smolvla"
    PI0 = "pi0"
    PI0_FAST = "pi0_fast"
    PI05 = "pi05"
    XVLA = "xvla"
    XR1 = "xr1"
    ACT = "act"
    DIFFUSION = "diffusion"
    VQBET = "vqbet"
    TDMPC = "tdmpc"
    MULTI_TASK_DIT = "multi_task_dit"
    GAUSSIAN_ACTOR = "gaussian_actor"
    EO1 = "eo1"
    EVO1 = "evo1"
    FASTWAM = "fastwam"
    VLA_JEPA = "vla_jepa"
    WALL_X = "wall_x"
    RLDX = "rldx"
    MOLMOACT2 = "molmoact2"
    GR00T = "gr00t"
    DIFFUSER_ACTOR = "diffuser_actor"
    OPENVLA = "openvla"
    LINGBOT_VLA = "lingbot_vla"
    LINGBOT_VLA2 = "lingbot_vla2"
    LINGBOT_VA = "lingbot_va"
    LINGBOT_VA_A1 = "lingbot_va_a1"
    INTERNVLA_N1 = "internvla_n1"


PROCESSOR_FAMILIES = frozenset(
    {
        ModelFamily.SMOLVLA,
        ModelFamily.PI05,
        ModelFamily.XVLA,
        ModelFamily.DIFFUSION,
        ModelFamily.RLDX,
        ModelFamily.MOLMOACT2,
    }
)
"""Families with checkpoints that are unusable without their pre- and postprocessor files."""


class SkillAction(StrEnum):
    """What a skill does, in one verb."""

    PICK = "pick"
    PLACE = "place"
    PICK_AND_PLACE = "pick_and_place"
    TRANSFER = "transfer"
    GRASP = "grasp"
    RELEASE = "release"
    OPEN = "open"
    CLOSE = "close"
    PUSH = "push"
    PULL = "pull"
    SLIDE = "slide"
    INSERT = "insert"
    POUR = "pour"
    WIPE = "wipe"
    ROTATE = "rotate"
    REACH = "reach"
    LOOK = "look"
    NAVIGATE = "navigate"
    WAVE = "wave"
    SHAKE = "shake"
    GENERALIST = "generalist"
    DETECT = "detect"
    QUERY = "query"
    MONITOR = "monitor"
    PLAN = "plan"


class Runtime(StrEnum):
    """What executes the weights."""

    PYTORCH = "pytorch"
    ONNX = "onnx"
    TENSORRT = "tensorrt"
    TRT_LLM = "trt_llm"
    VLLM = "vllm"
    GGUF = "gguf"
    MLX = "mlx"
    JAX = "jax"


class Dtype(StrEnum):
    """Number format of the weights. `int4` is bitsandbytes' NF4 in every file of the field
    so far."""

    FP32 = "fp32"
    FP16 = "fp16"
    BF16 = "bf16"
    INT8 = "int8"
    FP8 = "fp8"
    INT4 = "int4"
    FP4_NVFP4 = "fp4_nvfp4"


class QuantizationBackend(StrEnum):
    """What quantizes."""

    PYTORCH = "pytorch"
    ONNX = "onnx"
    TENSORRT = "tensorrt"
    GGUF = "gguf"
    MLX = "mlx"


class Modality(StrEnum):
    """What a sensor measures."""

    RGB = "rgb"
    DEPTH = "depth"
    STEREO = "stereo"
    IR = "ir"
    POINT_CLOUD = "point_cloud"
    LIDAR_2D = "lidar_2d"
    IMU = "imu"
    FORCE_TORQUE = "force_torque"
    JOINT_STATE = "joint_state"
    TACTILE_VISION = "tactile_vision"
    TACTILE_ARRAY = "tactile_array"
    AUDIO = "audio"
    GPS = "gps"
    BATTERY = "battery"


class GripperConvention(StrEnum):
    """How a policy encodes its gripper."""

    NORMALIZED_OPEN_UNIT = "normalized_open_unit"  # 0 closed, 1 open
    NORMALIZED_OPEN_SYMMETRIC = "normalized_open_symmetric"  # -1 closed, 1 open
    NORMALIZED_CLOSE_SYMMETRIC = "normalized_close_symmetric"  # -1 open, 1 closed
    PERCENT_OPEN = "percent_open"  # 0 closed, 100 open
    BINARY_CLOSE_ONE = "binary_close_one"  # 0 open, 1 closed
    RAW_JOINT_RAD = "raw_joint_rad"
    WIDTH_METERS = "width_meters"


class ActionRepresentation(StrEnum):
    """What the numbers of an action vector are, when no slots say so."""

    JOINT_POSITIONS = "joint_positions"
    JOINT_VELOCITIES = "joint_velocities"
    DELTA_EE_6D_PLUS_GRIPPER = "delta_ee_6d_plus_gripper"
    DELTA_EE_6D = "delta_ee_6d"
    DELTA_EE_3D_PLUS_GRIPPER = "delta_ee_3d_plus_gripper"
    CARTESIAN_POSE = "cartesian_pose"


class Rotation(StrEnum):
    """How an orientation is written. Quaternions have w ≥ 0, angles are in rad."""

    QUAT_XYZW = "quat_xyzw"
    QUAT_WXYZ = "quat_wxyz"
    ROT6D = "rot6d"  # first two rows of the rotation matrix
    AXIS_ANGLE = "axis_angle"  # axis times angle
    EULER_XYZ = "euler_xyz"  # roll, pitch, yaw about the fixed axes

    @property
    def width(self) -> int:
        """Number of values."""
        return {"quat": 4, "rot6": 6}.get(self.value[:4], 3)


class DetectorEngine(StrEnum):
    """What runs a detector."""

    RTDETR_ONNX = "rtdetr_onnx"
    VLM_SIDECAR = "vlm_sidecar"
    ZEROSHOT_HF = "zeroshot_hf"


class DetectorMode(StrEnum):
    """Whether a detector watches all the time or answers when asked."""

    CONTINUOUS = "continuous"
    ON_DEMAND = "on_demand"


EmbodimentTag = Literal[
    "aloha",
    "aloha_agilex",
    "aloha_bimanual",
    "any",
    "anvil_openarm_v2",
    "custom",
    "franka_panda",
    "g1",
    "galaxea_a1",
    "go2",
    "go2_z1",
    "google_robot",
    "gr1",
    "h1",
    "mobile_base",
    "multi",
    "openarm",
    "panda_mobile",
    "panda_mobile_vslam",
    "pusht",
    "pusht_2d",
    "r1pro",
    "rizon4",
    "sawyer",
    "so100_follower",
    "so101_follower",
    "ur10e",
    "ur5e",
    "widowx",
]
"""Robots that a skill is made for; `any` for all, `mobile_base` for a class of them, `custom` for
one described in the file."""

BenchmarkId = Literal[
    "aloha",
    "aloha_insertion",
    "aloha_transfer_cube",
    "behavior",
    "gr1_tabletop",
    "libero_10",
    "libero_goal",
    "libero_object",
    "libero_spatial",
    "maniskill3_franka_pick_cube",
    "maniskill3_panda",
    "maniskill3_pick_place",
    "maniskill_panda",
    "metaworld_mt10",
    "metaworld_mt50",
    "pusht",
    "rlbench",
    "robocasa_pnp",
    "robotwin",
    "simpler_env_widowx",
]
"""Benchmark suites that a success rate may be stated for."""

TASK_SPACE_LAYOUTS: dict[str, tuple[str, ...]] = {
    "human300_16d": ("eef_frame", "base_frame"),
    "rc365": ("eef_frame", "base_frame"),
    "libero_eef8d": ("eef_frame", "gripper_qpos_joints"),
}
"""State layouts made of poses, and the bindings without which no such vector can be assembled."""

JOINT_SPACE_LAYOUTS = frozenset({"smolvla_9d", "gr1", "simpler_widowx", "simpler_google"})
"""State layouts that are joint values in the robot's order."""
