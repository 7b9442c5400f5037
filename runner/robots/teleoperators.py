"""lerobot's teleoperators as poses of this robot, in rad: `teleop.adapter: lerobot:TYPE`.

A leader arm gives the pose that the robot follows, a keyboard the ends of the ranges of the joints
whose keys are pressed. A thread of its own reads the device, because a serial bus that loses an
answer would make a tick late. Must not know skills or the control loop.
"""

from __future__ import annotations

import contextlib
import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vram_arbiter.runner.control.clock import Clock, SystemClock
from vram_arbiter.runner.params import wrong
from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.robots.lerobot_devices import LEROBOT, bus_unit, make_device
from vram_arbiter.runner.robots.units import POSITION, JointUnit, LerobotUnits, Scale
from vram_arbiter.schemas.config.robot import TeleopConfig
from vram_arbiter.schemas.errors import RobotFault, StateStale
from vram_arbiter.schemas.findings import did_you_mean

if TYPE_CHECKING:
    from lerobot.lerobot_types import RobotAction

MAX_AGE_S = 0.2  # as of a joint state: an older pose is not the operator's any more
KEYBOARD = "keyboard"
# of the joints in their order: the key that raises it, and the one that lowers it
KEYS = ("qa", "ws", "ed", "rf", "tg", "yh", "uj", "ik")

Pose = Mapping[str, float]
"""Where the operator wants joints (rad, by name; ±inf: as far as they go); others stay."""


class Teleoperator(ABC):
    """`start` and `stop` on one thread at a time, both repeatable; `pose` on any.

    `device` is an unconnected `lerobot.teleoperators.Teleoperator`.
    """

    leads = True  # it has a pose of its own, which the robot follows at its speed once it is there

    def __init__(self, device: Any, *, period_s: float, clock: Clock | None = None) -> None:
        self._device = device
        self._period_s = period_s
        self._clock = clock or SystemClock()
        self._read: tuple[Pose, int] = ({}, 0)  # the newest pose, and its stamp
        self._why = "it has not answered yet"
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()

    def start(self) -> None:
        """Connect, unless it answers. Raises RobotFault, with nothing left open."""
        with contextlib.suppress(StateStale):
            self.pose()
            return
        self.stop()
        try:
            self._attempt(self._connect)
            self._attempt(self._take)
        except RobotFault:
            self.stop()
            raise
        self._stopping.clear()
        self._thread = threading.Thread(target=self._read_on, name="teleoperator", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._read = ({}, 0)
        with contextlib.suppress(RobotFault):  # its cable may be out
            self._attempt(self._disconnect)

    def pose(self) -> Pose:
        """Return the newest pose. Raises StateStale when it is too old to act on."""
        pose, stamp_ns = self._read
        if (self._clock.now_ns() - stamp_ns) / 1e9 > MAX_AGE_S:
            raise StateStale(
                f"the teleoperator is stale: {self._why}", hint="look at its cables and power"
            )
        return pose

    @abstractmethod
    def _connect(self) -> None: ...

    @abstractmethod
    def _pose_of(self, action: RobotAction) -> Pose:
        """Return the pose that an action of the device means."""

    def _disconnect(self) -> None:
        """Give the port back, also if the motors behind it do not answer any more."""
        if not self._device.is_connected:
            return
        try:
            self._device.disconnect()
        finally:
            bus: Any = getattr(self._device, "bus", None)
            if getattr(bus, "is_connected", False):
                bus.disconnect(disable_torque=False)

    def _take(self) -> None:
        stamp_ns = self._clock.now_ns()  # before the device is asked: never younger than the data
        self._read = self._pose_of(self._device.get_action()), stamp_ns

    def _read_on(self) -> None:
        while not self._stopping.wait(self._period_s):
            try:
                self._attempt(self._take)
            except RobotFault as error:  # one lost answer is harmless: the pose's age decides
                self._why = error.message

    def _attempt(self, work: Any) -> None:
        """Turn whatever a driver raises into RobotFault."""
        try:
            work()
        except RobotFault:
            raise
        except Exception as error:
            raise RobotFault(
                f"{self._device} does not answer: {type(error).__name__}: {error}",
                hint="look at its cables and power, and at teleop.transport",
            ) from error


class Leader(Teleoperator):
    """An arm that the operator moves by hand; `scales` are the robot's, by joint."""

    def __init__(self, device: Any, scales: Mapping[str, Scale], **options: Any) -> None:
        super().__init__(device, **options)
        self._scales = dict(scales)

    def _connect(self) -> None:
        self._device.connect(calibrate=False)
        if not self._device.is_calibrated:
            raise RobotFault(
                f"{self._device} is not calibrated",
                hint=f"run lerobot-calibrate --teleop.type={self._device.name}"
                f" --teleop.id={self._device.id} once, and give the same id in teleop.transport",
            )

    def _pose_of(self, action: RobotAction) -> Pose:
        pose = {
            name: scale.joint(float(action[name + POSITION]))
            for name, scale in self._scales.items()
        }
        if lost := [name for name, value in pose.items() if not math.isfinite(value)]:
            raise RobotFault(f"{self._device} reports no number for {', '.join(lost)}")
        return pose


class Keyboard(Teleoperator):
    """Keys that move joints while they are pressed, see KEYS."""

    leads = False

    def __init__(self, device: Any, joints: tuple[str, ...], **options: Any) -> None:
        super().__init__(device, **options)
        self._ends = {
            key: (joint, end)
            for joint, keys in zip(joints, KEYS, strict=False)
            for key, end in zip(keys, (math.inf, -math.inf), strict=True)
        }

    def _connect(self) -> None:
        self._device.connect()
        if not self._device.is_connected:
            raise RobotFault("no keys can be read here", hint="lerobot's keyboard needs X11")

    def _pose_of(self, action: RobotAction) -> Pose:
        return dict(self._ends[key] for key in action if key in self._ends)


def make_teleoperator(
    config: TeleopConfig,
    robot: RobotDescription,
    units: LerobotUnits | None,
    *,
    period_s: float,
    clock: Clock | None = None,
) -> Teleoperator:
    """Return the teleoperator, not connected.

    Args: `units` are those in which lerobot knows this robot. Raises ConfigError for an unknown
    one, and for one that does not fit the robot.
    """
    kind = config.adapter.removeprefix(LEROBOT)
    if kind == config.adapter:
        raise wrong("adapter", f"unknown adapter {kind!r}{did_you_mean(kind, (LEROBOT + 'TYPE',))}")
    device = make_device("teleoperator", kind, config.transport)
    if kind == KEYBOARD:
        return Keyboard(device, robot.joint_names, period_s=period_s, clock=clock)
    if units is None:
        raise wrong("adapter", f"lerobot has no names and units for {robot.name}")
    known = [name + POSITION for name in units.scales]
    if others := [name for name in device.action_features if name not in known]:
        raise wrong(
            "adapter", f"{config.adapter} gives {', '.join(others)}; the robot has no such joint"
        )
    names = [name.removesuffix(POSITION) for name in device.action_features]
    scales = {name: units.scales[name] for name in names}
    for name, scale in scales.items():
        unit = bus_unit(device, name)
        in_degrees = math.isclose(abs(scale.scale), math.radians(1.0))
        if unit is not None and (unit is JointUnit.DEG) is not in_degrees:
            raise wrong("transport", f"{name} comes in {unit}, not in the robot's unit")
    return Leader(device, scales, period_s=period_s, clock=clock)
