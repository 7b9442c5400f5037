"""What the NVML reader makes of the driver's answers; the module `pynvml` is handed in. The real
one is tried where no driver is."""

import os
from types import SimpleNamespace

import pytest

from vram_arbiter.arbiter.host.gpu.nvml import NvmlProbe
from vram_arbiter.arbiter.host.gpu.pids import PidMap
from vram_arbiter.schemas.errors import NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId

GIB = 2**30


class NVMLError(Exception):
    pass


class NotSupported(NVMLError):
    pass


class FunctionNotFound(NVMLError):
    pass


class Driver:
    """Answers as `pynvml` does, for GPUs given as dictionaries."""

    NVMLError = NVMLError
    NVMLError_NotSupported = NotSupported
    NVMLError_FunctionNotFound = FunctionNotFound
    nvmlMemory_v2 = 2

    def __init__(self, *gpus, init_error=None):
        self.gpus = gpus
        self.init_error = init_error
        self.shutdowns = 0

    def nvmlInit(self):
        if self.init_error:
            raise self.init_error

    def nvmlShutdown(self):
        self.shutdowns += 1
        if self.shutdowns > 1:
            raise NVMLError("Uninitialized")

    def nvmlDeviceGetCount(self):
        return len(self.gpus)

    def nvmlDeviceGetHandleByIndex(self, index):
        return self.gpus[index]

    def nvmlDeviceGetIndex(self, handle):
        return handle["index"]

    def nvmlDeviceGetUUID(self, handle):
        return handle["uuid"]

    def nvmlDeviceGetName(self, handle):
        return handle.get("name", "NVIDIA GPU")

    def nvmlDeviceGetMigMode(self, handle):
        if "mig" not in handle:
            raise NotSupported("Not Supported")
        return [handle["mig"], handle["mig"]]

    def nvmlDeviceGetMemoryInfo(self, handle, version=None):
        if "memory_error" in handle:
            raise handle["memory_error"]
        if version == self.nvmlMemory_v2 and handle.get("old"):
            raise FunctionNotFound("Function Not Found")
        reserved = handle["reserved"]
        if version == self.nvmlMemory_v2:
            return SimpleNamespace(total=handle["total"], reserved=reserved, used=handle["used"])
        return SimpleNamespace(total=handle["total"], used=handle["used"] + reserved)

    def nvmlDeviceGetComputeRunningProcesses(self, handle):
        return self._processes(handle, "compute")

    def nvmlDeviceGetGraphicsRunningProcesses(self, handle):
        return self._processes(handle, "graphics")

    def _processes(self, handle, kind):
        listed = handle.get(kind, [])
        if isinstance(listed, NVMLError):
            raise listed
        return [SimpleNamespace(pid=pid, usedGpuMemory=size) for pid, size in listed]


def a_gpu(**changes):
    return {
        "uuid": "GPU-1",
        "index": 0,
        "total": 8 * GIB,
        "reserved": GIB // 4,
        "used": GIB,
    } | changes


def test_the_drivers_reserve_is_neither_used_nor_there():
    probe = NvmlProbe(Driver(a_gpu(uuid=b"GPU-1", name=b"NVIDIA GPU")))
    (found,) = probe.gpus()
    assert (found.id, found.name) == ("GPU-1", "NVIDIA GPU")
    assert (found.total_bytes, found.reserved_bytes) == (8 * GIB - GIB // 4, GIB // 4)
    reading = probe.sample(found.id)
    assert (reading.used_bytes, reading.total_bytes) == (GIB, 8 * GIB - GIB // 4)


def test_an_old_driver_counts_its_reserve_as_used():
    probe = NvmlProbe(Driver(a_gpu(old=True)))
    reading = probe.sample(GpuId("GPU-1"))
    assert (reading.used_bytes, reading.total_bytes) == (GIB + GIB // 4, 8 * GIB)


def test_gpus_come_in_the_drivers_order_under_their_uuids():
    probe = NvmlProbe(Driver(a_gpu(uuid="GPU-b", index=1), a_gpu(uuid="GPU-a", index=0)))
    assert [found.id for found in probe.gpus()] == ["GPU-a", "GPU-b"]


def test_a_process_with_compute_and_graphics_counts_once_and_unknown_stays_unknown():
    me = os.getpid()
    probe = NvmlProbe(
        Driver(a_gpu(compute=[(me, 300), (2**22 + 1, None)], graphics=[(me, 300), (2**22 + 2, 5)]))
    )
    processes = probe.sample(GpuId("GPU-1")).processes
    assert processes is not None
    assert [(use.process.pid, use.used_bytes) for use in processes] == [
        (me, 300),
        (2**22 + 1, None),
        (2**22 + 2, 5),
    ]
    assert processes[0].process.start_ticks > 0
    assert "py" in processes[0].name
    assert (processes[1].process.start_ticks, processes[1].name) == (0, ""), (
        "it may live in another pid namespace"
    )


def test_where_processes_cannot_be_listed_the_total_still_counts():
    probe = NvmlProbe(Driver(a_gpu(graphics=NotSupported("Not Supported"))))
    reading = probe.sample(GpuId("GPU-1"))
    assert (reading.used_bytes, reading.processes) == (GIB, None)


def test_a_gpu_that_fell_off_the_bus_is_a_failed_reading():
    handle = a_gpu()
    probe = NvmlProbe(Driver(handle))
    handle["memory_error"] = NVMLError("GPU is lost")
    with pytest.raises(ProbeFailed, match="GPU is lost"):
        probe.sample(GpuId("GPU-1"))


def test_no_driver_no_gpu_unknown_gpu():
    with pytest.raises(NoGpu, match="--gpu fake:8GiB"):
        NvmlProbe(Driver(init_error=NVMLError("Driver Not Loaded")))
    empty = Driver()
    with pytest.raises(NoGpu, match="knows no GPU"):
        NvmlProbe(empty)
    assert empty.shutdowns == 1
    with pytest.raises(UnknownGpu):
        NvmlProbe(Driver(a_gpu())).sample(GpuId("GPU-2"))


def test_one_gpu_that_fails_does_not_disturb_the_other():
    lost, fine = a_gpu(), a_gpu(uuid="GPU-2", index=1, used=5)
    driver = Driver(lost, fine)
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
    probe = NvmlProbe(Driver(a_gpu(compute=[(os.getpid(), 300)])), PidMap(proc=tmp_path))
    assert probe.sample(GpuId("GPU-1")).processes is None


def test_closing_twice_is_harmless():
    driver = Driver(a_gpu())
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
