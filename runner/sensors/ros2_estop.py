"""Emergency stop by a ROS 2 topic: `std_msgs/Bool`, true stops. Needs DDS, and no ROS installation.

Fails to the safe side: a message that cannot be read stops the robot, and so does a listener that
breaks down. A publisher that is away stops nothing: the topic is a button, not a dead man's switch.
"""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from vram_arbiter.runner.sensors.dds_thread import DdsThread
from vram_arbiter.runner.sensors.ros2_dds import dds_problems, dds_topic, domain_of, reader_of
from vram_arbiter.runner.sensors.ros2_types import cdr_of
from vram_arbiter.schemas.config.robot import RobotEnvironment
from vram_arbiter.schemas.errors import ConfigError

log = logging.getLogger(__name__)

MESSAGES_KEPT = 64  # until the thread has come to them
_BOOL_BYTES = 5  # four that name the encoding, and the value


def listened_topic(robot: RobotEnvironment) -> str | None:
    """Return the topic that a deployment is stopped by: one that its file gives, where DDS is
    installed."""
    safety = robot.safety
    if safety is None or "e_stop_topic" not in safety.model_fields_set:
        return None
    return safety.e_stop_topic if importlib.util.find_spec("cyclonedds") is not None else None


@contextmanager
def estop_topic(topic: str | None, stop: Callable[[str], None]) -> Iterator[None]:
    """While inside, call `stop(reason)` on a thread of its own when the topic says so; None: do
    nothing.

    Raises ConfigError: a wrong name or domain, or DDS cannot be started.
    """
    if topic is None:
        yield
        return
    try:
        name, domain = dds_topic(topic), domain_of()
    except ValueError as error:
        raise ConfigError(f"safety.e_stop_topic: {error}") from error
    listener = _Listener(topic, name, domain, stop)
    try:
        yield
    finally:
        listener.close()


class _Listener:
    def __init__(self, topic: str, name: str, domain: int, stop: Callable[[str], None]) -> None:
        from cyclonedds.core import DDSStatus
        from cyclonedds.domain import DomainParticipant

        self._topic, self._stop = topic, stop
        with dds_problems(domain):
            participant = DomainParticipant(domain)
            # not the newest alone: a button that is let go at once has been pressed
            reader = reader_of(participant, name, "std_msgs/msg/Bool", kept=MESSAGES_KEPT)
            reader.set_status_mask(DDSStatus.RequestedIncompatibleQos)
            self._thread = DdsThread(
                "estop-topic",
                participant,
                [reader],
                [reader],
                lambda: self._attend(reader),
                self._broke_down,
            )
        log.info("the robot stops when %s says true", topic)

    def close(self) -> None:
        self._thread.close()

    # -- on its thread
    def _broke_down(self, problem: str) -> None:
        self._stop(f"the listener on {self._topic} broke down: {problem}")

    def _attend(self, reader: Any) -> None:
        from cyclonedds.core import DDSStatus

        if reader.take_status(DDSStatus.RequestedIncompatibleQos):
            log.error(
                "a publisher on %s offers best effort and is not heard: it has to be reliable",
                self._topic,
            )
        for sample in reader.take(N=MESSAGES_KEPT):
            if sample.sample_info.valid_data and (reason := said(cdr_of(sample))):
                self._stop(f"{self._topic} {reason}")


def said(cdr: bytes) -> str:
    """Return why a `std_msgs/Bool` as it came stops the robot; "" if it says false."""
    if len(cdr) < _BOOL_BYTES or cdr[0] != 0 or cdr[4] > 1:
        return "sent what cannot be read"
    return "says stop" if cdr[4] else ""
