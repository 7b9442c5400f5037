"""What goes into and comes out of a policy: its processors, pictures, state vector and action
vector."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from vram_arbiter.schemas.control import CARTESIAN_MODES, GRIPPER_MODES, JOINT_MODES, ControlMode
from vram_arbiter.schemas.findings import Problem, misplaced, raise_if, wrong
from vram_arbiter.schemas.manifest.contracts import Finite, ManifestBlock, PositiveInt
from vram_arbiter.schemas.manifest.vocabulary import (
    JOINT_SPACE_LAYOUTS,
    TASK_SPACE_LAYOUTS,
    ActionRepresentation,
    GripperConvention,
    Rotation,
)

FileUri = Annotated[
    str,
    Field(
        pattern=r"^(?:hf://[A-Za-z0-9][A-Za-z0-9._-]*/[A-Za-z0-9._-]+(?:@[A-Za-z0-9._-]+)?"
        r"|local://[A-Za-z0-9._-]+)"
        r"/[A-Za-z0-9._/-]+\.[A-Za-z0-9]+$"
    ),
]


class Processors(ManifestBlock):
    """The two files that turn observations into a policy's input and its output into actions."""

    preprocessor_uri: Annotated[
        FileUri,
        Field(description="a file: hf://OWNER/REPO[@REV]/FILE.EXT or local://FOLDER/FILE.EXT"),
    ]
    postprocessor_uri: Annotated[
        FileUri,
        Field(description="a file: hf://OWNER/REPO[@REV]/FILE.EXT or local://FOLDER/FILE.EXT"),
    ]

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        if self.preprocessor_uri == self.postprocessor_uri:
            raise wrong("must be another file than preprocessor_uri", "postprocessor_uri")
        return self


class ImagePreprocessing(ManifestBlock):
    """What was done to the pictures in training. `aliases` maps the robot's camera names to the
    policy's."""

    flip_180: bool = False
    flip_vertical: bool = False
    input_template: str = "observation.images.{cam}"
    aliases: dict[str, str] = Field(default_factory=dict)
    norm_tag: str | None = None
    image_max_crops: Annotated[int, Field(ge=1)] | None = None
    resize_width: PositiveInt | None = None
    resize_height: PositiveInt | None = None

    @model_validator(mode="after")
    def _pair(self) -> Self:
        if (self.resize_width is None) != (self.resize_height is None):
            missing = "resize_width" if self.resize_width is None else "resize_height"
            raise wrong("is required: width and height are given together", missing)
        return self


class StateBindings(ManifestBlock):
    """Where the parts of a task-space state vector come from on this robot."""

    eef_frame: str | None = None
    base_frame: str | None = None
    world_frame: str | None = "map"
    gripper_qpos_joints: tuple[str, ...] = ()
    quaternion_convention: Literal["xyzw", "wxyz"] = "xyzw"


class StatePart(ManifestBlock):
    """One stretch of a state vector. Joints left out are all of the robot's, grippers included.

    `ee` is an end effector or a frame of the robot; its pose is expressed in `frame`. `rotation`
    left out: the position alone.
    """

    kind: Literal["joint_positions", "joint_velocities", "ee_pose", "base_pose", "base_twist"]
    joints: tuple[str, ...] = ()
    ee: str | None = None
    frame: str | None = None
    rotation: Rotation | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        rules = {
            "joints": "-" if self.kind.startswith("joint_") else "F",
            "ee": "R" if self.kind == "ee_pose" else "F",
            "frame": {"ee_pose": "R", "base_pose": "R"}.get(self.kind, "F"),
            "rotation": "-" if self.kind.endswith("_pose") else "F",
        }
        raise_if(misplaced(self, rules, self.kind))
        return self


