"""Readers from the description of a camera. Opens nothing; reports mistakes in the description.

A backend is a module with `make(config, clock, tee) -> SlotReader`, imported when a camera needs
it.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.params import wrong
from vram_arbiter.runner.sensors.slot import FrameTee, SlotReader
from vram_arbiter.schemas.config.robot import SensorBackend, SensorReaderConfig

BACKENDS: Mapping[SensorBackend, str] = {
    SensorBackend.OPENCV_THREAD: "vram_arbiter.runner.sensors.opencv_thread",
    SensorBackend.GSTREAMER: "vram_arbiter.runner.sensors.gstreamer",
    SensorBackend.ROS2_IMAGE: "vram_arbiter.runner.sensors.ros2_image",
}
"""Backend → module."""


def make_reader(config: SensorReaderConfig, clock: Clock) -> SlotReader:
    """Return the reader of one camera, not started.

    Raises ConfigError: missing backend or packages, unknown or unneeded parameters.
    """
    module = BACKENDS.get(config.backend)
    if module is None:
        known = ", ".join(BACKENDS)
        raise wrong("backend", f"{config.backend} is reserved; choose from {known}")
    tee: FrameTee | None = None
    if config.publish_to_ros:
        from vram_arbiter.runner.sensors.ros2_image import make_tee

        tee = make_tee(config)
    reader: SlotReader = importlib.import_module(module).make(config, clock, tee)
    return reader
