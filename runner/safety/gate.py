"""Safety gate before the motors, of a robot and of its simulation.

It checks joint ranges, joint and base speed, workspace, no-go zones, tool speed, effort, and how
fresh the state is. Every action passes it. A small excess is shortened and reported, a large one is
withheld: the robot then keeps its last targets. It judges by the measured state; where that is
stale or incomplete nothing moves. `Action.safety_overrides` is not read: the source of an action
cannot switch a check off. Must not know skills or GPU memory: no eviction weakens it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.safety.limits import (
    EVERYWHERE,
    Kinematics,
    Limits,
    Vector3,
    outside_m,
    own_limits,
    tighten,
)
from vram_arbiter.runner.safety.ranges import CLAMP_TOLERANCE_RAD, JointRanges
from vram_arbiter.runner.safety.violations import SafetyViolation, Violation
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.contracts import SafetyEnvelope
from vram_arbiter.schemas.world import Action, Twist, WorldState

MAX_STATE_AGE_S = 0.2  # an older joint state is not the robot's any more
# steps are measured from the last target while it is this young, else from the robot's pose
REFERENCE_AGE_S = 0.2
# periods a joint may be ahead of its speed limit: a late tick is made up by the next one
SPARE = 1.0
LATE_MAX = (
    1.5  # a late tick's step may be so much longer, no more: the servo makes it as fast as it can
)
MAX_FOLLOWING_ERROR_RAD = (
    0.8  # a joint so far behind its target is blocked; servos lag by 0.1 s at most
)
OVERSPEED = 1.5  # a measured speed of so many times the limit is a fault, not a servo's overshoot
EASE_FROM = 0.8  # from this share of an effort limit on, a joint is not commanded to push harder
SHORTENED_MIN = 0.5  # a tool step that would have to shrink to less than this share is withheld
SHORTENINGS_MAX = 20
EPSILON = 1e-9

Targets = dict[str, float]
Sent = Callable[[], Mapping[str, float]]
Verdict = tuple[Action | None, tuple[Violation, ...]]


@dataclass(slots=True)
class _Memory:
    """State that all gates of one robot share: the last targets that passed (rad, stamp) and the
    latch.
    """

    last: dict[str, tuple[float, int]] = field(default_factory=dict)
    passed_ns: int = 0  # when the last action passed
    spare_s: float = 0.0  # time that had passed by then and no step has used
    tripped: str = ""


@dataclass(frozen=True, slots=True)
class _Motion:
    """One step in judgement. Joints in rad by name."""

    measured: Mapping[str, float]
    start: dict[str, float]  # where each commanded joint's step begins
    elapsed_s: float  # what a step's length is measured by
    unused_s: float  # what has passed since the last one, and what was left then: no step uses more
    yielding: frozenset[str]


class RobotGate:
    """`envelopes` by the name that errors use; each only tightens the robot's own limits.

    `sent` returns the last target (rad) that the motors really got, by joint (`HalBase.sent`): an
    action that passes here can still be dropped for being late, and the next step must not begin
    where that one would have ended. Without it what passed counts as sent. `now_ns` is the clock of
    the world's stamps: a skill that thought for long must not move the robot on outdated inputs;
    without it the state's age counts to the world state's stamp only. `needs` are the components of
    the world state that must be fresh, beside the joint state; None: all of them. Raises
    ConfigError for envelopes that cannot be enforced. `check` on the control thread, `trip` on any.
    """

    def __init__(
        self,
        robot: RobotDescription,
        *,
        rate_hz: float,
        kinematics: Kinematics | None = None,
        envelopes: Mapping[str, SafetyEnvelope | None] | None = None,
        sent: Sent | None = None,
        needs: frozenset[str] | None = None,
        now_ns: Callable[[], int] | None = None,
        _base: tuple[Limits, _Memory] | None = None,
    ) -> None:
        self._robot = robot
        self._period_s = 1.0 / rate_hz
        self._kinematics = kinematics
        self._sent = sent
        self._needs = needs
        self._now_ns = now_ns
        limits, self._memory = _base or (own_limits(robot), _Memory())
        for name, envelope in (envelopes or {}).items():
            if envelope is not None:
                limits = tighten(limits, robot, envelope, name, kinematics)
        self.limits = limits
        self._ranges = JointRanges(limits.joints_rad)

    def tightened(
        self, name: str, envelope: SafetyEnvelope | None, needs: frozenset[str] | None = None
    ) -> RobotGate:
        """Return the gate for one goal: this one tightened by the skill's envelope.

        Latch and targets stay shared.
        """
        return RobotGate(
            self._robot,
            rate_hz=1.0 / self._period_s,
            kinematics=self._kinematics,
            envelopes={name: envelope},
            sent=self._sent,
            needs=self._needs if needs is None else needs,
            now_ns=self._now_ns,
            _base=(self.limits, self._memory),
        )

    def for_skill(self, manifest: RSkillManifest | None, cameras: Iterable[str]) -> RobotGate:
        """Return the gate for one skill's goals.

        Raises ConfigError for an envelope that cannot be enforced.
        """
        if manifest is None:
            return self.tightened("", None, frozenset(cameras))
        return self.tightened(f"envelope of {manifest.name}", manifest.envelope, frozenset(cameras))

    @property
    def unkept(self) -> tuple[str, ...]:
        """Return what the envelopes ask for and this gate cannot enforce: shown before the robot
        moves.
        """
        return self.limits.unkept

    def trip(self, reason: str) -> None:
        """Latch: from now on nothing passes, until the program is started again."""
        self._memory.tripped = self._memory.tripped or reason

    # -- one action
    def check(self, action: Action, world: WorldState) -> Verdict:
        """Return the action to apply, possibly shortened, or None; and the violations."""
        problems: list[Violation] = []
        try:
            allowed = self._judge(action, world, problems)
        except SafetyViolation as reason:
            return None, (reason.violation, *problems)
        return allowed, tuple(problems)

    def _judge(self, action: Action, world: WorldState, problems: list[Violation]) -> Action:
        """Check an action.

        Order: 1. latch, freshness, form; a base's speed, and for an arm 2. ranges 3. measured state
        4. efforts 5. joint speed 6. tool speed 7. workspace.
        """
        if self._memory.tripped:
            raise SafetyViolation("estop", f"the emergency stop is latched: {self._memory.tripped}")
        self._fresh(world)
        if action.horizon != 1:
            raise SafetyViolation(
                "form", f"{action.horizon} steps at once: the gate passes one at a time"
            )
        if action.body_twist is not None:
            self._base_speed(action.body_twist[0])
            if action.control_mode is ControlMode.BODY_TWIST:
                return action
        names = action.joint_names or self._robot.joint_names
        if len(set(names)) != len(names):
            raise SafetyViolation("form", "a joint is commanded twice")
        allowed, found = self._ranges.check(action, world)
        problems += found
        if allowed is None:
            first = problems.pop(0)
            raise SafetyViolation(first.check, first)
        measured = dict(zip(world.joint_state.name, world.joint_state.position, strict=True))
        if missing := [name for name in self.limits.joints_rad if name not in measured]:
            raise SafetyViolation("freshness", f"the state of {', '.join(missing)} is not measured")
        self._speed_is_sound(world)
        targets = dict(zip(names, allowed.rows[0], strict=True))
        yielding = self._yield(targets, measured, world, problems)
        motion = self._motion(targets, measured, yielding, world.stamp_ns)
        self._joint_speed(targets, motion, problems)
        self._tool_speed(targets, motion, problems)
        self._workspace(targets, motion, problems)
        self._memory.passed_ns = world.stamp_ns
        self._memory.spare_s = min(
            max(0.0, motion.unused_s - self._used_s(targets, motion)), SPARE * self._period_s
        )
        for name, value in targets.items():
            self._memory.last[name] = (value, world.stamp_ns)
        row = tuple(targets[name] for name in names)
        if row == action.rows[0]:
            return action
        return allowed.model_copy(update={"joint_targets": (row,)})

    def _fresh(self, world: WorldState) -> None:
        stale = [
            name
            for name in world.stale
            if name == "joint_state" or self._needs is None or name in self._needs
        ]
        if stale:
            raise SafetyViolation("freshness", f"stale: {', '.join(stale)}")
        now_ns = world.stamp_ns if self._now_ns is None else max(world.stamp_ns, self._now_ns())
        age_s = (now_ns - world.joint_state.stamp_ns) / 1e9
        if age_s > MAX_STATE_AGE_S:
            raise SafetyViolation("freshness", f"the joint state is stale: {age_s:.2f} s old")

    def _base_speed(self, twist: Twist) -> None:
        if self._robot.base is None:
            raise SafetyViolation("base_speed", f"{self._robot.name} has no base to drive")
        vx, vy, vz, wx, wy, wz = twist
        if vz or wx or wy:
            raise SafetyViolation(
                "base_speed", f"{self._robot.name} drives on a plane: vz, wx and wy must be 0"
            )
        speed, turn = math.hypot(vx, vy), abs(wz)
        most, fastest = self.limits.base_speed_m_s + EPSILON, self.limits.base_turn_rad_s + EPSILON
        if not (speed <= most and turn <= fastest):  # said so that a NaN is withheld, too
            raise SafetyViolation(
                "base_speed",
                f"base speed {speed:.2f} m/s, {turn:.2f} rad/s is beyond "
                f"{self.limits.base_speed_m_s:.2f} m/s, {self.limits.base_turn_rad_s:.2f} rad/s",
            )

    def _speed_is_sound(self, world: WorldState) -> None:
        for name, speed in zip(world.joint_state.name, world.joint_state.velocity, strict=False):
            limit = self.limits.speeds_rad_s.get(name, math.inf)
            if abs(speed) > OVERSPEED * limit:
                raise SafetyViolation(
                    "measured_speed", f"{name} moves at {speed:.2f} rad/s, the limit is {limit:.2f}"
                )

    # -- efforts
    def _yield(
        self,
        targets: Targets,
        measured: Mapping[str, float],
        world: WorldState,
        problems: list[Violation],
    ) -> frozenset[str]:
        """Move the targets of joints that push too hard nearer to their positions.

        Withholding would keep up the pressure: targets stay in force.
        """
        yielding = set()
        for name, effort in zip(world.joint_state.name, world.joint_state.effort, strict=False):
            limit = self._effort_limit_nm(name)
            target = targets.get(name)
            if target is None or abs(effort) <= EASE_FROM * limit:
                continue
            # the effort comes from the target's distance: less distance, less effort
            share = min(1.0, limit / abs(effort))
            most = measured[name] + share * (self._last(name, measured) - measured[name])
            if (target - most) * effort <= 0:
                continue
            low, high = self.limits.joints_rad[name]
            targets[name] = min(max(most, low), high)
            yielding.add(name)
            said = f"{name} pushes with {abs(effort):.2f} N·m, the limit is {limit:.2f}: it yields"
            problems.append(Violation("effort", said))
        return frozenset(yielding)

    def _effort_limit_nm(self, name: str) -> float:
        gripper = any(joint.gripper for joint in self._robot.joints if joint.name == name)
        if gripper and self._kinematics is not None:
            return min(
                self.limits.torque_nm, self.limits.force_n * self._kinematics.gripper_lever_m
            )
        return self.limits.torque_nm

    def _last(self, name: str, measured: Mapping[str, float]) -> float:
        """Return the joint's last target, or its position if it never had one."""
        if self._sent is not None:
            return self._sent().get(name, measured[name])
        return self._memory.last.get(name, (measured[name], 0))[0]

    # -- speeds
    def _motion(
        self, targets: Targets, measured: Mapping[str, float], yielding: frozenset[str], now_ns: int
    ) -> _Motion:
        start, elapsed_s, follows = {}, self._period_s, False
        for name in targets:
            last = self._memory.last.get(name)
            if last is not None and 0 <= now_ns - last[1] <= REFERENCE_AGE_S * 1e9:
                start[name], follows = self._last(name, measured), True
                late_s = (now_ns - last[1]) / 1e9
                elapsed_s = max(elapsed_s, min(late_s, LATE_MAX * self._period_s))
            else:
                start[name] = measured[name]
        for name in yielding:
            start[name] = targets[name]
        unused_s = (1 + SPARE) * self._period_s
        if follows:
            unused_s = self._memory.spare_s + (now_ns - self._memory.passed_ns) / 1e9
        return _Motion(measured, start, max(min(elapsed_s, unused_s), EPSILON), unused_s, yielding)

    def _used_s(self, targets: Targets, motion: _Motion) -> float:
        """Return how long the steps take at the greatest speeds."""
        used = [
            abs(value - motion.start[name]) / self.limits.speeds_rad_s[name]
            for name, value in targets.items()
            if name not in motion.yielding
        ]
        if self._kinematics is not None and self.limits.ee_speed_m_s < math.inf:
            begin = self._tool({**motion.measured, **motion.start})
            way = math.dist(begin, self._tool({**motion.measured, **targets}))
            used.append(way / self.limits.ee_speed_m_s)
        return max(used, default=0.0)

    def _joint_speed(self, targets: Targets, motion: _Motion, problems: list[Violation]) -> None:
        grippers = {joint.name for joint in self._robot.joints if joint.gripper}
        for name, value in targets.items():
            if name in motion.yielding:
                continue
            step = value - motion.start[name]
            longest = self.limits.speeds_rad_s[name] * motion.elapsed_s
            excess = abs(step) - longest
            if excess > EPSILON:
                said = (
                    f"{name}: {abs(step) / motion.elapsed_s:.2f} rad/s is beyond "
                    f"{self.limits.speeds_rad_s[name]:.2f} rad/s"
                )
                if (
                    excess > CLAMP_TOLERANCE_RAD and name not in grippers
                ):  # a gripper just closes more slowly
                    raise SafetyViolation("joint_speed", said)
                problems.append(Violation("joint_speed", said))
                low, high = self.limits.joints_rad[name]
                targets[name] = min(
                    max(motion.start[name] + math.copysign(longest, step), low), high
                )
            behind = abs(targets[name] - motion.measured[name])
            if (
                behind > MAX_FOLLOWING_ERROR_RAD and name not in grippers
            ):  # a grasp is meant to block
                # withholding would keep up the pressure; a policy that continues from its far
                # target is withheld as too fast
                said = (
                    f"{name} is {behind:.2f} rad behind its target:"
                    " it does not follow, and is relaxed"
                )
                problems.append(Violation("following_error", said))
                low, high = self.limits.joints_rad[name]
                targets[name] = motion.start[name] = min(max(motion.measured[name], low), high)

    def _tool_speed(self, targets: Targets, motion: _Motion, problems: list[Violation]) -> None:
        longest = min(self.limits.ee_speed_m_s * motion.elapsed_s, self.limits.ee_step_m)
        if self._kinematics is None or longest == math.inf:
            return
        begin = self._tool({**motion.measured, **motion.start})
        way = math.dist(begin, self._tool({**motion.measured, **targets}))
        if way <= longest + EPSILON:
            return
        said = (
            f"the tool would move {way * 1e3:.0f} mm in {motion.elapsed_s * 1e3:.0f} ms,"
            f" the limit is {longest * 1e3:.0f} mm"
        )
        share = longest / way
        if share < SHORTENED_MIN:
            raise SafetyViolation("tool_speed", said)
        problems.append(Violation("tool_speed", said))
        shorter: Targets = {}
        for _ in range(SHORTENINGS_MAX):  # an arc is longer than its chord: shorten until it fits
            shorter = {
                name: motion.start[name] + share * (value - motion.start[name])
                for name, value in targets.items()
            }
            way = math.dist(begin, self._tool({**motion.measured, **shorter}))
            if way <= longest + EPSILON:
                break
            share *= 0.999 * longest / way
        else:
            raise SafetyViolation("tool_speed", said)
        for name, value in shorter.items():
            low, high = self.limits.joints_rad[name]
            targets[name] = min(max(value, low), high)

    # -- places
    def _workspace(self, targets: Targets, motion: _Motion, problems: list[Violation]) -> None:
        """Check the target and the way half there.

        A robot that is already outside may come back in.
        """
        if self._kinematics is None or (self.limits.box == EVERYWHERE and not self.limits.zones):
            return
        now = self._kinematics.points(motion.measured)
        half = {name: (motion.start[name] + value) / 2 for name, value in targets.items()}
        for pose in (half, targets):
            points = self._kinematics.points({**motion.measured, **pose})
            self._tool_is_inside(points["tool"], now["tool"], problems)
            self._zones_are_free(points, now, problems)

    def _tool_is_inside(self, tool: Vector3, now: Vector3, problems: list[Violation]) -> None:
        outside = outside_m(self.limits.box, tool)
        if outside <= EPSILON:
            return
        said = f"the tool at {_place(tool)} m is {outside * 1e3:.0f} mm outside the workspace"
        if outside >= outside_m(self.limits.box, now) - EPSILON:
            raise SafetyViolation("workspace", said)
        problems.append(Violation("workspace", f"{said}, on its way back"))

    def _zones_are_free(
        self, points: Mapping[str, Vector3], now: Mapping[str, Vector3], problems: list[Violation]
    ) -> None:
        for index, zone in enumerate(self.limits.zones):
            for name, point in points.items():
                depth = zone.depth_m(point)
                if depth <= EPSILON:
                    continue
                said = (
                    f"the {name} at {_place(point)} m is inside the no-go zone {zone.name or index}"
                )
                if depth >= zone.depth_m(now[name]) - EPSILON:
                    raise SafetyViolation("no_go_zone", said)
                problems.append(Violation("no_go_zone", f"{said}, on its way out"))

    def _tool(self, joints: Mapping[str, float]) -> Vector3:
        if self._kinematics is None:
            raise SafetyViolation("form", "this robot has no kinematics")
        return self._kinematics.points(joints)["tool"]


def _place(point: Vector3) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in point) + ")"
