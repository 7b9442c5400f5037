"""The simulated GPU (`schemas.fakegpu`) as a test sees it: bytes put there by hand, and faults.

Knows nothing of leases. What a block turns on it turns off again at its end.
"""

import contextlib
import json
import os
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from vram_arbiter.clients.calibration.gpu import fake_gpu
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.fakegpu import FOLDER_VARIABLE
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import fakegpu_folder, procfs
from vram_arbiter.schemas.sizes import parse_bytes


class FakeGpu:
    """The GPU in `folder`, and bytes of this process or another one on it.

    Without `folder` it is the GPU of `VRAM_FAKE_GPU`: programs that `Consumer` starts have that
    variable. `name`: of this process in the allocation log. Raises NoGpu where there is none.
    """

    def __init__(self, folder: Path | None = None, name: str = "test") -> None:
        self.folder = folder or Path(os.environ.get(FOLDER_VARIABLE, f"${FOLDER_VARIABLE}"))
        self._name = name
        fake_gpu(self.folder)  # raises it

    @property
    def used_bytes(self) -> int:
        return self._change(fakegpu.Change).used_bytes

    @property
    def free_bytes(self) -> int:
        return self._change(fakegpu.Change).free_bytes

    def allocate(self, size: str | int, pid: int | None = None) -> None:
        """Put bytes there for a process, this one by default: those of a process without a lease
        are a stowaway's. Raises SimulatedOutOfMemory."""
        key, count = _key(pid or os.getpid()), parse_bytes(size)
        self._change(
            lambda gpu: fakegpu.allocate(gpu, key, self._name, "", count, time.monotonic())
        )

    def free(self, pid: int | None = None) -> None:
        """Give back all bytes of a process; they are free after the GPU's lag."""
        key = _key(pid or os.getpid())
        self._change(lambda gpu: fakegpu.leave(gpu, key, time.monotonic()))

    @contextlib.contextmanager
    def stowaway(self, size: str | int | None = None) -> Iterator[int]:
        """Hold `size` bytes by a process without a lease; the block is given its pid. Without a
        size it takes all that are free, and others are out of memory. The process ends with the
        block, or with this process. As in `edited`, its event (`stowaway`) says that the daemon
        knows."""
        with subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
            try:
                held = self.free_bytes if size is None else size
                FakeGpu(self.folder, "stowaway").allocate(held, process.pid)
                yield process.pid
            finally:
                process.kill()

    def edit(self, **changes: object) -> Mapping[str, object]:
        """Change fields of `gpu.json`; return their former values. Raises ConfigError.

        Fields of `FakeGpuConfig`: `release_lag_s`, `throttle_bytes_per_s` …; and of `Faults`:
        `probe` (`fail`, `hang`), `hide_processes`, `leak_bytes`.
        """
        with fakegpu_folder.locked(self.folder):
            path = self.folder / fakegpu.GPU_FILE
            config = fakegpu.parse_config(path.read_text()).model_dump(mode="json")
            before: dict[str, object] = {}
            for name, value in changes.items():
                section = config["faults"] if name in config["faults"] else config
                before[name], section[name] = section.get(name), value
            text = fakegpu.dump_config(fakegpu.parse_config(json.dumps(config)))
            fakegpu_folder.replace(path, text)
        return before

    @contextlib.contextmanager
    def edited(self, **changes: object) -> Iterator[None]:
        """`edit` for a block, such as `edited(probe="fail")`.

        A reading from before counts for up to 2 s more: to see what follows from a fault, wait for
        its event (`probe_failed`) first.
        """
        before = self.edit(**changes)
        try:
            yield
        finally:
            self.edit(**before)

    def _change(self, transition: Callable[[fakegpu.GpuState], fakegpu.Change]) -> fakegpu.GpuState:
        with fakegpu_folder.locked(self.folder):
            return fakegpu_folder.change(self.folder, transition)


def _key(pid: int) -> ProcessKey:
    return ProcessKey(pid, procfs.start_ticks(pid) or 0)
