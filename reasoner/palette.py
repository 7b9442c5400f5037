"""Tools and skills that a planner may use: executable only if their *kind* is on the allow-list.

A detector, a scene VLM or a reward model can never be executed as an action, whatever its role:
they are reached through `locate_in_view`, `query_scene` and `query_task_progress`, and only if
those are provided. A playbook is read, not executed. A model for another robot, or one that needs
what this one lacks, is listed and refused with the reason. What is offered and what is accepted
come from the same fields; `check` is asked again for each call.
"""

import dataclasses
import re
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass, field

from vram_arbiter.reasoner.params import JsonSchema, misfits
from vram_arbiter.schemas.body import UNKNOWN_BODY, Body
from vram_arbiter.schemas.errors import BadRequest, CallerError, NotPermitted, UnknownSkill
from vram_arbiter.schemas.manifest import Role, RSkillManifest
from vram_arbiter.schemas.plain import JsonMap, JsonObject
from vram_arbiter.schemas.tools import (
    EmitPrompt,
    ExecuteRskill,
    FunctionTool,
    LifecycleTransition,
    LocateInView,
    Look,
    QueryScene,
    StopGoal,
    ToolCall,
    WaitOn,
    function_schemas,
    parse_skill_call,
    parse_tool_call,
    skill_function,
    skill_tool_name,
)

EXECUTABLE_KINDS = frozenset({"vla", "ros_action", "ros_service"})
# they have a model and read words; the others have their goal in its parameters
PROMPTED_KINDS = frozenset({"vla"})
WHILE_A_GOAL_RUNS = frozenset({"wait", "stop_goal"})
OPERATOR = "/operator"
OPEN = "open-vocabulary"  # in `objects` of a manifest: any word
ARTICLES = frozenset({"a", "an", "the"})

FINISH = "finish"  # how a language model ends a task: offered always, and no tool of the robot's
_PROVIDED = {  # tool → what says that it is there, why it is not, and what would provide it
    "locate_in_view": ("can_locate", "no detector is provided", "start the detector sidecar"),
    "query_scene": ("can_query", "no scene VLM is provided", "start the scene-VLM sidecar"),
    "look": (
        "can_look",
        "no pictures are shown to this planner",
        "start the reasoner with --look",
    ),
    "query_task_progress": (
        "can_judge",
        "no reward model is provided",
        "start the reward sidecar, and the reasoner with --reward",
    ),
}
_ASKED_THROUGH = {
    "detector": "locate_in_view",
    "vlm": "query_scene",
    "reward": "query_task_progress",
}
_USED_AS = {
    "playbook": "it is a text for the planner: --playbook FILE",
    "wam": "nothing here runs world action models",
}


@dataclass(frozen=True, slots=True)
class Skill:
    """What a planner needs to know of an installed skill."""

    id: str
    kind: str
    description: str
    actions: tuple[str, ...]
    goal_params_schema: JsonSchema | None = None
    barred: str = ""
    """Why it must not be used although its kind could be; empty: it may."""
    longest_s: float = 0.0
    """Of its motion, as its manifest says; 0: it does not."""
    vocabulary: frozenset[str] = frozenset()
    """Words that a detector's manifest names, lower case; empty: any word may be known."""

    def unknown_words(self, query: str) -> list[str]:
        """Return the words of a query that the manifest does not name."""
        if not self.vocabulary:
            return []
        named = self.vocabulary | ARTICLES
        return [word for word in words_of(query) if word not in named]


