"""Pose and velocity of a mobile base, from its joints."""

from __future__ import annotations

import math

from vram_arbiter.runner.planar import planar_pose
from vram_arbiter.runner.protocols import MobileBase
from vram_arbiter.schemas.world import WorldState


def with_base(world: WorldState, base: MobileBase) -> WorldState:
    """Return the world state with pose and velocity of a base instead of the base's joints, if its
    joint state has them; a base that is not measured has no pose.
    """
    state = world.joint_state
    place = {name: index for index, name in enumerate(state.name)}
    if not all(name in place for name in base.joints):
        return world
    x, y, yaw = (state.position[place[name]] for name in base.joints)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    twist = None
    if state.velocity:
        vx, vy, wz = (state.velocity[place[name]] for name in base.joints)
        twist = (cosine * vx + sine * vy, cosine * vy - sine * vx, 0.0, 0.0, 0.0, wz)
    arm = [index for name, index in place.items() if name not in base.joints]
    rows = {
        field: tuple(values[index] for index in arm)
        for field in ("name", "position", "velocity", "effort")
        if (values := getattr(state, field))
    }
    return world.model_copy(
        update={
            "base_pose": planar_pose(x, y, yaw, base.world_frame),
            "base_twist": twist,
            "joint_state": state.model_copy(update=rows),
        }
    )
