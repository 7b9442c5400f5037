"""The tools that a reasoner may call, as frozen values discriminated by `tool`.

Only the shapes: what a call does, whether it is allowed and what serves it are the reasoner's
business. The same classes give the function schemas that are offered to a language model, so that
what is offered and what is accepted cannot drift apart.

A skill may also be offered as a function of its own, `execute_rskill__OWNER__REPO`, with the
parameters its manifest describes: `skill_tool_name` names it, `skill_function` describes it,
`parse_skill_call` reads it back as an `ExecuteRskill`.
"""

import copy
import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Annotated, Literal, TypedDict, get_args

from pydantic import (
    AliasChoices,
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    TypeAdapter,
    ValidationError,
    field_validator,
)

from vram_arbiter.schemas import strictjson
from vram_arbiter.schemas.errors import BadRequest, UnknownOp
from vram_arbiter.schemas.plain import JsonMap, JsonObject

PROGRESS_WINDOW_MAX_S = 60.0
CLIP_FRAMES_MAX, CLIP_MAX_S = 16, 10.0  # of one question to a scene VLM
TOOL_NAME_MAX_CHARS = 64  # what the public chat APIs accept

Text = Annotated[str, Field(max_length=4096)]
Words = Annotated[Text, Field(min_length=1)]
Name = Annotated[str, Field(min_length=1, max_length=256)]
Camera = Annotated[
    str, Field(max_length=128, description="Name of the camera; empty: the default one.")
]


class _Tool(BaseModel):
    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        populate_by_name=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )

    rationale: Annotated[Text, Field(validation_alias=AliasChoices("rationale", "rational"))] = ""
    """One sentence: why this call, now."""


class ExecuteRskill(_Tool):
    """Run an installed skill on the robot and wait for its result. The only tool that moves
    anything."""

    tool: Literal["execute_rskill"] = "execute_rskill"
    rskill_id: Name
    """Name of the skill, OWNER/REPOSITORY."""
    prompt: Text = ""
    """What the skill is to do, in words."""
    goal_params_json: Text = ""
    """JSON object with the skill's structured parameters; empty for none."""
    deadline_s: Annotated[float, Field(ge=0)] = 0.0
    """Seconds until it is cancelled; 0: as the manifest says."""
    patience_s: Annotated[float | None, Field(gt=0)] = None
    """Cancel it when its progress stands still for so long, seconds."""
    progress_tolerance: Annotated[float | None, Field(ge=0, le=1)] = None
    """A gain of progress (0..1) no larger than this is none."""
    next_rskill_id: Annotated[str, Field(max_length=256)] = ""
    """The skill that follows, so that its model is made ready meanwhile. It starts nothing."""

    @field_validator("goal_params_json")
    @classmethod
    def _is_json_object(cls, text: str) -> str:
        if text:
            try:
                value = strictjson.loads(text)
            except ValueError as error:
                raise ValueError(f"must be empty or a JSON object: {error}") from error
            if not isinstance(value, dict):
                raise ValueError("must be empty or a JSON object")
        return text

    @property
    def goal_params(self) -> dict[str, JsonValue]:
        """The structured parameters as a dict; empty if none were given."""
        params: dict[str, JsonValue] = (
            json.loads(self.goal_params_json) if self.goal_params_json else {}
        )
        return params


class LocateInView(_Tool):
    """Look for an object in a camera's present picture. Moves nothing."""

    tool: Literal["locate_in_view"] = "locate_in_view"
    query: Words
    """The object, in words, e.g. `red cube`."""
    camera: Camera = ""


class QueryScene(_Tool):
    """Ask a question about a camera's present picture, or a short clip, and get a sentence back.
    Moves nothing."""

    tool: Literal["query_scene"] = "query_scene"
    question: Words
    """A question that the picture can answer."""
    camera: Camera = ""
    frames: Annotated[int, Field(ge=1, le=CLIP_FRAMES_MAX)] = 1
    """Number of pictures; several are a clip that begins now, for questions about what changes."""
    seconds: Annotated[float, Field(gt=0, le=CLIP_MAX_S)] = 2.0
    """Length of the clip."""


