"""Bytes of a stand-in for a model server on the simulated GPU."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vram_arbiter.sidecars.device.memory import Block


class HeldBytes:
    """`size` bytes on the GPU in `folder`, held until they are freed."""

    def __init__(self, folder: str, size: str) -> None:
        from vram_arbiter.sidecars.device.fake import FakeMemory

        self._memory, self._size = FakeMemory(Path(folder), "server"), int(size)
        self.close = self._memory.close
        self._blocks: list[Block] = []
        self.load()

    def free(self) -> None:
        self._memory.free(self._blocks.pop())
        self._memory.empty_cache()

    def load(self) -> None:
        self._blocks.append(self._memory.allocate("weights", self._size))
