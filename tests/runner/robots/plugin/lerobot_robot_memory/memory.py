"""Keeps what it is sent, says it when asked; `fault` makes it fail as a pulled cable does."""

from typing import Any

from lerobot.motors import Motor, MotorNormMode
from lerobot.robots import Robot
from lerobot.robots.utils import ensure_safe_goal_position
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from .config_memory import MemoryRobotConfig


class MemoryBus:
    def __init__(self, modes: list[str]) -> None:
        self.motors = {
            f"motor_{i}": Motor(i, "sts3215", MotorNormMode(mode))
            for i, mode in enumerate(modes, 1)
        }
        self.torque = True

    def disable_torque(self) -> None:
        self.torque = False


class MemoryRobot(Robot):
    config_class = MemoryRobotConfig
    name = "memory_robot"

    def __init__(self, config: MemoryRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        names = [f"motor_{i}" for i in range(1, len(config.values) + 1)]
        self.values: dict[str, Any] = dict(zip(names, config.values, strict=True))
        if config.bus:
            self.bus = MemoryBus(config.modes)
        self.fault: Exception | None = None
        self.sent: list[dict[str, Any]] = []
        self.lost_answers = config.lost_answers
        self._connected = False

    @property
    def action_features(self) -> dict[str, type]:
        extra = [self.config.extra_feature] if self.config.extra_feature else []
        return dict.fromkeys([*(f"{name}.pos" for name in self.values), *extra], float)

    @property
    def observation_features(self) -> dict[str, type]:
        return self.action_features

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return self.config.calibrated

    def connect(self, calibrate: bool = True) -> None:
        if self._connected:
            raise DeviceAlreadyConnectedError
        if self.fault:
            raise self.fault
        self._connected = True
        if self.lost_answers:
            self.lost_answers -= 1
            raise RuntimeError("motor 3 is missing")
        if calibrate:
            self.calibrate()

    def calibrate(self) -> None:
        raise AssertionError("nobody asks questions on the terminal of a robot that runs")

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        self._check()
        return {f"{name}.pos": value for name, value in self.values.items()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self._check()
        wanted = {key.removesuffix(".pos"): value for key, value in action.items()}
        if self.config.max_relative_target is not None:
            present = {name: (value, self.values[name]) for name, value in wanted.items()}
            wanted = ensure_safe_goal_position(present, self.config.max_relative_target)
        self.values.update(wanted)
        self.sent.append(wanted)
        return {f"{name}.pos": value for name, value in wanted.items()}

    def disconnect(self) -> None:
        if not self._connected:
            raise DeviceNotConnectedError
        self._connected = False
        if self.fault:
            raise self.fault

    def _check(self) -> None:
        if not self._connected:
            raise DeviceNotConnectedError
        if self.fault:
            raise self.fault