class Look(_Tool):
    """Look at a camera's present picture yourself. Moves nothing."""

    tool: Literal["look"] = "look"
    camera: Camera = ""


class QueryTaskProgress(_Tool):
    """Ask the reward model how far along a task the newest pictures show the robot to be. Moves
    nothing; its word is an opinion, never a proof."""

    tool: Literal["query_task_progress"] = "query_task_progress"
    window_s: Annotated[float, Field(gt=0, le=PROGRESS_WINDOW_MAX_S)] = 8.0
    """How far to look back, seconds."""
    task: Text = ""
    """Progress towards what, in words; empty: the present task."""


class LifecycleTransition(_Tool):
    """Configure, activate, deactivate or clean up a component that the reasoner is allowed to
    manage."""

    tool: Literal["lifecycle_transition"] = "lifecycle_transition"
    node: Name
    """Name of the component."""
    transition: Literal["configure", "activate", "deactivate", "cleanup"]


class EmitPrompt(_Tool):
    """Say something to another component or to the operator. Moves nothing."""

    tool: Literal["emit_prompt"] = "emit_prompt"
    target_topic: Annotated[str, Field(pattern=r"^/\S+$", max_length=256)]
    """Where to, starting with `/`."""
    text: Words


class WaitOn(_Tool):
    """Let the goal that runs go on."""

    tool: Literal["wait"] = "wait"


class StopGoal(_Tool):
    """Cancel the goal that runs. The robot holds where it is."""

    tool: Literal["stop_goal"] = "stop_goal"


ToolCall = (
    ExecuteRskill
    | LocateInView
    | QueryScene
    | Look
    | QueryTaskProgress
    | LifecycleTransition
    | EmitPrompt
    | WaitOn
    | StopGoal
)

TOOLS: dict[str, type[ToolCall]] = {
    tool.model_fields["tool"].default: tool for tool in get_args(ToolCall)
}

TOOL_CALL: TypeAdapter[ToolCall] = TypeAdapter(Annotated[ToolCall, Field(discriminator="tool")])


def read_arguments(name: str, arguments: str | JsonMap) -> dict[str, JsonValue]:
    """A call's arguments, a JSON text (empty: none) or a mapping, as a dict. Raises BadRequest, see
    `schemas.strictjson`."""
    try:
        value = strictjson.loads(arguments or "{}") if isinstance(arguments, str) else arguments
        strictjson.check(value)
    except ValueError as error:
        raise BadRequest(f"{name}: the arguments are not JSON: {error}") from error
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise BadRequest(f"{name}: the arguments are not a JSON object")
    return dict(value)


def parse_tool_call(name: str, arguments: str | JsonMap) -> ToolCall:
    """Read a call as language models make it: the function's name and its arguments, a JSON text or
    a mapping.

    Raises UnknownOp for a tool that does not exist and BadRequest, field by field, for wrong
    arguments.
    """
    if name not in TOOLS:
        raise UnknownOp(
            f"there is no tool {name!r}",
            hint=f"choose from {', '.join(TOOLS)}",
            details={"known": [*TOOLS]},
        )
    arguments = read_arguments(name, arguments)
    try:
        return TOOL_CALL.validate_python({**arguments, "tool": name})
    except ValidationError as error:
        fields = [
            {"path": ".".join(map(str, item["loc"][1:])) or name, "problem": item["msg"]}
            for item in error.errors(include_url=False, include_input=False)
        ]
        text = "; ".join(f"{field['path']}: {field['problem']}" for field in fields)
        raise BadRequest(f"{name}: {text}", details={"fields": fields}) from error


