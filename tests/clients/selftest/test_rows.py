"""Rows and their verdicts: stand-ins of the GPU, and rows that end in every way."""

import asyncio
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.arbiter.host.gpu.fake import make_gpu
from vram_arbiter.clients.calibration.gpu import Gpu, Reading, fake_gpu
from vram_arbiter.clients.cli.programs import Programs
from vram_arbiter.clients.selftest import report, rows
from vram_arbiter.clients.selftest.bed import Bed, Missed, Skipped
from vram_arbiter.clients.selftest.run import judged
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.errors import CheckpointUnsupported, NoGpu
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime import fakegpu_folder, procfs
from vram_arbiter.schemas.runtime.extras import NotInstalled


def bed_on(gpu: Gpu, folder: Path) -> Bed:
    """Return a bed without a daemon and sidecars."""
    programs = Programs(folder, dict(gpu.environ))
    return Bed(gpu, gpu.read(), GIB, programs, None, ())  # type: ignore[arg-type]


@pytest.fixture
def bed(tmp_path: Path) -> Bed:
    """A bed on a simulated GPU whose memory returns at once."""
    make_gpu(tmp_path / "gpu", 8 * GIB, release_lag_s=0.05)
    return bed_on(fake_gpu(tmp_path / "gpu"), tmp_path)


def row(measure: Any, **fields: Any) -> rows.Claim:
    given = {"id": "r", "what": "w", "unit": "ms", "source": "s", "most": 5.0, **fields}
    return rows.Claim(measure=measure, **given)


def row_of(name: str) -> rows.Claim:
    (found,) = [row for row in rows.ROWS if row.id == name]
    return found


async def found(bed: Bed, figure: float = 4.0) -> rows.Found:
    return figure, "seen"


async def raised(error: Exception, bed: Bed) -> rows.Found:
    raise error


async def endless(bed: Bed) -> rows.Found:
    await asyncio.Event().wait()
    raise AssertionError


@pytest.mark.parametrize(
    ("one", "left_s", "verdict", "remark"),
    [
        (row(found), 9.0, "pass", "seen"),
        (row(partial(found, figure=6.0)), 9.0, "miss", "seen"),
        (row(found, most=float("inf"), least=5.0), 9.0, "miss", "seen"),
        (row(partial(found, figure=6.0), timed_model=True), 9.0, "pass", "seen"),
        (row(found, hardware=True), 9.0, "skipped", "needs an NVIDIA GPU"),
        (row(found), -1.0, "skipped", "no time was left: see --within"),
        (
            row(endless),
            0.01,
            "failed",
            "no result within 0 s, which was all that was left: see --within",
        ),
        (row(endless, limit_s=0.01), 9.0, "failed", "no result within 0 s"),
        (row(partial(raised, Skipped("why"))), 9.0, "skipped", "why"),
        (row(partial(raised, Missed("what"))), 9.0, "miss", "what"),
        (row(partial(raised, CheckpointUnsupported("old"))), 9.0, "skipped", "old"),
        (row(partial(raised, NotInstalled("torch"))), 9.0, "skipped", "torch"),
        (row(partial(raised, NoGpu("none"))), 9.0, "failed", "NoGpu: none"),
        (row(partial(raised, KeyError("x"))), 9.0, "failed", "KeyError: 'x'"),
    ],
)
def test_a_row_ends_in_one_verdict(
    bed: Bed, one: rows.Claim, left_s: float, verdict: str, remark: str
) -> None:
    """None that did not run is passed; a model's time on a simulated GPU is the CPU's."""
    result = asyncio.run(judged(one, bed, left_s))
    assert (result["verdict"], result["remark"]) == (verdict, remark)
    assert (result["figure"] is None) == (remark != "seen")


def test_two_leases_of_all_that_can_be_leased_do_not_fit(bed: Bed) -> None:
    """What is used already, the reserve, and twice the tolerance are left out."""
    bed.found = Reading(GIB, {})
    assert bed.lease_bytes == 7 * GIB - 300 * MIB - 128 * MIB


def result(name: str, figure: float | None, limit: str, verdict: str, remark: str) -> JsonMap:
    of = {"id": name, "what": "c", "figure": figure, "unit": "ms", "limit": limit, "source": "s"}
    return {**of, "verdict": verdict, "remark": remark, "seconds": 0.0}


RESULTS = [
    result("a", 4.0, "≤ 5 ms", "pass", "x|y"),
    result("b", 6.0, "≤ 5 ms", "miss", "slow"),
    result("c", None, "≤ 5 ms", "skipped", "why"),
    result("d", None, "", "failed", "NoGpu: \x1b[2Jnone"),
]


def test_a_row_is_declared_at_its_function() -> None:
    assert row_of("kill-holder").what == "time from a holder's SIGKILL to the grant of its bytes"
    assert row_of("page-locked").limit == "≥ 1 times"
    assert row_of("nf4").limit == "≤ 0.001"
    assert len({one.id for one in rows.ROWS}) == 16


