"""Reader of machines whose GPU has no memory of its own: Jetson (Tegra) and GB10 (DGX Spark).
/proc/meminfo is the truth there.

NVML answers NOT_SUPPORTED for their memory, and cudaMemGetInfo counts the page cache as used.
`MemAvailable` is what can still be had without swapping. The whole machine lives in that memory, so
it fluctuates: the GPU asks for a larger reserve and a larger tolerance than others. Bytes per
process are evidence where there is a source: nvmap's list of clients on an Orin (debugfs, root
only), NVML's on Thor and GB10.
"""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.arbiter.host.gpu.nvml import NvmlProbe
from vram_arbiter.arbiter.host.gpu.pids import PidMap, process_key, process_name
from vram_arbiter.arbiter.host.gpu.probe import GpuDevice, GpuProbe, Reading
from vram_arbiter.schemas.defaults import GIB, KIB, MIB
from vram_arbiter.schemas.errors import ConfigError, NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.views import SensorsView

MARGIN_SHARE = 0.15
"""Of the machine's memory that is never leased: kernel, desktop, cameras and their growth. A
discrete GPU needs 300 MiB."""
MARGIN_MIN_BYTES = GIB
NOISE_BYTES = 256 * MIB
"""By how much the free memory of a quiet machine moves."""
NVMAP_CLIENTS = "sys/kernel/debug/nvmap/iovmm/clients"
_GB10_NAMES = ("DGX_Spark", "DGX Spark", "GB10")

type Evidence = Callable[[], tuple[ProcessUse, ...] | None]


class UnifiedProbe:
    """`GpuProbe` with one GPU: the memory of the machine.

    `root` is where /proc, /sys and /etc are looked for; `evidence` lists bytes per process; None
    where that is impossible. `sensors` tells what NVML does.
    """

    def __init__(
        self,
        gpu: GpuId,
        name: str,
        root: Path,
        evidence: Evidence,
        sensors: Callable[[], SensorsView] = SensorsView,
    ) -> None:
        self._gpu = gpu
        self._name = name
        self._root = root
        self._evidence = evidence
        self._sensors = sensors

    def gpus(self) -> tuple[GpuDevice, ...]:
        total, _ = read_meminfo(self._root)
        margin = max(MARGIN_MIN_BYTES, int(total * MARGIN_SHARE))
        return (
            GpuDevice(
                self._gpu, 0, self._name, total, margin_bytes=margin, noise_bytes=NOISE_BYTES
            ),
        )

    def sample(self, gpu: GpuId) -> Reading:
        if gpu != self._gpu:
            raise UnknownGpu(f"no GPU {gpu}", details={"known": [self._gpu]})
        total, available = read_meminfo(self._root)
        return Reading(total - available, total, self._evidence())

    def sensors(self, gpu: GpuId) -> SensorsView:
        return self._sensors()

    def close(self) -> None:
        """Nothing is held open."""


def read_meminfo(root: Path) -> tuple[int, int]:
    """(MemTotal, MemAvailable) in bytes. Raises ProbeFailed for a file that does not say both."""
    path = root / "proc" / "meminfo"
    found: dict[str, int] = {}
    try:
        for line in path.read_text().splitlines():
            words = line.split()
            if words[:1] in (["MemTotal:"], ["MemAvailable:"]) and words[2:] == ["kB"]:
                found[words[0]] = int(words[1]) * KIB
        return found["MemTotal:"], found["MemAvailable:"]
    except (OSError, ValueError, KeyError) as error:
        raise ProbeFailed(
            f"{path} does not say how much memory is available: {error!r}",
            hint="MemAvailable is read there, as Linux shows it since 3.14",
        ) from error


