"""A robot for lerobot's own programs: six joints and two cameras in memory, which is where it was
sent."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig

JOINTS = [f"joint_{number}.pos" for number in range(6)]
SHAPES = {"front": (360, 480, 3), "wrist": (240, 320, 3)}  # as the policy's


@RobotConfig.register_subclass("door_arm")
@dataclass
class DoorArmConfig(RobotConfig):
    pass


class DoorArm(Robot):
    config_class = DoorArmConfig
    name = "door_arm"

    def __init__(self, config: DoorArmConfig) -> None:
        super().__init__(config)
        self.position = dict.fromkeys(JOINTS, 0.0)
        self.sent: list[dict[str, float]] = []
        self.is_connected = False

    observation_features = dict.fromkeys(JOINTS, float) | SHAPES
    action_features = dict.fromkeys(JOINTS, float)
    is_connected = False
    is_calibrated = True

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        pictures = {
            name: np.resize(np.arange(251, dtype=np.uint8), shape) for name, shape in SHAPES.items()
        }
        return {**self.position, **pictures}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.position = dict(action)
        self.sent.append(action)
        return action

    def disconnect(self) -> None:
        self.is_connected = False
