"""`RSkillManifest`: the whole of one `rskill.yaml`, checked.

Fields and their blocks here; words in `vocabulary`, what a kind demands in `kinds`. It reads no
files (`load` does) and knows nothing of how a skill is run.
"""

from collections.abc import Callable
from typing import Annotated, Final, Literal, Self

from pydantic import Field, JsonValue, StringConstraints, model_validator

from vram_arbiter.schemas.findings import Problem, raise_if
from vram_arbiter.schemas.manifest.contracts import (
    ActuatorRequirement,
    DetectorContract,
    EmbodimentExtra,
    Finite,
    LatencyBudget,
    ManifestBlock,
    NonEmpty,
    PlaybookContract,
    Positive,
    PositiveInt,
    Quantization,
    RewardContract,
    RosIntegration,
    SafetyEnvelope,
    SegmenterContract,
    SensorRequirement,
    Share,
)
from vram_arbiter.schemas.manifest.io_contracts import (
    ActionContract,
    ImagePreprocessing,
    Processors,
    StateContract,
)
from vram_arbiter.schemas.manifest.kinds import check_kind
from vram_arbiter.schemas.manifest.vocabulary import (
    COMMERCIAL_LICENSES,
    JOINT_SPACE_LAYOUTS,
    TASK_SPACE_LAYOUTS,
    ActionRepresentation,
    BenchmarkId,
    Dtype,
    EmbodimentTag,
    Kind,
    License,
    Modality,
    ModelFamily,
    Role,
    Runtime,
    SkillAction,
)

_REPO = r"[A-Za-z0-9][A-Za-z0-9._-]*/[A-Za-z0-9._-]+"
_REVISION = r"(?:@[A-Za-z0-9._-]+)?"

SkillName = Annotated[str, StringConstraints(pattern=rf"^{_REPO}$")]
Version = Annotated[
    str, StringConstraints(pattern=r"^\d+\.\d+\.\d+(?:-[0-9A-Za-z.-]+)?(?:\+[0-9A-Za-z.-]+)?$")
]
WeightsUri = Annotated[
    str, StringConstraints(pattern=rf"^(?:hf://{_REPO}{_REVISION}|local://[A-Za-z0-9._/-]+)$")
]
PackageRequirement = Annotated[
    str, StringConstraints(pattern=r"^[A-Za-z0-9][^\r\n]*$", max_length=500)
]
HubUri = Annotated[str, StringConstraints(pattern=rf"^hf://{_REPO}{_REVISION}$")]
WebUrl = Annotated[str, StringConstraints(pattern=r"^https?://\S+$")]

IMAGES_PREFIX: Final = "observation.images."
LICENSE_FLAG: Final = "--allow-noncommercial"
"""The flag by which an operator accepts licenses that forbid commercial use."""
LICENSE_HELP: Final = "also run models whose license does not allow commercial use"
_TEMPLATE_WORDS = ("TEMPLATE_ORG", "TEMPLATE_ID")


