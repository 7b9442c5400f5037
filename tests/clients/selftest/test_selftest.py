"""`vramctl selftest` as a program: on a simulated GPU, and on machines that a compiled
`libnvidia-ml.so.1` plays."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.support.nvml_stub import GIB, MIB, NvmlStub
from tests.support.process import Make, vramctl
from tests.support.processes import alive, children
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.clients.selftest.rows import LAST, READINGS, ROWS
from vram_arbiter.clients.selftest.run import leased_at

pytestmark = pytest.mark.e2e
PROGRAM = (sys.executable, "-m", "vram_arbiter.clients", "selftest")
NOT_SIMULATED = {"restore", "page-locked", "nf4", "checkpoint"}
BEFORE = 4 + READINGS
"""Readings of one GPU up to the end of the row `reading`: by the choice of the GPU, to open it, for
its room, before all rows, and those of the row."""


@pytest.fixture
def alone(short_folder: Path) -> dict[str, str]:
    """A machine on which no arbiter runs, with a temporary folder of its own."""
    own = {"VRAM_ARBITER_RUNTIME": str(short_folder / "runtime"), "TMPDIR": str(short_folder)}
    return {**os.environ, **own, "VRAM_ARBITER_ENDPOINT": f"ipc://{short_folder}/none.sock"}


def written(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the JSON of a run, and its verdicts."""
    told = json.loads(path.read_text())
    return told, {row["id"]: row["verdict"] for row in told["rows"]}