def test_a_table_says_what_did_not_pass_and_what_is_simulated() -> None:
    lines = [report.line_of(one, simulated=False) for one in RESULTS]
    assert [line[:5] for line in lines] == [" ✓  a", " ✗  b", " –  c", " ✗  d"]
    assert "miss: slow" in lines[1]
    assert "skipped: why" in lines[2]
    assert "\x1b" not in lines[3]
    assert report.line_of(RESULTS[0], simulated=True).startswith("(✓) a")


def test_an_issue_gets_a_table(bed: Bed) -> None:
    """A bar in a text would end its cell."""
    told = report.told(bed.gpu, RESULTS, simulated=False)
    assert told["summary"] == "1 pass, 1 miss, 1 failed, 1 skipped"
    text = report.markdown(report.told(bed.gpu, RESULTS, simulated=True))
    assert "SIMULATED" in text
    assert "- memory: 8 GiB" in text
    assert {line.count("|") for line in text.splitlines() if line.startswith("| ")} == {9}


# -- rows on a simulated GPU, without a daemon
@pytest.mark.parametrize("one", ["reading", "context", "lag-free", "lag-exit"])
def test_a_holder_is_measured(bed: Bed, one: str) -> None:
    result = asyncio.run(judged(row_of(one), bed, 60.0))
    assert result["verdict"] == "pass", result
    assert (bed.gpu.read().used_bytes, result["figure"] is None) == (0, False)
    if one == "context":
        assert (result["figure"], result["remark"]) == (450.0, "listed: 450 MiB")


@pytest.mark.parametrize(("more", "verdict"), [(0, "pass"), (65 * MIB, "miss")])
def test_what_is_left_is_a_miss(bed: Bed, more: int, verdict: str) -> None:
    bed.gpu = replace(bed.gpu, read=lambda: Reading(more, {1: more}))
    bed.patience_s = 0.01
    result = asyncio.run(judged(rows.LAST, bed, 60.0))
    assert (result["verdict"], result["figure"]) == (verdict, more / MIB)


def test_a_process_of_ones_own_on_the_gpu_is_a_miss(bed: Bed) -> None:
    bed.gpu = replace(bed.gpu, read=lambda: Reading(0, {os.getpid(): 0}))
    assert "are on the GPU" in asyncio.run(judged(rows.LAST, bed, 60.0))["remark"]


class Suspending:
    """The driver's checkpoints, on a simulated GPU: the bytes of a process leave, and return.
    `alters`: it continues with other numbers."""

    name = "simulated"
    keeps_context = parks = suspends = False

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._before: dict[int, fakegpu.ProcessFile] = {}

    def check(self) -> None:
        pass

    def busy(self) -> int | None:
        return None

    def free(self, pids: Sequence[int]) -> None:
        (pid,) = pids
        key = ProcessKey(pid, procfs.start_ticks(pid) or 0)
        with fakegpu_folder.locked(self._folder):
            process = fakegpu_folder.settled(self._folder).process(key)
            assert process is not None
            self._before[pid] = process
            fakegpu_folder.change(
                self._folder, lambda gpu: fakegpu.leave(gpu, key, time.monotonic())
            )

    def restore(self, pids: Sequence[int]) -> None:
        before = self._before[pids[0]]

        def back(gpu: fakegpu.GpuState) -> fakegpu.Change:
            now = time.monotonic()
            return fakegpu.touch(gpu, before.key, before.name, before.context_bytes, now)

        with fakegpu_folder.locked(self._folder):
            fakegpu_folder.change(self._folder, back)


@pytest.mark.heavy
def test_a_suspended_process_leaves_nothing_and_continues(bed: Bed) -> None:
    action = Suspending(bed.programs.log_dir / "gpu")
    here = replace(
        row_of("checkpoint"), measure=partial(rows.checkpoint, action=action), hardware=False
    )
    result = asyncio.run(judged(here, bed, 60.0))
    assert (result["verdict"], result["figure"]) == ("pass", 0.0), result
    assert "resumed in" in result["remark"]


def test_a_driver_without_checkpoints_is_no_failure(tmp_path: Path) -> None:
    """Here is none at all, or the package is not installed."""
    real = Gpu("GPU-1", "G", "1", GIB, "none", {}, lambda: Reading(0, {}))
    result = asyncio.run(judged(row_of("checkpoint"), bed_on(real, tmp_path), 60.0))
    assert (result["verdict"], " (" in result["remark"]) == ("skipped", True), result


@pytest.mark.heavy
@pytest.mark.nightly
def test_copies_and_nf4_without_a_device(tmp_path: Path) -> None:
    """A device that is the CPU: the figures are those of host RAM."""
    cpu = Gpu("GPU-1", "G", "1", GIB, "none", {}, lambda: Reading(0, {}))
    bed = bed_on(cpu, tmp_path)
    ratio, said = asyncio.run(rows.restore(bed))
    assert ratio > 0
    assert "cudaMemcpy" in said
    bed.copies["page_locked"] = bed.copies["pageable"] * 2
    assert asyncio.run(rows.page_locked(bed))[0] == pytest.approx(2.0)
    error, eighth = asyncio.run(rows.nf4(bed))
    assert (error, eighth) == (0.0, "an eighth of float32")
