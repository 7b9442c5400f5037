"""Reader of simulated GPUs (`schemas.fakegpu`): what NVML is to a real one. It also makes a GPU's
folder.

Reading lets time pass on the GPU: a death is noticed, and what is due comes back. It never
allocates.
"""

import os
import threading
import uuid
from collections.abc import Sequence
from pathlib import Path

from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.arbiter.host.gpu.probe import GpuDevice, Reading
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.errors import ConfigError, NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.schemas.runtime.fakegpu_folder import locked, replace, settled
from vram_arbiter.schemas.units import parse_bytes
from vram_arbiter.schemas.wire.views import SensorsView

_HANG_POLL_S = 0.05  # how soon a simulated hang notices that it was switched off


class FakeProbe:
    """`GpuProbe` over GPU folders. Raises NoGpu for a folder that holds no GPU."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders: dict[GpuId, Path] = {}
        self._closed = threading.Event()
        for folder in folders:
            try:
                config = fakegpu.parse_config((folder / fakegpu.GPU_FILE).read_text())
            except FileNotFoundError:
                raise NoGpu(
                    f"no simulated GPU in {folder}", hint="start with --gpu fake:8GiB to make one"
                ) from None
            except (OSError, UnicodeDecodeError) as error:
                raise _unreadable(folder, error) from error
            self._folders[GpuId(config.uuid)] = folder

    def gpus(self) -> tuple[GpuDevice, ...]:
        found = []
        for gpu, folder in self._folders.items():
            try:
                config = fakegpu.parse_config((folder / fakegpu.GPU_FILE).read_text())
            except (OSError, UnicodeDecodeError) as error:
                raise _unreadable(folder, error) from error
            found.append(GpuDevice(gpu, config.index, config.name, config.capacity_bytes))
        return tuple(sorted(found, key=lambda device: device.index))

    def sample(self, gpu: GpuId) -> Reading:
        if gpu not in self._folders:
            raise UnknownGpu(f"no simulated GPU {gpu}", details={"known": sorted(self._folders)})
        folder = self._folders[gpu]
        try:
            state = self._state(folder)
        except (ConfigError, OSError, UnicodeDecodeError) as error:
            raise ProbeFailed(
                f"the simulated GPU in {folder} cannot be read: {error}",
                hint="stop what uses it and delete the folder; the arbiter creates it again",
            ) from error
        processes = None
        if not state.config.faults.hide_processes:
            processes = tuple(
                ProcessUse(process.key, process.name, process.own_bytes)
                for process in state.processes.values()
                if process.own_bytes and process.died_at_s is None
            )
        return Reading(state.used_bytes, state.config.capacity_bytes, processes)

    def sensors(self, gpu: GpuId) -> SensorsView:
        try:
            text = (self._folders[gpu] / fakegpu.GPU_FILE).read_text()
            return fakegpu.parse_config(text).sensors
        except (ConfigError, OSError, UnicodeDecodeError):
            return SensorsView()

    def close(self) -> None:
        self._closed.set()

    def _state(self, folder: Path) -> fakegpu.GpuState:
        """The GPU as it is now. It fails or hangs as its faults say; a hang ends with the fault or
        with `close`."""
        while True:
            with locked(folder):
                state = settled(folder)
            match state.config.faults.probe:
                case "ok":
                    return state
                case "fail":
                    raise ProbeFailed(
                        "the probe fails because gpu.json says so", hint='set faults.probe to "ok"'
                    )
            if self._closed.wait(_HANG_POLL_S):
                raise ProbeFailed("the probe was closed while it hung")


def _unreadable(folder: Path, error: OSError | UnicodeDecodeError) -> ConfigError:
    return ConfigError(
        f"the simulated GPU in {folder} cannot be used: {error}",
        hint="name a folder that this user may read and write, or let --gpu fake:8GiB make one",
    )


def open_gpus(text: str, runtime: Path) -> FakeProbe:
    """Probe for what stands behind `fake:` in `--gpu`: a size (makes or keeps the GPU in
    RUNTIME/fakegpu) or a folder.

    Sizes may be listed, `8GiB,16GiB`: the second GPU lies in RUNTIME/fakegpu-1, and so on. Raises
    ConfigError.
    """
    if "/" in text:
        return FakeProbe([Path(text)])
    try:
        sizes = [parse_bytes(part) for part in text.split(",")]
    except ValueError as error:
        raise ConfigError(
            f"--gpu fake:{text}: {error}", hint="write fake:8GiB or fake:/path/to/folder"
        ) from None
    folders = []
    for index, size in enumerate(sizes):
        folder = runtime / ("fakegpu" if index == 0 else f"fakegpu-{index}")
        try:
            make_gpu(folder, size, index=index)
        except (OSError, UnicodeDecodeError) as error:
            raise _unreadable(folder, error) from error
        folders.append(folder)
    return FakeProbe(folders)


def make_gpu(
    folder: Path,
    capacity_bytes: int,
    *,
    index: int = 0,
    release_lag_s: float = fakegpu.RELEASE_LAG_S,
) -> None:
    """Make a GPU in `folder`, or keep the one there. Raises ConfigError if that one is in use with
    another capacity."""
    boot_id = procfs.boot_id()
    wanted = fakegpu.FakeGpuConfig(
        uuid=f"GPU-fake-{uuid.uuid4()}",
        name="Simulated GPU",
        index=index,
        capacity_bytes=capacity_bytes,
        release_lag_s=release_lag_s,
        boot_id=boot_id,
    )
    folder.mkdir(mode=0o750, parents=True, exist_ok=True)
    with locked(folder):
        path = folder / fakegpu.GPU_FILE
        existing = path.read_text() if path.exists() else None
        if existing is not None and fakegpu.parse_config(existing).boot_id == boot_id:
            settled(folder)  # so that processes which died since do not count as using it
        names = [name for name in os.listdir(folder) if fakegpu.is_process_file(name)]
        config = fakegpu.new_gpu(wanted, existing, in_use=bool(names))
        if config is not None:
            for name in (*names, fakegpu.LOG_FILE):
                (folder / name).unlink(missing_ok=True)
            replace(path, fakegpu.dump_config(config))
