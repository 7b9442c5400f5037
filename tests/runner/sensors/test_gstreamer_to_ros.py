"""A camera through GStreamer whose frames are published on a ROS 2 topic as well, read back there
over DDS on loopback.
"""

import uuid

import pytest

from tests.support.dds import NETWORK
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.sensors.factory import make_reader
from vram_arbiter.schemas.config.robot import SensorBackend, SensorReaderConfig

pytestmark = pytest.mark.heavy
pytest.importorskip(
    "gi", reason="GStreamer's binding is not installed; .ci/setup says what to install"
)
pytest.importorskip("cyclonedds")

CLOCK = SystemClock()
WAIT_NS = 60 * 10**9


def test_recorders_see_the_same_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", NETWORK)
    monkeypatch.setenv("ROS_DOMAIN_ID", "78")
    topic = f"/wrist_{uuid.uuid4().hex[:8]}/image"
    camera = make_reader(
        SensorReaderConfig(
            sensor_id="wrist",
            backend=SensorBackend.GSTREAMER,
            backend_params={"source": "test", "pattern": "red", "width": 33, "height": 17},
            max_age_ms=WAIT_NS / 1e6,
            publish_to_ros=True,
            publish_topic=topic,
            publish_width=11,
        ),
        CLOCK,
    )
    recorder = make_reader(
        SensorReaderConfig(
            sensor_id="seen", backend=SensorBackend.ROS2_IMAGE, backend_params={"topic": topic}
        ),
        CLOCK,
    )
    try:
        recorder.start()
        camera.start()
        own = camera.read_synced(CLOCK.now_ns() + WAIT_NS)
        seen = recorder.read_synced(CLOCK.now_ns() + WAIT_NS)
    finally:
        camera.stop()
        recorder.stop()
    assert (seen.encoding, seen.width, seen.height) == ("bgr8", 11, 6)  # scaled for the topic alone
    assert seen.data == b"\x00\x00\xff" * (11 * 6)
    assert own.data == b"\x00\x00\xff" * (33 * 17)
