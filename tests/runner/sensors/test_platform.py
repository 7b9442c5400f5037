"""The platform probe on the file systems of three machines, and on this one."""

from pathlib import Path

import pytest

from vram_arbiter.runner.sensors.platform import Platform, probe_platform


@pytest.mark.parametrize(
    ("files", "platform", "evidence"),
    [
        ({}, Platform.CPU_ONLY, "no NVIDIA device"),
        ({"proc/driver/nvidia/version": b"NVRM"}, Platform.CPU_ONLY, "no GPU is visible"),
        ({"dev/nvidiactl": b""}, Platform.CPU_ONLY, "no NVIDIA device"),
        (
            {"dev/nvidia0": b"", "dev/nvidiactl": b""},
            Platform.NVIDIA_DESKTOP,
            "/dev/nvidia0 exists",
        ),
        ({"etc/nv_tegra_release": b"# R36"}, Platform.TEGRA, "nv_tegra_release"),
        (
            {"proc/device-tree/compatible": b"nvidia,p3971\0nvidia,tegra264\0", "dev/nvidia0": b""},
            Platform.TEGRA,
            "nvidia,tegra264",
        ),
        (
            {"proc/device-tree/compatible": b"raspberrypi,5-model-b\0brcm,bcm2712\0"},
            Platform.CPU_ONLY,
            "",
        ),
    ],
)
def test_machines(
    tmp_path: Path, files: dict[str, bytes], platform: Platform, evidence: str
) -> None:
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    report = probe_platform(tmp_path)
    assert report.platform is platform
    assert evidence in report.evidence


def test_this_machine_is_one_of_them() -> None:
    report = probe_platform()
    assert report.platform in Platform
    assert report.evidence
