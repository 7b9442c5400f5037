"""Platform of picture decoding: Tegra, a PC with an NVIDIA GPU, or a CPU alone.

Looks at files that drivers and boards provide; loads no driver library, needs no permission and
never fails. It does not check whether a decoder is installed: the pipeline builder checks each
element.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

TEGRA_RELEASE = "etc/nv_tegra_release"
# NUL-separated texts, such as nvidia,p3737-0000 and nvidia,tegra234
BOARD = "proc/device-tree/compatible"
GPU_NODES = "dev/nvidia[0-9]*"


class Platform(StrEnum):
    """Which family of decoders and converters fits."""

    TEGRA = "tegra"
    """Jetson: nvv4l2decoder and nvvidconv on NVMM memory."""
    NVIDIA_DESKTOP = "nvidia_desktop"
    """A PC or server with an NVIDIA GPU: nvh264dec and the like, plain videoconvert behind them."""
    CPU_ONLY = "cpu_only"
    """No NVIDIA device that this process can reach: software decoders."""


def probe_platform(root: Path = Path("/")) -> Platform:
    """Probe the machine whose file system begins at `root`.

    Tegra comes first: new Jetsons have a PC's device files as well. A driver without a GPU that
    this process can reach is none.
    """
    if (root / TEGRA_RELEASE).exists() or any(
        text.startswith(b"nvidia,tegra") for text in _texts(root / BOARD)
    ):
        return Platform.TEGRA
    return Platform.NVIDIA_DESKTOP if any(root.glob(GPU_NODES)) else Platform.CPU_ONLY


def _texts(path: Path) -> list[bytes]:
    try:
        return path.read_bytes().split(b"\0")
    except OSError:
        return []
