"""Whether a skill was made for a robot: tags, and capabilities by name and by value."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from vram_arbiter.schemas.body import UNKNOWN_BODY, Body, read_body
from vram_arbiter.schemas.manifest import RSkillManifest

BASE: dict[str, Any] = {
    "name": "lab/x", "version": "1.0.0", "kind": "vlm", "weights_uri": "local://models/x",
    "chunk_size": 1,
    "latency_budget": {"per_chunk_ms": 1}, "description": "d", "actions": ["query"],
}  # fmt: skip
ARM = Body(
    embodiment_tags=("so101_follower",),
    capabilities={"has_gripper": True, "can_lift_kg": 0.25, "fingers": 2,
    "gripper_kind": "parallel", "bimanual": False},
)  # fmt: skip


def skill_for(tags: list[str], **needs: Any) -> RSkillManifest:
    return RSkillManifest.model_validate(
        {**BASE, "embodiment_tags": tags, "capabilities_required": needs}
    )


def test_tags() -> None:
    assert ARM.misfit(skill_for(["so101_follower"])) == ""
    assert ARM.misfit(skill_for(["franka_panda", "so101_follower"])) == ""
    assert ARM.misfit(skill_for(["any"])) == UNKNOWN_BODY.misfit(skill_for(["any"])) == ""
    assert (
        ARM.misfit(skill_for(["franka_panda", "ur5e"]))
        == "it is made for franka_panda or ur5e; this robot is so101_follower"
    )
    assert "does not say what it is" in UNKNOWN_BODY.misfit(skill_for(["so101_follower"]))
    assert ARM.misfit(skill_for(["multi"])), (
        "several robots, and nobody says that this is one of them"
    )


@pytest.mark.parametrize("vague", ["any", "multi"])
def test_a_robot_is_one_robot(vague: str) -> None:
    with pytest.raises(ValidationError, match="not what a robot is"):
        Body.model_validate({"embodiment_tags": [vague]})


@pytest.mark.parametrize(
    ("needs", "said"),
    [
        ({"has_gripper": True}, ""),
        ({"bimanual": False}, ""),
        ({"never_heard_of": False}, ""),
        ({"can_lift_kg": 0.25}, ""),
        ({"fingers": 2}, ""),
        ({"gripper_kind": "parallel"}, ""),
        ({"bimanual": True}, "it needs bimanual, which this robot lacks"),
        ({"has_legs": True}, "it needs has_legs, which this robot lacks"),
        ({"has_gripper": False}, "it is not for a robot with has_gripper"),
        ({"can_lift_kg": 0.5}, "it needs can_lift_kg of at least 0.5; this robot has 0.25"),
        ({"reach_m": 0.5}, "it needs reach_m of at least 0.5; this robot has none"),
        ({"gripper_kind": "suction"}, "it needs gripper_kind 'suction'; this robot has 'parallel'"),
        ({"fingers": True}, "it needs fingers, which this robot has as 2"),
        ({"has_gripper": 1}, "it needs has_gripper of at least 1; this robot has True"),
        ({"has_gripper": "True"}, "it needs has_gripper 'True'; this robot has True"),
        (
            {"can_lift_kg": float("nan")},
            "it needs can_lift_kg of at least nan; this robot has 0.25",
        ),
    ],
)
def test_capabilities_count_by_value(needs: dict[str, Any], said: str) -> None:
    """The defect of the field: only their names were looked at, so that `can_lift_kg: 50` fitted
    every arm that can lift."""
    assert ARM.misfit(skill_for(["so101_follower"], **needs)) == said


def test_every_finding_is_named() -> None:
    fields = [field for field, _ in ARM.misfits(skill_for(["ur5e"], has_legs=True, can_lift_kg=3))]
    assert fields == [
        "embodiment_tags",
        "capabilities_required.has_legs",
        "capabilities_required.can_lift_kg",
    ]


VALUES = st.booleans() | st.integers(-3, 3) | st.floats(allow_infinity=True) | st.text(max_size=3)


@given(wanted=VALUES, have=st.none() | VALUES)
def test_a_robot_that_says_less_never_fits_more(wanted: Any, have: Any) -> None:
    manifest = skill_for(["any"], thing=wanted)
    fits = not Body(capabilities={} if have is None else {"thing": have}).misfits(manifest)
    if not UNKNOWN_BODY.misfits(manifest):
        assert wanted is False, "only what must not be there is fitted by silence"
    if fits and wanted is not False:
        assert have is not None
        assert isinstance(have, bool) == isinstance(wanted, bool)


def test_a_body_from_a_stranger() -> None:
    assert read_body(ARM.model_dump(mode="json")) == ARM
    for broken in (
        None,
        7,
        [],
        {"embodiment_tags": ["any"]},
        {"tags": []},
        {"capabilities": {"x": []}},
    ):
        assert read_body(broken) == UNKNOWN_BODY
