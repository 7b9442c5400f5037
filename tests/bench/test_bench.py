"""The benchmarks run, and their file has the shape that is documented. What they measure is nobody's test."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
KEYS = {"name", "p50_us", "p99_us", "floor_us", "ratio", "target", "ok", "value", "unit", "against", "note"}


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, object]]:
    """What one short run over a few subjects writes."""
    out = tmp_path_factory.mktemp("bench") / "deep" / "arbiter.json"
    subjects = ["--only", "grants", "--only", "eviction", "--only", "death"]
    command = [sys.executable, str(HERE / "run.py"), "--quick", *subjects, "--out", str(out)]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": str(HERE.parents[1])}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    found: list[dict[str, object]] = json.loads(out.read_text())
    for row in found:
        assert str(row["name"]) in done.stdout
    return found


def test_every_row_has_the_documented_fields(rows: list[dict[str, object]]) -> None:
    assert len({row["name"] for row in rows}) == len(rows) > 8
    for row in rows:
        assert set(row) == KEYS
        assert row["ok"] in (True, False, None)
        assert (row["ok"] is None) == (row["target"] is None)


def test_a_row_says_a_time_or_a_value_or_why_not(rows: list[dict[str, object]]) -> None:
    for row in rows:
        time, value = row["p50_us"], row["value"]
        assert isinstance(time, float) or isinstance(value, float) or row["note"]
        if isinstance(time, float) and isinstance(row["p99_us"], float):
            assert 0 < time <= row["p99_us"]


def test_a_comparison_names_its_floor(rows: list[dict[str, object]]) -> None:
    grant = next(row for row in rows if str(row["name"]).startswith("grant: acquire"))
    assert grant["against"] == "F"
    assert isinstance(grant["p50_us"], float)
    assert isinstance(grant["floor_us"], float)
    assert grant["ratio"] == pytest.approx(grant["p50_us"] / grant["floor_us"])
