"""A deployment: which robot, which cameras, which skill, at which rate. The YAML file that
`vram-runner deploy` reads.

Pure: `robot_of` takes a file that was read. Field names are those of the field's
`RobotEnvironment` files, so that they load unchanged. Nothing is guessed: what an adapter or a
reader needs beyond these fields stands in `transport`, `params` and `backend_params` and is checked
by that adapter, before anything moves.
"""

from enum import StrEnum
from typing import Annotated, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, JsonValue, field_validator, model_validator

from vram_arbiter.schemas.body import Body, Capability
from vram_arbiter.schemas.manifest.contracts import Quantization, SafetyEnvelope
from vram_arbiter.schemas.manifest.vocabulary import DetectorMode, EmbodimentTag
from vram_arbiter.schemas.yamltext import YamlText, validated

RATE_HZ_MAX = 1000.0
MAX_AGE_MS = 100.0

Text = Annotated[str, Field(min_length=1, max_length=256)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class SensorBackend(StrEnum):
    """How the frames of a camera come in."""

    OPENCV_THREAD = "opencv_thread"
    ROS2_IMAGE = "ros2_image"
    GSTREAMER = "gstreamer"
    HOLOSCAN = "holoscan"


class SensorReaderConfig(_Section):
    """One camera."""

    sensor_id: Text
    """Name under which its frames appear in the world state; a skill's manifest refers to it."""
    backend: SensorBackend = SensorBackend.OPENCV_THREAD
    """`holoscan` is reserved: it is refused when the runner starts."""
    backend_params: dict[str, JsonValue] = {}
    """What this backend needs: a device, a URL, a topic, a pipeline."""
    max_age_ms: Positive = MAX_AGE_MS
    """An older frame is stale: it is not shown to the skill."""
    publish_to_ros: bool = False
    """Publish the frames on a ROS 2 topic as well, for recorders and viewers."""
    publish_topic: Text | None = None
    publish_rate_hz: Positive | None = None
    """At most so many frames a second are published; null: all."""
    publish_width: Annotated[int, Field(gt=0, le=16_384)] | None = None
    """Wider frames are published scaled down to this width; null: as they are."""

    @model_validator(mode="after")
    def _topic_goes_with_publishing(self) -> Self:
        if self.publish_to_ros != (self.publish_topic is not None):
            raise ValueError(
                "publish_to_ros and publish_topic belong together: give both or neither"
            )
        for name in ("publish_rate_hz", "publish_width"):
            if getattr(self, name) is not None and not self.publish_to_ros:
                raise ValueError(f"{name} without publish_to_ros publishes nothing")
        return self


class SyncConfig(_Section):
    """Cameras whose frames are shown together, as pictures of one moment."""

    sensor_ids: Annotated[tuple[Text, ...], Field(min_length=2)]
    max_spread_ms: Positive = 20.0
    """Frames that were taken further apart are not shown; less than half a period of the slowest
    camera needs cameras that are triggered together."""


class DetectorConfig(_Section):
    """One detector that looks at a camera all the time; its sidecar serves it under its lease."""

    id: Text
    """The installed rSkill of kind `detector`: OWNER/REPOSITORY."""
    sensor_id: Text
    """The camera that it looks at; one detector a camera."""
    mode: DetectorMode | None = None
    """null: as in its manifest, which has to say `continuous` then."""
    queries: tuple[Text, ...] = ()
    """What to look for; empty: the labels of its manifest."""
    score_threshold: Annotated[float, Field(ge=0, le=1)] | None = None
    rate_hz: Annotated[float, Field(gt=0, le=30, allow_inf_nan=False)] = 2.0
    """Looks a second at most."""
    max_age_ms: Positive = 1000.0
    """Detections are absent once their picture was taken longer ago than this."""
    reload_s: Positive | None = 10.0
    """Interval at which an evicted model whose sidecar is not on standby is loaded again; null: it
    stays away until something else loads it."""


class HalConfig(_Section):
    """The robot's hardware adapter."""

    adapter: Text
    """`so101_mujoco`, `so101_kinematic` or `lerobot:TYPE`."""
    transport: dict[str, JsonValue] = {}
    """Port, ids, calibration: how the hardware is reached."""
    params: dict[str, JsonValue] = {}


class TeleopConfig(_Section):
    """The operator's device: a leader arm or a keyboard."""

    adapter: Text
    """`lerobot:TYPE`, one of lerobot's teleoperators, e.g. `lerobot:so101_leader`."""
    transport: dict[str, JsonValue] = {}
    """The fields of lerobot's own configuration of it."""


class TaskSpec(_Section):
    """What the robot is to do when no goals arrive."""

    id: Text
    scene_id: str = ""
    instruction: Annotated[str, Field(max_length=2000)] = ""
    max_steps: Annotated[int, Field(gt=0)] | None = None
    success_key: str | None = None
    metadata: dict[str, JsonValue] = {}


class VlaSpec(_Section):
    """The skill that runs the task: an installed rSkill by name, without a scheme."""

    id: Text
    """The skill's name; or, as the field writes it, the policy's family (`act`), and then
    `weights_uri` names the skill: `rskills/so101-grab`."""
    weights_uri: str = ""
    device: str = "auto"
    runtime: str | None = None
    quantization: Quantization | None = None
    """A block as in the skill's manifest, or its `dtype` alone."""
    deterministic: bool = False
    extra: dict[str, JsonValue] = {}

    @field_validator("quantization", mode="before")
    @classmethod
    def _a_word_is_a_dtype(cls, value: object) -> object:
        return {"dtype": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _bare_reference(self) -> Self:
        if "://" in self.id:
            raise ValueError(
                f"{self.id!r}: write the skill's name, OWNER/REPOSITORY, without a scheme"
            )
        return self


class RobotEnvironment(_Section):
    """One robot as it is deployed."""

    robot_id: Text
    embodiment_tags: tuple[Text, ...] = ()
    """What the robot is, e.g. `so101_follower`; empty: what its adapter is known to be. Skills made
    for other robots are refused. A tag that no manifest can name is a warning."""
    capabilities: dict[str, Capability] = {}
    """Facts that manifests ask for by name: `has_vision: true`, `can_lift_kg: 0.5`. Cameras and
    grippers are seen without being named here."""
    hal: HalConfig
    sensors: tuple[SensorReaderConfig, ...] = ()
    sync: SyncConfig | None = None
    """Cameras that are read together; null: each by itself."""
    detectors: tuple[DetectorConfig, ...] = ()
    """Detectors that look all the time, for the world state's `detected_objects`."""
    sidecars: dict[Text, Annotated[str, Field(pattern=r"^ssh://[^/]+/[^/]+$")]] = {}
    """Sidecars on a GPU server, by skill or by the sidecar's name: `grab: ssh://HOST/grab`. A
    tunnel forwards them (`vramctl remote up HOST grab`); goals are uses at that server's arbiter.
    """
    ros_actions: tuple[
        Literal["nav2_msgs/NavigateToPose", "control_msgs/FollowJointTrajectory"], ...
    ] = ()
    """Interfaces of `ros_action` skills that ROS 2 servers execute. Their motion passes neither
    this runner's safety gate nor its emergency stop, which only cancels their goals."""
    ros_services: tuple[
        Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*/[A-Z][A-Za-z0-9]*$")], ...
    ] = ()
    """Interfaces of `ros_service` skills that ROS 2 servers execute, such as `std_srvs/Trigger`. As
    for `ros_actions`, their motion passes no gate of this runner, and a call cannot be canceled."""
    teleop: TeleopConfig | None = None
    """By it an operator moves the robot (`vram-runner record`, `takeover`); null: by none."""
    task: TaskSpec | None = None
    vla: VlaSpec | None = None
    safety: SafetyEnvelope | None = None
    """Tightens the robot's own limits; it can never widen them."""
    rate_hz: Annotated[float, Field(gt=0, le=RATE_HZ_MAX, allow_inf_nan=False)] = 30.0
    thumbnail_hz: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 25.0
    deadline_overrun_policy: Literal["warn", "drop", "raise"] = "warn"
    latency_budget_ms: Positive | None = None
    """Ticks that take longer are counted as `budget_violations`; null: longer than a period."""
    max_ticks: Annotated[int, Field(gt=0)] | None = None
    save_dir: str | None = None
    """Folder of the recorded dataset; null: nothing is recorded."""
    save_format: Literal["full", "lerobot"] = "full"
    """Columns of the dataset: all, or those of `lerobot-record` with its names and units."""
    metadata: dict[str, JsonValue] = {}

    @model_validator(mode="after")
    def _names_are_unique(self) -> Self:
        names = [sensor.sensor_id for sensor in self.sensors]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"sensor_id must be unique; given twice: {', '.join(twice)}")
        paired = () if self.sync is None else self.sync.sensor_ids
        if unknown := sorted(set(paired) - set(names)):
            raise ValueError(f"sync names cameras that are not there: {', '.join(unknown)}")
        if len(set(paired)) != len(paired):
            raise ValueError("sync names a camera twice")
        watched = [detector.sensor_id for detector in self.detectors]
        if unknown := sorted(set(watched) - set(names)):
            raise ValueError(f"detectors look at cameras that are not there: {', '.join(unknown)}")
        if twice := sorted({name for name in watched if watched.count(name) > 1}):
            raise ValueError(f"one detector a camera; given twice: {', '.join(twice)}")
        if (self.vla is None) != (self.task is None):
            raise ValueError(
                "task and vla belong together: give both, or neither to only serve goals"
            )
        Body.model_validate({"embodiment_tags": self.known_tags, "capabilities": self.capabilities})
        return self

    @property
    def known_tags(self) -> tuple[str, ...]:
        """The tags that manifests have words for."""
        return tuple(tag for tag in self.embodiment_tags if tag in get_args(EmbodimentTag))


def robot_of(source: YamlText) -> RobotEnvironment:
    """Return a parsed deployment file as its model. Raises ConfigError with every mistake and its
    line."""
    return validated(RobotEnvironment, source)
