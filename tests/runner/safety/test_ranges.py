"""The gate before the motors."""

from typing import Any

import pytest

from vram_arbiter.runner.safety.ranges import CLAMP_TOLERANCE_RAD, JointRanges
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.world import Action, JointState, WorldState

LIMITS = {"a": (-1.0, 1.0), "b": (0.0, 2.0)}
WORLD = WorldState(
    stamp_ns=1, joint_state=JointState(name=("a", "b"), position=(0.0, 0.0), stamp_ns=1)
)


def joints(*row: float, names: tuple[str, ...] | None = ("a", "b")) -> Action:
    return Action(control_mode=ControlMode.JOINT_POSITION, joint_targets=(row,), joint_names=names)


@pytest.mark.parametrize("action", [joints(0.5, 1.0), joints(-1.0, 2.0, names=None)])
def test_what_is_inside_passes_unchanged(action: Action) -> None:
    assert JointRanges(LIMITS).check(action, WORLD) == (action, ())


def test_a_small_excess_is_clamped_and_said() -> None:
    allowed, problems = JointRanges(LIMITS).check(joints(1.0 + CLAMP_TOLERANCE_RAD / 2, 1.0), WORLD)
    assert allowed.joint_targets == ((1.0, 1.0),)
    assert "a: 1.075 rad" in problems[0]


@pytest.mark.parametrize(
    ("action", "said"),
    [
        (joints(1.5, 1.0), "outside"),
        (joints(0.0, -0.4), "outside"),
        (joints(0.0, names=("a",)), ""),
        (joints(0.0, 0.0, names=("a", "z")), "unknown joint z"),
        (joints(0.0, 0.0, 0.0, names=None), "3 joint targets for 2"),
        (Action(control_mode=ControlMode.BODY_TWIST, body_twist=((0.0,) * 6,)), "not supported"),
        (Action(control_mode=ControlMode.GRIPPER_POSITION, gripper=(0.5,)), "not supported"),
    ],
)
def test_what_is_outside_is_withheld(action: Action, said: str) -> None:
    allowed, problems = JointRanges(LIMITS).check(action, WORLD)
    if not said:
        assert allowed == action  # a subset of the joints is fine
        return
    assert allowed is None
    assert said in problems[0]


def test_the_first_violation_is_the_one_that_withholds() -> None:
    """Regression: a small excess of an earlier joint was told as the reason, with its severity."""
    allowed, problems = JointRanges(LIMITS).check(joints(1.05, 3.0), WORLD)
    assert allowed is None
    assert [problem.split(":")[0] for problem in problems] == ["b", "a"]


def test_nothing_moves_on_a_stale_state() -> None:
    stale = WORLD.model_copy(update={"diagnostics": {"joint_state": "stale"}})
    allowed, problems = JointRanges(LIMITS).check(joints(0.0, 0.0), stale)
    assert allowed is None
    assert "stale" in problems[0]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_are_none_cannot_even_become_an_action(value: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        joints(value, 0.0)


def test_a_chunk_is_checked_row_by_row() -> None:
    chunk: Any = Action(
        control_mode=ControlMode.JOINT_POSITION,
        horizon=2,
        joint_targets=((0.0, 0.0), (5.0, 0.0)),
        joint_names=("a", "b"),
    )
    assert JointRanges(LIMITS).check(chunk, WORLD)[0] is None
