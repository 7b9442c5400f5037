"""Weights in host RAM that a model's processes share.

They lie in one anonymous file (memfd), mapped before the fork: each residency copies them onto its
device, and no process copies or reads them again. Must not know adapters, devices or leases.
"""

import mmap
import os
from collections.abc import Callable, Iterable
from itertools import chain
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

_ALIGNMENT = 64  # bytes: the widest vector load

type _Allocate = Callable[[int], Tensor]


def share(networks: "Iterable[Module]", label: str) -> int:
    """Move the parameters and buffers of networks into memory that forked processes share.

    Returns its bytes. Tensors that were one (tied weights) stay one.
    """
    import torch

    networks = tuple(networks)
    size = sum(_aligned(length) for length in _extents(networks))
    if not size:
        return 0
    file = os.memfd_create(f"weights of {label}"[:200], os.MFD_CLOEXEC)
    try:
        os.ftruncate(file, size)
        memory = mmap.mmap(file, size)  # lives as long as a tensor in it
    finally:
        os.close(file)
    at = 0

    def allocate(length: int) -> "Tensor":
        nonlocal at
        begin, at = at, at + _aligned(length)
        return torch.frombuffer(memory, dtype=torch.uint8, count=length, offset=begin)

    _move(networks, allocate)
    return size


def own(networks: "Iterable[Module]") -> None:
    """Copy the parameters and buffers of networks into memory of this process alone."""
    import torch

    _move(tuple(networks), lambda length: torch.empty(length, dtype=torch.uint8))


def drop(networks: "Iterable[Module]") -> None:
    """Free the parameters and buffers of networks; they are to be loaded again before their use."""
    import torch

    for tensor in _tensors(networks):
        tensor.data = torch.empty(0, dtype=tensor.dtype)


def _tensors(networks: "Iterable[Module]") -> "Iterable[Tensor]":
    return chain.from_iterable(
        chain(network.parameters(), network.buffers()) for network in networks
    )


def _extent(tensor: "Tensor") -> tuple[int, int]:
    """Return the address of a dense tensor and the bytes from its first to its last element."""
    steps = zip(tensor.shape, tensor.stride(), strict=True)
    last = sum((size - 1) * stride for size, stride in steps)
    return tensor.data_ptr(), (last + 1) * tensor.element_size()


def _extents(networks: "Iterable[Module]") -> "Iterable[int]":
    """Return the bytes of each tensor, tied ones once."""
    return dict(_extent(tensor) for tensor in _tensors(networks) if tensor.numel()).values()


def _move(networks: "Iterable[Module]", allocate: _Allocate) -> None:
    """Copy each tensor into bytes of `allocate`, and let go of those it had, one by one: two copies
    of a whole model may not fit."""
    import torch

    moved: dict[tuple[int, int], Tensor] = {}
    for tensor in _tensors(networks):
        if not tensor.numel():
            continue
        extent = _extent(tensor)
        if extent not in moved:
            old = torch.empty(0, dtype=torch.uint8).set_(
                tensor.untyped_storage(),
                tensor.storage_offset() * tensor.element_size(),
                (extent[1],),
                (1,),
            )
            moved[extent] = allocate(extent[1]).copy_(old)
        fresh = torch.empty(0, dtype=tensor.dtype)
        tensor.data = fresh.set_(moved[extent].untyped_storage(), 0, tensor.shape, tensor.stride())


def _aligned(length: int) -> int:
    return -(-length // _ALIGNMENT) * _ALIGNMENT
