"""Cameras of ROS 2, read from the network by DDS, and the frames of any reader as ROS pictures."""

from __future__ import annotations

import logging
from typing import Annotated, Any, Literal

from pydantic import Field

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.params import Params, read_params, wrong
from vram_arbiter.runner.sensors.dds_thread import DdsThread
from vram_arbiter.runner.sensors.pictures import scaled_down
from vram_arbiter.runner.sensors.ros2_dds import (
    DOMAIN_MAX,
    dds_problems,
    dds_topic,
    domain_of,
    full_topic,
    reader_of,
    writer_of,
)
from vram_arbiter.runner.sensors.ros2_messages import (
    COMPRESSED,
    IMAGE,
    message_of,
    picture_of,
    stamp_ns_of,
)
from vram_arbiter.runner.sensors.ros2_types import RosMessage, cdr_of, read, sample_of, write
from vram_arbiter.runner.sensors.slot import Feed, FrameTee, SlotReader
from vram_arbiter.schemas.config.robot import SensorReaderConfig
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.world import SensorFrame

log = logging.getLogger(__name__)

TAKE_MAX = (
    4  # samples a turn: the reader keeps one, and there may be words about a publisher beside it
)
AHEAD_MAX_NS = (
    50_000_000  # a stamp may lie so far in the future: clocks of two machines never agree fully
)
_RELIABILITY = 11  # DDS's number for the policy that two sides can disagree about


class RosImageParams(Params, strict=True):
    """`backend_params` of `ros2_image`."""

    topic: Annotated[str, Field(min_length=1, max_length=256)]
    """As `ros2 topic list` shows it."""
    message: Literal["image", "compressed"] = "image"
    """`sensor_msgs/Image`, or `sensor_msgs/CompressedImage` (JPEG)."""
    reliability: Literal["best_effort", "reliable"] = "best_effort"
    """Best effort reads every publisher; reliable only those that offer it."""
    domain_id: Annotated[int, Field(ge=0, le=DOMAIN_MAX)] | None = None
    """null: ROS_DOMAIN_ID of the environment, else 0."""
    stamp: Literal["header", "arrival"] = "header"
    """Start of a picture's age: its header's stamp, or its arrival.

    With the stamp the clocks of both machines must agree; with the arrival delays stay unseen.
    """


def make(config: SensorReaderConfig, clock: Clock, tee: FrameTee | None) -> SlotReader:
    """Return a reader, not started. Raises ConfigError: wrong parameters, missing Cyclone DDS."""
    params = read_params(RosImageParams, config.backend_params, "backend_params")
    need("ROS 2", "cyclonedds", extra="ros2")
    try:
        topic = full_topic(params.topic)
    except ValueError as error:
        raise wrong("backend_params.topic", str(error)) from error
    if config.publish_topic is not None and full_topic(config.publish_topic) == topic:
        raise wrong("publish_topic", f"the camera is read from {topic} itself")
    try:
        domain_id = domain_of() if params.domain_id is None else params.domain_id
    except ValueError as error:
        raise wrong("backend_params.domain_id", str(error)) from error
    return RosImageReader(config.sensor_id, config.max_age_ms, params, domain_id, clock, tee)


def make_tee(config: SensorReaderConfig) -> RosImagePublisher:
    """Return the publisher of a camera's frames on its `publish_topic`. Raises ConfigError."""
    need("ROS 2", "cyclonedds", extra="ros2")
    try:
        return RosImagePublisher(
            config.publish_topic or "",
            domain_of(),
            rate_hz=config.publish_rate_hz,
            width=config.publish_width,
        )
    except ValueError as error:
        raise wrong("publish_topic", str(error)) from error