@pytest.mark.heavy
@pytest.mark.parametrize(
    "left_out",
    [
        pytest.param({"detector", "vlm"}, id="one sidecar"),
        pytest.param(set[str](), id="all", marks=pytest.mark.nightly),
    ],
)
def test_rows_on_a_simulated_gpu(alone: dict[str, str], tmp_path: Path, left_out: set[str]) -> None:
    """What needs hardware is skipped by name, all else passes, and nothing is left behind."""
    rows = [row.id for row in ROWS if row.id not in left_out]
    place, text = tmp_path / "rows.json", tmp_path / "report.md"
    done = vramctl(
        "selftest", "--gpu", "fake", "--within", "600", "--json", str(place), "--report", str(text),
        *(word for one in rows for word in ("--row", one)), environ=alone,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    told, verdicts = written(place)
    wanted = {one: "skipped" if one in NOT_SIMULATED else "pass" for one in (*rows, LAST.id)}
    assert verdicts == wanted, done.stdout
    assert told["simulated"]
    passed = f"{len(wanted) - len(NOT_SIMULATED)} pass, {len(NOT_SIMULATED)} skipped (SIMULATED"
    assert text.read_text().startswith(f"## vramctl selftest: {passed}")
    assert "SIMULATED GPU" in done.stdout
    assert os.listdir(alone["TMPDIR"]) == []


def test_children_of_a_killed_test_die_with_it(alone: dict[str, str]) -> None:
    command = [*PROGRAM, "--gpu", "fake", "--row", "reading", "--row", "stowaway"]
    with subprocess.Popen(command, env=alone, stdout=subprocess.PIPE, text=True) as test:
        while "reading" not in test.stdout.readline():
            assert test.poll() is None
        holding = until(lambda: len(found := children(test.pid)) == 2 and found)
        test.send_signal(signal.SIGKILL)
        test.wait(PATIENCE_S)
        until(lambda: not any(map(alive, holding)))


# -- odd machines
def on_stub(nvml: NvmlStub, environ: Mapping[str, str], *arguments: str) -> tuple[int, str]:
    """Return exit code and output of a run of the row `reading` on the compiled library."""
    done = subprocess.run(  # a program of its own: the library is found as it starts
        [*PROGRAM, "--row", "reading", *arguments], env={**environ, **nvml.environ},
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


@dataclass(frozen=True)
class Odd:
    """Lines of the control file, the exit code, and what is printed in this order."""

    lines: Sequence[str]
    code: int
    says: Sequence[str]
    arguments: Sequence[str] = ()


ODD = {
    "driver mismatch": Odd(["error init 18"], 1, ["RM has detected an NVML/RM version mismatch"]),
    "no driver": Odd(["error init 9"], 0, ["SIMULATED GPU", "(✓) reading", "2 pass"]),
    "memory of the machine": Odd(["error memory 3"], 2, ["uses the machine's memory"]),
    "lost in the middle": Odd(
        [f"error memory 15 {BEFORE}"], 1,
        [" ✓  reading", " ✗  left-as-found", "failed: ProbeFailed", "GPU is lost"],
    ),
    "hangs": Odd(["hang memory"], 1, ["the driver gave no answer within 5 s"]),
    "hangs in the middle": Odd(
        [f"hang memory {BEFORE}"], 1,
        [" ✓  reading", " ✗  left-as-found", "failed: ProbeFailed", "gave no answer within 5 s"],
    ),
    "hidden processes": Odd(["error compute 3"], 0, ["no bytes by process", " ✓  left-as-found"]),
    "bytes are not listed": Odd(
        [f"process 0 compute {os.getpid()} na"], 0, ["no bytes by process", " ✓  left-as-found"]
    ),
    "a GPU that is not there": Odd([], 1, ["no NVIDIA driver answers for GPU 7"], ["--gpu", "7"]),
}  # fmt: skip


@pytest.mark.parametrize("odd", ODD.values(), ids=list(ODD))
def test_an_odd_machine_is_told(nvml: NvmlStub, alone: dict[str, str], odd: Odd) -> None:
    nvml.write(*odd.lines)
    code, said = on_stub(nvml, alone, *odd.arguments)
    places = [said.find(words) for words in odd.says]
    assert (code, sorted(places)) == (odd.code, places), said
    assert min(places) >= 0, said


def test_the_sixth_of_eight_gpus(nvml: NvmlStub, alone: dict[str, str], tmp_path: Path) -> None:
    """Its figures are its own: the others are not touched by what is used there."""
    nvml.gpus = [f"gpu GPU-stub-{n} {(8 + n) * GIB} {256 * MIB} 0" for n in range(8)]
    nvml.write("error memory_v2 13", "process 5 compute 1 7")
    place = tmp_path / "rows.json"
    code, said = on_stub(nvml, alone, "--gpu", "5", "--json", str(place))
    told, verdicts = written(place)
    assert (code, verdicts) == (0, {"reading": "pass", "left-as-found": "pass"}), said
    assert told["machine"]["memory"] == "13 GiB"
    assert "1 processes before, 1 now" in said


def test_a_gpu_without_room_is_refused(nvml: NvmlStub, alone: dict[str, str]) -> None:
    nvml.gpu(7 * GIB)
    nvml.write()
    code, said = on_stub(nvml, alone)
    assert (code, "768 MiB free, and 1 GiB beside the reserve of 300 MiB" in said) == (2, True), (
        said
    )


def test_a_gpu_that_an_arbiter_leases_is_refused(
    nvml: NvmlStub, alone: dict[str, str], make_arbiter: Make
) -> None:
    """A robot may run on it. One of other GPUs does not matter."""
    leasing = make_arbiter(gpu="nvml").start(nvml.environ)
    found = {**alone, "VRAM_ARBITER_ENDPOINT": leasing.endpoint}
    code, said = on_stub(nvml, found)
    assert (code, "leases NVIDIA Stub (GPU-stub-0)" in said) == (2, True), said
    assert (leased_at("GPU-stub-0", found), leased_at("GPU-1", found)) == (leasing.endpoint, None)
    leasing.stop()
    assert leased_at("GPU-stub-0", found) is None


def test_options_are_checked_first(alone: dict[str, str]) -> None:
    for given, says in (
        (("--memory", "512MiB"), "at least 768 MiB"),
        (("--gpu", "first"), "auto, fake or a number"),
        (("--row", "none"), "invalid choice"),
        (("--report", "/proc/no/report.md"), "--report /proc/no/report.md cannot be written"),
    ):
        done = vramctl("selftest", *given, environ=alone)
        assert (done.returncode, says in done.stderr) == (2, True), done.stderr
