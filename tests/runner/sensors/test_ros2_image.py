"""ROS 2 pictures over DDS on loopback: a publisher and a subscriber that know nothing of the
product.
"""

import logging
import os
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.runner.small_robots import frame_at
from tests.support.dds import NETWORK
from tests.support.waiting import until
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.sensors import SlotReader
from vram_arbiter.runner.sensors.factory import make_reader
from vram_arbiter.runner.sensors.ros2_dds import dds_topic, domain_of, full_topic
from vram_arbiter.runner.sensors.ros2_dds import reader_of as dds_reader_of
from vram_arbiter.runner.sensors.ros2_image import RosImagePublisher, RosImageReader
from vram_arbiter.runner.sensors.ros2_messages import IMAGE
from vram_arbiter.schemas.config.robot import SensorBackend, SensorReaderConfig
from vram_arbiter.schemas.errors import ConfigError, FrameStale
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame

pytestmark = pytest.mark.heavy
pytest.importorskip("cyclonedds")

from tests.runner.sensors.ros2_node import Node  # noqa: E402

DOMAIN = "77"
Reading = Callable[[SlotReader], SlotReader]


@pytest.fixture(autouse=True)
def loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", NETWORK)
    monkeypatch.setenv("ROS_DOMAIN_ID", DOMAIN)


@pytest.fixture
def topic() -> str:
    return f"/front_{uuid.uuid4().hex}/image_raw"


@pytest.fixture
def node() -> Iterator[Callable[..., Node]]:
    made: list[Node] = []

    def make(topic: str, message: str = "image", reliability: str = "best_effort") -> Node:
        made.append(Node(int(DOMAIN), topic, message, reliability).offer())
        return made[-1]

    yield make
    for one in made:
        one.close()


def config(topic: str, max_age_ms: float = 60_000.0, **params: Any) -> SensorReaderConfig:
    return SensorReaderConfig(
        sensor_id="front",
        backend=SensorBackend.ROS2_IMAGE,
        backend_params={"topic": topic, **params},
        max_age_ms=max_age_ms,
    )


def reader_of(topic: str, **params: Any) -> SlotReader:
    return make_reader(config(topic, **params), SystemClock())


def image(width: int, height: int, encoding: str = "rgb8", per_pixel: int = 3) -> dict[str, Any]:
    return {
        "width": width,
        "height": height,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": width * per_pixel,
    }


def picture_now(reader: SlotReader, publisher: Node, data: bytes, **fields: Any) -> SensorFrame:
    """Publish until this picture is the newest: best effort repeats nothing. At most a minute."""
    slot = reader.slot
    for _ in range(300):
        publisher.publish(data, **{"stamp_ns": SystemClock().wall_ns(), **fields})
        with slot._changed:
            if slot._changed.wait_for(
                lambda: slot._frame is not None and slot._frame.data == data, 0.2
            ):
                return reader.read_latest()
    raise AssertionError(f"no picture within a minute: {slot._reason}")


def why_stale(reader: SlotReader, word: str) -> str:
    """What readers are told, once it contains `word`; waits at most a minute."""
    slot = reader.slot
    with slot._changed:
        assert slot._changed.wait_for(lambda: word in slot._reason, 60), slot._reason
    with pytest.raises(FrameStale) as stale:
        reader.read_latest()
    return str(stale.value)


@pytest.mark.parametrize("reliability", ["best_effort", "reliable"])
def test_pictures_of_another_node_arrive(
    topic: str, node: Callable[..., Node], started_reader: Reading, reliability: str
) -> None:
    reader = started_reader(reader_of(topic, reliability=reliability))
    publisher = node(topic, "image", "reliable")
    data = os.urandom(64 * 48 * 3)
    before_ns = SystemClock().wall_ns()
    frame = picture_now(reader, publisher, data, **image(64, 48))
    assert (frame.sensor_id, frame.encoding, frame.width, frame.height) == ("front", "rgb8", 64, 48)
    assert frame.data == data
    assert frame.metadata == {"frame_id": "cam", "topic": topic}
    assert before_ns <= frame.stamp_wall_ns <= SystemClock().wall_ns()
    again = os.urandom(64 * 48 * 3)
    assert picture_now(reader, publisher, again, **image(64, 48)).data == again


