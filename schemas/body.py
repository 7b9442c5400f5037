"""What a robot is and can, and whether a skill was made for it: its embodiment and the capabilities
that the manifest asks for.

Pure. The runner says its body with the list of its skills and refuses goals that do not fit it; a
planner reads the same words, so that what is offered and what is accepted cannot differ. A body
that says nothing is fitted only by skills for any robot that ask for nothing.
"""

from collections.abc import Mapping
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from vram_arbiter.schemas.manifest.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import EmbodimentTag

ANY = "any"
MULTI = "multi"
NOT_A_ROBOT = frozenset({ANY, MULTI})  # words for skills; no robot is all robots
CAPABILITIES_MAX = 256

Capability = bool | int | float | Annotated[str, Field(max_length=256)]
Finding = tuple[str, str]
"""Field of the manifest, and what of it does not fit."""


class Body(BaseModel):
    """`capabilities` are facts by name: true, a number (the most that it can), a word."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    embodiment_tags: tuple[EmbodimentTag, ...] = ()
    capabilities: Annotated[dict[str, Capability], Field(max_length=CAPABILITIES_MAX)] = {}

    @model_validator(mode="after")
    def _is_one_robot(self) -> Self:
        if vague := [tag for tag in self.embodiment_tags if tag in NOT_A_ROBOT]:
            raise ValueError(f"{vague[0]!r} is what a skill may be made for, not what a robot is")
        return self

    def misfits(self, manifest: RSkillManifest) -> list[Finding]:
        """Why a skill is not for this robot; empty: it is.

        Names and values of capabilities count. `true` has to be true, `false` must not be true, a
        number is the least that is needed, a word has to be the same. A number never stands for a
        truth nor the other way round.
        """
        found: list[Finding] = []
        tags = manifest.embodiment_tags
        if ANY not in tags and not set(tags) & set(self.embodiment_tags):
            here = (
                f"is {' and '.join(self.embodiment_tags)}"
                if self.embodiment_tags
                else "does not say what it is"
            )
            found.append(
                ("embodiment_tags", f"it is made for {' or '.join(tags)}; this robot {here}")
            )
        for name, wanted in manifest.capabilities_required.items():
            if problem := _lacks(name, self.capabilities.get(name), wanted):
                found.append((f"capabilities_required.{name}", problem))
        return found

    def misfit(self, manifest: RSkillManifest) -> str:
        """The same as one text for people; empty: it fits."""
        return "; ".join(problem for _, problem in self.misfits(manifest))


UNKNOWN_BODY = Body()
"""A robot of which nothing is known."""


def read_body(value: object) -> Body:
    """A body as it came over a wire. What is missing or cannot be read is a body of which nothing
    is known: fewer skills, never more."""
    if not isinstance(value, Mapping):
        return UNKNOWN_BODY
    try:
        return Body.model_validate(dict(value))
    except ValidationError:
        return UNKNOWN_BODY


def _lacks(name: str, have: Capability | None, wanted: Capability) -> str:
    """Return what is wrong with a capability; empty: the robot has it."""
    match wanted:
        case True:
            has = "lacks" if have in (None, False) else f"has as {have!r}"
            return "" if have is True else f"it needs {name}, which this robot {has}"
        case False:
            return f"it is not for a robot with {name}" if have is True else ""
        case int() | float():
            if isinstance(have, int | float) and not isinstance(have, bool) and have >= wanted:
                return ""
            shown = "none" if have is None else have
            return f"it needs {name} of at least {wanted:g}; this robot has {shown}"
        case _:
            shown = "none" if have is None else repr(have)
            return "" if have == wanted else f"it needs {name} {wanted!r}; this robot has {shown}"
