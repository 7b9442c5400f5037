"""Which tools and skills a planner may use: a skill is executable only if its *kind* is on the allow-list.

A detector, a scene VLM or a reward model can never be executed as an action, whatever its role says: they are reached through
`locate_in_view` and `query_scene`, and only if those are provided.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from schemas.errors import CallerError, NotPermitted, UnknownSkill
from schemas.manifest import RSkillManifest
from schemas.tools import (
    EmitPrompt,
    ExecuteRskill,
    LifecycleTransition,
    LocateInView,
    QueryScene,
    ToolCall,
    function_schemas,
)

EXECUTABLE_KINDS = frozenset({"vla", "ros_action", "ros_service"})


@dataclass(frozen=True, slots=True)
class Skill:
    """What a planner needs to know of an installed skill."""

    id: str
    kind: str
    description: str
    actions: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Palette:
    """`can_locate` and `can_query` are independent: the two are provided by different sidecars."""

    skills: tuple[Skill, ...]
    can_locate: bool = True
    can_query: bool = True

    @property
    def executable(self) -> dict[str, Skill]:
        return {skill.id: skill for skill in self.skills if skill.kind in EXECUTABLE_KINDS}

    @property
    def manipulation(self) -> frozenset[str]:
        """Ids of learnt manipulation skills: what counts as an attempt."""
        return frozenset(skill.id for skill in self.skills if skill.kind == "vla")

    def first(self, action: str) -> Skill:
        """The first executable skill that offers an action verb. Raises UnknownSkill."""
        for skill in self.executable.values():
            if action in skill.actions:
                return skill
        raise UnknownSkill(
            f"no installed skill can {action}", hint="start the runner with a manifest that lists this action"
        )

    def check(self, call: ToolCall) -> CallerError | None:
        """Why a call is not allowed, or None."""
        match call:
            case ExecuteRskill(rskill_id=rskill) if rskill not in self.executable:
                kind = next((skill.kind for skill in self.skills if skill.id == rskill), None)
                if kind is not None:
                    return NotPermitted(
                        f"{rskill} is of kind {kind} and cannot be executed",
                        hint=f"choose from {_names(self.executable)}",
                    )
                return UnknownSkill(
                    f"there is no skill {rskill}", hint=f"choose from {_names(self.executable)}"
                )
            case LocateInView() if not self.can_locate:
                return NotPermitted("no detector is provided", hint="start the detector sidecar")
            case QueryScene() if not self.can_query:
                return NotPermitted("no scene VLM is provided", hint="start the scene-VLM sidecar")
            case LifecycleTransition():
                return NotPermitted(
                    "no component may be managed by this reasoner",
                    hint="the arbiter decides what is resident",
                )
            case EmitPrompt():
                return NotPermitted("this reasoner has nobody to prompt")
            case _:
                return None

    def functions(self) -> list[dict[str, Any]]:
        """OpenAI-style descriptions of what is allowed; the executable skills are listed in `execute_rskill`."""
        names = ["execute_rskill"] + ["locate_in_view"] * self.can_locate + ["query_scene"] * self.can_query
        functions = function_schemas(names)
        rskill = functions[0]["function"]["parameters"]["properties"]["rskill_id"]
        rskill["enum"] = list(self.executable)
        rskill["description"] = " ".join(
            f"{skill.id}: {skill.description}" for skill in self.executable.values()
        )
        return functions


def palette_of(manifests: Iterable[RSkillManifest], *, can_locate: bool, can_query: bool) -> Palette:
    """Palette of installed manifests."""
    skills = tuple(
        Skill(
            manifest.name,
            str(manifest.kind),
            manifest.description.strip(),
            tuple(str(action) for action in manifest.actions),
        )
        for manifest in manifests
    )
    return Palette(skills, can_locate=can_locate, can_query=can_query)


def _names(skills: dict[str, Skill]) -> str:
    return ", ".join(skills) or "nothing: no executable skill is installed"