class StateContract(ManifestBlock):
    """The proprioception that the checkpoint was trained on: a named layout with bindings for
    task-space layouts, or its `parts` in order; and its width."""

    layout: (
        Annotated[
            str,
            Field(
                pattern=r"^[a-z0-9][a-z0-9_]*$", description="the name of a layout, e.g. 'rc365'"
            ),
        ]
        | None
    ) = None
    dim: PositiveInt | None = None
    bindings: StateBindings | None = None
    parts: Annotated[tuple[StatePart, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        needed, layout = TASK_SPACE_LAYOUTS.get(self.layout or "", ()), f"layout {self.layout!r}"
        said: list[tuple[tuple[str, ...], str]] = []
        if self.parts is not None and self.layout is not None:
            said.append((("parts",), "is not allowed beside layout: give one of them"))
        if self.bindings is None and needed:
            said.append((("bindings",), f"is required for {layout}, with {' and '.join(needed)}"))
        elif self.bindings is not None:
            lacking = [field for field in needed if not getattr(self.bindings, field)]
            said += [(("bindings", field), f"is required for {layout}") for field in lacking]
            if self.layout is None or self.layout in JOINT_SPACE_LAYOUTS:
                problem = f"is not allowed for {layout}: joint values need no source"
                said.append((("bindings",), problem))
        raise_if([Problem(path, problem) for path, problem in said])
        return self


_SLOT_RULES = {
    # control mode: rules of ee, frame, joint_names (`findings.misplaced`)
    **dict.fromkeys(JOINT_MODES, "FF-"),
    **dict.fromkeys(CARTESIAN_MODES, "RRF"),
    **dict.fromkeys(GRIPPER_MODES, "RFF"),
    ControlMode.BODY_TWIST: "FRF",
    ControlMode.COMPOSITE_MODE: "FFF",
}


_OF_A_COMMAND = (
    "control_mode",
    "ee",
    "frame",
    "joint_names",
    "rotation",
    "gripper_convention",
    "input_bounds",
)


class ActionSlot(ManifestBlock):
    """A slice of the action vector, both ends inclusive, and where it goes. `discard` drops it;
    `terminate` ends the goal once its one value is above 0.5. The policy's numbers are clipped to
    `input_bounds` before they are scaled, as robosuite's controllers do."""

    range: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]
    control_mode: ControlMode | None = None
    discard: bool = False
    terminate: bool = False
    ee: str | None = None
    frame: str | None = None
    joint_names: tuple[str, ...] = ()
    rotation: Rotation | None = None
    gripper_convention: GripperConvention | None = None
    input_bounds: tuple[Finite, Finite] | None = None

    @property
    def width(self) -> int:
        """Number of values in the slice."""
        return self.range[1] - self.range[0] + 1

    @model_validator(mode="after")
    def _check(self) -> Self:
        problems = self._check_command()
        if self.width < 1:
            said = f"must be [first, last] with last ≥ first, not {list(self.range)}"
            problems.append(Problem(("range",), said))
        if self.input_bounds is not None and not self.input_bounds[0] < self.input_bounds[1]:
            problems.append(Problem(("input_bounds",), "must be [low, high] with high > low"))
        raise_if(problems)
        return self

    def _check_command(self) -> list[Problem]:
        """Return what is wrong with where the slice goes."""
        if self.discard or self.terminate:
            kind = "discarded" if self.discard else "terminate"
            alien = _OF_A_COMMAND if not self.discard else (*_OF_A_COMMAND, "terminate")
            said = f"is not allowed in a {kind} slot"
            problems = [Problem((field,), said) for field in alien if getattr(self, field)]
            return problems + self._check_single("terminate" if self.terminate else "")
        if self.control_mode is None:
            return [Problem(("control_mode",), "is required unless the slot is discarded")]
        return self._check_mode(self.control_mode)

    def _check_single(self, of: str) -> list[Problem]:
        """Return that the slice has several values, where what it is `of` takes one."""
        if not of or self.width <= 1:
            return []
        return [Problem(("range",), f"must cover one value for {of}, not {self.width}")]

    def _check_mode(self, mode: ControlMode) -> list[Problem]:
        rules = dict(zip(("ee", "frame", "joint_names"), _SLOT_RULES.get(mode, ""), strict=False))
        rules["rotation"] = "-" if mode is ControlMode.CARTESIAN_POSE else "F"
        rules["gripper_convention"] = "-" if mode in GRIPPER_MODES else "F"
        problems = misplaced(self, rules, mode.value)
        count = len(self.joint_names)
        if count and count != self.width > 0 and not problems:
            said = f"has {count} names for {self.width} values of the action vector"
            problems.append(Problem(("joint_names",), said))
        single = mode is ControlMode.COMPOSITE_MODE
        return problems + self._check_single(repr(mode.value) if single else "")


_DIM_MAX = 4096  # far above any robot; keeps the check of the cover cheap

_DELTA_WIDTH = {
    ActionRepresentation.DELTA_EE_6D: 6,
    ActionRepresentation.DELTA_EE_6D_PLUS_GRIPPER: 6,
    ActionRepresentation.DELTA_EE_3D_PLUS_GRIPPER: 3,
}


class ActionContract(ManifestBlock):
    """The action vector of the checkpoint. With `slots`, each of its `dim` values lies in exactly
    one slot."""

    dim: Annotated[int, Field(gt=0, le=_DIM_MAX)]
    representation: ActionRepresentation | None = None
    slots: Annotated[tuple[ActionSlot, ...], Field(min_length=1)] | None = None
    cartesian_delta_scale: tuple[Annotated[float, Field(gt=0)], ...] | None = None
    joint_units: Literal["degrees", "radians", "range_m100_100"] | None = None
    """Of joint positions, in actions and states. `range_m100_100` runs over the joint's range, as
    lerobot's motor buses do without degrees."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        raise_if([*self._check_cover(), *self._check_scale()])
        return self

    def _check_cover(self) -> list[Problem]:
        if self.slots is None:
            return []
        problems = []
        owner: dict[int, int] = {}
        for index, slot in enumerate(self.slots):
            place, (first, last) = ("slots", index, "range"), slot.range
            if last >= self.dim:
                said = f"ends at {last}, beyond the {self.dim} values of dim"
                problems.append(Problem(place, said))
            values = range(first, min(last, self.dim - 1) + 1)
            if (taken := next((value for value in values if value in owner), None)) is not None:
                said = f"covers value {taken}, which slots[{owner[taken]}] covers already"
                problems.append(Problem(place, said))
            owner |= dict.fromkeys([value for value in values if value not in owner], index)
        missing = [value for value in range(self.dim) if value not in owner]
        if missing and not problems:
            said = f"must cover every value of dim; not covered: {missing}. Discard what is unused"
            problems.append(Problem(("slots",), said))
        return problems

    def _check_scale(self) -> list[Problem]:
        scale = self.cartesian_delta_scale
        if scale is None:
            return []
        slots = self.slots or ()
        widths = [slot.width for slot in slots if slot.control_mode is ControlMode.CARTESIAN_DELTA]
        if not slots and self.representation in _DELTA_WIDTH:
            widths = [_DELTA_WIDTH[self.representation]]
        if not all(math.isfinite(value) for value in scale):
            return [Problem(("cartesian_delta_scale",), "must be finite")]
        if not widths or set(widths) != {len(scale)}:
            said = f"has {len(scale)} values; the cartesian_delta slots have {widths or 'none'}"
            return [Problem(("cartesian_delta_scale",), said)]
        return []
