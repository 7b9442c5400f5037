"""A stand-in of `vramctl demo --quick`, started with its name and the size of its model.

It allocates on the simulated GPU what its model would take, and frees it when it is revoked.
"""

import os
import sys
import time
from pathlib import Path
from typing import Final

from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import RESIDUE_BYTES
from vram_arbiter.schemas.errors import LeaseLost, LeaseRevoking
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import fakegpu_folder, procfs
from vram_arbiter.schemas.sizes import parse_bytes

JOBS: Final = 3
JOB_S: Final = 0.2
MIN_RESIDENCY_S: Final = 0.5


class Memory:
    """This process's bytes on the simulated GPU."""

    def __init__(self, name: str, size_bytes: int) -> None:
        self._name = name
        self._size_bytes = size_bytes
        self._folder = Path(os.environ[fakegpu.FOLDER_VARIABLE])
        self._key = ProcessKey(os.getpid(), procfs.start_ticks(os.getpid()) or 0)

    def load(self) -> None:
        """Raises SimulatedOutOfMemory."""
        own, weights = self._name, self._size_bytes - RESIDUE_BYTES

        def grow(gpu: fakegpu.GpuState) -> fakegpu.Change:
            now = time.monotonic()
            touched = fakegpu.touch(gpu, self._key, own, RESIDUE_BYTES, now)
            return touched.then(
                lambda gpu: fakegpu.allocate(gpu, self._key, own, "weights", weights, now)
            )

        with fakegpu_folder.locked(self._folder):
            fakegpu_folder.change(self._folder, grow)

    def free(self) -> None:
        with fakegpu_folder.locked(self._folder):
            fakegpu_folder.change(
                self._folder, lambda gpu: fakegpu.leave(gpu, self._key, time.monotonic())
            )


def work(name: str, size: str) -> None:
    """Do the jobs of one model. It keeps its lease between them, until another one needs the
    room."""
    memory, done = Memory(name, parse_bytes(size)), 0
    with Client(name) as arbiter:
        while done < JOBS:
            with arbiter.lease(
                vram=size, model=name, unload=memory.free, min_residency_s=MIN_RESIDENCY_S
            ) as lease:
                memory.load()
                try:
                    while done < JOBS:
                        with lease.use(f"job {done + 1}"):
                            time.sleep(JOB_S)
                        done += 1
                        time.sleep(JOB_S)
                except (LeaseRevoking, LeaseLost):
                    lease.wait_gone()


if __name__ == "__main__":
    work(*sys.argv[1:])
