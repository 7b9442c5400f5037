"""GPUs of AMD and Intel, from files laid out as the kernel lays them out below another root; `xe`
through a compiled `ioctl`."""

import os
from pathlib import Path
from typing import Any

import pytest

from tests.arbiter.host.gpu.conftest import answer_of_child
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.host.gpu.drm import DrmProbe
from vram_arbiter.arbiter.host.gpu.pids import PidMap
from vram_arbiter.arbiter.settings import budget
from vram_arbiter.schemas.config.arbiter import ArbiterConfig
from vram_arbiter.schemas.defaults import GIB, KIB, MIB
from vram_arbiter.schemas.errors import NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.views import SensorsView

FIRST, SECOND = "0000:03:00.0", "0000:0a:00.0"
AMD, NAMELESS = GpuId("AMD-9f3c21b0d5aa7e14"), GpuId(f"PCI-{SECOND}")


def write(root: Path, files: dict[str, object]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f"{text}\n")


def card(root: Path, name: str, place: str, driver: str = "amdgpu", **files: object) -> Path:
    folder = root / "sys" / "class" / "drm" / name / "device"
    uevent = f"DRIVER={driver}\nPCI_CLASS=30000\nPCI_SLOT_NAME={place}"
    write(folder, {"uevent": uevent, **files})
    return folder


def opens(root: Path, pid: int, descriptor: int, place: str, client: int, *said: str) -> None:
    """A process has a GPU open; the kernel says so much of it."""
    process = root / "proc" / str(pid)
    told = [f"drm-driver:\tamdgpu\ndrm-client-id:\t{client}\ndrm-pdev:\t{place}", *said]
    write(process, {f"fdinfo/{descriptor}": "pos:\t0\n" + "\n".join(told)})
    (process / "fd").mkdir(exist_ok=True)
    (process / "fd" / str(descriptor)).symlink_to("/dev/dri/renderD128")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two AMD GPUs, listed against their order on the bus; init and a program with another file."""
    card(
        tmp_path, "card0", SECOND, mem_info_vram_total=16 * GIB, mem_info_vram_used=0,
    )  # fmt: skip
    card(
        tmp_path, "card1", FIRST, mem_info_vram_total=24 * GIB, mem_info_vram_used=3 * GIB,
        unique_id="9f3c21b0d5aa7e14", product_name="AMD Radeon PRO W7900",
    )  # fmt: skip
    (tmp_path / "sys" / "class" / "drm" / "card1-DP-1" / "device").mkdir(parents=True)
    card(tmp_path, "card2", "0000:00:02.0", driver="i915")
    (tmp_path / "proc" / "1" / "fd").mkdir(parents=True)
    write(tmp_path / "proc" / "7", {"cmdline": "llama-server\0-m", "fdinfo/3": "pos:\t0"})
    (tmp_path / "proc" / "7" / "fd").mkdir()
    (tmp_path / "proc" / "7" / "fd" / "3").symlink_to("/dev/null")
    return tmp_path


def probe_of(root: Path) -> DrmProbe:
    return DrmProbe(PidMap("own", proc=root / "proc"), root)


def processes(root: Path, gpu: GpuId = AMD) -> list[tuple[int, int | None]] | None:
    listed = probe_of(root).sample(gpu).processes
    return None if listed is None else [(use.process.pid, use.used_bytes) for use in listed]


def test_gpus_come_in_the_order_of_the_bus_with_the_drivers_totals(root: Path) -> None:
    probe = probe_of(root)
    assert [(gpu.index, gpu.id, gpu.name, gpu.total_bytes) for gpu in probe.gpus()] == [
        (0, AMD, "AMD Radeon PRO W7900", 24 * GIB),
        (1, NAMELESS, f"amdgpu {SECOND}", 16 * GIB),
    ]
    reading = probe.sample(AMD)
    assert (reading.used_bytes, reading.total_bytes) == (3 * GIB, 24 * GIB)
    probe.close()
    with pytest.raises(UnknownGpu):
        probe.sample(GpuId("GPU-1"))
    with pytest.raises(NoGpu, match="amdgpu and xe"):
        probe_of(root / "proc")


@pytest.mark.parametrize("text", [None, "", "none"])
def test_a_total_that_is_not_told_is_unknown(root: Path, text: str | None) -> None:
    used = root / "sys" / "class" / "drm" / "card1" / "device" / "mem_info_vram_used"
    probe = probe_of(root)
    used.unlink() if text is None else used.write_text(text)
    with pytest.raises(ProbeFailed, match=FIRST):
        probe.sample(AMD)


def test_a_process_has_the_bytes_of_its_clients_on_the_gpu(root: Path) -> None:
    opens(root, 7, 4, FIRST, 20, "drm-resident-vram:\t2048 KiB", "drm-total-vram:\t9 MiB")
    opens(root, 7, 5, FIRST, 20, "drm-resident-vram:\t2048 KiB")  # the same one, by dup
    opens(root, 7, 6, FIRST, 21, "drm-memory-vram:\t3 MiB")  # as older kernels say it
    opens(root, 7, 8, SECOND, 20, "drm-resident-vram:\t512")
    opens(root, 8, 4, FIRST, 20, "drm-resident-vram:\t2048 KiB")  # a child that inherited it
    opens(root, 9, 4, FIRST, 22)
    assert processes(root) == [(7, 2048 * KIB + 3 * MIB), (9, None)]
    assert processes(root, NAMELESS) == [(7, 512)]
    listed = probe_of(root).sample(AMD).processes
    assert listed[0].name == "llama-server -m"


def test_a_process_without_a_lease_is_a_stowaway(root: Path) -> None:
    opens(root, 7, 4, FIRST, 20, "drm-resident-vram:\t2048 MiB")
    probe = probe_of(root)
    engine = Arbiter(Settings(epoch=1, gpus=budget(probe.gpus(), ArbiterConfig(), "drm")), 0.0)
    read = probe.sample(AMD)
    sampled = MemorySampled(AMD, 1.0, read.used_bytes, read.total_bytes, read.processes)
    engine.handle(sampled, 1.0)
    gpu, _ = engine.status(1.0, None).gpus
    assert (gpu.gpu, gpu.source, gpu.measured_used_bytes) == (AMD, "drm", 3 * GIB)
    assert [(one.pid, one.name, one.used_bytes, one.stowaway) for one in gpu.processes] == [
        (7, "llama-server -m", 2 * GIB, True)
    ]


def test_a_list_with_a_gap_is_no_list(root: Path) -> None:
    """Bytes that a process hides would have no owner. One that ended meanwhile has none."""
    assert processes(root) == []
    (root / "proc" / "500").mkdir()
    assert processes(root) == []
    (root / "proc" / "500" / "fd").write_text("")  # as good as forbidden: it cannot be listed
    assert processes(root) is None
    (root / "proc" / "500" / "fd").unlink()
    (root / "proc" / "1" / "fd").rmdir()
    (root / "proc" / "1").rmdir()
    assert processes(root) is None, "hidepid: others are not even listed"


def test_a_container_does_not_see_the_processes_of_its_host(root: Path) -> None:
    (root / "proc" / "self" / "ns").mkdir(parents=True)
    os.symlink("pid:[4026532999]", root / "proc" / "self" / "ns" / "pid")
    hidden = DrmProbe(PidMap(proc=root / "proc"), root)
    assert hidden.sample(AMD).processes is None
    opens(root / "host", 70, 4, FIRST, 1, "drm-resident-vram:\t5")
    (root / "host" / "proc" / "1" / "fd").mkdir(parents=True)
    shown = DrmProbe(PidMap(proc=root / "proc", host_proc=root / "host" / "proc"), root)
    (use,) = shown.sample(AMD).processes or ()
    assert (use.process.pid, use.used_bytes) == (-70, 5), "of no process here"
    away = DrmProbe(PidMap(proc=root / "proc", host_proc=root / "nothing"), root)
    assert away.sample(AMD).processes is None


def test_sensors(root: Path) -> None:
    assert probe_of(root).sensors(AMD) == SensorsView()
    folder = root / "sys" / "class" / "drm" / "card1" / "device"
    write(folder, {"gpu_busy_percent": 87, "hwmon/hwmon3/temp1_input": 64000})
    write(folder, {"hwmon/hwmon3/power1_input": 215400000, "hwmon/hwmon3/temp2_input": 71000})
    assert probe_of(root).sensors(AMD) == SensorsView(0.87, 64.0, 215.4)


# -- Intel
XE = """
import json, sys
from pathlib import Path
from vram_arbiter.arbiter.host.gpu.drm import DrmProbe
from vram_arbiter.arbiter.host.gpu.pids import PidMap
from vram_arbiter.schemas.errors import VramError
root = Path(sys.argv[1])
try:
    probe = DrmProbe(PidMap("own", proc=root / "proc"), root)
    (gpu,) = probe.gpus()
    reading = probe.sample(gpu.id)
    listed = [[one.process.pid, one.used_bytes] for one in reading.processes]
    print(json.dumps([gpu.id, gpu.total_bytes, reading.used_bytes, reading.total_bytes, listed]))
