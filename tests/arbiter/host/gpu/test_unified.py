"""Machines whose GPU shares the CPU's memory: Jetson and GB10, from their files under another root,
and how a source is chosen.

The files have the layout of those machines (the GB10's totals are those that an owner published);
`NVML` is handed in.
"""

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.support.nvml_module import GIB, NotSupported, NVMLError, NvmlModule, a_gpu
from vram_arbiter.arbiter.host.gpu.pids import PidMap
from vram_arbiter.arbiter.host.gpu.probe import GpuDevice
from vram_arbiter.arbiter.host.gpu.unified import (
    NOISE_BYTES,
    choose,
    nvmap_clients,
    read_meminfo,
    tegra_name,
)
from vram_arbiter.arbiter.host.journal import Opened
from vram_arbiter.arbiter.settings import budget, core_settings
from vram_arbiter.schemas.config.arbiter import load_config
from vram_arbiter.schemas.defaults import KIB
from vram_arbiter.schemas.errors import ConfigError, NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId

MACHINES = Path(__file__).with_name("machines")
PIDS = PidMap("own")


GB10 = {
    "uuid": "GPU-gb10",
    "name": "NVIDIA GB10",
    "reserved": 0,
    "compute": [(os.getpid(), 7 * GIB)],
}
NO_DRIVER = NvmlModule(init_error=NVMLError("Driver Not Loaded"))
UMA = NvmlModule(a_gpu(**GB10, memory_error=NotSupported("Not Supported")))
DISCRETE = NvmlModule(a_gpu(**GB10))


@pytest.fixture
def orin(tmp_path: Path) -> Path:
    """A Jetson Orin Nano, with debugfs readable."""
    tree = tmp_path / "proc" / "device-tree"
    tree.mkdir(parents=True)
    (tree / "model").write_bytes(b"NVIDIA Jetson Orin Nano Developer Kit\0")
    (tree / "compatible").write_bytes(
        b"nvidia,p3768-0000+p3767-0005\0nvidia,p3767-0005\0nvidia,tegra234\0"
    )
    (tree / "serial-number").write_bytes(b"1423223012345\0")
    shutil.copy(MACHINES / "orin-nano-8gb.meminfo", tmp_path / "proc" / "meminfo")
    clients = tmp_path / "sys" / "kernel" / "debug" / "nvmap" / "iovmm" / "clients"
    clients.parent.mkdir(parents=True)
    shutil.copy(MACHINES / "orin.nvmap", clients)
    return tmp_path


@pytest.fixture
def gb10(tmp_path: Path) -> Path:
    (tmp_path / "proc").mkdir()
    shutil.copy(MACHINES / "gb10.meminfo", tmp_path / "proc" / "meminfo")
    dmi = tmp_path / "sys" / "class" / "dmi" / "id"
    dmi.mkdir(parents=True)
    (dmi / "product_name").write_text("NVIDIA_DGX_Spark\n")
    return tmp_path


# -- Jetson
def test_an_orin_is_read_by_what_is_available(orin: Path) -> None:
    probe, source = choose("auto", PIDS, orin, NO_DRIVER)
    assert source == "unified"
    (gpu,) = probe.gpus()
    assert (gpu.id, gpu.name) == ("UNIFIED-1423223012345", "NVIDIA Jetson Orin Nano Developer Kit")
    reading = probe.sample(gpu.id)
    assert (reading.total_bytes, reading.used_bytes) == (
        7802124 * KIB,
        (7802124 - 4688128) * KIB,
    ), "the page cache is not used memory: sglang#10075"
    probe.close()
    with pytest.raises(UnknownGpu):
        probe.sample(GpuId("GPU-1"))


def test_nvmaps_clients_are_evidence(orin: Path) -> None:
    probe, _ = choose("unified", PIDS, orin, NO_DRIVER)
    processes = probe.sample(probe.gpus()[0].id).processes
    assert processes is not None
    assert [(use.process.pid, use.used_bytes) for use in processes] == [
        (1203, 12288 * KIB),
        (1788, 48900 * KIB),
        (4321, (3145728 + 524288) * KIB),
    ], "several clients of one process are one; the kernel and the total are nobody's"


def test_without_root_nobody_says_who_holds_what(orin: Path) -> None:
    shutil.rmtree(orin / "sys")
    probe, _ = choose("auto", PIDS, orin, NO_DRIVER)
    assert probe.sample(probe.gpus()[0].id).processes is None


def test_on_a_thor_nvmap_shows_nothing_and_nvml_lists_processes(orin: Path) -> None:
    clients = orin / "sys" / "kernel" / "debug" / "nvmap" / "iovmm" / "clients"
    clients.write_text("CLIENT PROCESS PID SIZE\nuser llama-server 4321 0K\ntotal 0K\n")
    assert nvmap_clients(orin) is None
    probe, source = choose("auto", PIDS, orin, UMA)
    assert source == "unified"
    processes = probe.sample(probe.gpus()[0].id).processes
    assert processes is not None
    assert [(use.process.pid, use.used_bytes) for use in processes] == [(os.getpid(), 7 * GIB)]


