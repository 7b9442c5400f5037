"""Any robot that lerobot drives by joint positions, in rad: `adapter: lerobot:TYPE`.

`transport` holds the fields of lerobot's own config; its degrees and percentages become rad here.
It never calibrates: lerobot's calibration asks questions on the terminal (`lerobot-calibrate` does
that once). Cameras belong under `sensors`: lerobot would read them within the control loop. lerobot
is imported when the adapter is made.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

from vram_arbiter.runner.control.clock import Clock, SystemClock
from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.robots.units import POSITION, LerobotUnits, Scale
from vram_arbiter.schemas.errors import RobotFault
from vram_arbiter.schemas.world import JointState

if TYPE_CHECKING:
    from lerobot.lerobot_types import RobotAction, RobotObservation

log = logging.getLogger(__name__)

CONNECT_TRIES = 4  # lerobot asks each motor dozens of things and gives up when one answer is lost
Estop = Literal["hold", "torque_off"]


class LerobotHal(HalBase):
    """`robot` is an unconnected `lerobot.robots.Robot`; `scales` gives the unit of each joint.

    `estop` `hold` makes the motors keep the present pose (an arm without torque falls);
    `torque_off` switches them off. Where holding fails, they are switched off.
    """

    def __init__(
        self,
        robot: Any,
        description: RobotDescription,
        scales: Mapping[str, Scale],
        *,
        estop: Estop = "hold",
        clock: Clock | None = None,
    ) -> None:
        super().__init__(description)
        self._robot = robot
        self._scales = dict(scales)
        self._estop_by = estop
        self._clock = clock or SystemClock()
        self._target: dict[str, float] = {}  # rad: what the robot accepted last

    @property
    def lerobot_units(self) -> LerobotUnits:
        return LerobotUnits(str(self._robot.name), self._scales)

    def _open(self) -> None:
        robot = self._robot
        for tries_left in reversed(range(CONNECT_TRIES)):
            try:
                with self._faults("connect"):
                    robot.connect(calibrate=False)
                break
            except RobotFault as error:
                if robot.is_connected:  # half: its port is open
                    self._close()
                if not tries_left:
                    raise
                log.warning("%s; trying again", error.message)
        try:
            with self._faults("connect"):
                calibrated = bool(robot.is_calibrated)
            if not calibrated:
                raise RobotFault(
                    f"{self.description.name} is not calibrated",
                    hint=f"run lerobot-calibrate --robot.type={robot.name}"
                    f" --robot.id={robot.id} once,"
                    " and give the same id in hal.transport",
                )
            self._target = self._positions()  # the first action moves only the joints it names
        except RobotFault:
            self._close()
            raise

    def _close(self) -> None:
        try:
            with self._faults("disconnect"):
                self._robot.disconnect()
        except RobotFault as error:  # the cable is out: the torque stays on, but the port is closed
            log.warning("%s", error)
            bus = getattr(self._robot, "bus", None)
            if getattr(bus, "is_connected", False):
                try:
                    with self._faults("give its port back"):
                        self._robot.bus.disconnect(disable_torque=False)
                except RobotFault as second:
                    log.warning("%s", second)

    def _read(self) -> JointState:
        stamp_ns = self._clock.now_ns()  # before the bus is asked: never younger than the data
        positions = self._positions()
        return JointState(
            name=tuple(positions), position=tuple(positions.values()), stamp_ns=stamp_ns
        )

    def _drive(self, targets: Mapping[str, float]) -> Mapping[str, float]:
        wanted = {**self._target, **targets}
        command = {name + POSITION: self._scales[name].of(value) for name, value in wanted.items()}
        with self._faults("move"):
            sent: RobotAction = self._robot.send_action(command)
        # lerobot answers with what it really sent (`max_relative_target` shortens steps): joints
        # that later actions leave out stay there
        for name in wanted:
            value = sent.get(name + POSITION, command[name + POSITION])
            self._target[name] = self._scales[name].joint(self._number(name, value))
        return self._target

    def _halt(self) -> str:
        if self._estop_by == "hold":
            try:
                self._target = {}
                self._drive(self._positions())
            except RobotFault as error:
                log.error("cannot hold the pose, switching the motors off: %s", error)
            else:
                return "the motors hold the present pose"
        switch_off(self._robot, self._faults)
        return "the motors are off"

    def _positions(self) -> dict[str, float]:
        with self._faults("answer"):
            seen: RobotObservation = self._robot.get_observation()
        if missing := [name for name in self._scales if name + POSITION not in seen]:
            raise RobotFault(f"{self.description.name} does not report {', '.join(missing)}")
        return {
            name: scale.joint(self._number(name, seen[name + POSITION]))
            for name, scale in self._scales.items()
        }

    def _number(self, name: str, value: Any) -> float:
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            raise RobotFault(
                f"{self.description.name} reports {value!r} for {name}, which is not a number"
            )
        return number

    @contextmanager
    def _faults(self, what: str) -> Iterator[None]:
        """Turn whatever a driver raises into RobotFault.

        That covers lerobot's own errors and a serial port whose cable is pulled (`termios.error` is
        not an OSError).
        """
        try:
            yield
        except RobotFault:
            raise
        except Exception as error:
            raise RobotFault(
                f"{self.description.name} does not {what}: {type(error).__name__}: {error}",
                hint="look at the robot's cables and power, and at hal.transport",
            ) from error


def can_switch_off(robot: Any) -> bool:
    """Return whether this robot's torque can be switched off at once: it has a bus of lerobot's."""
    return callable(getattr(getattr(robot, "bus", None), "disable_torque", None))


def switch_off(robot: Any, faults: Callable[[str], Any]) -> None:
    """Switch the torque off; a robot without a bus of lerobot's is disconnected instead."""
    with faults("switch off"):
        if can_switch_off(robot):
            robot.bus.disable_torque()
        else:
            robot.disconnect()
