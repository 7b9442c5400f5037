"""Where GStreamer's binding is not installed, a camera that wants it is refused with what to
install.
"""

import subprocess
import sys

CODE = """
import sys
sys.modules["gi"] = None  # what an import finds where it is not installed
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.sensors.gstreamer import make
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.config.robot import SensorReaderConfig
try:
    params = {"source": "test"}
    config = SensorReaderConfig(sensor_id="wrist", backend="gstreamer", backend_params=params)
    make(config, SystemClock(), None)
except ConfigError as error:
    print(error.message, error.hint)
"""


def test_it_says_what_to_install() -> None:
    result = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    assert "GStreamer cannot be used here" in result.stdout
    assert "vram-arbiter[gstreamer]" in result.stdout
