"""Memory of a real NVIDIA GPU through torch.

Blocks are ballast: they give a small model the footprint of the production model.
"""

import os
from typing import Any

from vram_arbiter.clients import cuda
from vram_arbiter.schemas.defaults import RESIDUE_BYTES
from vram_arbiter.schemas.errors import BadState, NoGpu, OutOfMemory
from vram_arbiter.sidecars.device.memory import REMEASURE, Block, DeviceMemory

_ALLOCATOR_VARIABLE = "PYTORCH_CUDA_ALLOC_CONF"
_CHECK_VARIABLE = "PYTORCH_NVML_BASED_CUDA_CHECK"


class CudaMemory(DeviceMemory):
    """Memory on GPU `index`, or on the first one that is granted.

    Raises NoGpu if torch sees no such GPU. CUDA reads its visible GPUs when it is initialized, so a
    process stays on the GPU that it was granted first. `context_bytes` is the assumed cost of the
    process's context where the driver does not list it.
    """

    def __init__(self, index: int | None = None, context_bytes: int = RESIDUE_BYTES) -> None:
        # segments that grow and shrink: otherwise a fragmented cache keeps far more than is in use
        os.environ.setdefault(_ALLOCATOR_VARIABLE, "expandable_segments:True")
        # with it is_available() asks NVML and does not initialize CUDA
        os.environ.setdefault(_CHECK_VARIABLE, "1")
        if cuda.VISIBLE not in os.environ:
            os.environ.setdefault(cuda.ORDER, cuda.PCI)  # GPU N of CUDA is the arbiter's GPU N
        import torch

        self._free_choice = index is None
        index = index or 0
        if not torch.cuda.is_available() or index >= torch.cuda.device_count():
            raise NoGpu(
                f"torch sees no CUDA GPU {index}",
                hint="use --device fake:FOLDER, or install a CUDA build of torch",
            )
        self._torch = torch
        self._index = index
        self.torch_device = f"cuda:{index}"
        self._context_guess_bytes = context_bytes
        self._ballast: dict[Block, Any] = {}
        self._touched = False
        self._bound: str | None = None

    def bind(self, gpu: str) -> str | None:
        if self._bound not in (None, gpu):
            raise BadState(
                f"{gpu} was granted, but CUDA of this process is limited to {self._bound}",
                hint="ask again: the next lease names that GPU",
            )
        found = cuda.visible(gpu, os.environ) if self._free_choice and self._bound is None else {}
        if found and not self._torch.cuda.is_initialized():
            os.environ.update(found)
            self._bound = gpu
        return self._bound

    def touch(self) -> None:
        self._torch.cuda.init()
        self._torch.zeros(1, device=self.torch_device)
        self._touched = True

    def allocate(self, label: str, size_bytes: int) -> Block:
        self._touched = True
        try:
            tensor = self._torch.empty(
                size_bytes, dtype=self._torch.uint8, device=self.torch_device
            )
        except self._torch.OutOfMemoryError as error:
            raise self.out_of_memory(error, size_bytes) from error
        block = Block(label, size_bytes)
        self._ballast[block] = tensor
        return block

    def free(self, block: Block) -> None:
        del self._ballast[block]

    def empty_cache(self) -> None:
        if self._touched:
            self._torch.cuda.synchronize(self._index)
            self._torch.cuda.empty_cache()

    def used_bytes(self) -> int | None:
        """Return the driver's figure for this process, else the allocator's segments plus the
        assumed context."""
        if not self._touched:
            return 0
        listed = self._listed_bytes()
        if listed is not None:
            return listed
        return int(self._torch.cuda.memory_reserved(self._index)) + self._context_guess_bytes

    def close(self) -> None:
        """Free what can be freed before the process ends; its CUDA context goes with it."""
        self._ballast.clear()
        self.empty_cache()

    def out_of_memory(self, error: BaseException, requested_bytes: int = 0) -> OutOfMemory:
        """Return torch's error as OutOfMemory, with the numbers that the arbiter learns from."""
        free_bytes, capacity_bytes = self._torch.cuda.mem_get_info(self._index)
        return OutOfMemory(
            str(error),
            hint=REMEASURE,
            details={
                "requested_bytes": requested_bytes,
                "free_bytes": int(free_bytes),
                "capacity_bytes": int(capacity_bytes),
                "allocated_bytes": self.used_bytes() or 0,
            },
        )

    def _listed_bytes(self) -> int | None:
        """Return this process in NVML's list; None where it is not listed (another PID namespace,
        no permission)."""
        import pynvml

        try:
            pynvml.nvmlInit()
            uuid = str(self._torch.cuda.get_device_properties(self._index).uuid)
            handle = pynvml.nvmlDeviceGetHandleByUUID(
                cuda.instance(os.environ) or f"GPU-{uuid.removeprefix('GPU-')}"
            )
            listed = {
                process.pid: process.usedGpuMemory
                for process in pynvml.nvmlDeviceGetComputeRunningProcesses(handle)
            }
        except (pynvml.NVMLError, AttributeError):
            return None
        return listed.get(os.getpid())