except VramError as error:
    print(json.dumps(error.message))
"""


def asked_of_xe(library: Path, root: Path) -> Any:
    return answer_of_child(XE, str(root), environ={"LD_PRELOAD": str(library)})


def test_xe_tells_its_memory_by_ioctl(tmp_path: Path, xe_library: Path) -> None:
    """Main memory does not count, and two tiles are one GPU. Nothing used is what the driver says
    to those that it does not tell."""
    folder = card(tmp_path, "card0", FIRST, driver="xe")
    (folder / "drm" / "renderD128").mkdir(parents=True)
    said = ("drm-resident-vram0:\t5 MiB", "drm-resident-vram1:\t1 MiB", "drm-resident-gtt:\t9")
    opens(tmp_path, 1, 4, FIRST, 3, *said)
    node = {"dev/dri/renderD128": f"0 {64 * GIB} {GIB}\n1 {8 * GIB} {GIB}\n1 {8 * GIB} {MIB}"}
    write(tmp_path, node)
    assert asked_of_xe(xe_library, tmp_path) == [
        f"PCI-{FIRST}", 16 * GIB, GIB + MIB, 16 * GIB, [[1, 6 * MIB]],
    ]  # fmt: skip
    write(tmp_path, {"dev/dri/renderD128": f"0 {64 * GIB} 0\n1 {8 * GIB} 0"})
    assert "needs CAP_PERFMON" in asked_of_xe(xe_library, tmp_path)
    write(tmp_path, {"dev/dri/renderD128": f"0 {64 * GIB} 0"})
    assert "has memory of its own" in asked_of_xe(xe_library, tmp_path), "integrated"
    (tmp_path / "dev" / "dri" / "renderD128").unlink()
    assert "No such file" in asked_of_xe(xe_library, tmp_path)
    (folder / "drm" / "renderD128").rmdir()
    assert f"memory of {FIRST} cannot be read" in asked_of_xe(xe_library, tmp_path)
