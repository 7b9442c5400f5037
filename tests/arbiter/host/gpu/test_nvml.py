"""Failures of the NVML reader that a module handed in for `pynvml` plays; what the driver answers
is read through the real one (`test_nvml_library`)."""

import os

import pytest

from tests.support.nvml_module import GIB, NVMLError, NvmlModule, a_gpu
from vram_arbiter.arbiter.host.gpu.nvml import NvmlProbe
from vram_arbiter.arbiter.host.gpu.pids import PidMap
from vram_arbiter.schemas.errors import NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId


def test_gpus_come_in_the_drivers_order_under_their_uuids():
    probe = NvmlProbe(NvmlModule(a_gpu(uuid="GPU-b"), a_gpu(uuid="GPU-a")))
    assert [(found.index, found.id) for found in probe.gpus()] == [(0, "GPU-b"), (1, "GPU-a")]


def test_no_driver_no_gpu_unknown_gpu():
    with pytest.raises(NoGpu, match="--gpu fake:8GiB"):
        NvmlProbe(NvmlModule(init_error=NVMLError("Driver Not Loaded")))
    empty = NvmlModule()
    with pytest.raises(NoGpu, match="knows no GPU"):
        NvmlProbe(empty)
    assert empty.shutdowns == 1
    with pytest.raises(UnknownGpu):
        NvmlProbe(NvmlModule(a_gpu())).sample(GpuId("GPU-2"))


def test_one_gpu_that_fails_does_not_disturb_the_other():
    lost, fine = a_gpu(), a_gpu(uuid="GPU-2", used=5)
    driver = NvmlModule(lost, fine)
    probe = NvmlProbe(driver)
    lost["memory_error"] = NVMLError("GPU is lost")
    for _ in range(3):
        with pytest.raises(ProbeFailed, match="GPU is lost"):
            probe.sample(GpuId("GPU-1"))
        assert probe.sample(GpuId("GPU-2")).used_bytes == 5
    assert driver.shutdowns == 0
    del lost["memory_error"]
    assert probe.sample(GpuId("GPU-1")).used_bytes == GIB


def test_a_list_whose_pids_mean_nothing_here_is_no_evidence(tmp_path):
    (tmp_path / "self" / "ns").mkdir(parents=True)
    os.symlink("pid:[4026532999]", tmp_path / "self" / "ns" / "pid")
    probe = NvmlProbe(NvmlModule(a_gpu(compute=[(os.getpid(), 300)])), PidMap(proc=tmp_path))
    assert probe.sample(GpuId("GPU-1")).processes is None


def test_closing_twice_is_harmless():
    driver = NvmlModule(a_gpu())
    probe = NvmlProbe(driver)
    probe.close()
    probe.close()
    assert driver.shutdowns == 2, (
        "the library says that it is shut down already, and that is no error"
    )


def test_the_real_library_says_no_gpu_where_there_is_no_driver():
    pynvml = pytest.importorskip("pynvml")
    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError:
        with pytest.raises(NoGpu, match="no NVIDIA driver answers"):
            NvmlProbe()
    else:
        pytest.skip("an NVIDIA driver is here")