@dataclass(frozen=True, slots=True)
class Palette:
    """`can_locate`, `can_query` and `can_judge` are independent: different sidecars provide them.
    `can_look`: the planner may see pictures itself.

    `managed` names the components that `lifecycle_transition` may touch, `topics` where
    `emit_prompt` may publish; empty: the tool is not there. `only` restricts all of it to the tools
    that a playbook composes; None does not.
    """

    skills: tuple[Skill, ...]
    can_locate: bool = True
    can_query: bool = True
    can_judge: bool = False
    can_look: bool = False
    cameras: tuple[str, ...] = ()
    """Of the robot, the default one first; empty: not known."""
    body: Body = UNKNOWN_BODY
    managed: frozenset[str] = frozenset()
    topics: frozenset[str] = frozenset()
    only: frozenset[str] | None = None
    benched: frozenset[str] = field(default_factory=frozenset)
    """Refuse skills that could not be started several times in a row, for the rest of the
    episode.
    """

    @property
    def executable(self) -> dict[str, Skill]:
        return {
            skill.id: skill
            for skill in self.skills
            if skill.kind in EXECUTABLE_KINDS and not skill.barred and skill.id not in self.benched
        }

    def followers(self, rskill_id: str) -> tuple[str, ...]:
        """Return the skills that `next_rskill_id` may name: the other ones with a model."""
        return tuple(
            skill.id
            for skill in self.executable.values()
            if skill.kind in PROMPTED_KINDS and skill.id != rskill_id
        )

    @property
    def manipulation(self) -> frozenset[str]:
        """Ids of learnt manipulation skills: what counts as an attempt."""
        return frozenset(skill.id for skill in self.skills if skill.kind == "vla")

    @property
    def tools(self) -> frozenset[str]:
        """Names of the tools that are there while no goal runs."""
        given = {name: getattr(self, needs[0]) for name, needs in _PROVIDED.items()} | {
            "execute_rskill": self.executable,
            "lifecycle_transition": self.managed,
            "emit_prompt": self.topics,
        }
        names = frozenset(name for name, there in given.items() if there)
        return names if self.only is None else names & self.only

    def first(self, action: str) -> Skill:
        """Return the first executable skill that offers an action verb. Raises UnknownSkill."""
        for skill in self.executable.values():
            if action in skill.actions:
                return skill
        barred = [
            f"{skill.id}: {skill.barred}"
            for skill in self.skills
            if action in skill.actions and skill.barred
        ]
        raise UnknownSkill(
            f"no installed skill can {action}",
            hint="; ".join(barred) or "start the runner with a manifest that lists this action",
        )

    def without(self, benched: Set[str]) -> "Palette":
        """Return the same palette without these skills."""
        return dataclasses.replace(self, benched=frozenset(benched))

    # -- is a call allowed?
    def check(self, call: ToolCall, *, goal_runs: bool = False) -> CallerError | None:
        """Return why a call is not allowed, or None."""
        if isinstance(call, WaitOn | StopGoal):
            return None if goal_runs else NotPermitted("no goal runs", hint=self.choice())
        if goal_runs:
            return NotPermitted(
                f"a goal runs: {call.tool} has to wait", hint=self.choice(goal_runs=True)
            )
        if self.only is not None and call.tool not in self.only:
            return NotPermitted(f"{call.tool} is not a tool of this playbook", hint=self.choice())
        if call.tool in _PROVIDED and call.tool not in self.tools:
            _, why, hint = _PROVIDED[call.tool]
            return NotPermitted(why, hint=hint)
        match call:
            case ExecuteRskill():
                return self._check_skill(call)
            case LocateInView(camera=name) | QueryScene(camera=name) | Look(camera=name) if (
                name and self.cameras and name not in self.cameras
            ):
                hint = f"choose from {', '.join(self.cameras)}"
                return BadRequest(f"unknown camera {name}", hint=hint)
            case LifecycleTransition() if call.node not in self.managed:
                hint = f"it may manage {_list(self.managed)}; the arbiter decides what is resident"
                return NotPermitted(f"{call.node} may not be managed by this reasoner", hint=hint)
            case EmitPrompt() if call.target_topic not in self.topics:
                hint = f"choose from {_list(self.topics)}"
                return NotPermitted(f"prompts to {call.target_topic} are not allowed", hint=hint)
            case _:
                return None

    def _check_skill(self, call: ExecuteRskill) -> CallerError | None:
        skill = self.executable.get(call.rskill_id)
        if skill is not None:
            given = call.goal_params_json
            if wrong := misfits(call.goal_params, skill.goal_params_schema) if given else []:
                return BadRequest(f"{skill.id}: {'; '.join(wrong[:8])}", hint="see its parameters")
            return None
        known = next((known for known in self.skills if known.id == call.rskill_id), None)
        if known is None:
            return UnknownSkill(f"unknown skill {call.rskill_id}", hint=self.choice())
        if known.kind not in EXECUTABLE_KINDS:
            through = _ASKED_THROUGH.get(known.kind)
            how = _USED_AS.get(known.kind, "nothing here serves it")
            how = f"it is asked through {through}" if through in self.tools else how
            why = f"is of kind {known.kind} and cannot be executed: {how}"
        elif known.barred:
            why = f"must not be used: {known.barred}"
        else:
            why = "could not be started several times"
        return NotPermitted(f"{known.id} {why}", hint=self.choice())

    def permits(self, rskill_id: str) -> CallerError | None:
        """Return whether the model that a perception sidecar serves may be asked.

        A model that is not listed here is its operator's responsibility.
        """
        for skill in self.skills:
            if skill.id == rskill_id and skill.barred:
                return NotPermitted(f"{rskill_id} must not be used: {skill.barred}")
        return None

    # -- what is offered, and how it is read back
    def choice(self, *, goal_runs: bool = False) -> str:
        """Return the hint of a refusal: the names that are offered now, and no others."""
        names = [str(offer["function"]["name"]) for offer in self.functions(goal_runs=goal_runs)]
        return f"choose from {_list([*names, FINISH])}"

    def functions(self, *, goal_runs: bool = False) -> list[FunctionTool]:
        """Return OpenAI-style descriptions of the tools and executable skills that are allowed
        now.
        """
        if goal_runs:
            return function_schemas(sorted(WHILE_A_GOAL_RUNS))
        tools = self.tools
        offered = []
        if "execute_rskill" in tools:
            offered += [
                skill_function(
                    skill.id,
                    skill.description,
                    skill.goal_params_schema,
                    prompted=skill.kind in PROMPTED_KINDS,
                    followers=self.followers(skill.id),
                )
                for skill in self.executable.values()
            ]
        for name, parameter, choices in (
            *((name, "camera", self.cameras) for name in _PROVIDED),
            ("lifecycle_transition", "node", sorted(self.managed)),
            ("emit_prompt", "target_topic", sorted(self.topics)),
        ):
            if name in tools:
                offered += [_choosing(one, parameter, choices) for one in function_schemas([name])]
        return offered

    def parse(self, name: str, arguments: str | JsonMap) -> ToolCall:
        """Read a call by the name of its offer, or by the tool's own.

        Raises UnknownOp and BadRequest.
        """
        for skill in self.skills:
            if skill_tool_name(skill.id) == name:
                call = parse_skill_call(skill.id, arguments)
                if call.goal_params and not skill.goal_params_schema:
                    raise BadRequest(f"{name}: takes no goal_params", hint="leave them out")
                return call
        return parse_tool_call(name, arguments)


