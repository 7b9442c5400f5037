"""Prints the spans of one tick on a robot as JSON: a program of its own, because a process has one
tracer provider for good.
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
    runner.activate()
    skill = Nod(load_manifest(Path(sys.argv[1])), cameras=("front",))
    skill.state = SkillState.ACTIVE
    runner.begin_skill(skill, Goal("g", "a/nod", traceparent=sys.argv[2]), lambda ended: None)
    result = runner.tick()
    camera.stop()
    runner.run(3)
    runner.deactivate()
    spans = [
        {
            "name": span.name,
            "trace_id": f"{span.context.trace_id:032x}",
            "span_id": f"{span.context.span_id:016x}",
            "parent": f"{span.parent.span_id:016x}" if span.parent else None,
            "events": [event.name for event in span.events],
        }
        for span in exporter.get_finished_spans()
    ]
    print(
        json.dumps({"spans": spans, "tick": result.trace_context, "run": runner.result().trace_id})
    )


if __name__ == "__main__":
    main()
