"""Its configuration, registered with lerobot as `memory_robot`."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("memory_robot")
@dataclass(kw_only=True)
class MemoryRobotConfig(RobotConfig):
    """`values` are the first positions, in the robot's own units; `modes` names lerobot's unit of
    each motor. `lost_answers` times connecting fails half way, with the port open.
    """

    port: str = "memory"
    values: list[float] = field(default_factory=lambda: [0.0, 0.0, 50.0])
    modes: list[str] = field(default_factory=lambda: ["degrees", "range_m100_100", "range_0_100"])
    calibrated: bool = True
    max_relative_target: float | None = None
    bus: bool = True
    lost_answers: int = 0
    extra_feature: str | None = None
    cameras: dict[str, Any] = field(default_factory=dict)
