"""Choice of the GPU backend that the configuration names."""

from pathlib import Path

from vram_arbiter.arbiter.host.gpu.drm import DrmProbe
from vram_arbiter.arbiter.host.gpu.fake import open_gpus
from vram_arbiter.arbiter.host.gpu.pids import PidMap
from vram_arbiter.arbiter.host.gpu.probe import GpuProbe
from vram_arbiter.arbiter.host.gpu.unified import choose
from vram_arbiter.schemas.config.arbiter import GpuConfig


def open_probe(config: GpuConfig, runtime: Path) -> tuple[GpuProbe, str]:
    """Return the backend of `gpu.source` and its name.

    A simulated GPU is never a fallback: it has to be asked for. Raises NoGpu or ConfigError.
    """
    kind, _, what = config.source.partition(":")
    if kind == "fake":
        return open_gpus(what, runtime), "fake"
    host_proc = None if config.host_proc is None else Path(config.host_proc)
    pids = PidMap(config.pids, host_proc)
    if kind == "drm":
        return DrmProbe(pids), "drm"
    return choose("nvml" if kind == "nvml" else "unified" if kind == "unified" else "auto", pids)