class RSkillManifest(ManifestBlock):
    """The package description of one robot skill.

    `min_vram_gb` is what its authors declare per number format, in the field's loose GB: good for a
    first guess, never for a grant. `policy_extras` and `quantization.extra` belong to the adapter
    that runs the skill.
    """

    schema_version: Literal["0.1"] = "0.1"
    name: Annotated[SkillName, Field(description="a name of the form OWNER/REPOSITORY")]
    version: Annotated[Version, Field(description="a version of the form 1.2.3")]
    license: License = License.UNKNOWN
    role: Role = Role.S1
    kind: Kind
    model_family: ModelFamily | None = None

    embodiment_tags: Annotated[
        tuple[EmbodimentTag, ...],
        Field(min_length=1, description="the robots it is made for, or 'any'"),
    ]
    embodiment_extra: EmbodimentExtra | None = None
    capabilities_required: dict[str, bool | float | int | str] = Field(default_factory=dict)
    sensors_required: tuple[SensorRequirement, ...] = ()
    actuators_required: tuple[ActuatorRequirement, ...] = ()

    runtime: Runtime = Runtime.PYTORCH
    quantization: Quantization = Quantization()
    weights_uri: Annotated[
        WeightsUri | None,
        Field(description="a place of weights: hf://OWNER/REPO[@REVISION] or local://PATH"),
    ] = None
    min_vram_gb: dict[Dtype, Positive] | None = None
    environment: Annotated[
        tuple[PackageRequirement, ...] | None,
        Field(description="Python packages of its sidecar alone, e.g. transformers==5.5.0"),
    ] = None

    chunk_size: PositiveInt
    n_action_steps: PositiveInt | None = None
    latency_budget: LatencyBudget
    fallback_skill_id: Annotated[
        SkillName | None, Field(description="a name of the form OWNER/REPOSITORY")
    ] = None

    benchmarks: dict[BenchmarkId, Share] = Field(default_factory=dict)
    evaluated_tasks: tuple[str, ...] = ()
    sim_env_control_mode: str | None = None
    paper_url: Annotated[WebUrl | None, Field(description="a http(s) address")] = None
    dataset_uri: Annotated[
        HubUri | None, Field(description="of the form hf://OWNER/REPO[@REVISION]")
    ] = None
    source_repo: Annotated[
        HubUri | None, Field(description="of the form hf://OWNER/REPO[@REVISION]")
    ] = None

    description: Annotated[str, Field(min_length=1, max_length=500)]
    default_prompt: Annotated[str, Field(min_length=1, max_length=500)] | None = None
    actions: Annotated[tuple[SkillAction, ...], Field(min_length=1)]
    objects: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()

    envelope: SafetyEnvelope | None = None
    policy_extras: dict[str, JsonValue] = Field(default_factory=dict)
    processors: Processors | None = None
    image_preprocessing: ImagePreprocessing | None = None
    state_contract: StateContract | None = None
    action_contract: ActionContract | None = None
    starting_pose: tuple[Finite, ...] | None = None

    ros_integration: RosIntegration | None = None
    detector: DetectorContract | None = None
    segmenter: SegmenterContract | None = None
    reward: RewardContract | None = None
    reward_rskill_name: NonEmpty | None = None
    playbook: PlaybookContract | None = None
    goal_params_schema: dict[str, JsonValue] | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        values = {name: getattr(self, name) for name in type(self).model_fields}
        raise_if(
            [*check_kind(self.kind, values), *self._check_embodiment(), *self._check_fallback()]
        )
        return self

    def _check_embodiment(self) -> list[Problem]:
        problems = []
        custom, extra = "custom" in self.embodiment_tags, self.embodiment_extra is not None
        if custom and not extra:
            problems.append(Problem(("embodiment_extra",), "is required with the tag 'custom'"))
        if extra and not custom:
            problems.append(Problem(("embodiment_extra",), "is only allowed with the tag 'custom'"))
        for index, actuator in enumerate(self.actuators_required if custom else ()):
            problems += [
                Problem(("actuators_required", index, field), "is required with the tag 'custom'")
                for field in ("n_dof", "vla_action_key")
                if getattr(actuator, field) is None
            ]
        return problems

    def _check_fallback(self) -> list[Problem]:
        if self.fallback_skill_id == self.name:
            return [Problem(("fallback_skill_id",), "must be another skill than this one")]
        return []

    # -- what others ask
    @property
    def is_commercial_use_allowed(self) -> bool:
        """Whether the license of the weights allows commercial use; unknown ones do not."""
        return self.license in COMMERCIAL_LICENSES

    def license_refusal(self, *, allow_noncommercial: bool) -> str:
        """Return why the license keeps this skill from being run; empty: it may run.

        A robot at work, real or simulated, is commercial use unless the operator says otherwise. A
        skill without weights has no license of weights.
        """
        if allow_noncommercial or self.weights_uri is None or self.is_commercial_use_allowed:
            return ""
        return (
            f"its license ({self.license}) does not allow commercial use; {LICENSE_FLAG} allows it "
            "anyway"
        )

    @property
    def is_scaffold_placeholder(self) -> bool:
        """Whether the file is still the template of a new skill: valid, but nothing that could be
        run."""
        texts = (self.name, self.weights_uri or "", self.source_repo or "")
        return any(word in text for word in _TEMPLATE_WORDS for text in texts)

    @property
    def declared_vram_gb(self) -> float | None:
        """What the authors declare for the active number format, in the field's GB; None if they do
        not."""
        return (self.min_vram_gb or {}).get(self.quantization.dtype)

    @property
    def weights_revision(self) -> str:
        """The pinned revision of `weights_uri`, or an empty text."""
        return (self.weights_uri or "").partition("@")[2]

    @property
    def camera_keys(self) -> tuple[str, ...]:
        """Feature keys of the rgb sensors through which its policy looks."""
        return tuple(
            sensor.vla_feature_key
            for sensor in self.sensors_required
            if sensor.modality is Modality.RGB and sensor.vla_feature_key
        )

    def not_executable(self) -> list[Problem]:
        """What keeps every runner from executing the skill, although a sidecar may serve it."""
        if self.kind is not Kind.VLA or self.camera_keys:
            return []
        return [
            Problem(
                ("sensors_required",),
                "names no camera: give a sensor of modality rgb a vla_feature_key "
                f"{IMAGES_PREFIX}…",
            )
        ]

    def warnings(self) -> list[Problem]:
        """What is allowed but probably not meant, in the same form as errors."""
        return [Problem(path, message) for path, message, applies in _WARNINGS if applies(self)]


_WARNINGS: tuple[tuple[tuple[str, ...], str, Callable[[RSkillManifest], bool]], ...] = (
    (
        ("role",),
        "a vlm answers the slow reasoner: 's2' is meant, with 's1' it may be offered as a motion "
        "skill",
        lambda m: m.kind is Kind.VLM and m.role is not Role.S2,
    ),
    (
        ("kind",),
        "no runner executes world action models yet",
        lambda m: m.kind is Kind.WAM,
    ),
    (
        ("min_vram_gb",),
        "does not declare the active quantization.dtype; the footprint has to be configured or "
        "learnt",
        lambda m: m.weights_uri is not None and m.declared_vram_gb is None,
    ),
    (
        ("state_contract", "layout"),
        "is a layout that is unknown here; only its own adapter can assemble it",
        lambda m: (
            m.state_contract is not None
            and m.state_contract.layout is not None
            and m.state_contract.layout not in JOINT_SPACE_LAYOUTS | TASK_SPACE_LAYOUTS.keys()
        ),
    ),
    (
        ("action_contract", "joint_units"),
        "is not stated: degrees taken for radians drive an arm into its stops",
        lambda m: (
            m.action_contract is not None
            and m.action_contract.representation is ActionRepresentation.JOINT_POSITIONS
            and m.action_contract.joint_units is None
        ),
    ),
    (
        ("n_action_steps",),
        "is more than chunk_size; the whole chunk is replayed, no more",
        lambda m: m.n_action_steps is not None and m.n_action_steps > m.chunk_size,
    ),
    (
        ("starting_pose",),
        "is not as long as state_contract.dim",
        lambda m: (
            m.starting_pose is not None
            and m.state_contract is not None
            and m.state_contract.dim not in (None, len(m.starting_pose))
        ),
    ),
)
