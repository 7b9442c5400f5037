"""The main job, whole: `vramctl demo` with six real processes, with and without the arbiter."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.e2e, pytest.mark.heavy, pytest.mark.timeout(720)]

GIB = 1 << 30


def run_demo(out: Path, *arguments: str) -> tuple[int, dict[str, Any]]:
    for module in ("torch", "lerobot", "mujoco"):
        pytest.importorskip(module, reason="needs the full install")
    command = [sys.executable, "-m", "vram_arbiter.clients", "demo", "--out", str(out), *arguments]
    ended = subprocess.run(
        command,
        capture_output=True,
        text=True,
        env=os.environ | {"MUJOCO_GL": "egl"},
        timeout=700,
        check=False,
    )
    assert (out / "summary.json").exists(), ended.stdout + ended.stderr
    return ended.returncode, json.loads((out / "summary.json").read_text())


def test_find_navigate_grab_fits_in_eight_gib(tmp_path: Path) -> None:
    code, summary = run_demo(tmp_path / "on", "--seed", "0")
    assert summary["completed"], summary
    assert code == 0
    assert summary["oom_events"] == 0
    assert summary["switches"] == summary["switches_verified"] >= 1
    assert summary["peak_bytes"] <= summary["capacity_bytes"] == 8 * GIB
    grab = next(load for load in summary["loads"] if load["consumer"] == "grab")
    assert grab["evicted"] == ["detector"], "the detector fits beside neither of the others"
    vlm = [load for load in summary["loads"] if load["consumer"] == "scene-vlm"][-1]
    assert vlm["evicted"] == [], "scene VLM and policy fit together and must not evict each other"
    assert (tmp_path / "on" / "timeline.png").read_bytes().startswith(b"\x89PNG")
    assert b"ftyp" in (tmp_path / "on" / "episode.mp4").read_bytes()[:64]


@pytest.mark.nightly  # it starts all programs once more; they have tests of their own
def test_without_the_arbiter_the_same_loop_runs_out_of_memory(tmp_path: Path) -> None:
    code, summary = run_demo(tmp_path / "off", "--seed", "0", "--arbiter", "off")
    assert not summary["completed"]
    assert summary["oom_events"] >= 1
    assert code == 0, "an out-of-memory is what this run is to show"
