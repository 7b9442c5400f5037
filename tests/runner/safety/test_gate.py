"""A robot's gate: speed, workspace, zones, effort, freshness; envelopes only tighten; nothing
switches it off.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vram_arbiter.runner.control.skill_slot import WITHHELD_IN_A_ROW_MAX
from vram_arbiter.runner.protocols import Joint, MobileBase, RobotDescription
from vram_arbiter.runner.safety.gate import LATE_MAX, MAX_FOLLOWING_ERROR_RAD, RobotGate
from vram_arbiter.runner.safety.limits import Vector3
from vram_arbiter.runner.safety.ranges import CLAMP_TOLERANCE_RAD
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest.contracts import SafetyEnvelope
from vram_arbiter.schemas.world import Action, JointState, WorldState

ROBOT = RobotDescription(
    "planar",
    (
        Joint("turn", -3.0, 3.0, 3.0),
        Joint("reach", 0.0, 2.0, 3.0),
        Joint("grip", 0.0, 1.0, 6.0, gripper=True),
    ),
    {},
)
NAMES = ROBOT.joint_names
STEP = 3.0 / 30  # rad a tick at 30 Hz


class Planar:
    """An arm that turns about the vertical and reaches out: the tool at `reach` meters in the
    direction of `turn`.
    """

    gripper_lever_m = 0.1

    def points(self, joints: Mapping[str, float]) -> Mapping[str, Vector3]:
        turn, reach = joints["turn"], joints["reach"]
        tool = (reach * math.cos(turn), reach * math.sin(turn), 0.0)
        return {"tool": tool, "elbow": (tool[0] / 2, tool[1] / 2, 0.0)}


def gate(needs: frozenset[str] | None = None, kinematic: bool = True, **envelope: Any) -> RobotGate:
    wide = (
        {"max_ee_speed_m_s": 1e9, "max_joint_speed_factor": 1.0} if kinematic and envelope else {}
    )
    return RobotGate(
        ROBOT,
        rate_hz=30.0,
        kinematics=Planar() if kinematic else None,
        envelopes={"safety": SafetyEnvelope(**{**wide, **envelope}) if envelope else None},
        needs=needs,
    )


def at(*position: float, ms: float = 1000.0, age_ms: float = 0.0, **more: Any) -> WorldState:
    state = {key: more.pop(key) for key in ("velocity", "effort") if key in more}
    stamp_ns = int(ms * 1e6)
    joints = JointState(
        name=NAMES, position=position, stamp_ns=stamp_ns - int(age_ms * 1e6), **state
    )
    return WorldState(stamp_ns=stamp_ns, joint_state=joints, **more)


def to_row(*row: float, **more: Any) -> Action:
    more.setdefault("joint_names", NAMES)
    return Action(control_mode=ControlMode.JOINT_POSITION, joint_targets=(row,), **more)


def row_of(verdict: tuple[Action | None, tuple[str, ...]]) -> tuple[float, ...]:
    assert verdict[0] is not None, verdict[1]
    row: tuple[float, ...] = verdict[0].rows[0]
    return row


def withheld(checked: RobotGate, action: Action, world: WorldState, said: str) -> None:
    """Check that the action is withheld, for this reason."""
    allowed, problems = checked.check(action, world)
    assert allowed is None
    assert said in problems[0]


HERE = (0.0, 1.0, 0.5)


# -- what passes and what does not
@pytest.mark.parametrize("names", [NAMES, None])
def test_what_is_inside_passes_unchanged(names: tuple[str, ...] | None) -> None:
    action = to_row(0.05, 1.05, 0.6, joint_names=names)
    assert gate().check(action, at(*HERE)) == (action, ())


@pytest.mark.parametrize(
    ("checked", "action", "world", "check"),
    [
        (gate(), to_row(0.0, 0.1, joint_names=("turn", "turn")), at(*HERE), "form"),
        (gate(), to_row(*HERE), at(*HERE, age_ms=500.0), "freshness"),
        (gate(), to_row(0.0, 2.5, 0.5), at(0.0, 1.95, 0.5), "joint_range"),
        (gate(), to_row(0.0, 2.05, 0.5), at(0.0, 1.95, 0.5), "joint_range"),
        (gate(), to_row(2.0, 1.0, 0.5), at(*HERE), "joint_speed"),
        (gate(), to_row(*HERE), at(*HERE, velocity=(9.0, 0.0, 0.0)), "measured_speed"),
        (gate(max_cartesian_step_m=0.02), to_row(0.03, 1.0, 0.5), at(*HERE), "tool_speed"),
    ],
)
def test_a_violation_names_its_check(
    checked: RobotGate, action: Action, world: WorldState, check: str
) -> None:
    _, problems = checked.check(action, world)
    assert [problem.check for problem in problems] == [check]


def test_ranges_are_still_checked() -> None:
    assert row_of(gate().check(to_row(1.95 + 0.1, joint_names=("reach",)), at(0.0, 1.95, 0.5))) == (
        2.0,
    )
    assert gate().check(to_row(2.5, joint_names=("reach",)), at(0.0, 1.95, 0.5))[0] is None


@pytest.mark.parametrize(
    ("action", "said"),
    [
        (Action(control_mode=ControlMode.BODY_TWIST, body_twist=((0.0,) * 6,)), "no base"),
        (Action(control_mode=ControlMode.GRIPPER_POSITION, gripper=(0.5,)), "not supported"),
        (
            Action(control_mode=ControlMode.JOINT_POSITION, horizon=2, joint_targets=(HERE, HERE)),
            "2 steps at once",
        ),
        (to_row(0.0, 0.1, joint_names=("turn", "turn")), "commanded twice"),
        (to_row(0.0, joint_names=("tail",)), "unknown joint tail"),
    ],
)
def test_forms_that_are_not_one_step_of_joints_are_withheld(action: Action, said: str) -> None:
    withheld(gate(), action, at(*HERE), said)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_state_or_target_that_is_no_number_cannot_be_built(value: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        to_row(value, 0.0, 0.0)
    with pytest.raises(ValueError, match="finite"):
        at(value, 0.0, 0.0)


@pytest.mark.parametrize("kinematic", [True, False])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_target_that_is_no_number_is_withheld_however_it_was_built(
    value: float, kinematic: bool
) -> None:
    """Regression: copies of an action are not validated, and every comparison with NaN is false."""
    # not validated
    action = to_row(0.0, 1.0, 0.5).model_copy(update={"joint_targets": ((value, 1.0, 0.5),)})
    withheld(gate(kinematic=kinematic), action, at(*HERE), "expected a number of rad")


# -- freshness
@pytest.mark.parametrize("state", ["stale", "error"])
@pytest.mark.parametrize(
    ("component", "needs", "stops"),
    [
        ("joint_state", None, True),
        ("joint_state", frozenset(), True),  # whatever is asked for: without joints nothing moves
        ("front", None, True),
        ("front", frozenset({"front"}), True),
        ("front", frozenset({"wrist"}), False),
    ],
)
def test_a_stale_world_stops(
    state: Any, component: str, needs: frozenset[str] | None, stops: bool
) -> None:
    world = at(*HERE, diagnostics={component: state})
    allowed, problems = gate(needs).check(to_row(*HERE), world)
    assert (allowed is None) is stops
    assert not stops or component in problems[0]


def test_an_old_joint_state_stops_even_when_nobody_says_so() -> None:
    assert gate().check(to_row(*HERE), at(*HERE, age_ms=150))[0] is not None
    withheld(gate(), to_row(*HERE), at(*HERE, age_ms=250), "0.25 s old")


def test_a_joint_that_is_not_measured_stops() -> None:
    partial = WorldState(
        stamp_ns=1, joint_state=JointState(name=NAMES[:2], position=(0.0, 1.0), stamp_ns=1)
    )
    withheld(gate(), to_row(0.0, joint_names=("turn",)), partial, "grip")


# -- speed
def test_a_step_a_little_too_long_is_shortened_and_said() -> None:
    verdict = gate().check(to_row(STEP + 0.9 * CLAMP_TOLERANCE_RAD, 1.0, 0.5), at(*HERE))
    assert row_of(verdict) == pytest.approx((STEP, 1.0, 0.5))
    assert "turn: 7.05 rad/s is beyond 3.00 rad/s" in verdict[1][0]


@pytest.mark.parametrize("direction", [1, -1])
def test_a_step_far_too_long_is_withheld(direction: int) -> None:
    withheld(
        gate(), to_row(direction * (STEP + 1.1 * CLAMP_TOLERANCE_RAD), 1.0, 0.5), at(*HERE), "turn"
    )


def test_a_gripper_that_jumps_closes_at_its_own_speed() -> None:
    assert row_of(gate().check(to_row(0.0, 1.0, 0.0), at(0.0, 1.0, 0.9))) == pytest.approx(
        (0.0, 1.0, 0.7)
    )


def test_steps_are_measured_from_the_last_target_while_it_is_young() -> None:
    checked = gate()
    row_of(checked.check(to_row(0.1, 1.0, 0.5), at(*HERE, ms=1000)))
    # the servo lags at 0.02; the next target is a step from the last one, not from there
    assert row_of(checked.check(to_row(0.2, 1.0, 0.5), at(0.02, 1.0, 0.5, ms=1033))) == (
        0.2,
        1.0,
        0.5,
    )
    # after a late tick the way may be half as long again, and no more however late it is
    assert row_of(checked.check(to_row(0.4, 1.0, 0.5), at(0.1, 1.0, 0.5, ms=1150)))[
        0
    ] == pytest.approx(0.35)
    # much later only where it is counts
    allowed = row_of(checked.check(to_row(0.4, 1.0, 0.5), at(0.2, 1.0, 0.5, ms=5000)))
    assert allowed == pytest.approx((0.3, 1.0, 0.5))


@pytest.mark.parametrize("early", [0.0, 0.03, 0.3, 0.5, 0.9])
def test_ticks_that_come_late_and_then_early_make_no_joint_faster(early: float) -> None:
    """A late tick may go farther, and the next one, which is in time, less far by as much: else a
    jittering loop moves faster than the limit.
    """
    motors = {"turn": -2.9}
    checked = RobotGate(ROBOT, rate_hz=30.0, sent=lambda: motors)
    ms, begun = 1000.0, -2.9
    for tick in range(60):
        share = 1 + early if tick % 2 else 1 - early
        ms += share * 1000 / 30
        wanted = motors["turn"] + min(max(share, 1.0), LATE_MAX) * STEP
        allowed, _ = checked.check(
            to_row(wanted, joint_names=("turn",)), at(motors["turn"], 1.0, 0.5, ms=ms)
        )
        motors["turn"] = row_of((allowed, ()))[0]
        if motors["turn"] > 2.5:  # the way back
            motors["turn"], begun = -2.9, begun - 5.4
    moved = motors["turn"] - begun
    assert moved <= 3.0 * (ms - 1000.0) / 1000 + 2 * STEP
    assert moved >= 0.9 * 3.0 * (ms - 1000.0) / 1000


def test_a_withheld_step_is_no_reference_for_the_next_one() -> None:
    checked = gate()
    for tick in range(20):  # a lost policy does not get to its far target by repeating it
        assert checked.check(to_row(2.0, 1.0, 0.5), at(*HERE, ms=1000 + 33 * tick))[0] is None


def test_steps_that_were_dropped_for_being_late_do_not_add_up() -> None:
    """Everything passes, nothing is applied (the deadline policy drops it), then one action is: it
    is one step long, not ten.
    """
    motors = {"turn": 0.0}
    checked = RobotGate(ROBOT, rate_hz=30.0, sent=lambda: motors)
    wanted, seen = 0.0, at(*HERE)
    for tick in range(10):
        wanted += STEP
        seen = at(*HERE, ms=1000 + 100 * tick / 3)
        allowed, _ = checked.check(to_row(wanted, joint_names=("turn",)), seen)
        assert allowed is None or abs(allowed.rows[0][0]) <= LATE_MAX * STEP
    motors["turn"] = 0.05
    later = RobotGate(ROBOT, rate_hz=30.0, sent=lambda: motors)
    row_of(later.check(to_row(0.1, joint_names=("turn",)), at(*HERE, ms=1000)))
    shortened = later.tightened("skill", None).check(
        to_row(0.2, joint_names=("turn",)), at(*HERE, ms=1033)
    )
    assert row_of(shortened) == pytest.approx((0.15,))


def test_a_joint_that_does_not_follow_is_let_go_and_not_pushed_again() -> None:
    """Blocked at 0, by somebody perhaps.

    Whoever only stops sending leaves the motor pulling towards the last target.
    """
    motors = dict(zip(NAMES, HERE, strict=True))
    checked = RobotGate(ROBOT, rate_hz=30.0, sent=lambda: motors)
    farthest, turn, withheld = 0.0, 0.0, 0
    for tick in range(60):  # measured never changes
        turn = min(turn + STEP, 1.5)
        allowed, problems = checked.check(
            to_row(turn, joint_names=("turn",)), at(*HERE, ms=1000 + 100 * tick / 3)
        )
        if allowed is None:
            withheld += 1
            continue
        withheld = 0
        motors["turn"] = allowed.rows[0][0]
        farthest = max(farthest, motors["turn"])
        if problems:
            assert "it does not follow" in problems[0]
    assert farthest == pytest.approx(MAX_FOLLOWING_ERROR_RAD, abs=STEP)
    assert motors["turn"] == 0.0  # no pressure is left
    assert withheld > WITHHELD_IN_A_ROW_MAX  # so the goal fails


def test_a_measured_speed_beyond_all_limits_stops() -> None:
    assert gate().check(to_row(*HERE), at(*HERE, velocity=(4.0, 0.0, 0.0)))[0] is not None
    withheld(
        gate(), to_row(*HERE), at(*HERE, velocity=(-4.6, 0.0, 0.0)), "turn moves at -4.60 rad/s"
    )


def test_the_tool_keeps_its_speed() -> None:
    slow = gate(max_ee_speed_m_s=1.5)  # 50 mm a tick; turning 0.08 rad at 1 m would be 80 mm
    verdict = slow.check(to_row(0.08, 1.0, 0.5), at(*HERE))
    assert row_of(verdict)[0] == pytest.approx(0.05, abs=0.002)
    assert "80 mm" in verdict[1][0]
    allowed, _ = gate(max_cartesian_step_m=0.02).check(to_row(0.08, 1.0, 0.5), at(*HERE))
    assert allowed is None  # a quarter of what was asked is not what was asked


# -- places
BOX = {"workspace_box_min_xyz": (0.2, -0.5, -0.1), "workspace_box_max_xyz": (1.05, 0.5, 0.5)}


def test_the_tool_stays_in_the_workspace() -> None:
    assert gate(**BOX).check(to_row(0.0, 1.04, 0.5), at(*HERE))[0] is not None
    withheld(gate(**BOX), to_row(0.0, 1.07, 0.5), at(*HERE), "20 mm outside the workspace")


def test_a_tool_that_is_outside_may_only_come_back() -> None:
    outside = at(0.0, 1.2, 0.5)
    verdict = gate(**BOX).check(to_row(0.0, 1.12, 0.5), outside)
    assert row_of(verdict) == (0.0, 1.12, 0.5)
    assert "on its way back" in verdict[1][0]
    for reach in (1.2, 1.25):
        assert gate(**BOX).check(to_row(0.0, reach, 0.5), outside)[0] is None


def test_an_open_side_of_the_workspace_is_open() -> None:
    half = {"workspace_box_max_xyz": (1.05, 9.0, 9.0)}
    assert gate(**half).check(to_row(0.0, 0.95, 0.5), at(*HERE))[0] is not None
    assert gate(**half).check(to_row(0.0, 1.07, 0.5), at(*HERE))[0] is None


@pytest.mark.parametrize(
    "zone",
    [
        {"name": "bin", "min_xyz": (1.05, -0.1, -0.1), "max_xyz": (1.2, 0.1, 0.1)},
        {"name": "bin", "center_xyz": (1.15, 0.0, 0.0), "radius_m": 0.1},
        {"name": "bin", "center_xyz": (0.5375, 0.0, 0.0), "radius_m": 0.02},  # in the elbow's way
    ],
)
def test_no_point_of_the_arm_enters_a_zone(zone: dict[str, Any]) -> None:
    withheld(gate(no_go_zones=(zone,)), to_row(0.0, 1.07, 0.5), at(*HERE), "no-go zone bin")
    assert gate(no_go_zones=(zone,)).check(to_row(0.0, 0.95, 0.5), at(*HERE))[0] is not None


def test_a_thin_zone_is_not_stepped_over() -> None:
    wall = {"min_xyz": (1.04, -1.0, -1.0), "max_xyz": (1.06, 1.0, 1.0)}
    assert gate(no_go_zones=(wall,)).check(to_row(0.0, 1.1, 0.5), at(*HERE))[0] is None


# -- effort
def test_a_grip_eases_to_its_limit_and_keeps_it() -> None:
    """A servo with 10 N·m/rad against a thing of 0.5 rad: 10 N at 0.1 m are 1 N·m, so 0.1 rad of
    squeeze.
    """
    checked = gate(max_force_n=10.0, max_torque_nm=100.0)
    target, efforts = 0.5, []
    for tick in range(40):
        effort = 10.0 * (target - 0.5)
        efforts.append(abs(effort))
        world = at(0.0, 1.0, 0.5, ms=1000 + 100 * tick / 3, effort=(0.0, 0.0, effort))
        target = row_of(checked.check(to_row(0.0, 1.0, 0.0), world))[2]
    assert max(efforts[:5]) > 1.0  # it was seen only after it happened
    assert efforts[-10:] == pytest.approx([1.0] * 10, abs=0.01)


def test_an_easing_joint_is_said_and_opening_is_free() -> None:
    checked = gate(max_force_n=10.0)
    pressed = at(0.0, 1.0, 0.5, effort=(0.0, 0.0, -2.0))
    verdict = checked.check(to_row(0.0, 1.0, 0.2), pressed)
    assert row_of(verdict)[2] == 0.5
    assert "grip pushes with 2.00 N·m, the limit is 1.00: it yields" in verdict[1]
    assert row_of(checked.check(to_row(0.0, 1.0, 0.6), pressed))[2] == 0.6


def test_an_arm_joint_keeps_its_torque() -> None:
    checked = gate(max_torque_nm=2.0)
    verdict = checked.check(to_row(0.05, 1.0, 0.5), at(*HERE, effort=(3.0, 0.0, 0.0)))
    assert row_of(verdict)[0] == 0.0


# -- envelopes
def test_envelopes_only_tighten() -> None:
    wide = SafetyEnvelope(
        max_joint_speed_factor=9.0,
        max_ee_speed_m_s=100.0,
        workspace_box_min_xyz=(-9.0, -9.0, -9.0),
        workspace_box_max_xyz=(9.0, 9.0, 9.0),
    )
    base = gate(**BOX, max_ee_speed_m_s=0.4, max_force_n=5.0)
    tighter = base.tightened("skill", wide).limits
    assert tighter.box == base.limits.box
    assert tighter.speeds_rad_s == {"turn": 3.0, "reach": 3.0, "grip": 6.0}
    assert (tighter.ee_speed_m_s, tighter.force_n) == (0.4, 5.0)
    slow = base.tightened(
        "skill", SafetyEnvelope(max_joint_speed_factor=0.5, max_force_n=3.0)
    ).limits
    assert slow.speeds_rad_s == {"turn": 1.5, "reach": 1.5, "grip": 3.0}
    assert slow.force_n == 3.0
    assert base.limits.speeds_rad_s["turn"] == 3.0  # the base gate is as it was


@pytest.mark.parametrize(
    ("envelope", "field", "said"),
    [
        ({"max_joint_speed_factor": float("nan")}, "max_joint_speed_factor", "above 0"),
        ({"max_force_n": 0.0}, "max_force_n", "above 0"),
        ({"max_cartesian_step_m": -1.0}, "max_cartesian_step_m", "above 0"),
        ({"workspace_box_min_xyz": (0, 0, 1), "workspace_box_max_xyz": (1, 1, 0)},
         "workspace_box_min_xyz", "z 1.0 > 0.0"),
        *(({"no_go_zones": (zone,)}, "no_go_zones[0]", told) for zone, told in (
            ({"around": "table"}, "center_xyz"),
            ({"min_xyz": (0, 0, float("nan")), "max_xyz": (1, 1, 1)}, "min_xyz"),
            ({"min_xyz": (0, 1, 0), "max_xyz": (1, 0, 1)}, "must be below"),
            ({"min_xyz": (0, 0, 0), "max_xyz": (1, 1, 0)}, "must be below"),
        )),
    ],
)  # fmt: skip
def test_an_envelope_that_limits_nothing_is_refused(envelope: Any, field: str, said: str) -> None:
    """Regression: a no-go zone with exchanged corners has no inside, so it kept nothing out."""
    with pytest.raises(ConfigError) as caught:
        gate(**envelope)
    found = caught.value.details["fields"][0]
    assert found["field"] == f"safety.{field}"
    assert said in found["problem"]


def test_two_workspaces_without_a_common_place_are_refused() -> None:
    elsewhere = SafetyEnvelope(
        workspace_box_min_xyz=(2.0, 0.0, 0.0), workspace_box_max_xyz=(3.0, 1.0, 1.0)
    )
    with pytest.raises(ConfigError, match=r"skill\.workspace_box_min_xyz: the workspace is empty"):
        gate(**BOX).tightened("skill", elsewhere)


@pytest.mark.parametrize(
    "envelope",
    [
        {"max_ee_speed_m_s": 0.1},
        {"workspace_box_min_xyz": (0, 0, 0)},
        {"max_cartesian_step_m": 0.1},
    ],
)
def test_what_needs_kinematics_is_refused_without(envelope: Any) -> None:
    with pytest.raises(ConfigError, match="cannot be enforced: there are no kinematics"):
        gate(kinematic=False, **envelope)


def test_what_is_asked_for_and_not_kept_is_told() -> None:
    told = gate(
        kinematic=False, deadman_required=True, human_in_loop_required=("cut",), max_force_n=3.0
    ).unkept
    assert {line.split(" ")[0] for line in told} == {
        "safety.deadman_required",
        "safety.human_in_loop_required",
        "safety.max_ee_speed_m_s",
        "safety.max_force_n",
    }
    assert gate(max_ee_speed_m_s=0.5, deadman_required=False).unkept == ()


def test_a_stop_button_that_nobody_listens_to_is_told() -> None:
    """Whoever names a topic will press that button, and the robot would go on."""
    assert gate(max_ee_speed_m_s=0.5, e_stop_topic="/cell/e_stop").unkept == (
        "safety.e_stop_topic (no topic is listened to: `vram-runner estop` stops the robot)",
    )


def test_a_limit_of_force_is_told_as_not_kept_where_no_effort_is_measured() -> None:
    """Regression: such limits were dropped silently."""
    asked = {"max_force_n": 3.0, "max_torque_nm": 2.0, "contact_force_threshold_n": 5.0}
    blind = gate(**asked).unkept
    assert {line.split(" ")[0] for line in blind} == {f"safety.{key}" for key in asked}
    feeling = replace(ROBOT, tells_efforts=True)
    envelopes = {"safety": SafetyEnvelope(**asked)}
    kept = RobotGate(feeling, rate_hz=30.0, kinematics=Planar(), envelopes=envelopes).unkept
    assert kept == ("safety.contact_force_threshold_n",)  # no robot here has contact sensors


def test_an_action_cannot_switch_a_check_off() -> None:
    overrides = {
        "max_joint_speed_factor": 100.0,
        "workspace_box_max_xyz": (9, 9, 9),
        "disable": True,
    }
    allowed, _ = gate(**BOX).check(to_row(0.0, 1.07, 0.5, safety_overrides=overrides), at(*HERE))
    assert allowed is None


def test_a_latched_stop_holds_for_every_gate_of_the_robot() -> None:
    base = gate()
    goal = base.tightened("skill", SafetyEnvelope())
    goal.trip("hand in the way")
    goal.trip("second reason")
    for checked in (base, goal, base.tightened("next", None)):
        withheld(checked, to_row(*HERE), at(*HERE), "hand in the way")


Angles = st.tuples(
    st.floats(-3.5, 3.5, allow_nan=False),
    st.floats(-0.5, 2.5, allow_nan=False),
    st.floats(-0.5, 1.5),
)
Inside = st.tuples(st.floats(-3.0, 3.0), st.floats(0.0, 2.0), st.floats(0.0, 1.0))


@given(
    start=Inside,
    targets=st.lists(Angles, min_size=1, max_size=6),
    factor=st.floats(0.1, 1.0),
    ee_speed=st.floats(0.1, 5.0),
)
def test_whatever_is_asked_for_what_passes_is_inside(
    start: tuple[float, float, float],
    targets: list[tuple[float, float, float]],
    factor: float,
    ee_speed: float,
) -> None:
    """The robot follows exactly. Ranges, joint speeds and tool speed hold for whatever passes."""
    checked = gate(max_joint_speed_factor=factor, max_ee_speed_m_s=ee_speed)
    arm = Planar()
    here = start
    for tick, target in enumerate(targets):
        allowed, problems = checked.check(to_row(*target), at(*here, ms=1000 + 100 * tick / 3))
        if allowed is None:
            assert problems
            continue
        row = allowed.rows[0]
        assert (row == target) is (problems == ())
        for joint, value, before in zip(ROBOT.joints, row, here, strict=True):
            assert joint.lower_rad <= value <= joint.upper_rad
            assert abs(value - before) <= joint.max_speed_rad_s * factor * LATE_MAX / 30 + 1e-6
        tools = [arm.points(dict(zip(NAMES, pose, strict=True)))["tool"] for pose in (here, row)]
        assert math.dist(*tools) <= ee_speed * LATE_MAX / 30 + 1e-6
        here = row


# -- a base that drives
def driving(**envelope: Any) -> RobotGate:
    robot = dataclasses.replace(ROBOT, base=MobileBase(max_speed_m_s=0.5, max_turn_rad_s=1.2))
    asked = SafetyEnvelope(**envelope) if envelope else None
    return RobotGate(robot, rate_hz=30.0, kinematics=Planar(), envelopes={"safety": asked})


def twist(vx: float, vy: float, wz: float, vz: float = 0.0) -> Action:
    return Action(control_mode=ControlMode.BODY_TWIST, body_twist=((vx, vy, vz, 0.0, 0.0, wz),))


def test_a_base_drives_as_fast_as_it_may_and_not_faster() -> None:
    assert driving().check(twist(0.3, 0.4, -1.2), at(*HERE)) == (twist(0.3, 0.4, -1.2), ())
    for command in (twist(0.5, 0.5, 0.0), twist(0.0, 0.0, -1.5)):
        withheld(driving(), command, at(*HERE), "base speed")
    allowed, problems = driving().check(twist(0.1, 0.0, 0.0, vz=0.1), at(*HERE))
    assert (allowed, problems) == (None, ("planar drives on a plane: vz, wx and wy must be 0",))


def test_an_arm_that_moves_while_its_base_drives_keeps_the_limits_of_both() -> None:
    both = to_row(*HERE, body_twist=((0.1, 0.0, 0.0, 0.0, 0.0, 0.2),))
    assert driving().check(both, at(*HERE)) == (both, ())
    fast = to_row(*HERE, body_twist=((9.0, 0.0, 0.0, 0.0, 0.0, 0.0),))
    assert driving().check(fast, at(*HERE))[0] is None
    leap = both.model_copy(update={"joint_targets": ((9.0, 1.0, 0.5),)})
    assert driving().check(leap, at(*HERE))[0] is None


def test_an_envelope_slows_the_base_and_never_speeds_it_up() -> None:
    slow = driving(max_base_linear_speed_m_s=0.2, max_base_angular_speed_rad_s=9.0)
    assert (slow.limits.base_speed_m_s, slow.limits.base_turn_rad_s) == (0.2, 1.2)
    assert slow.check(twist(0.3, 0.0, 0.0), at(*HERE))[0] is None
    assert slow.check(twist(0.2, 0.0, 1.2), at(*HERE))[0] is not None


def test_a_base_stands_on_a_stale_state_after_the_emergency_stop_and_for_what_is_no_number() -> (
    None
):
    gate = driving()
    assert gate.check(twist(0.1, 0.0, 0.0), at(*HERE, age_ms=500.0))[0] is None
    row = (math.nan, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert (
        gate.check(twist(0.1, 0.0, 0.0).model_copy(update={"body_twist": (row,)}), at(*HERE))[0]
        is None
    )
    gate.trip("hand in the way")
    assert gate.check(twist(0.1, 0.0, 0.0), at(*HERE))[0] is None
