"""The platform probe on the file systems of three machines, and on this one."""

from pathlib import Path

import pytest

from vram_arbiter.runner.sensors.platform import Platform, probe_platform

BOARD = "proc/device-tree/compatible"


@pytest.mark.parametrize(
    ("files", "platform"),
    [
        ({}, Platform.CPU_ONLY),
        ({"proc/driver/nvidia/version": b"NVRM", "dev/nvidiactl": b""}, Platform.CPU_ONLY),
        ({"dev/nvidia0": b"", "dev/nvidiactl": b""}, Platform.NVIDIA_DESKTOP),
        ({"etc/nv_tegra_release": b"# R36"}, Platform.TEGRA),
        ({BOARD: b"nvidia,p3971\0nvidia,tegra264\0", "dev/nvidia0": b""}, Platform.TEGRA),
        ({BOARD: b"raspberrypi,5-model-b\0brcm,bcm2712\0"}, Platform.CPU_ONLY),
    ],
)
def test_machines(tmp_path: Path, files: dict[str, bytes], platform: Platform) -> None:
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    assert probe_platform(tmp_path) is platform


def test_this_machine_is_one_of_them() -> None:
    assert probe_platform() in Platform
