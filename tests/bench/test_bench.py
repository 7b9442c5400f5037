"""The benchmarks run, and their file has the shape that is documented. What they measure is
nobody's test."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.bench_attacks import cost_us
from tests.bench.bench_core import Bench
from tests.bench.bench_runner import Measured, Tick
from tests.support.costly import COSTLY

HERE = Path(__file__).parent
KEYS = {
    "name",
    "p50_us",
    "p99_us",
    "floor_us",
    "ratio",
    "target",
    "ok",
    "value",
    "unit",
    "against",
    "note",
}


def run_bench(out: Path, *subjects: str) -> list[dict[str, object]]:
    """A short run over a few subjects: the rows that it wrote to `out`, all of them in the table
    that it printed."""
    flags = [word for subject in subjects for word in ("--only", subject)]
    command = [
        sys.executable,
        str(HERE / "run.py"),
        "--quick",
        *flags,
        "--out",
        str(out.with_name("arbiter.json")),
    ]
    done = subprocess.run(
        command,
        env=os.environ | {"PYTHONPATH": f"{HERE.parents[1]}/src:{HERE.parents[1]}"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    found: list[dict[str, object]] = json.loads(out.read_text())
    for row in found:
        assert str(row["name"]) in done.stdout
    return found


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, object]]:
    """What one short run over a few subjects writes."""
    return run_bench(
        tmp_path_factory.mktemp("bench") / "deep" / "arbiter.json", "grants", "eviction", "death"
    )


@pytest.mark.nightly
def test_every_row_has_the_documented_fields(rows: list[dict[str, object]]) -> None:
    assert len({row["name"] for row in rows}) == len(rows) > 8
    for row in rows:
        assert set(row) == KEYS
        assert row["ok"] in (True, False, None)
        assert (row["ok"] is None) == (row["target"] is None)


@pytest.mark.nightly
def test_a_row_says_a_time_or_a_value_or_why_not(rows: list[dict[str, object]]) -> None:
    for row in rows:
        time, value = row["p50_us"], row["value"]
        assert isinstance(time, float) or isinstance(value, float) or row["note"]
        if isinstance(time, float) and isinstance(row["p99_us"], float):
            assert 0 < time <= row["p99_us"]


@pytest.mark.nightly
def test_a_comparison_names_its_floor(rows: list[dict[str, object]]) -> None:
    grant = next(row for row in rows if str(row["name"]).startswith("grant: acquire"))
    assert grant["against"] == "F"
    assert isinstance(grant["p50_us"], float)
    assert isinstance(grant["floor_us"], float)
    assert grant["ratio"] == pytest.approx(grant["p50_us"] / grant["floor_us"])


@pytest.mark.heavy
@pytest.mark.e2e
@pytest.mark.nightly
@pytest.mark.timeout(600)
def test_the_runners_ticks_are_measured_beside_real_sidecars(tmp_path: Path) -> None:
    if not (HERE.parents[1] / "configs/models/so101-grab/model.safetensors").exists():
        pytest.skip("the checkpoints are not in this tree")
    rows = run_bench(tmp_path / "runner.json", "runner")
    for row in rows:
        assert set(row) == {"name", "p50_us", "p99_us", "idle_p99_us", "ratio", "target", "ok"}
        assert isinstance(row["p50_us"], float)
        assert isinstance(row["p99_us"], float)
        assert 0 <= row["p50_us"] <= row["p99_us"]
    (jitter,) = [row for row in rows if row["name"] == "tick_jitter"]
    assert isinstance(jitter["idle_p99_us"], float)
    assert jitter["ok"] == (float(str(jitter["p99_us"])) < 2000)


@pytest.mark.e2e
@pytest.mark.nightly
def test_the_gateway_is_measured_beside_a_plain_proxy(tmp_path: Path) -> None:
    out = tmp_path / "gateway.json"
    subprocess.run(
        [sys.executable, str(HERE / "gateway.py"), "--minutes", "0.1", "--out", str(out)],
        env=os.environ | {"PYTHONPATH": f"{HERE.parents[1]}/src:{HERE.parents[1]}"},
        check=True,
    )
    rows = {row["name"]: row for row in json.loads(out.read_text())}
    assert rows["turns, gateway: failed"]["ok"]
    for name in ("gateway", "plain proxy"):
        assert rows[f"turns, {name}: requests"]["value"] >= 32
        assert rows[f"turns, {name}: gap at a switch"]["p50_us"] > 0


def test_a_costly_message_is_timed() -> None:
    """The row called a function that had changed, and no test ran it."""
    assert cost_us(COSTLY["a long key"]) > 0


def test_decisions_of_the_engine_alone_are_timed() -> None:
    bench = Bench(leases=4, waiters=8)
    bench.mix(3)
    assert {kind: len(took) for kind, took in bench.samples.items()}["Renew"] == 3


def test_a_loop_that_stood_still_is_in_the_figures_however_long() -> None:
    """Regression: gaps of a second counted as pauses between stretches and were left out."""

    def tick(started_s: float) -> Tick:
        return {"started_s": started_s, "late_ms": 0.0, "tick_ms": 1.0, "hal_ms": 0.5}

    ticks = [tick(at) for at in (0.0, 1 / 30, 5 + 1 / 30, 10.0, 10 + 1 / 30, 20.0, 20 + 1 / 30)]
    alone, beside, starting = [(10.0, 11.0)], [(0.0, 6.0)], [(20.0, 21.0)]
    one = [1.0]
    found = Measured(
        ticks, alone, beside, starting, alone, beside, one, one, one, alone, one, one, one
    )
    (uneven,) = [row for row in found.rows() if "from one start to the next" in row.name]
    assert uneven.p99_us == pytest.approx(5e6, rel=0.05)
    assert uneven.idle_p99_us == pytest.approx(0.0, abs=1.0)
