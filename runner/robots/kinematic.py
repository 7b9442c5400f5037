"""Twin without physics: every joint goes straight to its target at its maximum speed.

Needs only the base install: for tests of everything around a robot, and to try a deployment file on
a machine without simulator. Joints move with the clock between calls, as a robot's do.
"""

from __future__ import annotations

from collections.abc import Mapping

from vram_arbiter.runner.control.clock import Clock, SystemClock
from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.schemas.world import JointState


class KinematicTwin(HalBase):
    """Starts at the description's rest pose, or at `start_pose_rad`; a joint in neither starts at
    0.
    """

    def __init__(
        self,
        description: RobotDescription,
        *,
        start_pose_rad: Mapping[str, float] | None = None,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(description)
        self._clock = clock or SystemClock()
        start = {**description.rest_pose_rad, **(start_pose_rad or {})}
        self._position = {name: start.get(name, 0.0) for name in description.joint_names}
        self._velocity = dict.fromkeys(description.joint_names, 0.0)
        self._target = dict(self._position)
        self._now_ns = 0

    def _open(self) -> None:
        self._now_ns = self._clock.now_ns()
        self._target = dict(self._position)

    def _close(self) -> None:
        self._advance()
        self._target = dict(self._position)  # without power it stays where it is

    def _read(self) -> JointState:
        self._advance()
        return JointState(
            name=tuple(self._position),
            position=tuple(self._position.values()),
            velocity=tuple(self._velocity.values()),
            stamp_ns=self._now_ns,
        )

    def _drive(self, targets: Mapping[str, float]) -> Mapping[str, float]:
        self._advance()
        self._target.update(targets)
        return targets

    def _halt(self) -> str:
        self._advance()
        self._target = dict(self._position)
        self._velocity = dict.fromkeys(self._position, 0.0)
        return "all joints stand still"

    def _advance(self) -> None:
        now_ns = self._clock.now_ns()
        elapsed_s = (now_ns - self._now_ns) / 1e9
        if elapsed_s <= 0:
            return
        self._now_ns = now_ns
        for joint in self.description.joints:
            way, reach = (
                self._target[joint.name] - self._position[joint.name],
                joint.max_speed_rad_s * elapsed_s,
            )
            if abs(way) <= reach:  # it arrived, and stands now
                self._position[joint.name] = self._target[joint.name]
                self._velocity[joint.name] = 0.0
            else:
                direction = 1.0 if way > 0 else -1.0
                self._position[joint.name] += direction * reach
                self._velocity[joint.name] = direction * joint.max_speed_rad_s
