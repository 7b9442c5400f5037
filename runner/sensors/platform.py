"""Platform of picture decoding: Tegra, a PC with an NVIDIA GPU, or a CPU alone.

Looks at files that drivers and boards provide; loads no driver library, needs no permission and
never fails. It does not check whether a decoder is installed: the pipeline builder checks each
element.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

TEGRA_RELEASE = "etc/nv_tegra_release"
# NUL-separated texts, such as nvidia,p3737-0000 and nvidia,tegra234
BOARD = "proc/device-tree/compatible"
DRIVER = "proc/driver/nvidia/version"
GPU_NODES = "dev/nvidia[0-9]*"


class Platform(StrEnum):
    """Which family of decoders and converters fits."""

    TEGRA = "tegra"
    """Jetson: nvv4l2decoder and nvvidconv on NVMM memory."""
    NVIDIA_DESKTOP = "nvidia_desktop"
    """A PC or server with an NVIDIA GPU: nvh264dec and the like, plain videoconvert behind them."""
    CPU_ONLY = "cpu_only"
    """No NVIDIA device that this process can reach: software decoders."""


@dataclass(frozen=True, slots=True)
class PlatformReport:
    """The platform and the evidence for it, for people."""

    platform: Platform
    evidence: str


def probe_platform(root: Path = Path("/")) -> PlatformReport:
    """Probe the machine whose file system begins at `root`.

    Tegra comes first: new Jetsons have a PC's device files as well.
    """
    if (root / TEGRA_RELEASE).exists():
        return PlatformReport(Platform.TEGRA, f"/{TEGRA_RELEASE} exists")
    if board := next(
        (text for text in _texts(root / BOARD) if text.startswith("nvidia,tegra")), None
    ):
        return PlatformReport(Platform.TEGRA, f"the board is {board}")
    nodes = sorted(path.name for path in root.glob(GPU_NODES))
    if nodes:
        return PlatformReport(Platform.NVIDIA_DESKTOP, f"/dev/{nodes[0]} exists")
    if (root / DRIVER).exists():
        return PlatformReport(
            Platform.CPU_ONLY, "the NVIDIA driver is loaded, but no GPU is visible to this process"
        )
    return PlatformReport(Platform.CPU_ONLY, "no NVIDIA device")


def _texts(path: Path) -> tuple[str, ...]:
    try:
        raw = path.read_bytes()
    except OSError:
        return ()
    return tuple(part.decode("ascii", "replace") for part in raw.split(b"\0") if part)
