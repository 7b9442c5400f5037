"""The short storm: real processes killed, stopped and starved at every step of a switch, judged by
the independent checker."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

pytestmark = pytest.mark.e2e


def test_a_short_storm_leaves_every_promise_kept(tmp_path: Path) -> None:
    """`make chaos` is the same for five minutes."""
    storm = subprocess.run(
        [sys.executable, str(ROOT / "tests/chaos/storm.py"), "--seconds", "8", "--faults", "10",
        "--seed", "7", "--out", str(tmp_path)],
        env={**os.environ, "PYTHONPATH": f"{ROOT}/src:{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip
    assert storm.returncode == 0, storm.stdout + storm.stderr[-2000:]
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["violations"] == []
    assert report["faults"]["total"] >= 10
    assert report["grants"] >= 5
