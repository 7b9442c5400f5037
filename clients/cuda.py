"""Which GPU CUDA shows a process. Set it before CUDA is initialized: CUDA reads it once."""

from collections.abc import Mapping

VISIBLE: str = "CUDA_VISIBLE_DEVICES"
ORDER: str = "CUDA_DEVICE_ORDER"
PCI: str = "PCI_BUS_ID"
"""The order in which NVML, and so the arbiter, counts GPUs; CUDA's own order is by speed."""
_FAKE = "GPU-fake-"


def visible(gpu: str, environ: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that limit CUDA to a granted GPU.

    Empty where the environment names devices itself, and for a GPU that CUDA does not know by this
    id: a simulated one, or the only one of a machine with unified memory.
    """
    known = gpu.startswith(("GPU-", "MIG-")) and not gpu.startswith(_FAKE)
    if VISIBLE in environ or not known:
        return {}
    return {VISIBLE: gpu, **({} if ORDER in environ else {ORDER: PCI})}
