"""The writer on a simulated GPU: real processes, real files, real kills; the daemon's reader and
the checker look on."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from tests.support.fakegpu_check import check_log
from vram_arbiter.arbiter.host.gpu.fake import FakeProbe, make_gpu
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.errors import NoGpu, OutOfMemory
from vram_arbiter.schemas.fakegpu import SimulatedOutOfMemory
from vram_arbiter.sidecars.device.fake import FakeMemory
from vram_arbiter.sidecars.device.memory import DeviceMemory, fill

CONTENDER = """
import random, sys
from pathlib import Path
from vram_arbiter.schemas.fakegpu import SimulatedOutOfMemory
from vram_arbiter.sidecars.device.fake import FakeMemory

memory, dice = FakeMemory(Path(sys.argv[1]), "contender", 10 << 20), random.Random(int(sys.argv[2]))
blocks, refused = [], 0
for _ in range(60):
    if blocks and dice.random() < 0.4:
        memory.free(blocks.pop(dice.randrange(len(blocks))))
        if dice.random() < 0.5:
            memory.empty_cache()
    else:
        try:
            blocks.append(memory.allocate("w", dice.randrange(1, 300) << 20))
        except SimulatedOutOfMemory:
            refused += 1
print(refused)
"""

HOLDER = """
import sys
from pathlib import Path
from vram_arbiter.sidecars.device.fake import FakeMemory

memory = FakeMemory(Path(sys.argv[1]), "holder", 450 << 20)
block = memory.allocate("weights", 4 << 30)
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def gpu_folder(tmp_path):
    make_gpu(tmp_path, 8 * GIB, release_lag_s=0.2)
    return tmp_path


@pytest.fixture
def start_child(gpu_folder):
    children = []

    def start(code, *arguments):
        command = [sys.executable, "-c", code, str(gpu_folder), *arguments]
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        children.append(child)
        return child

    yield start
    for child in children:
        child.kill()
        child.communicate()


def used(gpu_folder):
    probe = FakeProbe([gpu_folder])
    return probe.sample(probe.gpus()[0].id).used_bytes


def seconds_until(condition):
    """Wait until a condition on the GPU's files holds; returns how long it took."""
    began, pause = time.monotonic(), threading.Event()
    while not condition():
        assert time.monotonic() < began + 60.0, "it did not happen in time"
        pause.wait(0.005)
    return time.monotonic() - began


def test_racing_processes_never_exceed_the_capacity(tmp_path, start_child, gpu_folder):
    make_gpu(gpu_folder, 1 * GIB, release_lag_s=0.01)
    children = [start_child(CONTENDER, str(seed)) for seed in range(4)]
    refused = [int(child.communicate(timeout=60)[0]) for child in children]
    assert sum(refused) > 0, "the race was not tight enough to show anything"
    seconds_until(lambda: used(gpu_folder) == 0)
    report = check_log((gpu_folder / "log.jsonl").read_text())
    assert report.problems == []
    assert report.oom_events == sum(refused)
    assert 0.5 * GIB < report.peak_bytes <= GIB


def test_a_killed_process_gives_its_memory_back_after_the_lag(start_child, gpu_folder):
    holder = start_child(HOLDER)
    assert holder.stdout.readline() == "ready\n"
    assert used(gpu_folder) == 4 * GIB + 450 * MIB
    with pytest.raises(SimulatedOutOfMemory):
        FakeMemory(gpu_folder, "other", 0).allocate("w", 5 * GIB)
    os.kill(holder.pid, signal.SIGKILL)
    assert seconds_until(lambda: used(gpu_folder) == 0) >= 0.2, (
        "it came back before the lag was over"
    )
    FakeMemory(gpu_folder, "other", 0).allocate("w", 5 * GIB)
    assert check_log((gpu_folder / "log.jsonl").read_text()).problems == []


def test_a_zombie_holds_nothing(start_child, gpu_folder):
    holder = start_child(HOLDER)
    holder.stdout.readline()
    os.kill(holder.pid, signal.SIGKILL)  # not reaped: it stays as a zombie
    seconds_until(lambda: used(gpu_folder) == 0)
    assert holder.poll() is not None


def test_the_life_of_one_model(gpu_folder):
    memory = FakeMemory(gpu_folder, "model", 450 * MIB)
    assert memory.used_bytes() == 0
    block = memory.allocate("weights", 3 * GIB)
    peak = memory.allocate("shard", GIB)
    assert memory.used_bytes() == 4 * GIB + 450 * MIB
    memory.free(peak)
    memory.free(block)
    assert memory.used_bytes() == 4 * GIB + 450 * MIB, (
        "caching frameworks give nothing back by themselves"
    )
    memory.empty_cache()
    assert memory.used_bytes() == 450 * MIB
    seconds_until(lambda: used(gpu_folder) == 450 * MIB)
    memory.close()
    seconds_until(lambda: used(gpu_folder) == 0)


def test_an_out_of_memory_while_filling_leaves_nothing_behind(gpu_folder):
    memory = FakeMemory(gpu_folder, "model", 0)
    with pytest.raises(OutOfMemory):
        fill(memory, "weights", 9 * GIB, bytes_per_s=None)
    memory.empty_cache()
    assert memory.used_bytes() == 0


def test_filling_is_throttled():
    slept: list[float] = []
    blocks = fill(DeviceMemory(), "w", 300 * MIB, bytes_per_s=100 * MIB, sleep=slept.append)
    assert sum(block.size_bytes for block in blocks) == 300 * MIB
    assert sum(slept) == pytest.approx(3.0)


def test_threads_of_one_process_do_not_lose_each_others_bytes(gpu_folder):
    memory = FakeMemory(gpu_folder, "model", 0)
    threads = [
        threading.Thread(target=lambda: [memory.allocate("w", MIB) for _ in range(20)])
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert memory.used_bytes() == 80 * MIB


def test_there_must_be_a_gpu(tmp_path):
    with pytest.raises(NoGpu, match="--gpu fake:8GiB"):
        FakeMemory(tmp_path / "none", "model")