def test_a_reader_waits_for_its_publisher_and_says_so(
    topic: str, node: Callable[..., Node], started_reader: Reading, caplog: pytest.LogCaptureFixture
) -> None:
    """Regression: it was as silent as a broken camera, and given up like one."""
    caplog.set_level(logging.INFO)
    reader = started_reader(reader_of(topic))
    with pytest.raises(FrameStale, match=f"{topic} has no publisher yet") as stale:
        reader.read_latest()
    assert stale.value.details["absent"]
    until(lambda: f"camera front reads {topic}" in caplog.text)
    publisher = node(topic)
    assert picture_now(reader, publisher, bytes(12), **image(2, 2)).height == 2
    assert f"camera front has a publisher on {topic}" in caplog.text
    assert caplog.text.count("has a publisher") == 1


def test_a_picture_larger_than_a_datagram_arrives_whole(
    topic: str, node: Callable[..., Node], started_reader: Reading
) -> None:
    reader = started_reader(reader_of(topic, reliability="reliable"))
    publisher = node(topic, "image", "reliable")
    data = os.urandom(640 * 480 * 3)
    assert picture_now(reader, publisher, data, **image(640, 480, "bgr8")).data == data


def test_jpeg_pictures(topic: str, node: Callable[..., Node], started_reader: Reading) -> None:
    import cv2
    import numpy as np

    data = bytes(cv2.imencode(".jpg", np.full((48, 64, 3), 90, dtype=np.uint8))[1])
    reader = started_reader(reader_of(topic + "/compressed", message="compressed"))
    publisher = node(topic + "/compressed", "compressed")
    frame = picture_now(reader, publisher, data, format="jpeg")
    assert (frame.encoding, frame.width, frame.height, frame.channels) == ("jpeg", 64, 48, 3)
    assert frame.data == data


def test_age_counts_from_the_header(
    topic: str, node: Callable[..., Node], started_reader: Reading
) -> None:
    reader = started_reader(reader_of(topic, max_age_ms=1_000.0, reliability="reliable"))
    publisher = node(topic, "image", "reliable")
    # a machine that has just been started has no longer past
    old_ns = SystemClock().wall_ns() - 30 * 10**9
    slot = reader.slot
    for _ in range(300):  # whoever has matched a reader may not yet have been matched by it
        publisher.publish(bytes(12), old_ns, **image(2, 2))
        with slot._changed:
            if slot._changed.wait_for(lambda: slot._frame is not None, 0.2):
                break
    with pytest.raises(FrameStale, match="ms old, 1000 ms are accepted") as stale:
        reader.read_latest()
    assert 30_000 <= stale.value.details["age_ms"] < 300_000
    publisher.publish(bytes(12), SystemClock().wall_ns() + 3600 * 10**9, **image(2, 2))
    assert "in the future; synchronize the machines' clocks" in why_stale(reader, "future")


def test_age_can_count_from_the_arrival(
    topic: str, node: Callable[..., Node], started_reader: Reading
) -> None:
    reader = started_reader(reader_of(topic, stamp="arrival"))
    publisher = node(topic)
    # a clock that begins with the machine
    frame = picture_now(reader, publisher, bytes(12), stamp_ns=1, **image(2, 2))
    assert reader.read_latest().data == frame.data


def test_a_picture_that_cannot_be_used_is_not_shown(
    topic: str, node: Callable[..., Node], started_reader: Reading
) -> None:
    reader = started_reader(reader_of(topic, reliability="reliable"))
    publisher = node(topic, "image", "reliable")
    picture_now(reader, publisher, bytes(12), **image(2, 2))
    publisher.publish(bytes(4), SystemClock().wall_ns(), **image(2, 2, "bayer_rggb8", 1))
    assert "'bayer_rggb8' is not supported" in why_stale(reader, "bayer")
    picture_now(reader, publisher, bytes(12), **image(2, 2))
    publisher.publish(bytes(11), SystemClock().wall_ns(), **image(2, 2))
    assert "in 11 bytes" in why_stale(reader, "11 bytes")
    assert picture_now(reader, publisher, bytes(12), **image(2, 2)).width == 2


def test_a_publisher_that_leaves_takes_its_picture_with_it(
    topic: str, node: Callable[..., Node], started_reader: Reading
) -> None:
    reader = started_reader(reader_of(topic))
    publisher = node(topic)
    picture_now(reader, publisher, bytes(12), **image(2, 2))
    publisher.close()
    assert f"{topic} has no publisher any more" in why_stale(reader, "no publisher")
    other = node(topic)
    assert picture_now(reader, other, bytes(12), **image(2, 2)).height == 2


