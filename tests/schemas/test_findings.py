"""Findings name the place as people write it, and what would be right there."""

from enum import StrEnum
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, RootModel, ValidationError, model_validator

from vram_arbiter.schemas.findings import Problem, problems_of, raise_if


class Color(StrEnum):
    RED = "red"
    GREEN = "green"


class Joint(BaseModel):
    model_config = ConfigDict(extra="forbid")
    max_rad: Annotated[float, Field(gt=0)] = 1.0
    color: Color = Color.RED


class Robot(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: Annotated[str, Field(pattern="^[a-z]+$", description="a word in small letters")] = "arm"
    joints: dict[str, Joint] = {}
    spares: tuple[Joint, ...] | None = None
    mode: Literal["sim", "real"] = "sim"
    tag: int | None = None
    low: float = 0

    @model_validator(mode="after")
    def _check(self) -> "Robot":
        raise_if([Problem(("low",), "is below -1")] if self.low < -1 else [])
        return self


class Robots(RootModel[dict[str, Robot]]):
    pass


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"nmae": "x"}, "nmae: unknown key; did you mean name?"),
        (
            {"zzz": 1},
            "zzz: unknown key; known here: joints, low, mode, name, spares, tag",
        ),
        ({"joints": {"elbow": {"max_rda": 1}}},
         "joints.elbow.max_rda: unknown key; did you mean max_rad?"),
        ({"spares": [{}, {"colour": 1}]}, "spares[1].colour: unknown key; did you mean color?"),
        ({"name": "A1"}, "name: 'A1' is not a word in small letters"),
        ({"mode": "reel"}, "mode: 'reel' is not one of 'sim' or 'real'; did you mean real?"),
        ({"mode": 7}, "mode: 7 is not one of 'sim' or 'real'"),
        ({"joints": {"elbow": {"color": "gren"}}},
         "joints.elbow.color: 'gren' is not one of 'red' or 'green'; did you mean green?"),
        ({"joints": {"elbow": {"max_rad": 0}}},
         "joints.elbow.max_rad: must be greater than 0, not 0"),
        ({"joints": []}, "joints: must be a mapping of fields, not []"),
        ({"spares": "x"}, "spares: must be a list, not 'x'"),
        ({"name": 5}, "name: must be a valid string, not 5; put it in quotes"),
        ({"tag": "x"}, "tag: must be a valid integer, not 'x'"),
        ({"tag": 1.5}, "tag: must be a valid integer, not 1.5"),
        ({"low": -2}, "low: is below -1"),
        ([], "must be a mapping of fields, not []"),
    ],
)  # fmt: skip
def test_a_finding_says_where_and_what(data: Any, said: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Robot.model_validate(data)
    assert [str(problem) for problem in problems_of(caught.value, Robot, data)] == [said]
    inside = {"mine": data}
    with pytest.raises(ValidationError) as caught:
        Robots.model_validate(inside)
    (found,) = problems_of(caught.value, Robots, inside)
    assert (found.path[0], found.message) == ("mine", said.partition(": ")[2] if data else said)
