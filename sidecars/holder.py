"""A process with bytes on a GPU that does what its parent says, for `vramctl selftest`.

`python -m vram_arbiter.sidecars.holder fake:FOLDER|cuda[:N]|none` reads one request a line from
stdin, a word and sizes in bytes, and answers each with one JSON object on stdout. It ends with its
input, and with a request that fails. Must not know leases.
"""

import json
import os
import signal
import statistics
import sys
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any, Final

from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.sidecars.device.memory import Block, fill
from vram_arbiter.sidecars.device.open import open_memory
from vram_arbiter.sidecars.host_weights import HostWeights
from vram_arbiter.sidecars.parent import end_with

PIECE_BYTES: Final = 16 * MIB
REPEATS: Final = 5
WIDTH: Final = 1024
NF4: Final = {"compute_dtype": "float32", "min_params_to_quantize": 0, "skip_modules": []}
"""In float32, CPU and GPU differ by the order of additions alone."""


class Holder:
    """Bytes of this process. Raises NoGpu; requests raise OutOfMemory, and what their libraries
    raise."""

    def __init__(self, device: str) -> None:
        self._memory = open_memory(device, "selftest")
        self._blocks: list[Block] = []
        self._numbers: Any = None

    def fill(self, size_bytes: int) -> JsonMap:
        """Make the context, and allocate beside it."""
        self._memory.touch()
        self._blocks += fill(self._memory, "weights", size_bytes, bytes_per_s=None)
        return {}

    def free(self) -> JsonMap:
        """Give everything but the context back to the driver."""
        while self._blocks:
            self._memory.free(self._blocks.pop())
        self._memory.empty_cache()
        return {}

    def sum(self, size_bytes: int) -> JsonMap:
        """Add numbers up on the GPU, one of each eight bytes; the first request puts them there."""
        import torch

        if self._numbers is None:
            self._memory.touch()
            self._numbers = torch.arange(size_bytes // 8, device=self._memory.torch_device)
        return {"sum": int(self._numbers.sum())}

    def copies(self, size_bytes: int) -> JsonMap:
        """Time copies of weights from host RAM, in a process that is forked as a model's is, from
        memory that both share (`host_weights`). The first request, if at all: a context does not
        survive the fork, which serves in this process's place."""
        import torch

        torch.set_num_threads(1)  # a fork copies no other thread
        pieces = [torch.ones(PIECE_BYTES // 4) for _ in range(size_bytes // PIECE_BYTES)]
        network = torch.nn.ParameterList(pieces).requires_grad_(False)
        weights = HostWeights([network], "selftest")
        parent = os.getpid()
        if os.fork():
            os._exit(os.waitstatus_to_exitcode(os.wait()[1]))
        end_with(parent)
        return self._timed_copies(network, weights)

    def _timed_copies(self, network: Any, weights: HostWeights) -> JsonMap:
        """Return GB/s of the first copy of a sidecar's weights, and of plain copies (medians), each
        one `cudaMemcpyAsync` of all bytes and a synchronization: from ordinary and from page-locked
        memory."""
        import torch

        self._memory.touch()
        device, on_cpu = self._memory.torch_device, self._memory.torch_device == "cpu"
        restore = weights.own if on_cpu else lambda: network.to(device)
        times = {"restore": _seconds(restore)}
        plain = torch.ones(weights.size_bytes, dtype=torch.uint8)
        there = plain.to(device, copy=True)  # the allocator has room from here on
        sources = {"pageable": plain} | ({} if on_cpu else {"page_locked": plain.pin_memory()})
        for name, source in sources.items():
            copy = partial(there.copy_, source)
            times[name] = statistics.median(_seconds(copy) for _ in range(REPEATS))
        return {name: weights.size_bytes / taken_s / 1e9 for name, taken_s in times.items()}

    def nf4(self) -> JsonMap:
        """Quantize two linear layers in host RAM, and compare their answer there with that of the
        same bytes on the GPU. `difference` is relative."""
        import torch

        from vram_arbiter.schemas.manifest.contracts import Quantization
        from vram_arbiter.sidecars.quantization import quantize_linear

        asked = Quantization.model_validate({"dtype": "int4", "extra": NF4})
        manifest: Any = SimpleNamespace(name="selftest", quantization=asked)  # all that is read
        torch.manual_seed(0)
        layers = (torch.nn.Linear(WIDTH, WIDTH, bias=False) for _ in range(2))
        network = torch.nn.Sequential(*layers).eval().requires_grad_(False)
        before = _size(network)
        quantize_linear(network, manifest)
        values, device = torch.ones(1, WIDTH), self._memory.torch_device
        with torch.inference_mode():
            here = network(values)
            self._memory.touch()
            there = network.to(device)(values.to(device)).cpu()
        difference = float((there - here).norm() / here.norm())
        return {"bytes": _size(network), "of_bytes": before, "difference": difference}


def _seconds(work: Callable[[], object]) -> float:
    from torch.utils.benchmark.utils.timer import timer  # it waits for the GPU

    began_s: float = timer()
    work()
    taken_s: float = timer() - began_s
    return taken_s


def _size(network: Any) -> int:
    return sum(one.numel() * one.element_size() for one in network.parameters())


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    try:
        holder = Holder(sys.argv[1])
        for line in sys.stdin:
            word, *sizes = line.split()
            print(json.dumps(getattr(holder, word)(*map(int, sizes))), flush=True)
    except Exception as error:  # noqa: BLE001  any failure is an answer
        print(json.dumps({"error": f"{type(error).__name__}: {error}"}), flush=True)


if __name__ == "__main__":
    main()
