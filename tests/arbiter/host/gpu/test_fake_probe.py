"""The reader of simulated GPUs, on real files, and the making of a GPU."""

import json
import os
import threading

import pytest

from tests.support.waiting import PATIENCE_S
from vram_arbiter.arbiter.host.gpu.fake import FakeProbe, make_gpu, open_gpus
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import ConfigError, NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.runtime.fakegpu_folder import locked
from vram_arbiter.schemas.wire.views import SensorsView


def edit(gpu_folder, **changes):
    path = gpu_folder / "gpu.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def stowaway(gpu_folder, pid, size, name="browser"):
    (gpu_folder / f"{name}.json").write_text(
        json.dumps({"pid": pid, "name": name, "allocated_bytes": size})
    )


@pytest.fixture
def gpu_folder(tmp_path):
    make_gpu(tmp_path / "gpu", 8 * GIB, release_lag_s=0.0)
    return tmp_path / "gpu"


@pytest.fixture
def probe(gpu_folder):
    probe = FakeProbe([gpu_folder])
    yield probe
    probe.close()


def test_a_new_gpu_is_empty(probe):
    (gpu,) = probe.gpus()
    assert (gpu.index, gpu.total_bytes) == (0, 8 * GIB)
    reading = probe.sample(gpu.id)
    assert (reading.used_bytes, reading.total_bytes, reading.processes) == (0, 8 * GIB, ())


def test_sensors_are_what_the_file_says(probe, gpu_folder):
    (gpu,) = probe.gpus()
    assert probe.sensors(gpu.id) == SensorsView()
    edit(gpu_folder, sensors={"utilization": 0.5, "power_w": 12.5})
    assert probe.sensors(gpu.id) == SensorsView(utilization=0.5, power_w=12.5)
    (gpu_folder / "gpu.json").write_text("{")
    assert probe.sensors(gpu.id) == SensorsView()


def test_a_process_is_listed_with_its_bytes_and_a_dead_one_is_not(probe, gpu_folder):
    edit(gpu_folder, release_lag_s=3600)
    stowaway(gpu_folder, os.getpid(), 2 * GIB)
    stowaway(gpu_folder, 2**22 + 1, GIB, name="ghost")
    reading = probe.sample(probe.gpus()[0].id)
    assert reading.used_bytes == 3 * GIB, "the bytes of the dead are still on the GPU"
    (use,) = reading.processes
    assert (use.process.pid, use.name, use.used_bytes) == (os.getpid(), "browser", 2 * GIB)


def test_a_name_that_is_cut_in_the_middle_of_a_letter_fails_no_reading(
    probe, gpu_folder, half_a_letter
):
    """Regression: the kernel cuts names at 15 bytes, and `/proc/PID/stat` was decoded as text."""
    stowaway(gpu_folder, half_a_letter, GIB)
    (use,) = probe.sample(probe.gpus()[0].id).processes
    assert (use.process.pid, use.used_bytes) == (half_a_letter, GIB)


def test_memory_of_the_dead_is_gone_after_the_lag(probe, gpu_folder):
    stowaway(gpu_folder, 2**22 + 1, GIB, name="ghost")
    assert probe.sample(probe.gpus()[0].id).used_bytes == 0
    assert not [path for path in gpu_folder.iterdir() if fakegpu.is_process_file(path.name)]


def test_a_probe_can_fail_and_recover(probe, gpu_folder):
    gpu = probe.gpus()[0].id
    edit(gpu_folder, faults={"probe": "fail"})
    with pytest.raises(ProbeFailed, match=r"gpu\.json says so"):
        probe.sample(gpu)
    edit(gpu_folder, faults={})
    assert probe.sample(gpu).used_bytes == 0


