"""One trace through all processes: from the reasoner's decision to the first action that reaches
the robot.

Real programs (arbiter, two sidecars, the simulator's runner, reasoner) export by OTLP to a
collector in the test. The language model decides twice: look for the cube, so that the detector has
the GPU; then grab, so that it has to leave. Once the arm has moved, everything is ended by
SIGTERM, which has to lose nothing.
"""

import asyncio
import re
import subprocess
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.paths import ROOT

pytest.importorskip("prometheus_client", reason="the extra `telemetry`")

from tests.sidecars.conftest import MANIFEST
from tests.support import promql
from tests.support.chat_server import chat_server
from tests.support.collector import Collector, ReceivedSpan
from tests.support.observer import ObserverProcess
from tests.support.process import ArbiterProcess
from tests.support.programs import Programs
from vram_arbiter.clients.observer import names as own
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.reasoner.llm import names as llm_names
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.runtime.telemetry import names as telemetry

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(280)]

GRAB = ROOT / "configs/rskills/so101-grab"
START_S, MOVES_S = 90.0, 120.0
ARBITER, RUNNER, REASONER = "vram-arbiter", "vram-runner", "vram-reasoner"
DETECTOR, POLICY = "vram-sidecar-detector", "vram-sidecar-grab"
DECISIONS = (
    ("locate_in_view", {"query": "red cube"}),
    ("execute_rskill__vram-arbiter__so101-grab", {"prompt": "grab the red cube"}),
)
"""In their order; asked again while the last one is carried out, it says that again."""


