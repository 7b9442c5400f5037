"""What all adapters have in common: connected or not, the latched emergency stop, and which actions they take at all.

A subclass says how its hardware connects, is read, is driven and is stopped. Knows no safety limits: that is the gate's work; what is
refused here is what could not be sent.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import NoReturn

from pydantic import ValidationError

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import (
    BadState,
    EstopRequested,
    InternalError,
    RobotFault,
    VramError,
)
from vram_arbiter.schemas.world import Action, JointState

log = logging.getLogger(__name__)


class HalBase(ABC):
    """One robot. All calls on one thread. `connect` and `disconnect` may be repeated."""

    def __init__(self, description: RobotDescription) -> None:
        self.description = description
        self._connected = False
        self._estop: EstopRequested | None = None
        self._sent: dict[str, float] = {}

    # -- what the hardware does ------------------------------------------------------------------------------------------
    @abstractmethod
    def _open(self) -> None:
        """Reach the hardware; nothing moves. RobotFault or OperatorError when that fails; nothing is left open then."""

    @abstractmethod
    def _close(self) -> None: ...

    @abstractmethod
    def _read(self) -> JointState: ...

    @abstractmethod
    def _drive(self, targets: Mapping[str, float]) -> Mapping[str, float]:
        """Send joint targets in rad; returns those that the hardware accepted. Joints that are left out keep their last target."""

    @abstractmethod
    def _halt(self) -> str:
        """Stop the motors; returns in a few words what was done. RobotFault when it could not be done."""

    # -- the protocol ------------------------------------------------------------------------------------------------------
    def connect(self) -> None:
        """Raises EstopRequested once the emergency stop is latched: a person looks, then starts the runner again."""
        if self._estop is not None:
            raise self._estop
        if not self._connected:
            self._sent = {}
            self._open()
            self._connected = True

    def disconnect(self) -> None:
        if self._connected:
            self._connected = False
            self._close()

    def read_state(self) -> JointState:
        """Measured positions (rad) and, where the hardware knows them, velocities (rad/s) and efforts (N·m).

        Raises BadState when not connected, RobotFault when the hardware does not answer or answers what is no number.
        """
        self._require_connected()
        try:
            return self._read()
        except ValidationError as error:
            raise RobotFault(
                f"{self.description.name} reports a state that is none: {error.errors()[0]['msg']}",
                hint="look at the robot's cables and power",
            ) from error

    def send_action(self, action: Action) -> None:
        """Raises EstopRequested once latched, BadState when not connected, InternalError for what no gate lets through."""
        if self._estop is not None:
            raise self._estop
        self._require_connected()
        self._sent.update(self._drive(self._targets_of(action)))

    def sent(self) -> Mapping[str, float]:
        """The last target (rad) that the motors were really given, by joint; empty before the first action."""
        return self._sent

    def estop(self, reason: str) -> NoReturn:
        """Stop the motors, latch, raise EstopRequested. Again: stops again and raises the first one's reason.

        `details.told` says whether the motors have been told; while they have not it is worth trying again.
        """
        told, halted = True, "the robot is not connected"
        if self._connected:
            try:
                halted = self._halt()
            except (
                Exception
            ) as error:  # a driver's defect, too, must not keep anybody from hearing this
                if self._estop is None:
                    log.exception("the motors of %s could not be stopped", self.description.name)
                text = (
                    error.message
                    if isinstance(error, VramError)
                    else f"{type(error).__name__}: {error}"
                )
                told, halted = False, f"the motors may still be on: {text}"
        if self._estop is None or not self._estop.details["told"]:
            first = reason if self._estop is None else self._estop.details["reason"]
            self._estop = EstopRequested(
                f"emergency stop: {first}; {halted}",
                hint="look at the robot, then start the runner again",
                details={"reason": first, "halted": halted, "told": told},
            )
        raise self._estop

    def _require_connected(self) -> None:
        if not self._connected:
            raise BadState(f"{self.description.name} is not connected", hint="call connect() first")

    def _targets_of(self, action: Action) -> dict[str, float]:
        if action.control_mode is not ControlMode.JOINT_POSITION or action.horizon != 1:
            raise InternalError(
                f"{self.description.name} takes one step of joint positions, not {action.horizon} of {action.control_mode}"
            )
        names = action.joint_names or self.description.joint_names
        row = action.rows[0]
        if len(row) != len(names):
            raise InternalError(
                f"{len(row)} joint targets for {len(names)} joints reached the robot"
            )
        if unknown := [name for name in names if name not in self.description.joint_names]:
            raise InternalError(f"{self.description.name} has no joint {', '.join(unknown)}")
        return dict(zip(names, row, strict=True))