class RosImageReader(SlotReader):
    """One ROS topic as a camera. Its thread sleeps in DDS until something happens or it is
    stopped.
    """

    def __init__(
        self,
        sensor_id: str,
        max_age_ms: float,
        params: RosImageParams,
        domain_id: int,
        clock: Clock,
        tee: FrameTee | None = None,
    ) -> None:
        super().__init__(sensor_id, max_age_ms, clock, tee)
        self._params = params
        self._domain_id = domain_id
        self._topic = full_topic(params.topic)
        self._awaits = False  # the first publisher
        self._kind = IMAGE if params.message == "image" else COMPRESSED
        self._thread: DdsThread | None = None

    def _run_begins(self, feed: Feed) -> None:
        """Start reading. Raises ConfigError if DDS cannot be started."""
        from cyclonedds.core import DDSStatus
        from cyclonedds.domain import DomainParticipant

        self._awaits = feed.await_source(f"{self._topic} has no publisher yet")
        with dds_problems(self._domain_id):
            participant = DomainParticipant(self._domain_id)
            topic = dds_topic(self._topic)
            reader = reader_of(participant, topic, self._kind, self._params.reliability)
            reader.set_status_mask(
                DDSStatus.SubscriptionMatched | DDSStatus.RequestedIncompatibleQos
            )
            self._thread = DdsThread(
                f"camera-{self.sensor_id}",
                participant,
                [reader],
                [reader],
                lambda: self._attend(feed, reader),
                lambda problem: self._dds_failed(feed, problem),
            )
        log.info("camera %s reads %s, DDS domain %d", self.sensor_id, self._topic, self._domain_id)

    def _run_ends(self) -> None:
        if self._thread is not None:
            self._thread.close()
            self._thread = None

    # -- on the camera's thread
    def _dds_failed(self, feed: Feed, problem: str) -> None:
        feed.end(f"its reader failed: {problem}")

    def _attend(self, feed: Feed, reader: Any) -> None:
        """Handle what has come since the last time: changes of publishers, then pictures."""
        self._look_at_publishers(feed, reader)
        self._take(feed, reader)

    def _look_at_publishers(self, feed: Feed, reader: Any) -> None:
        from cyclonedds.core import DDSStatus

        changes = reader.take_status(
            DDSStatus.SubscriptionMatched | DDSStatus.RequestedIncompatibleQos
        )
        if not changes:
            return
        matched = reader.get_subscription_matched_status()
        refused = reader.get_requested_incompatible_qos_status()
        if matched.current_count:
            if self._awaits:
                self._awaits = False
                feed.interrupt("")
                log.info("camera %s has a publisher on %s", self.sensor_id, self._topic)
            return
        # pictures that former publishers sent arrive before the notice that they are gone
        self._take(feed, reader)
        if matched.current_count_change < 0:
            feed.interrupt(f"{self._topic} has no publisher any more")
        if refused.total_count_change:
            feed.interrupt(
                f"the publisher on {self._topic} offers best effort,"
                " and this reader asks for reliable:"
                " set reliability: best_effort"
                if refused.last_policy_id == _RELIABILITY
                else f"a publisher on {self._topic} offers another quality of service"
                f" (policy {refused.last_policy_id})"
            )

    def _take(self, feed: Feed, reader: Any) -> None:
        samples = reader.take(N=TAKE_MAX)
        newest = next(
            (sample for sample in reversed(samples) if sample.sample_info.valid_data), None
        )
        if newest is None:
            return
        try:
            message = read(self._kind, cdr_of(newest))
            frame = self._frame(message, newest.sample_info.source_timestamp)
        except ValueError as error:
            feed.interrupt(f"what comes on {self._topic} cannot be used: {error}")
        else:
            self.deliver(feed, frame)

    def _frame(self, message: RosMessage, sent_ns: int) -> SensorFrame:
        """Return a frame. Raises ValueError for a stamp of the future, or no picture."""
        picture = picture_of(self._kind, message)
        now_ns, wall_ns = self.clock.now_ns(), self.clock.wall_ns()
        taken_ns = (stamp_ns_of(message) or sent_ns) if self._params.stamp == "header" else wall_ns
        if taken_ns < 0:
            raise ValueError("it is stamped before 1970")
        age_ns = wall_ns - taken_ns
        if age_ns < -AHEAD_MAX_NS:
            raise ValueError(
                f"it is stamped {-age_ns / 1e6:.0f} ms in the future;"
                " synchronize the machines' clocks,"
                " or set stamp: arrival"
            )
        return SensorFrame(
            sensor_id=self.sensor_id,
            stamp_monotonic_ns=max(0, now_ns - max(0, age_ns)),
            stamp_wall_ns=taken_ns,
            encoding=picture.encoding,
            width=picture.width,
            height=picture.height,
            channels=picture.channels,
            data=picture.data,
            metadata={"frame_id": message["header"]["frame_id"], "topic": self._topic},
        )


class RosImagePublisher:
    """`FrameTee` to a ROS topic: Image, or CompressedImage for JPEG frames.

    Offered as reliable, which every ROS subscriber takes; without history, so a slow subscriber
    misses pictures and the camera never waits. `publish` never raises: failures are counted in
    `dropped`, and the first of a series is logged.
    """

    def __init__(
        self,
        topic: str,
        domain_id: int,
        *,
        rate_hz: float | None = None,
        width: int | None = None,
    ) -> None:
        """Raises ValueError if `topic` is not a ROS name. `rate_hz` limits the pictures per second,
        `width` their pixels.
        """
        self.topic = full_topic(topic)
        self.domain_id = domain_id
        self.published = 0
        self.dropped = 0
        self._period_ns = 0.0 if rate_hz is None else 1e9 / rate_hz
        self._next_ns = 0.0
        self._width = width
        self._failing = False
        self._kind = ""  # of its messages
        self._writer: Any = None

    def publish(self, frame: SensorFrame) -> None:
        from cyclonedds.core import DDSException

        if frame.stamp_monotonic_ns < self._next_ns:
            return
        try:
            if self._width is not None:
                frame = scaled_down(frame, self._width)
            kind, message = message_of(frame)
            self._open(kind).write(sample_of(kind, write(kind, message)))
        except (ValueError, ConfigError, DDSException) as error:
            self.dropped += 1
            if not self._failing:
                log.warning("camera %s: no picture on %s: %s", frame.sensor_id, self.topic, error)
            self._failing = True
            return
        self._failing = False
        self.published += 1
        due_ns = self._next_ns + self._period_ns
        self._next_ns = (
            due_ns
            if due_ns > frame.stamp_monotonic_ns
            else frame.stamp_monotonic_ns + self._period_ns
        )

    def close(self) -> None:
        """Leave the domain. `publish` joins it again."""
        self._writer, self._kind = None, ""

    def _open(self, kind: str) -> Any:
        from cyclonedds.domain import DomainParticipant

        if self._writer is None:
            with dds_problems(self.domain_id):
                participant = DomainParticipant(self.domain_id)
                self._writer = writer_of(participant, dds_topic(self.topic), kind)
            self._kind = kind
        elif kind != self._kind:
            raise ValueError(
                "a topic carries one type: the camera changed between JPEG and plain pictures"
            )
        return self._writer
