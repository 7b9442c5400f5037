"""Skills that this runner performs itself in place of a ROS 2 server, by interface type.

A `ros_action` or `ros_service` without one is refused before a goal could ask for it, with a list
of the known ones. `runner.ros2` asks ROS 2 servers, where a deployment names the interface.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from vram_arbiter.runner.protocols import Skill
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.manifest import RSkillManifest

NAVIGATE = "nav2_msgs/NavigateToPose"
TRAJECTORY = "control_msgs/FollowJointTrajectory"


@dataclass(frozen=True, slots=True)
class StandIn:
    """`drives` are the control modes that it sends, which the robot has to take; `misfit` says what
    else is wrong with a manifest, or nothing."""

    make: Callable[[RSkillManifest], Skill]
    drives: frozenset[ControlMode]
    misfit: Callable[[RSkillManifest], str] = lambda manifest: ""


class StandIns:
    """Maker of `ros_action` or `ros_service` skills, with refusals. `joints` are the robot's, for
    ordered manifests; `setting` is the deployment's that names what ROS 2 servers execute.
    """

    def __init__(
        self, known: Mapping[str, StandIn], joints: Iterable[str], setting: str = "ros_actions"
    ) -> None:
        self._known = dict(known)
        self._setting = setting
        self._joints = tuple(joints)

    def __call__(self, manifest: RSkillManifest) -> Skill:
        return self._known[interface_of(manifest)].make(manifest)

    def refuses(self, manifest: RSkillManifest) -> str:
        """Return why a skill cannot be made here; empty: it can."""
        wanted = interface_of(manifest)
        stand_in = self._known.get(wanted)
        if stand_in is None:
            known = " and ".join(sorted(self._known)) or "none"
            return (
                f"this runner stands in for {known}, not for {wanted};"
                f" a deployment's `{self._setting}` names what ROS 2 servers execute"
            )
        for actuator in manifest.actuators_required:
            if actuator.kind not in stand_in.drives:
                drives = " and ".join(sorted(stand_in.drives))
                return f"it drives by {actuator.kind}; the stand-in for {wanted} drives by {drives}"
            order = actuator.control_mode_semantics.joint_order or ()
            if missing := [name for name in order if name not in self._joints]:
                return f"it moves {', '.join(missing)}; the robot has {', '.join(self._joints)}"
        return stand_in.misfit(manifest)


def interface_of(manifest: RSkillManifest) -> str:
    """Return `package/Type`, for a short type as well as ROS's `package/action/Type`."""
    ros = manifest.ros_integration
    return "" if ros is None else f"{ros.package}/{ros.interface_type.rpartition('/')[2]}"