def test_the_last_picture_of_a_publisher_that_left_is_not_shown_after_it(topic: str) -> None:
    """Regression: both came while the camera's thread stood still; the picture was taken up after
    the word that nobody publishes any more.
    """
    from cyclonedds.core import DDSStatus, WaitSet
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.util import duration

    reader = reader_of(topic, reliability="reliable")
    assert isinstance(reader, RosImageReader)
    feed, slot = reader.slot.open(), reader.slot  # its thread is this test
    participant = DomainParticipant(int(DOMAIN))
    source = dds_reader_of(participant, dds_topic(topic), IMAGE)
    source.set_status_mask(DDSStatus.SubscriptionMatched)
    waitset = WaitSet(participant)
    waitset.attach(source)
    publisher, clock = RosImagePublisher(topic, int(DOMAIN)), SystemClock()
    until_s = clock.now_s() + 60
    while slot._frame is None:
        assert clock.now_s() < until_s, "no picture within a minute"
        publisher.publish(frame_at(clock.wall_ns(), data=b"a"))
        waitset.wait(duration(milliseconds=100))
        reader._attend(feed, source)
    publisher.publish(frame_at(clock.wall_ns(), data=b"z"))
    while not source.read(1):
        assert clock.now_s() < until_s, "the last picture did not come"
        waitset.wait(duration(milliseconds=100))
    publisher.close()
    while not source.read_status(DDSStatus.SubscriptionMatched):
        assert clock.now_s() < until_s, "its end went unnoticed"
        waitset.wait(duration(milliseconds=100))
    reader._attend(feed, source)
    assert "has no publisher" in slot._reason
    assert slot._frame is None


def test_a_publisher_with_another_quality_of_service_is_named(
    topic: str, node: Callable[..., Node], started_reader: Reading
) -> None:
    reader = started_reader(reader_of(topic, reliability="reliable"))
    node(topic, "image", "best_effort")
    assert "set reliability: best_effort" in why_stale(reader, "best_effort")


def test_stopping_ends_the_thread_and_starting_begins_anew(
    topic: str, node: Callable[..., Node]
) -> None:
    reader = reader_of(topic)
    publisher = node(topic)
    for _ in range(2):
        reader.start()
        assert isinstance(reader, RosImageReader)
        thread = reader._thread
        picture_now(reader, publisher, bytes(12), **image(2, 2))
        reader.stop()
        assert not thread.alive
        with pytest.raises(FrameStale, match="stopped"):
            reader.read_latest()


def test_the_frames_of_any_reader_can_be_published(
    topic: str, make_video: Callable[..., Path], started_reader: Reading
) -> None:
    subscriber = Node(int(DOMAIN), topic, "image", "reliable")
    camera = SensorReaderConfig(
        sensor_id="file",
        backend_params={"path": str(make_video([200], fps=20.0)), "loop": True},
        publish_to_ros=True,
        publish_topic=topic,
    )
    started_reader(make_reader(camera, SystemClock()))
    got = subscriber.take()
    assert (got.width, got.height, got.encoding, got.step) == (64, 48, "bgr8", 64 * 3)
    assert got.header.frame_id == "file"
    assert len(got.data) == 64 * 48 * 3
    assert sum(got.data) / len(got.data) == pytest.approx(200, abs=3)


def test_the_publisher_keeps_to_its_rate_and_counts_what_it_cannot_send(topic: str) -> None:
    publisher = RosImagePublisher(topic, int(DOMAIN), rate_hz=10.0)
    for at_ms in range(1000, 2000, 33):
        publisher.publish(frame_at(at_ms * 1_000_000))
    assert (publisher.published, publisher.dropped) == (10, 0)
    publisher.publish(frame_at(3_000_000_000, data=None, topic="/elsewhere"))
    publisher.publish(frame_at(3_000_000_000, encoding=FrameEncoding.RAW))
    publisher.publish(frame_at(3_000_000_000, encoding=FrameEncoding.JPEG))
    assert (publisher.published, publisher.dropped) == (10, 3)
    publisher.close()
    publisher.publish(frame_at(4_000_000_000))
    assert publisher.published == 11
    publisher.close()


