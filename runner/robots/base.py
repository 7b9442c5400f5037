"""Base of all adapters: connection state, latched emergency stop, and the actions they accept.

A subclass connects, reads, drives and stops its hardware. Must not know safety limits: the gate
enforces them; this class refuses only what cannot be sent.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import NoReturn

from pydantic import ValidationError

from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.so101 import lerobot_units_of
from vram_arbiter.runner.robots.units import LerobotUnits
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import (
    BadState,
    EstopRequested,
    InternalError,
    RobotFault,
    VramError,
)
from vram_arbiter.schemas.world import Action, JointState, Twist

log = logging.getLogger(__name__)


class HalBase(ABC):
    """One robot. All calls on one thread. `connect` and `disconnect` may be repeated."""

    def __init__(self, description: RobotDescription) -> None:
        self.description = description
        self._connected = False
        self._estop: EstopRequested | None = None
        self._sent: dict[str, float] = {}

    @property
    def lerobot_units(self) -> LerobotUnits | None:
        """How lerobot would record this robot; None: it does not know such a robot."""
        return lerobot_units_of(self.description)

    # -- what the hardware does
    @abstractmethod
    def _open(self) -> None:
        """Connect to the hardware; nothing moves.

        Raises RobotFault or OperatorError, with nothing left open.
        """

    @abstractmethod
    def _close(self) -> None: ...

    @abstractmethod
    def _read(self) -> JointState: ...

    @abstractmethod
    def _drive(self, targets: Mapping[str, float]) -> Mapping[str, float]:
        """Send joint targets in rad; return those that the hardware accepted.

        Other joints keep theirs.
        """

    def _roll(self, twist: Twist | None) -> None:
        """Drive the base at a velocity in its own frame; None stops it.

        Called with every command of a robot whose description has a base.
        """
        raise InternalError(f"{self.description.name} has no base to drive")

    @abstractmethod
    def _halt(self) -> str:
        """Stop the motors; return in a few words what was done. Raises RobotFault when it
        failed.
        """

    # -- the protocol
    def connect(self) -> None:
        """Raise EstopRequested once the emergency stop is latched: a person has to restart the
        runner.
        """
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
        """Return measured positions (rad) and, where the hardware knows them, velocities (rad/s)
        and efforts (N·m).

        Raises BadState when not connected, RobotFault when the hardware does not answer or answers
        without a number.
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
        """Send an action that passed the gate.

        Raises EstopRequested once latched, BadState when not connected, InternalError for an action
        that cannot have passed a gate.
        """
        if self._estop is not None:
            raise self._estop
        self._require_connected()
        targets = {}
        if action.control_mode is not ControlMode.BODY_TWIST or self.description.base is None:
            targets = self._targets_of(action)
        if self.description.base is not None or action.body_twist is not None:
            self._roll(action.body_twist[0] if action.body_twist is not None else None)
        if targets:
            self._sent.update(self._drive(targets))

    def sent(self) -> Mapping[str, float]:
        """Return the last target (rad) that the motors really got, by joint; empty at first."""
        return self._sent

    def estop(self, reason: str) -> NoReturn:
        """Stop the motors, latch, raise EstopRequested.

        Again: stops again and raises the first reason.

        `details.told` is true once the motors have been told; until then it is worth trying again.
        """
        told, halted = True, "the robot is not connected"
        if self._connected:
            try:
                halted = self._halt()
            except Exception as error:  # a driver's defect must not hide the stop
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
                f"{self.description.name} takes one step of joint positions,"
                f" got {action.horizon} of {action.control_mode}"
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
