"""SO-101 arms of lerobot on a stand-in of their bus."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.runner.robots.so101 import RANGES_RAD

from .servo_bus import ServoBus


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[ServoBus]:
    """The driver waits for a servo as long as it may answer; the 50 ms of real ones say nothing on
    a busy machine.
    """
    pytest.importorskip(
        "scservo_sdk", reason="Feetech's driver is missing: pip install 'vram-arbiter[so101]'"
    )
    with ServoBus() as servos:

        def wait_as_long_as_it_lives(port: Any, packet_length: int) -> None:
            port.packet_start_time = port.getCurrentTime()
            port.packet_timeout = 1.0 if servos.silent else 60_000.0  # ms

        monkeypatch.setattr(
            "lerobot.motors.feetech.feetech.patch_setPacketTimeout", wait_as_long_as_it_lives
        )
        yield servos


@pytest.fixture
def calibrated(tmp_path: Path) -> Path:
    calibration = {
        name: {"id": i, "drive_mode": 0, "homing_offset": 0, "range_min": 0, "range_max": 4095}
        for i, name in enumerate(RANGES_RAD, 1)
    }
    (tmp_path / "arm.json").write_text(json.dumps(calibration), encoding="utf-8")
    return tmp_path
