"""Prints what a robot's ticks record when one in four is to be traced: a program of its own, a
process has one tracer provider for good.
"""

import json
import sys
from pathlib import Path

from opentelemetry import trace
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from tests.runner.manual_clock import ManualClock
from tests.runner.small_robots import FedCamera, Nod, Twin
from vram_arbiter.runner.protocols import Goal
from vram_arbiter.runner.robots.hardware import hardware_runner
from vram_arbiter.runner.safety.ranges import JointRanges
from vram_arbiter.runner.skills.base import SkillState
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.runtime.telemetry import names as telemetry


def main() -> None:
    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    trace.set_tracer_provider(provider)
    clock = ManualClock()
    twin, camera = Twin(clock), FedCamera("front", clock)
    limits = {joint.name: (joint.lower_rad, joint.upper_rad) for joint in twin.description.joints}
    runner = hardware_runner(
        twin, [(camera, 1000.0)], lambda skill: JointRanges(limits), clock=clock
    )
    runner.spans.share = 0.25
    runner.activate()
    skill = Nod(load_manifest(Path(sys.argv[1])), cameras=("front",))
    skill.state = SkillState.ACTIVE
    ticks = [runner.tick(), runner.tick()]  # nobody has the arm
    idle_spans = len(exporter.get_finished_spans())
    goal = Goal("g", "a/nod", traceparent=sys.argv[2])
    runner.mailbox.post(
        lambda: runner.begin_skill(skill, goal, lambda ended: None), lambda *_: None
    )
    ticks += [runner.tick() for _ in range(9)]
    runner.mailbox.post(runner.end_skill, lambda *_: None)
    ticks.append(runner.tick())
    runner.deactivate()
    spans = [span for span in exporter.get_finished_spans() if span.name == telemetry.SPAN_TICK]
    sent = [span for span in exporter.get_finished_spans() if span.name == telemetry.SPAN_SEND]
    facts = {
        "idle_spans": idle_spans,
        "tick_spans": [f"{span.context.span_id:016x}" for span in spans],
        "send_parents": [f"{span.parent.span_id:016x}" for span in sent if span.parent],
        "traces": sorted(
            {f"{span.context.trace_id:032x}" for span in exporter.get_finished_spans()}
        ),
        "ticks": [tick.trace_context and tick.trace_context["traceparent"] for tick in ticks],
    }
    print(json.dumps(facts))


if __name__ == "__main__":
    main()
