"""An episode's spans: one tick from the question to what came of the answer, with every decision
and the tool's work in it.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.schemas.runtime.telemetry import names as telemetry

pytestmark = pytest.mark.heavy  # the OpenTelemetry SDK


def test_each_turn_of_an_episode_is_a_tick_with_its_decisions_and_its_tool() -> None:
    program = str(Path(__file__).parent / "trace_an_episode.py")
    done = subprocess.run(
        [sys.executable, program], capture_output=True, text=True, timeout=60, check=True
    )
    said = json.loads(done.stdout)
    spans: list[dict[str, Any]] = sorted(said["spans"], key=lambda span: span["start"])
    (task,) = [span for span in spans if span["parent"] is None]

    def below(parent: dict[str, Any]) -> list[tuple[str, str]]:
        return [
            (span["name"], span["attributes"][telemetry.ATTR_OUTCOME])
            for span in spans
            if span["parent"] == parent["span_id"]
        ]

    tick, plan, tool = telemetry.SPAN_REASONER_TICK, telemetry.SPAN_PLAN, telemetry.SPAN_TOOL
    assert below(task) == [(tick, "refused"), (tick, "succeeded"), (tick, "finished")]
    refused, grabbed, finished = [span for span in spans if span["parent"] == task["span_id"]]
    assert below(refused) == [(plan, "execute_rskill")]
    assert below(grabbed) == [(plan, "execute_rskill"), (tool, "succeeded"), (plan, "superseded")]
    assert below(finished) == [(plan, "finish")]
    (acted,) = [span for span in spans if span["name"] == tool]
    assert acted["attributes"][telemetry.ATTR_SKILL] == "lab/grab"
    assert said["handed_on"].split("-")[2] == acted["span_id"], (
        "the runner's goal is the tool's child"
    )