@pytest.mark.parametrize("encoding", [FrameEncoding.DEPTH16, FrameEncoding.JPEG])
def test_what_is_published_is_read_as_it_was(
    topic: str, started_reader: Reading, encoding: FrameEncoding
) -> None:
    import cv2
    import numpy as np

    depth = np.arange(12, dtype="<u2").reshape(3, 4) * 5000
    data = (
        depth.tobytes()
        if encoding is FrameEncoding.DEPTH16
        else bytes(cv2.imencode(".jpg", depth >> 8)[1])
    )
    message = "image" if encoding is FrameEncoding.DEPTH16 else "compressed"
    reader = started_reader(reader_of(topic, message=message, reliability="reliable"))
    publisher = RosImagePublisher(topic, int(DOMAIN))
    slot, clock = reader.slot, SystemClock()
    for _ in range(300):
        shown = {"encoding": encoding, "width": 4, "height": 3, "data": data}
        frame = frame_at(clock.now_ns(), "other", stamp_wall_ns=clock.wall_ns(), **shown)
        publisher.publish(frame)
        with slot._changed:
            if slot._changed.wait_for(lambda: slot._frame is not None, 0.2):
                break
    got = reader.read_latest()
    publisher.close()
    assert (got.encoding, got.width, got.height, got.channels, got.data) == (
        encoding,
        4,
        3,
        1,
        data,
    )


def test_a_network_that_is_not_there_is_said_at_the_start(
    topic: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a process of its own: Cyclone reads its settings once."""
    monkeypatch.setenv("CYCLONEDDS_URI", NETWORK.replace('name="lo"', 'name="no-such-if"'))
    code = (
        "from vram_arbiter.runner.control.clock import SystemClock\n"
        "from vram_arbiter.runner.sensors.factory import make_reader\n"
        "from vram_arbiter.schemas.config.robot import SensorReaderConfig\n"
        f"params = {{'topic': {topic!r}}}\n"
        "config = SensorReaderConfig(sensor_id='a', backend='ros2_image', backend_params=params)\n"
        "reader = make_reader(config, SystemClock())\n"
        "try:\n    reader.start()\nexcept Exception as error:\n    print(type(error).__name__,"
        " error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.startswith("ConfigError DDS could not be started on domain 77"), done
    assert "CYCLONEDDS_URI" in done.stdout


@pytest.mark.parametrize(
    ("params", "problem"),
    [
        ({}, "backend_params.topic: is missing"),
        ({"topic": "front camera"}, "expected a ROS topic"),
        ({"topic": "/a", "qos": "reliable"}, "backend_params.qos: unknown key"),
        ({"topic": "/a", "domain_id": 233}, "domain_id"),
        ({"topic": "/a", "message": "depth"}, "'image' or 'compressed'"),
    ],
)
def test_wrong_parameters_are_refused(params: dict[str, Any], problem: str) -> None:
    camera = SensorReaderConfig(
        sensor_id="front", backend=SensorBackend.ROS2_IMAGE, backend_params=params
    )
    with pytest.raises(ConfigError) as refused:
        make_reader(camera, SystemClock())
    assert problem in str(refused.value)


def test_a_camera_is_not_published_where_it_is_read() -> None:
    camera = config("/a/b").model_copy(update={"publish_to_ros": True, "publish_topic": "a/b"})
    with pytest.raises(ConfigError, match="read from /a/b itself"):
        make_reader(camera, SystemClock())
    other = SensorReaderConfig(
        sensor_id="front", backend_params={"device": 0}, publish_to_ros=True, publish_topic="a b"
    )
    with pytest.raises(ConfigError, match=r"publish_topic: expected a ROS topic .*'a b'"):
        make_reader(other, SystemClock())


def test_names_and_domains() -> None:
    assert full_topic("front/image_raw") == full_topic("/front/image_raw") == "/front/image_raw"
    for wrong in ("", "/", "//a", "/a/", "/1a", "a-b"):
        with pytest.raises(ValueError, match="a ROS topic"):
            full_topic(wrong)
    assert (domain_of({}), domain_of({"ROS_DOMAIN_ID": "42"})) == (0, 42)
    for wrong in ("-1", "233", "x"):
        with pytest.raises(ValueError, match="ROS_DOMAIN_ID"):
            domain_of({"ROS_DOMAIN_ID": wrong})
