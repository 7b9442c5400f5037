"""Joint targets as actions, and bounded motion to a known pose: the arm folds before it drives or
before a policy begins.

Pure: joint names and radians in, targets out, one per control step.
"""

from __future__ import annotations

from collections.abc import Mapping

from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.world import Action, Twist, WorldState

SPEED_RAD_S = 1.6
REACHED_RAD = 0.06  # servos under load stop a little short
SETTLE_STEPS_MAX = 45  # after the target stands still the arm gets 1.5 s to arrive


def joint_positions(world: WorldState, names: tuple[str, ...]) -> dict[str, float]:
    """Return measured positions of the named joints. Raises ModelError for a missing or stale
    one.
    """
    if "joint_state" in world.stale:
        raise ModelError("the joint state is stale", hint="nothing moves on an old state")
    known = dict(zip(world.joint_state.name, world.joint_state.position, strict=True))
    missing = [name for name in names if name not in known]
    if missing:
        raise ModelError(f"the joint state lacks {', '.join(missing)}")
    return {name: known[name] for name in names}


def action_of(
    targets: Mapping[str, float],
    stamp_ns: int,
    twist: Twist | None = None,
    confidence: float = 1.0,
) -> Action:
    """Return an action of joint targets (rad), with a base's velocity, or of that alone."""
    driving = None if twist is None else (twist,)
    if not targets and driving is not None:
        return Action(
            control_mode=ControlMode.BODY_TWIST,
            body_twist=driving,
            confidence=confidence,
            stamp_ns=stamp_ns,
        )
    return Action(
        control_mode=ControlMode.JOINT_POSITION,
        joint_targets=(tuple(targets.values()),),
        joint_names=tuple(targets),
        body_twist=driving,
        confidence=confidence,
        stamp_ns=stamp_ns,
    )


def bounded(here: float, there: float, reach: float) -> float:
    """Return `here` moved towards `there`, by `reach` at most."""
    return here + min(max(there - here, -reach), reach)


class JointRamp:
    """Motion from the present pose to `goal` (rad, by name) at SPEED_RAD_S; `longest` are the
    longest steps (rad) of joints that are slower.

    `done` when the joints arrived, or cannot go further.
    """

    def __init__(
        self,
        start: Mapping[str, float],
        goal: Mapping[str, float],
        *,
        period_s: float,
        longest: Mapping[str, float] | None = None,
    ) -> None:
        self._target = {name: start[name] for name in goal}
        self._goal = dict(goal)
        stride = SPEED_RAD_S * period_s
        self._strides = {name: min(stride, (longest or {}).get(name, stride)) for name in goal}
        self._settling = 0

    def next_target(self) -> dict[str, float]:
        """Return the next joint targets; the goal itself once they are there."""
        self._target = {
            name: bounded(here, self._goal[name], self._strides[name])
            for name, here in self._target.items()
        }
        return dict(self._target)

    def done(self, measured: Mapping[str, float]) -> bool:
        """Return whether the motion is over, given the joints' positions."""
        if self._target != self._goal:
            return False
        self._settling += 1
        arrived = all(
            abs(measured[name] - goal) <= REACHED_RAD for name, goal in self._goal.items()
        )
        return arrived or self._settling > SETTLE_STEPS_MAX


def is_at(measured: Mapping[str, float], goal: Mapping[str, float]) -> bool:
    """Return whether every joint of `goal` is at its target."""
    return all(abs(measured[name] - value) <= REACHED_RAD for name, value in goal.items())
