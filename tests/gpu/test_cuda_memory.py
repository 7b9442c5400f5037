"""Memory of an NVIDIA GPU through torch."""

import os
import subprocess
import sys

import pytest

from tests.gpu.conftest import without_cuda
from vram_arbiter.clients.calibration.gpu import open_gpu
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import OutOfMemory

pytestmark = [pytest.mark.gpu, pytest.mark.heavy]


@pytest.fixture(autouse=True)
def _cuda() -> None:
    if why := without_cuda():
        pytest.skip(f"needs an NVIDIA GPU: {why}")


def test_ballast_fills_up_and_goes() -> None:
    from vram_arbiter.sidecars.device.cuda import CudaMemory
    from vram_arbiter.sidecars.device.memory import fill

    memory = CudaMemory()
    assert os.environ["PYTORCH_CUDA_ALLOC_CONF"] == "expandable_segments:True"
    assert memory.used_bytes() == 0
    memory.touch()
    context = memory.used_bytes()
    assert context is not None
    blocks = fill(memory, "weights", 512 * MIB, bytes_per_s=None)
    grown = (memory.used_bytes() or 0) - context
    assert 500 * MIB <= grown <= 600 * MIB
    for block in blocks:
        memory.free(block)
    memory.empty_cache()
    assert abs((memory.used_bytes() or 0) - context) <= 64 * MIB
    with pytest.raises(OutOfMemory) as caught:
        memory.allocate("too much", 1 << 50)
    assert caught.value.details["requested_bytes"] == 1 << 50
    memory.close()


BIND = """
import os
from vram_arbiter.schemas.errors import BadState
from vram_arbiter.sidecars.device.cuda import CudaMemory
uuid = os.environ["TEST_UUID"]
memory = CudaMemory()
assert memory.bind(uuid) == uuid
memory.touch()
import torch
assert torch.cuda.device_count() == 1
assert str(torch.cuda.get_device_properties(0).uuid) in uuid
try:
    memory.bind("GPU-another")
except BadState:
    print("bound")
"""


def test_cuda_is_limited_to_the_granted_gpu() -> None:
    """The last GPU is not the one that CUDA takes by itself, where there are several."""
    import pynvml

    open_gpu("cuda")
    environ = {**os.environ, "TEST_UUID": open_gpu(f"cuda:{pynvml.nvmlDeviceGetCount() - 1}").uuid}
    environ.pop("CUDA_VISIBLE_DEVICES", None)
    done = subprocess.run(
        [sys.executable, "-c", BIND], env=environ, capture_output=True, text=True, timeout=120
    )
    assert done.stdout == "bound\n", done.stderr
