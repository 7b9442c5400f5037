"""Device memory of a model, as the sidecar's host sees it: real, simulated, or none.

Calls block and belong to the host's worker thread. Must not know leases.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

REMEASURE: Final = "measure its footprint: vramctl calibrate"
"""What to do about a model that needs more bytes than its lease is charged."""


@dataclass(frozen=True, eq=False, slots=True)
class Block:
    """One allocation of `size_bytes`, equal to itself only; pass it to `free` exactly once."""

    label: str
    size_bytes: int


class DeviceMemory:
    """Bytes on one GPU for this process; this class is a process without a GPU, where every
    allocation is free and nothing is measured.

    `allocate` raises `schemas.errors.OutOfMemory` when the GPU is full, and nothing is allocated
    then. As in every caching framework, `free` returns nothing to the GPU: `empty_cache` does. The
    context that `touch` makes stays until the process ends (or `close`). `used_bytes` is what this
    process has on the GPU, context and caches included; None if unknown.
    """

    torch_device = "cpu"
    """Device of the model's weights: `cpu` or `cuda:N`."""

    def bind(self, gpu: str) -> str | None:
        """Put further allocations on the granted GPU.

        Returns the only GPU that this process can use from now on, None for any. Raises BadState
        where it is another one.
        """
        return None

    def touch(self) -> None:
        pass

    def allocate(self, label: str, size_bytes: int) -> Block:
        return Block(label, size_bytes)

    def free(self, block: Block) -> None:
        pass

    def empty_cache(self) -> None:
        pass

    def used_bytes(self) -> int | None:
        return None

    def throttle_bytes_per_s(self) -> int | None:
        return None

    def close(self) -> None:
        pass


def fill(
    memory: DeviceMemory,
    label: str,
    size_bytes: int,
    *,
    bytes_per_s: int | None,
    sleep: Callable[[float], object] = time.sleep,
    piece_bytes: int = 128 * 1024 * 1024,
) -> list[Block]:
    """Allocate `size_bytes` piece by piece, as a loader does by shards, no faster than
    `bytes_per_s`.

    On OutOfMemory every piece is freed before the error goes on.
    """
    blocks: list[Block] = []
    left = size_bytes
    try:
        while left > 0:
            piece = min(piece_bytes, left)
            blocks.append(memory.allocate(label, piece))
            left -= piece
            if bytes_per_s:
                sleep(piece / bytes_per_s)
    except BaseException:
        for block in blocks:
            memory.free(block)
        raise
    return blocks