def test_a_tegra_is_known_by_its_release_file_too(tmp_path: Path) -> None:
    assert tegra_name(tmp_path) is None
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc" / "nv_tegra_release").write_text("# R36 (release), REVISION: 4.3\n")
    assert tegra_name(tmp_path) == "NVIDIA Tegra"


def test_on_a_tegra_nvml_is_an_error_of_the_configuration(orin: Path) -> None:
    with pytest.raises(ConfigError, match="shares one memory") as error:
        choose("nvml", PIDS, orin, DISCRETE)
    assert "unified, or auto" in error.value.hint


# -- GB10
def test_a_gb10_has_nvmls_name_and_list_and_the_machines_memory(gb10: Path) -> None:
    probe, source = choose("auto", PIDS, gb10, UMA)
    assert source == "unified"
    (gpu,) = probe.gpus()
    assert (gpu.id, gpu.name, gpu.total_bytes) == ("GPU-gb10", "NVIDIA GB10", 127600748 * KIB)
    reading = probe.sample(gpu.id)
    assert reading.used_bytes == (127600748 - 118566368) * KIB
    assert reading.processes is not None
    assert [use.used_bytes for use in reading.processes] == [7 * GIB]


def test_a_gb10_without_nvml_is_known_by_its_name(gb10: Path) -> None:
    probe, source = choose("unified", PIDS, gb10, NO_DRIVER)
    assert (source, probe.gpus()[0].name) == ("unified", "NVIDIA_DGX_Spark")
    assert probe.sample(probe.gpus()[0].id).processes is None
    with pytest.raises(NoGpu):
        choose("nvml", PIDS, gb10, NO_DRIVER)


def test_on_a_gb10_nvml_alone_is_an_error_of_the_configuration(gb10: Path) -> None:
    with pytest.raises(ConfigError, match="it is the machine's"):
        choose("nvml", PIDS, gb10, UMA)


# -- other machines
@pytest.mark.parametrize("source", ["auto", "nvml"])
def test_a_gpu_with_memory_of_its_own_is_read_by_nvml(tmp_path: Path, source: Any) -> None:
    probe, chosen = choose(source, PIDS, tmp_path, DISCRETE)
    assert (chosen, probe.gpus()[0].total_bytes) == ("nvml", 8 * GIB)


def test_main_memory_never_stands_for_a_gpu_that_has_its_own(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="memory of its own"):
        choose("unified", PIDS, tmp_path, DISCRETE)


def test_a_lost_gpu_is_no_reason_to_read_main_memory(tmp_path: Path) -> None:
    probe, chosen = choose(
        "auto", PIDS, tmp_path, NvmlModule(a_gpu(memory_error=NVMLError("GPU is lost")))
    )
    assert chosen == "nvml"
    with pytest.raises(ProbeFailed, match="GPU is lost"):
        probe.gpus()


@pytest.mark.parametrize("source", ["auto", "nvml", "unified"])
def test_a_machine_without_any_gpu_has_no_gpu(tmp_path: Path, source: Any) -> None:
    with pytest.raises(NoGpu):
        choose(source, PIDS, tmp_path, NO_DRIVER)


# -- readings and margins
@pytest.mark.parametrize(
    "text",
    [
        None,
        "",
        "MemTotal: 5 kB\n",
        "MemTotal: x kB\nMemAvailable: 1 kB\n",
        "MemTotal: 5\nMemAvailable: 1 kB\n",
    ],
)
def test_a_meminfo_that_does_not_say_is_a_failed_reading(tmp_path: Path, text: str | None) -> None:
    (tmp_path / "proc").mkdir()
    if text is not None:
        (tmp_path / "proc" / "meminfo").write_text(text)
    with pytest.raises(ProbeFailed, match="does not say how much memory"):
        read_meminfo(tmp_path)


def test_the_machine_keeps_a_larger_margin_and_tolerance(orin: Path) -> None:
    (device,) = choose("auto", PIDS, orin, NO_DRIVER)[0].gpus()
    config = load_config("", "x")
    (gpu,) = budget([device], config, "unified")
    assert gpu.reserve_bytes == max(GIB, int(gpu.total_bytes * 0.15))
    assert gpu.source == "unified"
    assert core_settings(config, (gpu,), Opened(1, {})).verify_tolerance_bytes == NOISE_BYTES
    assert (
        budget([device], load_config("gpu: {reserve_bytes: 3GiB}", "x"))[0].reserve_bytes == 3 * GIB
    )
    (plain,) = budget([GpuDevice(GpuId("GPU-1"), 0, "gpu", 8 * GIB)], config, "nvml")
    assert (
        core_settings(config, (plain,), Opened(1, {})).verify_tolerance_bytes
        == config.verify.tolerance_bytes
    )
    with pytest.raises(ConfigError, match="leaves nothing"):
        budget([device], load_config("gpu: {capacity_bytes: {'0': 1GiB}}", "x"))
