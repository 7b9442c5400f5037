"""Episodes of a benchmark are spans with their ticks."""

import os
from pathlib import Path

import pytest

from tests.support.collector import Collector
from tests.support.paths import ROOT
from tests.support.prepared import run
from vram_arbiter.schemas.runtime.telemetry import names as telemetry

pytestmark = [pytest.mark.heavy, pytest.mark.e2e]


def test_each_episode_is_a_span_with_its_ticks(tmp_path: Path) -> None:
    argv = [
        *("benchmark", "--policy", "random", "--episodes", "2", "--max-steps", "4"),
        *("--no-arbiter", "--no-videos", "--out", str(tmp_path / "out")),
    ]
    with Collector() as collector:
        environ = os.environ | {"VRAM_ARBITER_RUNTIME": str(tmp_path)} | collector.environ()
        done = run("vram-runner", argv, environ, 120, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]
    episodes = collector.spans(telemetry.SPAN_EPISODE)
    assert len({span.span_id for span in episodes}) == len(episodes) == 2
    ticks = collector.spans(telemetry.SPAN_TICK)
    steps = [sum(tick.parent_id == span.span_id for tick in ticks) for span in episodes]
    assert steps == [4, 4]
    assert len(ticks) == 8, "nothing is recorded of the resets"
