"""The table of kinds, cell by cell: what a kind requires is missed, what it forbids is refused,
what is free is accepted."""

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from vram_arbiter.schemas.findings import problems_of
from vram_arbiter.schemas.manifest import Kind, RSkillManifest
from vram_arbiter.schemas.manifest.kinds import KINDS, RULES, check_kind

FOLDER = Path(__file__).parent / "samples"
SAMPLES: dict[Kind, dict[str, Any]] = {
    kind: yaml.safe_load((FOLDER / f"{kind.value}.yaml").read_text(encoding="utf-8"))
    for kind in KINDS
}

VALUES: dict[str, Any] = {
    **{
        field: value
        for data in SAMPLES.values()
        for field, value in data.items()
        if field in RULES and value
    },
    "model_family": "act",  # pi05 would ask for processors
    "environment": ["transformers==5.5.0"],
}
"""A valid value for every field of the table."""

FORBIDDEN = [
    (kind, field) for field, row in RULES.items() for kind, rule in row.items() if rule == "F"
]
REQUIRED = [
    (kind, field) for field, row in RULES.items() for kind, rule in row.items() if rule == "R"
]
FREE = [(kind, field) for field, row in RULES.items() for kind, rule in row.items() if rule == "-"]


def problems(data: dict[str, Any]) -> set[str]:
    try:
        RSkillManifest.model_validate(data)
    except ValidationError as error:
        return {problem.field for problem in problems_of(error, RSkillManifest, data)}
    return set()


def sample_of(kind: Kind) -> dict[str, Any]:
    return copy.deepcopy(SAMPLES[kind])


def test_every_field_of_the_table_is_a_field_of_the_manifest() -> None:
    assert set(RULES) <= set(RSkillManifest.model_fields)
    assert set(RULES) == set(VALUES)


@given(st.sampled_from(FORBIDDEN))
def test_forbidden_field_is_refused(cell: tuple[Kind, str]) -> None:
    kind, field = cell
    assert problems(sample_of(kind) | {field: VALUES[field]}) == {field}


@given(st.sampled_from(REQUIRED), st.sampled_from(["absent", "null", "empty"]))
def test_missing_required_field_is_refused(cell: tuple[Kind, str], how: str) -> None:
    kind, field = cell
    data = sample_of(kind)
    del data[field]
    if how == "empty":
        data |= {field: [] if isinstance(VALUES[field], list) else None}
    elif how == "null" and not isinstance(VALUES[field], list):
        data |= {field: None}
    assert problems(data) == {field}


@given(st.sampled_from(FREE))
def test_free_field_is_accepted_and_may_be_left_out(cell: tuple[Kind, str]) -> None:
    kind, field = cell
    assert problems(sample_of(kind) | {field: VALUES[field]}) == set()
    # required of every kind, or by the family
    if field not in ("chunk_size", "actions", "processors"):
        data = sample_of(kind)
        data.pop(field, None)
        assert problems(data) == set()


@given(st.sampled_from(KINDS), st.integers(2, 1000))
def test_chunks_of_one_where_rows_are_checked_one_by_one(kind: Kind, chunk_size: int) -> None:
    expected = (
        {"chunk_size"} if kind in (Kind.ROS_ACTION, Kind.ROS_SERVICE, Kind.PLAYBOOK) else set()
    )
    assert problems(sample_of(kind) | {"chunk_size": chunk_size}) == expected


@given(st.sampled_from(KINDS), st.sampled_from(["s0", "s1", None]))
def test_only_playbooks_are_bound_to_a_role(kind: Kind, role: str | None) -> None:
    data = sample_of(kind) | {"role": role}
    if role is None:  # the default, s1
        del data["role"]
    assert problems(data) == ({"role"} if kind is Kind.PLAYBOOK else set())


@given(
    st.sampled_from(KINDS),
    st.sets(st.sampled_from(sorted(set(VALUES) - {"chunk_size", "role", "actions"}))),
)
def test_any_set_of_extra_fields_is_judged_field_by_field(kind: Kind, extra: set[str]) -> None:
    data = sample_of(kind) | {field: VALUES[field] for field in extra}
    assert problems(data) == {field for field in extra if RULES[field][kind] == "F"}


@pytest.mark.parametrize("kind", KINDS)
def test_raw_and_validated_values_are_judged_alike(kind: Kind) -> None:
    assert check_kind(kind, sample_of(kind)) == []
    assert {problem.field for problem in check_kind(kind, {})} >= {
        field for field, row in RULES.items() if row[kind] == "R"
    }
