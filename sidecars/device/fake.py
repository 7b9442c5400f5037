"""Writer on a simulated GPU (`schemas.fakegpu`): this process's bytes, changed under its lock.

Thread-safe; knows nothing of leases or models.
"""

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import RESIDUE_BYTES
from vram_arbiter.schemas.errors import NoGpu
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import fakegpu_folder, procfs
from vram_arbiter.sidecars.device.memory import Block, DeviceMemory


class FakeMemory(DeviceMemory):
    """Memory on the simulated GPU in `folder`. Raises NoGpu if there is none.

    The weights themselves stay in host memory; the GPU is charged the footprint of the production
    model. `context_bytes` is the cost of the first touch (a CUDA context with its libraries).
    """

    def __init__(self, folder: Path, name: str, context_bytes: int = RESIDUE_BYTES) -> None:
        self._folder = folder
        self._name = name
        self._context_bytes = context_bytes
        self._key = ProcessKey(os.getpid(), procfs.start_ticks(os.getpid()) or 0)
        # flock guards against other processes, not against threads of this one
        self._thread_lock = threading.Lock()
        if not (folder / fakegpu.GPU_FILE).exists():
            raise NoGpu(
                f"no simulated GPU in {folder}", hint="start the arbiter with --gpu fake:8GiB"
            )

    def touch(self) -> None:
        """Create the context. Raises SimulatedOutOfMemory if it does not fit."""
        self._do(
            lambda gpu, now: fakegpu.touch(gpu, self._key, self._name, self._context_bytes, now)
        )

    def allocate(self, label: str, size_bytes: int) -> Block:
        """Allocate bytes. Raises SimulatedOutOfMemory."""

        def change(gpu: fakegpu.GpuState, now: float) -> fakegpu.Change:
            touched = fakegpu.touch(gpu, self._key, self._name, self._context_bytes, now)
            return touched.then(
                lambda c: fakegpu.allocate(c, self._key, self._name, label, size_bytes, now)
            )

        self._do(change)
        return Block(label, size_bytes)

    def free(self, block: Block) -> None:
        self._do(lambda gpu, now: fakegpu.free(gpu, self._key, block.label, block.size_bytes, now))

    def empty_cache(self) -> None:
        self._do(lambda gpu, now: fakegpu.empty_cache(gpu, self._key, now))

    def used_bytes(self) -> int | None:
        process = self._do(lambda gpu, now: fakegpu.Change(gpu)).process(self._key)
        return process.own_bytes if process else 0

    def throttle_bytes_per_s(self) -> int | None:
        return fakegpu.parse_config(
            (self._folder / fakegpu.GPU_FILE).read_text()
        ).throttle_bytes_per_s

    def close(self) -> None:
        """Destroy the context and all allocations, as an orderly exit does."""
        if (self._folder / fakegpu.GPU_FILE).exists():
            self._do(lambda gpu, now: fakegpu.leave(gpu, self._key, now))

    def _do(
        self, transition: Callable[[fakegpu.GpuState, float], fakegpu.Change]
    ) -> fakegpu.GpuState:
        """Apply one change under the lock. A refusal is written down and raised."""
        with self._thread_lock, fakegpu_folder.locked(self._folder):
            return fakegpu_folder.change(
                self._folder, lambda gpu: transition(gpu, time.monotonic())
            )
