"""A compiled `libnvidia-ml.so.1` for programs of these tests, too."""

from tests.arbiter.host.gpu.conftest import nvml, nvml_library

__all__ = ["nvml", "nvml_library"]
