"""From a camera's description to its reader: what is refused, and when."""

import pytest

from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.protocols import SensorReader
from vram_arbiter.runner.sensors.factory import BACKENDS, make_reader
from vram_arbiter.schemas.config.robot import SensorBackend, SensorReaderConfig
from vram_arbiter.schemas.errors import ConfigError


def test_a_reserved_backend_is_refused_with_the_ones_there_are() -> None:
    config = SensorReaderConfig(sensor_id="front", backend=SensorBackend.HOLOSCAN)
    with pytest.raises(
        ConfigError,
        match=r"backend: holoscan is reserved; choose from .*opencv_thread",
    ):
        make_reader(config, SystemClock())


def test_every_other_backend_is_there() -> None:
    assert set(BACKENDS) == set(SensorBackend) - {SensorBackend.HOLOSCAN}


@pytest.mark.heavy  # OpenCV
def test_a_made_reader_conforms_and_opens_nothing() -> None:
    config = SensorReaderConfig(sensor_id="front", backend_params={"device": 255})
    reader: SensorReader = make_reader(config, SystemClock())
    assert reader.sensor_id == "front"
    reader.stop()
