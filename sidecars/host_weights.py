"""Weights in host RAM that a model's processes share.

They lie in one anonymous file (memfd), mapped before the fork: each residency copies them onto its
device, and no process copies or reads them again. Must not know adapters, devices or leases.
"""

import mmap
import os
from collections.abc import Iterable, Iterator
from itertools import chain
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

_ALIGNMENT = 64  # bytes: the widest vector load
_PRIVATE = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | mmap.MAP_POPULATE


class HostWeights:
    """Parameters and buffers of networks, one behind the other in shared memory of `size_bytes`.

    Making one moves them there. Tensors that were one (tied weights) stay one.
    """

    def __init__(self, networks: "Iterable[Module]", label: str) -> None:
        self._networks = tuple(networks)
        lengths = dict(_extent(tensor) for tensor in self._tensors()).values()
        self.size_bytes = sum(_aligned(length) for length in lengths)
        self._memory: mmap.mmap | None = None  # it lives as long as a tensor in it, too
        if self.size_bytes:
            self._memory = _shared(self.size_bytes, label)
            self._fill(self._memory)

    def own(self) -> None:
        """Copy the weights into memory of this process alone.

        In one piece, of pages that the kernel hands out at once: one by one, as the tensors of a
        new process touch them, they cost several times the copy.
        """
        if self._memory is None:
            return
        copy = mmap.mmap(-1, self.size_bytes, flags=_PRIVATE)
        copy[:] = self._memory
        begin = _bytes_of(self._memory, 0, 1).data_ptr()
        for tensor in self._tensors():
            at, length = _extent(tensor)
            _point(tensor, _bytes_of(copy, at - begin, length))

    def drop(self) -> None:
        """Free the weights; they are to be loaded again before their use."""
        if self._memory is None:
            return
        import torch

        for tensor in self._tensors():
            tensor.data = torch.empty(0, dtype=tensor.dtype)
        self._memory = None

    def _fill(self, memory: mmap.mmap) -> None:
        """Copy each tensor, and let go of its old bytes one by one: two copies of a whole model may
        not fit."""
        import torch

        moved: dict[tuple[int, int], Tensor] = {}
        end = 0
        for tensor in self._tensors():
            at, length = _extent(tensor)
            if (at, length) not in moved:
                first = tensor.storage_offset() * tensor.element_size()
                old = torch.empty(0, dtype=torch.uint8)
                old.set_(tensor.untyped_storage(), first, (length,), (1,))
                moved[at, length] = _bytes_of(memory, end, length).copy_(old)
                end += _aligned(length)
            _point(tensor, moved[at, length])

    def _tensors(self) -> "Iterator[Tensor]":
        tensors = (chain(network.parameters(), network.buffers()) for network in self._networks)
        return (tensor for tensor in chain.from_iterable(tensors) if tensor.numel())


def _shared(size_bytes: int, label: str) -> mmap.mmap:
    file = os.memfd_create(f"weights of {label}"[:200], os.MFD_CLOEXEC)
    try:
        os.ftruncate(file, size_bytes)
        return mmap.mmap(file, size_bytes)
    finally:
        os.close(file)


def _extent(tensor: "Tensor") -> tuple[int, int]:
    """Return the address of a dense tensor and the bytes from its first to its last element."""
    steps = zip(tensor.shape, tensor.stride(), strict=True)
    last = sum((size - 1) * stride for size, stride in steps)
    return tensor.data_ptr(), (last + 1) * tensor.element_size()


def _bytes_of(memory: mmap.mmap, begin: int, length: int) -> "Tensor":
    """Return a view of memory. Raises ValueError where it would reach outside."""
    import torch

    return torch.frombuffer(memory, dtype=torch.uint8, count=length, offset=begin)


def _point(tensor: "Tensor", place: "Tensor") -> None:
    """Let the tensor have its bytes at a place."""
    import torch

    fresh = torch.empty(0, dtype=tensor.dtype)
    tensor.data = fresh.set_(place.untyped_storage(), 0, tensor.shape, tensor.stride())


def _aligned(length: int) -> int:
    return -(-length // _ALIGNMENT) * _ALIGNMENT
