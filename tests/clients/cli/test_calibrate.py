"""`vramctl calibrate`: from readings to figures, from figures to the footprint file, and programs
under observation on a simulated GPU."""

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.paths import CONFIGS, ROOT
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.arbiter.host.gpu.fake import make_gpu
from vram_arbiter.clients.calibration import entry as entries
from vram_arbiter.clients.calibration import model
from vram_arbiter.clients.calibration.gpu import Gpu, Reading, fake_gpu, nvml_gpu, open_gpu
from vram_arbiter.clients.calibration.record import Figures, Record, add, of_life, of_marks
from vram_arbiter.clients.cli import calibrate as calibrate_module
from vram_arbiter.clients.cli.calibrate import MODEL, source_of
from vram_arbiter.clients.cli.main import run_main
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import GIB, MIB, VERIFY_TOLERANCE_BYTES
from vram_arbiter.schemas.errors import ConfigError, NoGpu
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.sidecars.images import header
from vram_arbiter.sidecars.settings import read_footprints
from vram_arbiter.testing.gpu import FakeGpu

RATE_HZ = 200.0
PR_SET_CHILD_SUBREAPER = 36


def series_of(*levels: tuple[float, int]) -> list[tuple[float, int]]:
    """Return a series of (seconds, MiB): a reading every 10 ms for so long."""
    sizes = [size for lasts_s, size in levels for _ in range(round(lasts_s * 100))]
    return [(at / 100, size * MIB) for at, size in enumerate(sizes)]


# -- series → figures
def test_the_figures_of_a_life() -> None:
    """A plateau is kept as two readings: it counts for as long as it lasts."""
    series: list[tuple[float, int]] = []
    levels = ((1, 0), (0.1, 300), (0.05, 2000), (2, 1500), (0.02, 1700), (0.4, 1500), (1, 0))
    for at_s, count in series_of(*levels):
        add(series, at_s, count)
    assert of_life(series) == Figures(load_peak=2000 * MIB, steady=1700 * MIB)
    assert of_life(series_of((0.5, 0), (1, 700))) == Figures(700 * MIB, 700 * MIB), "it stays"


def test_of_equal_readings_the_first_and_the_last_are_kept() -> None:
    """A program may run for days."""
    series: list[tuple[float, int]] = []
    for at_s, size in enumerate((0, 7, 7, 7, 7, 0, 0, 0)):
        add(series, at_s, size)
    assert series == [(0, 0), (1, 7), (4, 7), (5, 0), (7, 0)]