def skill_tool_name(rskill_id: str) -> str:
    """`execute_rskill__OWNER__REPO`, letters, digits, `_` and `-`, at most 64. Different skills
    never share a name.

    A name that would be too long, or that cannot be read back because letters were replaced or
    underscores run together, ends in `_` and eight digits of the id's SHA-1.
    """
    name = "execute_rskill__" + "__".join(
        re.sub(r"[^A-Za-z0-9_-]", "_", part) for part in rskill_id.split("/")
    )
    if len(name) <= TOOL_NAME_MAX_CHARS and re.fullmatch(f"{_PLAIN}/{_PLAIN}", rskill_id):
        return name
    digits = hashlib.sha1(
        rskill_id.encode(errors="surrogatepass"), usedforsecurity=False
    ).hexdigest()[:8]
    return f"{name[: TOOL_NAME_MAX_CHARS - 9]}_{digits}"


_PLAIN = "[A-Za-z0-9-]+(?:_[A-Za-z0-9-]+)*"


class Function(TypedDict):
    """A function as a language model is told of it."""

    name: str
    description: str
    parameters: JsonObject
    """A JSON Schema."""


class FunctionTool(TypedDict):
    """An entry of `tools` in a request of OpenAI's chat completions."""

    type: Literal["function"]
    function: Function


def skill_function(
    rskill_id: str,
    description: str,
    goal_params_schema: JsonMap | None,
    *,
    prompted: bool = True,
    followers: Sequence[str] = (),
) -> FunctionTool:
    """The function description of one skill: `execute_rskill` without `rskill_id`, its parameters
    as the manifest describes them.

    `goal_params` takes the place of `goal_params_json` where the manifest has a schema; a skill
    without one takes none. Only a skill that is `prompted` reads words. `followers` are the choices
    of `next_rskill_id`.
    """
    function = function_schema(ExecuteRskill)
    body = function["function"]
    body["name"], body["description"] = skill_tool_name(rskill_id), " ".join(description.split())
    parameters = body["parameters"]
    del (
        parameters["properties"]["rskill_id"],
        parameters["properties"]["goal_params_json"],
        parameters["required"],
    )
    if not prompted:
        del parameters["properties"]["prompt"]
    following = parameters["properties"].pop("next_rskill_id")
    if followers:
        parameters["properties"]["next_rskill_id"] = {
            "type": "string",
            "enum": [*followers],
            "description": following["description"],
        }
    if goal_params_schema:
        parameters["properties"]["goal_params"] = copy.deepcopy(dict(goal_params_schema))
    return function


def parse_skill_call(rskill_id: str, arguments: str | JsonMap) -> ExecuteRskill:
    """Read a call of a skill's own function. Raises BadRequest; whether the parameters fit the
    skill is the palette's to say."""
    name = skill_tool_name(rskill_id)
    fields = read_arguments(name, arguments)
    if stray := [key for key in ("rskill_id", "goal_params_json", "tool") if key in fields]:
        raise BadRequest(f"{name}: {stray[0]}: is not an argument of this function")
    params = fields.pop("goal_params", None)
    if params is not None and not isinstance(params, Mapping):
        raise BadRequest(f"{name}: goal_params: must be a JSON object")
    if params:
        fields["goal_params_json"] = json.dumps(params, sort_keys=True, separators=(",", ":"))
    call = parse_tool_call("execute_rskill", fields | {"rskill_id": rskill_id})
    assert isinstance(call, ExecuteRskill), "the name says so"
    return call


def function_schema(tool: type[ToolCall]) -> FunctionTool:
    """The function description of a tool, the caller's own."""
    return copy.deepcopy(_function_schema(tool))


@cache
def _function_schema(tool: type[ToolCall]) -> FunctionTool:
    """Pydantic takes a millisecond for it, and each question to a planner offers all of them."""
    parameters = tool.model_json_schema(by_alias=False)
    name = parameters["properties"].pop("tool")["const"]
    description = " ".join(parameters.pop("description").split())
    parameters.pop("title", None)
    for field in parameters["properties"].values():
        field.pop("title", None)
    function = Function(name=name, description=description, parameters=parameters)
    return FunctionTool(type="function", function=function)


def function_schemas(names: Iterable[str] | None = None) -> list[FunctionTool]:
    """Function descriptions of the named tools, or of all. Raises KeyError for a name that is no
    tool."""
    return [function_schema(TOOLS[name]) for name in (TOOLS if names is None else names)]