def _choosing(offer: FunctionTool, parameter: str, choices: Sequence[str]) -> FunctionTool:
    """Let a function's parameter be one of these; of cameras the first is the default."""
    properties = offer["function"]["parameters"]["properties"]
    if choices and parameter in properties:
        chosen: JsonObject = {"type": "string", "enum": [*choices]}
        if parameter == "camera":
            chosen["description"] = f"Name of the camera; without it: {choices[0]}."
        properties[parameter] = chosen
    return offer


def skills_of(
    manifests: Iterable[RSkillManifest],
    *,
    allow_noncommercial: bool = False,
    body: Body = UNKNOWN_BODY,
) -> tuple[Skill, ...]:
    """Return the skills of installed manifests, by name: read from folders in another order they
    are the same prompt.

    Templates, models that do not fit the robot's `body` and, unless allowed, those whose license
    forbids commercial use are listed but barred. A robot without a described body gets what fits
    any body.
    """
    return tuple(
        Skill(
            manifest.name,
            str(manifest.kind),
            manifest.description.strip(),
            tuple(str(action) for action in manifest.actions),
            manifest.goal_params_schema,
            _barred(manifest, allow_noncommercial) or body.misfit(manifest),
            manifest.latency_budget.max_execution_s or 0.0,
            _vocabulary(manifest),
        )
        for manifest in sorted(manifests, key=lambda manifest: manifest.name)
    )


def words_of(text: str) -> list[str]:
    """Return the words of a text, in lower case."""
    return re.findall(r"[^\W_]+", text.lower())


def _vocabulary(manifest: RSkillManifest) -> frozenset[str]:
    """Return the words of a detector that says which objects and labels it is for."""
    labels = manifest.detector.labels if manifest.detector is not None else ()
    if not labels or not manifest.objects or any(OPEN in name for name in manifest.objects):
        return frozenset()
    return frozenset(word for name in (*labels, *manifest.objects) for word in words_of(name))


def _barred(manifest: RSkillManifest, allow_noncommercial: bool) -> str:
    if manifest.is_scaffold_placeholder:
        return "its manifest is still the template"
    if manifest.kind in EXECUTABLE_KINDS and manifest.role is not Role.S1:
        return f"its role is {manifest.role}, and only {Role.S1} acts"
    return manifest.license_refusal(allow_noncommercial=allow_noncommercial)


def _list(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "nothing"