def decide(asked: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Decide by what was done so far."""
    done = sum(message["role"] == "tool" for message in asked["messages"])
    return DECISIONS[min(done, len(DECISIONS) - 1)]


def test_one_trace_runs_from_the_decision_to_the_first_action(
    make_arbiter: Callable[..., ArbiterProcess], tmp_path: Path
) -> None:
    pytest.importorskip("mujoco", reason="needs the full install")
    pytest.importorskip("httpx", reason="needs the reasoner extra")
    if not (ROOT / "configs/models/so101-grab/model.safetensors").exists():
        pytest.skip("the grab checkpoint is not in this tree")
    with ExitStack() as stack:
        collector = stack.enter_context(Collector())
        llm = {
            "VRAM_REASONER_LLM_BASE_URL": stack.enter_context(chat_server(decide)),
            "VRAM_REASONER_LLM_MODEL": "m",
        }
        arbiter = make_arbiter().start()
        observer = ObserverProcess(arbiter, environ=collector.environ()).start()
        stack.callback(observer.stop)
        programs = Programs(arbiter, collector.environ() | llm)
        stack.callback(programs.close)
        try:
            codes = run_programs(arbiter, programs, collector, tmp_path)
        except (AssertionError, VramError, subprocess.TimeoutExpired):
            print(programs.log.read_text(errors="replace")[-6000:])
            raise
        assert codes == [1, 0, 0, 0], (
            "the reasoner's task was broken off, the others ended in order"
        )
        assert observer.stop() == 0
        assert arbiter.stop() == 0
    judge(Trace(collector.spans()), collector)


def run_programs(
    arbiter: ArbiterProcess, programs: Programs, collector: Collector, folder: Path
) -> list[int]:
    """Start the programs, let the arm move, end them. Their exit codes, the last started first."""
    (folder / "rskill.yaml").write_text(MANIFEST.format(name="detector"))
    device = ["--device", f"fake:{arbiter.gpu_folder}", "--min-residency-s", "0"]
    detector = [
        "--name",
        "detector",
        "--rskill",
        str(folder / "rskill.yaml"),
        "--footprint",
        "5.3GB,5.3GB,450MiB",
    ]
    grab = [
        "--name",
        "grab",
        "--rskill",
        str(GRAB / "rskill.yaml"),
        "--footprint",
        "4.3GB,4.3GB,450MiB",
    ]
    programs.start("echo", str(folder), *detector, *device)
    programs.start("vram-sidecar", *grab, *device)
    programs.start("vram-runner", "sim", "--seed", "1", "--skills", str(endless(folder)))
    asyncio.run(all_up(arbiter.runtime))
    programs.start(
        "vram-reasoner", "--task", "grab the red cube", "--planner", "openai", "--scene-vlm", "none"
    )
    collector.wait(
        lambda: bool(collector.spans(telemetry.SPAN_SEND)), "action that reaches the robot", MOVES_S
    )
    return programs.end()


def endless(folder: Path) -> Path:
    """The grab as a goal that does not end by itself, however late the SIGTERM comes."""
    manifest = yaml.safe_load((GRAB / "rskill.yaml").read_text())
    manifest["policy_extras"] |= {"rollout_steps": 100_000, "stop_when_still": False}
    manifest["latency_budget"]["max_execution_s"] = 3600.0
    skill = folder / GRAB.name
    skill.mkdir()
    (skill / "rskill.yaml").write_text(yaml.safe_dump(manifest))
    return skill


async def all_up(runtime: Path) -> None:
    """Each serves: the clients of the programs themselves wait no longer for one that is just being
    started than for one that is gone."""
    for name in ("detector", "grab"):
        async with SidecarClient(f"ipc://{runtime}/{name}.sock") as sidecar:
            await sidecar.ping(timeout_s=START_S)
    async with RunnerClient(f"ipc://{runtime}/runner.sock") as runner:
        await runner.ping(timeout_s=START_S)


class Trace:
    """What was exported, as a tree."""

    def __init__(self, spans: list[ReceivedSpan]) -> None:
        self.spans = spans
        self._by_id = {span.span_id: span for span in spans}

    def named(self, name: str) -> list[ReceivedSpan]:
        return sorted(
            (span for span in self.spans if span.name == name), key=lambda span: span.start_ns
        )

    def above(self, span: ReceivedSpan) -> list[ReceivedSpan]:
        """Parent, its parent, and so on up to the root. Raises KeyError for a parent that never was
        exported."""
        found: list[ReceivedSpan] = []
        while span.parent_id:
            span = self._by_id[span.parent_id]
            found.append(span)
        return found

    def below(self, span: ReceivedSpan, name: str) -> list[ReceivedSpan]:
        """Its children of that name, by their beginning."""
        return [seen for seen in self.named(name) if seen.parent_id == span.span_id]


def judge(trace: Trace, collector: Collector) -> None:
    """Follow the trace upwards from the first action, then down again to everything that had to
    happen before it."""
    first = trace.named(telemetry.SPAN_SEND)[0]
    above = trace.above(first)
    assert [(span.service, span.name) for span in above] == [
        (RUNNER, telemetry.SPAN_TICK),
        (RUNNER, telemetry.SPAN_GOAL),
        (REASONER, telemetry.SPAN_TOOL),
        (REASONER, telemetry.SPAN_REASONER_TICK),
        (REASONER, telemetry.SPAN_COMMAND),
    ]
    assert first.service == RUNNER
    assert {span.trace_id for span in above} == {first.trace_id}
    _, goal, tool, turn, task = above
    assert tool.attributes[telemetry.ATTR_TOOL] == "execute_rskill"
    assert goal.attributes[telemetry.ATTR_SKILL] == "vram-arbiter/so101-grab"
    assert goal.attributes[telemetry.ATTR_OUTCOME] == "canceled", "the reasoner took it with itself"
    # several where news came meanwhile, as of a picture that is late
    plans = trace.below(turn, telemetry.SPAN_PLAN)
    assert "execute_rskill" in [plan.attributes[telemetry.ATTR_OUTCOME] for plan in plans]

    chats = [chat for plan in plans for chat in trace.below(plan, "chat m")]
    assert {chat.attributes[telemetry.ATTR_PROVIDER] for chat in chats} == {"openai"}
    assert 1200 in [chat.attributes.get(llm_names.ATTR_INPUT_TOKENS) for chat in chats]

    look, _ = trace.below(task, telemetry.SPAN_REASONER_TICK)
    (seen,) = trace.below(look, telemetry.SPAN_TOOL)
    # again if it loads longer than a picture is good
    detect, *again = trace.below(seen, telemetry.SPAN_SIDECAR_REQUEST)
    assert {span.service for span in (detect, *again)} == {DETECTOR}
    assert (again or [detect])[-1].attributes[telemetry.ATTR_OUTCOME] == "ok"
    assert [span.service for span in trace.below(detect, telemetry.SPAN_SIDECAR_LOAD)] == [DETECTOR]

    (activation,) = trace.below(goal, telemetry.SPAN_ACTIVATE)
    load = trace.below(activation, telemetry.SPAN_SIDECAR_REQUEST)[0]
    assert (load.service, load.attributes[telemetry.ATTR_OPERATION]) == (POLICY, "load")
    (loading,) = trace.below(load, telemetry.SPAN_SIDECAR_LOAD)
    assert loading.end_ns <= first.start_ns

    (acquire,) = trace.below(load, own.SPAN_ACQUIRE)
    assert (acquire.service, acquire.attributes[telemetry.ATTR_CONSUMER]) == (ARBITER, "grab")
    assert [len(trace.below(acquire, name)) for name in (own.SPAN_QUEUE, own.SPAN_LOAD)] == [1, 1]
    (evict,) = trace.below(acquire, own.SPAN_EVICT)
    assert (evict.service, evict.attributes[telemetry.ATTR_CONSUMER]) == (ARBITER, "detector")
    (verify,) = trace.below(evict, own.SPAN_VERIFY)
    assert verify.attributes[own.ATTR_VERDICT] in ("verified", "residue")
    (unloading,) = trace.below(evict, telemetry.SPAN_SIDECAR_UNLOAD)
    assert unloading.service == DETECTOR, (
        "the holder that has to leave does so in the trace of who needs its room"
    )
    assert unloading.end_ns <= loading.start_ns, "first out, then in"
    assert {span.trace_id for span in (acquire, evict, verify, unloading, loading, detect)} == {
        first.trace_id
    }

    codes = {
        span.service: span.attributes[telemetry.ATTR_EXIT_CODE]
        for span in trace.named(telemetry.SPAN_COMMAND)
    }
    assert codes == {REASONER: 1, RUNNER: 0, POLICY: 0, DETECTOR: 0}, "SIGTERM loses nothing"
    others = {
        span.name
        for span in trace.spans
        if span.service == RUNNER and span.trace_id != first.trace_id
    }
    assert others == {telemetry.SPAN_COMMAND}, "a robot that waits records nothing"
    for service, metric in (
        (RUNNER, telemetry.METRIC_TICK),
        (RUNNER, telemetry.METRIC_GOALS),
        (RUNNER, telemetry.METRIC_CHUNK),
        (POLICY, telemetry.METRIC_SIDECAR_LOAD),
        (POLICY, telemetry.METRIC_SIDECAR_REQUEST),
        (REASONER, telemetry.METRIC_TOOL_CALLS),
        (REASONER, llm_names.GEN_AI_TOKENS),
        (ARBITER, own.METRIC_GRANTS),
    ):
        assert service in {point.service for point in collector.points(metric)}
    check_dashboard(collector)


def check_dashboard(collector: Collector) -> None:
    """Curves of chunks, goals, sidecars and the reasoner: the others are in
    tests/runner/control/test_hardware_spans.py."""
    elsewhere = (telemetry.METRIC_CHUNK, telemetry.METRIC_GOALS, telemetry.METRIC_SIDECAR_LOAD,
    telemetry.METRIC_SIDECAR_REQUEST, telemetry.METRIC_TOOL_CALLS)  # fmt: skip
    exported = {name.replace(".", "_"): name for name in elsewhere}
    drawn = {}
    for expression in promql.panels("runner.json").values():
        for selector in promql.selectors(expression):
            name = re.sub(r"(_seconds_bucket|_total)$", "", str(selector.name))
            drawn[name] = promql.grouped_by(expression) - {"le"}
    for name, metric in exported.items():
        points = collector.points(metric)
        labels = {label.replace(".", "_") for point in points for label in point.attributes}
        assert drawn[name] - {"error_type"} <= labels, f"{metric} has {labels}"