def test_no_bytes_are_no_figures() -> None:
    """Noise of the used bytes below 1 MiB is not a program's."""
    assert of_life([*series_of((1, 0)), (2.0, MIB // 2)]) is None
    marks = {"asked": 0.5, "answered": 0.6, "unloaded": 0.9, "requests": 1.0}
    assert of_marks(series_of((1, 0)), marks) is None


def test_the_figures_of_a_model_are_those_between_its_marks() -> None:
    series = series_of((0.5, 0), (0.2, 2000), (1, 1500), (0.1, 1700), (0.5, 1500), (1, 100))
    marks = {"asked": 1.65, "answered": 1.95, "unloaded": 3.0, "requests": 3.0}
    found = Figures(2000 * MIB, 1500 * MIB, inference_peak=1700 * MIB, retained=100 * MIB)
    assert of_marks(series, marks) == found
    unasked = of_marks(series, marks | {"requests": 0.0})
    assert unasked == replace(found, inference_peak=None)


# -- figures → the footprint file
FIGURES = Figures(6000 * MIB, 1000 * MIB, inference_peak=1100 * MIB, retained=0)


def test_a_load_that_takes_what_was_measured_shows_no_drift() -> None:
    """The arbiter notes a drift of more than the tolerance, above and below the declared."""
    for count in (0, 1, 500 * MIB, 3 * GIB, 80 * GIB):
        assert count <= entries.with_margin(count) < count + VERIFY_TOLERANCE_BYTES
    assert entries.with_margin(1000 * MIB) == 1020 * MIB


def test_an_entry_is_one_of_the_footprint_file(tmp_path: Path) -> None:
    """What is printed is copied there."""
    path = tmp_path / "footprints.yaml"
    entry = entries.entry_of(FIGURES, "measured 2026-01-02 on a GPU: 20 requests")
    path.write_text(entries.text_of("three/model/int4", entry))
    assert path.read_text() == (
        "three/model/int4:\n"
        "  load_peak: 6048MiB\n  steady: 1020MiB\n  residue: 450MiB\n  inference_peak: 1122MiB\n"
        "  source: 'measured 2026-01-02 on a GPU: 20 requests'\n"
    )
    assert read_footprints(path)["three/model/int4"].steady == 1020 * MIB


def test_figures_that_contradict_each_other_stay_in_order() -> None:
    """A program that frees its weights is smaller than a usual context: the file's rule is residue
    ≤ steady ≤ load peak, and steady ≤ inference peak."""
    small = Figures(90 * MIB, 100 * MIB, 80 * MIB)
    entry = entries.entry_of(small, "x")
    assert set(entry.values()) == {"102MiB", "x"}


# -- readings
class NvmlFault(Exception):
    pass


def listed(pid: int, size: int | None) -> Any:
    return SimpleNamespace(pid=pid, usedGpuMemory=size)


def nvml(**changes: Any) -> Any:
    """Return a module like pynvml with one GPU."""
    functions: dict[str, Any] = {
        "NVMLError": NvmlFault,
        "nvmlInit": lambda: None,
        "nvmlDeviceGetCount": lambda: 1,
        "nvmlDeviceGetMigMode": lambda handle: [0, 0],
        "nvmlDeviceGetHandleByIndex": lambda index: index,
        "nvmlDeviceGetUUID": lambda handle: "GPU-1",
        "nvmlDeviceGetName": lambda handle: "Test GPU",
        "nvmlSystemGetDriverVersion": lambda: "600.1",
        "nvmlDeviceGetMemoryInfo": lambda handle: SimpleNamespace(used=5, total=9),
        "nvmlDeviceGetComputeRunningProcesses": lambda handle: [listed(1, 10)],
        "nvmlDeviceGetGraphicsRunningProcesses": lambda handle: [listed(1, 11), listed(3, 5)],
    }
    return SimpleNamespace(**{**functions, **changes})


def fails(error: Exception) -> Any:
    raise error


def test_a_reading_of_nvml() -> None:
    gpu = nvml_gpu(0, nvml())
    assert gpu.read() == Reading(5, {1: 11, 3: 5})
    assert (gpu.name, gpu.device, gpu.environ["CUDA_VISIBLE_DEVICES"]) == (
        "Test GPU", "cuda", "GPU-1",
    )  # fmt: skip
    for no_bytes in (lambda handle: fails(NvmlFault("no")), lambda handle: [listed(2, None)]):
        unlisted = nvml(nvmlDeviceGetComputeRunningProcesses=no_bytes)
        assert nvml_gpu(0, unlisted).read() == Reading(5, None)
    with pytest.raises(NoGpu, match="library missing"):
        nvml_gpu(0, nvml(nvmlInit=lambda: fails(NvmlFault("library missing"))))
    with pytest.raises(NoGpu, match="GPU 1"):
        nvml_gpu(1, nvml())


def test_devices_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="write fake:FOLDER"):
        open_gpu("gpu0", {})
    with pytest.raises(NoGpu, match="no simulated GPU"):
        open_gpu(None, {fakegpu.FOLDER_VARIABLE: str(tmp_path)})


@pytest.mark.heavy
def test_noise_is_a_picture() -> None:
    assert header(model.noise_png(64)).width == 64


@pytest.mark.heavy
def test_an_observation_as_the_manifest_describes_it() -> None:
    import numpy as np

    grab = load_manifest(CONFIGS / "rskills/so101-grab/rskill.yaml")
    observation = model.observation_of(grab)
    shapes = {key: value.shape for key, value in observation.items() if key != "task"}
    assert shapes == {
        "observation.state": (6,),
        "observation.images.front": (360, 480, 3),
        "observation.images.wrist": (240, 320, 3),
    }
    assert list(observation["observation.state"]) == pytest.approx(list(grab.starting_pose or ()))
    assert observation["observation.images.front"].dtype == np.uint8


# -- programs
PROGRAM = """
import os, sys, time
from pathlib import Path
from vram_arbiter.sidecars.device.fake import FakeMemory

seen, began = Path(sys.argv[1]), time.monotonic()

def phase(count):
    while not (seen / str(count)).exists():  # until it was read
        time.sleep(0.002)

memory = FakeMemory(Path(os.environ["VRAM_FAKE_GPU"]), "program", 200 << 20)
memory.allocate("weights", 800 << 20)
block = memory.allocate("copy", 500 << 20)
phase(1500)
memory.free(block)
memory.empty_cache()
phase(1000)
steady = time.monotonic()
while time.monotonic() - steady < 4 * (steady - began):  # most of its life
    time.sleep(0.002)
print("has worked")
"""
"""Goes on to the next phase when the present one was read."""


@pytest.fixture
def fake_folder(tmp_path: Path) -> Path:
    make_gpu(tmp_path / "gpu", 8 * GIB, release_lag_s=0.0)
    return tmp_path / "gpu"


@pytest.fixture
def readings(tmp_path: Path) -> Path:
    (tmp_path / "seen").mkdir()
    return tmp_path / "seen"


@pytest.fixture
def gpu(fake_folder: Path, readings: Path) -> Gpu:
    """A simulated GPU that tells a program in a folder which sizes, in MiB, were read."""
    plain = fake_gpu(fake_folder)

    def read() -> Reading:
        reading = plain.read()
        for count in (*(reading.processes or {}).values(), reading.used_bytes):
            (readings / str(count // MIB)).touch()
        return reading

    return replace(plain, read=read)


def recorded(record: Record, *command: str) -> int:
    """Run a program for its record, without a lease."""
    record.begin()
    try:
        return subprocess.run(command, env={**os.environ, **record.gpu.environ}).returncode
    finally:
        record.end()
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)  # orphans of other tests


@pytest.mark.e2e
@pytest.mark.parametrize("listed", [True, False], ids=["listed", "hidden"])
def test_a_program_under_observation(
    listed: bool, gpu: Gpu, readings: Path, fake_folder: Path
) -> None:
    """Its bytes are those of its tree, also when a parent in it has ended."""
    if not listed:
        FakeGpu(fake_folder).edit(hide_processes=True)
    record = Record(gpu, RATE_HZ)
    assert recorded(record, sys.executable, "-c", ADOPTED, PROGRAM, str(readings)) == 0
    assert record.listed is listed
    assert record.figures({}) == Figures(load_peak=1500 * MIB, steady=1000 * MIB)


ADOPTED = """
import os, subprocess, sys

begin = "import subprocess as s, sys; s.Popen([sys.executable, '-c', *sys.argv[1:]], close_fds=0)"
ended, alive = os.pipe()
subprocess.run([sys.executable, "-c", begin, *sys.argv[1:]], pass_fds=[alive])
os.close(alive)
os.read(ended, 1)
"""
"""Its child starts a program and ends; it ends with that program."""


# -- models
MANIFEST = """
name: test/eye
version: 0.1.0
kind: detector
embodiment_tags: [any]
chunk_size: 1
license: apache-2.0
weights_uri: hf://test/eye
description: an echo
latency_budget: {per_chunk_ms: 100}
actions: [detect]
detector: {labels: [cube]}
"""


@pytest.mark.e2e
@pytest.mark.heavy
def test_a_model_in_a_sidecar_of_its_own(gpu: Gpu, readings: Path, fake_folder: Path) -> None:
    """Its load peak is seen although it is freed at once: memory comes back later."""
    FakeGpu(fake_folder).edit(release_lag_s=0.3)
    (readings / "rskill.yaml").write_text(MANIFEST)
    sidecar = [
        sys.executable, f"{ROOT}/tests/sidecars/echo_sidecar.py", str(readings),
        "--name", "calibrate",
        "--no-arbiter", "--device", gpu.device, "--rskill", str(readings / "rskill.yaml"),
        "--footprint", "1200MiB,1GiB,300MiB",
    ]  # fmt: skip
    marks = readings / "marks"
    plan = model.Plan(str(readings / "rskill.yaml"), sidecar, 3, str(marks), 0.6)
    record = Record(gpu)
    assert recorded(record, *MODEL, json.dumps(asdict(plan))) == 0
    assert record.figures(json.loads(marks.read_text())) == Figures(
        load_peak=1200 * MIB, steady=GIB, inference_peak=GIB, retained=0
    )
    assert source_of(record, 3, datetime(2026, 1, 2, tzinfo=UTC)) == (
        "measured 2026-01-02 on Simulated GPU (driver simulated), 3 requests, margin 2 % up to 48 "
        "MiB"
    )


# -- the command
@pytest.fixture
def calibrate(
    arbiter_daemon: ArbiterProcess, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., int]:
    """`vramctl calibrate` in this process, beside a real daemon."""
    monkeypatch.setenv("VRAM_ARBITER_RUNTIME", str(arbiter_daemon.runtime))
    monkeypatch.setenv(fakegpu.FOLDER_VARIABLE, str(arbiter_daemon.gpu_folder))
    return lambda *words: run_main(["calibrate", *words])


@pytest.mark.e2e
def test_the_command_beside_a_running_arbiter(
    calibrate: Callable[..., int],
    arbiter_daemon: ArbiterProcess,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It holds the whole GPU meanwhile; then it is free again."""
    words = ["--name", "acme/thing", "--json"]
    assert calibrate(*words, "--", sys.executable, "-c", HOLDING) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["bytes"]["steady"] == 900 * MIB
    assert answer["entry"]["steady"] == "918MiB"
    with Client("looker", endpoint=arbiter_daemon.endpoint) as client:
        with client.lease(vram="6GiB", wait_timeout_s=PATIENCE_S):
            pass
        granted = client.history(kinds=["granted"]).events[0]
    assert granted["consumer"] == "vramctl calibrate acme/thing"
    assert calibrate("--name", "thing", "--", sys.executable, "-c", HOLDING) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("local/thing:\n"), "the how-tos name it so, and were refused"


HOLDING = """
import os, time
from pathlib import Path
from vram_arbiter.clients.net.request import ask
from vram_arbiter.schemas.wire.requests import Status
from vram_arbiter.sidecars.device.fake import FakeMemory

(lease,) = ask(Status())["leases"]
assert lease["state"] == "held" and lease["charge_bytes"] > 7 << 30, lease
memory = FakeMemory(Path(os.environ["VRAM_FAKE_GPU"]), "program", 200 << 20)
memory.allocate("weights", 700 << 20)
time.sleep(0.2)  # ten readings
"""


@pytest.mark.e2e
def test_a_robot_goes_first(
    calibrate: Callable[..., int],
    readings: Path,
    arbiter_daemon: ArbiterProcess,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """A request of a higher priority ends the calibration and its program."""

    def robot() -> bool:
        until((readings / "up").exists)
        with Client("robot", endpoint=arbiter_daemon.endpoint) as client:
            client.acquire(vram="1GiB", priority=60, wait_timeout_s=PATIENCE_S).release()
        return True

    program = 'touch "$1"; exec sleep 1000'
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(robot)
        assert calibrate("--", "sh", "-c", program, "sh", str(readings / "up")) == 1
        assert waiting.result(PATIENCE_S)
    assert "the GPU is needed" in capfd.readouterr().err


@pytest.mark.e2e
def test_what_the_arbiter_refuses_is_said(
    calibrate: Callable[..., int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Each refusal was \"the arbiter does not lease this GPU\"."""
    refusal = {"ok": False, "error": {"code": "limit_exceeded", "message": "too many requests"}}
    monkeypatch.setattr(calibrate_module, "ask", lambda *_, **__: refusal)
    assert calibrate("--", "true") == 1
    assert "too many requests" in capsys.readouterr().err


@pytest.mark.e2e
def test_what_gives_no_figures_is_said(
    calibrate: Callable[..., int], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The second was a traceback."""
    program = tmp_path / "program"
    program.write_text("#!/no/such/interpreter\n")
    program.chmod(0o755)
    for words, said in (
        (["--", "/no/such/program"], "not found"),
        (["--", str(program)], f"{program}: No such file or directory"),
        (["--", "false"], "local/false ended with exit code 1"),
        (["--seconds", "1", "--", "sleep", "600"], "no bytes of local/sleep were seen"),
    ):
        assert calibrate(*words) == 1
        assert said in capfd.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ([], 2, "expected either MANIFEST or `-- COMMAND`"),
        (["so101-detector", "--", "true"], 2, "expected either MANIFEST or `-- COMMAND`"),
        (["so101-detector", "--seconds", "3"], 2, "belong to `-- COMMAND`"),
        (["--name", "a/b/c", "--", "true"], 2, "expected NAME or OWNER/NAME without spaces"),
        (["--name", "a b", "--", "true"], 2, "expected NAME or OWNER/NAME without spaces"),
        (["no-such-skill"], 2, "cannot be read"),
        (["so101-navigate"], 2, "no sidecar serves"),
    ],
)
def test_what_cannot_be_measured_is_refused(
    words: list[str],
    code: int,
    said: str,
    fake_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv(fakegpu.FOLDER_VARIABLE, str(fake_folder))
    monkeypatch.chdir(Path(__file__).parents[3])
    try:
        found = run_main(["calibrate", *words])
    except SystemExit as ended:
        found = int(ended.code or 0)
    assert (found, said in capsys.readouterr().err) == (code, True)