def test_a_hang_ends_with_the_fault_or_with_close(probe, gpu_folder):
    gpu = probe.gpus()[0].id
    edit(gpu_folder, faults={"probe": "hang"})
    outcome: list[object] = []

    def read():
        try:
            outcome.append(probe.sample(gpu))
        except ProbeFailed as error:
            outcome.append(error)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(0.2)
    assert thread.is_alive()
    probe.close()
    thread.join(PATIENCE_S)
    assert isinstance(outcome[0], ProbeFailed)


def test_processes_can_be_hidden(probe, gpu_folder):
    edit(gpu_folder, faults={"hide_processes": True})
    stowaway(gpu_folder, os.getpid(), GIB)
    reading = probe.sample(probe.gpus()[0].id)
    assert (reading.used_bytes, reading.processes) == (GIB, None)


def test_a_broken_file_is_a_failed_reading_not_a_free_gpu(probe, gpu_folder):
    gpu = probe.gpus()[0].id
    (gpu_folder / "7-7.json").write_text("{")
    with pytest.raises(ProbeFailed, match=r"7-7\.json"):
        probe.sample(gpu)


def test_unknown_gpus(probe, tmp_path):
    with pytest.raises(UnknownGpu):
        probe.sample(GpuId("GPU-no"))
    with pytest.raises(NoGpu, match="--gpu fake:8GiB"):
        FakeProbe([tmp_path])


def test_sizes_make_gpus_in_the_runtime_folder_and_a_second_start_keeps_them(tmp_path):
    first = open_gpus("8GiB,16GiB", tmp_path)
    assert [(gpu.index, gpu.total_bytes) for gpu in first.gpus()] == [(0, 8 * GIB), (1, 16 * GIB)]
    stowaway(tmp_path / "fakegpu", os.getpid(), GIB)
    again = open_gpus("8GiB,16GiB", tmp_path)
    assert again.gpus() == first.gpus()
    assert again.sample(again.gpus()[0].id).used_bytes == GIB
    with pytest.raises(ConfigError, match="in use here"):
        open_gpus("4GiB", tmp_path)
    (tmp_path / "fakegpu" / "browser.json").unlink()
    assert open_gpus("4GiB", tmp_path).gpus()[0].total_bytes == 4 * GIB
    assert open_gpus(str(tmp_path / "fakegpu"), tmp_path).gpus()[0].total_bytes == 4 * GIB
    with pytest.raises(ConfigError, match="write fake:8GiB"):
        open_gpus("much", tmp_path)


def test_a_reboot_voids_what_processes_held(tmp_path):
    make_gpu(tmp_path, 8 * GIB)
    edit(tmp_path, boot_id="an earlier one")
    stowaway(tmp_path, os.getpid(), GIB)
    make_gpu(tmp_path, 8 * GIB)
    probe = FakeProbe([tmp_path])
    assert probe.sample(probe.gpus()[0].id).used_bytes == 0


def test_readings_wait_for_the_lock(probe, gpu_folder):
    gpu = probe.gpus()[0].id
    done = threading.Event()

    def read():
        probe.sample(gpu)
        done.set()

    with locked(gpu_folder):
        thread = threading.Thread(target=read)
        thread.start()
        assert not done.wait(0.1)
    assert done.wait(PATIENCE_S)
    thread.join()


def test_what_a_killed_process_left_half_written_is_mended(probe, gpu_folder):
    line = {"seq": 1, "t": 0.0, "pid": os.getpid(), "start": 0, "name": "", "op": "alloc",
    "label": "", "bytes": 5, "delta": 5,
            "process_bytes": 5, "used_after": 5, "capacity": 8 * GIB}  # fmt: skip
    (gpu_folder / "half.json").write_text(
        json.dumps({"pid": os.getpid(), "allocated_bytes": 5, "last": line})
    )
    (gpu_folder / fakegpu.LOG_FILE).write_text('{"seq": 1, "t"')
    probe.sample(probe.gpus()[0].id)
    assert json.loads((gpu_folder / fakegpu.LOG_FILE).read_text().splitlines()[1]) == line
