"""Memory of a CUDA GPU where there is none; tests/gpu has the tests with one."""

import pytest

from vram_arbiter.schemas.errors import NoGpu


@pytest.mark.heavy
def test_without_a_gpu_it_says_what_to_do():
    torch = pytest.importorskip("torch")
    from vram_arbiter.sidecars.device.cuda import CudaMemory

    index = torch.cuda.device_count() if torch.cuda.is_available() else 0
    with pytest.raises(NoGpu, match="--device fake:FOLDER"):
        CudaMemory(index)
