"""Which GPU CUDA or ROCm shows a process. Set it before they are initialized: they read it once."""

from collections.abc import Mapping

VISIBLE: str = "CUDA_VISIBLE_DEVICES"
ORDER: str = "CUDA_DEVICE_ORDER"
PCI: str = "PCI_BUS_ID"
"""The order in which NVML, and so the arbiter, counts GPUs; CUDA's own order is by speed."""
ROCM: str = "ROCR_VISIBLE_DEVICES"
_FAKE, _AMD = "GPU-fake-", "AMD-"
_NAMED = frozenset({VISIBLE, ROCM, "HIP_VISIBLE_DEVICES"})


def visible(gpu: str, environ: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that limit CUDA or ROCm to a granted GPU.

    Empty where the environment names devices itself, and for a GPU that CUDA does not know by this
    id: a simulated one, or the only one of a machine with unified memory.
    """
    if gpu.startswith(_AMD) and not _NAMED & environ.keys():
        return {ROCM: gpu.replace(_AMD, "GPU-", 1)}
    known = gpu.startswith(("GPU-", "MIG-")) and not gpu.startswith(_FAKE)
    if VISIBLE in environ or not known:
        return {}
    return {VISIBLE: gpu, **({} if ORDER in environ else {ORDER: PCI})}


def instance(environ: Mapping[str, str]) -> str | None:
    """Return the MIG instance that CUDA is limited to; None: to none, or to one of several.

    CUDA's own answer does not say whether its UUID is that of an instance or of a GPU.
    """
    named = environ.get(VISIBLE, "")
    return named if named.startswith("MIG-") and "," not in named else None