def nvmap_clients(root: Path) -> tuple[ProcessUse, ...] | None:
    """Bytes per process by Tegra's memory manager: lines `user NAME PID SIZEK`.

    None where it cannot be read (it needs root), or says nothing: on a Thor CUDA does not allocate
    through nvmap, and all rows are 0K.
    """
    try:
        lines = (root / NVMAP_CLIENTS).read_text(errors="replace").splitlines()
    except OSError:
        return None
    used: dict[int, int] = {}
    for line in lines:
        words = line.split()
        if (
            len(words) == 4
            and words[0] == "user"
            and words[2].isdecimal()
            and words[3][:-1].isdecimal()
        ):
            used[int(words[2])] = used.get(int(words[2]), 0) + int(words[3][:-1]) * _UNITS.get(
                words[3][-1], 1
            )
    if not any(used.values()):
        return None
    proc = root / "proc"
    return tuple(
        ProcessUse(process_key(proc, pid), process_name(proc, pid), used[pid])
        for pid in sorted(used)
    )


_UNITS = {"K": KIB, "M": MIB, "B": 1}


# -- which backend
def choose(
    source: Literal["auto", "nvml", "unified"],
    pids: PidMap,
    root: Path = Path("/"),
    nvml: Any = None,
) -> tuple[GpuProbe, str]:
    """(backend, `nvml` or `unified`) for a source. A machine with a GPU of its own is never read
    by its main memory.

    1. Tegra: unified. 2. NVML answers and knows the memory: nvml. 3. It answers and does not
    (GB10): unified, named by NVML. 4. No NVML, but the machine calls itself a GB10: unified.

    Raises NoGpu, or ConfigError for a source that this machine does not have.
    """
    tegra = tegra_name(root)
    if source == "nvml" and tegra is not None:
        raise ConfigError(
            f"{tegra} shares one memory between CPU and GPU, and NVML cannot read it",
            hint="write gpu.source: unified, or auto",
        )
    if tegra is not None:  # 1
        listed = _nvml_list(nvml, pids)
        gpu = GpuId(f"UNIFIED-{_serial(root)}")
        return UnifiedProbe(gpu, tegra, root, lambda: nvmap_clients(root) or listed()), "unified"
    try:
        probe = NvmlProbe(nvml, pids)
    except NoGpu:
        machine = _machine(root)
        if source == "nvml" or not any(name in machine for name in _GB10_NAMES):
            raise
        return UnifiedProbe(GpuId("UNIFIED-0"), machine, root, lambda: None), "unified"  # 4
    if not probe.memory_supported():  # 3
        if source == "nvml":
            probe.close()
            raise ConfigError(
                "NVML does not know the memory of this GPU: it is the machine's",
                hint="write gpu.source: auto",
            )
        gpu, name = probe.first()
        lists, sensors = partial(probe.processes, gpu), partial(probe.sensors, gpu)
        return UnifiedProbe(gpu, name, root, lists, sensors), "unified"
    if source == "unified":
        probe.close()
        raise ConfigError(
            "this machine's GPU has memory of its own; main memory says nothing about it",
            hint="write gpu.source: nvml, or auto",
        )
    return probe, "nvml"  # 2


def _nvml_list(nvml: Any, pids: PidMap) -> Evidence:
    """NVML's list of processes on a Tegra: newer ones have it, older ones have no NVML at all."""
    try:
        probe = NvmlProbe(nvml, pids)
    except (NoGpu, ConfigError):
        return lambda: None
    first, _ = probe.first()
    return lambda: probe.processes(first)


def tegra_name(root: Path = Path("/")) -> str | None:
    """The model of a Jetson; None on any other machine."""
    model = _text(root / "proc" / "device-tree" / "model")
    compatible = _text(root / "proc" / "device-tree" / "compatible")
    if os.path.exists(root / "etc" / "nv_tegra_release") or "nvidia,tegra" in compatible:
        return model or "NVIDIA Tegra"
    return None


def _serial(root: Path) -> str:
    return _text(root / "proc" / "device-tree" / "serial-number") or "0"


def _machine(root: Path) -> str:
    return _text(root / "sys" / "class" / "dmi" / "id" / "product_name")


def _text(path: Path) -> str:
    """A device-tree or sysfs string; "" if there is none."""
    try:
        return path.read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return ""
