"""Prints the spans and metrics of some ticks on a robot as JSON.

A program of its own, because a process has one tracer provider for good.
"""

import json
import sys
from pathlib import Path
from typing import Any

from opentelemetry import metrics, trace
from opentelemetry.sdk.metrics import MeterProvider
from opentelemetry.sdk.metrics.export import InMemoryMetricReader
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
from vram_arbiter.schemas.runtime.telemetry import process
from vram_arbiter.schemas.world import Action, JointState

READ_S, SEND_S = 0.004, 0.008


class SlowTwin(Twin):
    """A bus takes its time."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__(clock)
        self.time = clock

    def _read(self) -> JointState:
        self.time.advance(READ_S)
        return super()._read()

    def send_action(self, action: Action) -> None:
        self.time.advance(SEND_S)
        super().send_action(action)


def main() -> None:
    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    trace.set_tracer_provider(provider)
    reader = InMemoryMetricReader()
    metrics.set_meter_provider(MeterProvider([reader]))
    process.observe()
    clock = ManualClock()
    twin, camera = SlowTwin(clock), FedCamera("front", clock)
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
    twin.silent = True
    runner.request_estop("hand in the way")
    runner.tick()
    runner.tick()
    runner.deactivate()
    spans = [
        {
            "name": span.name,
            "trace_id": f"{span.context.trace_id:032x}",
            "span_id": f"{span.context.span_id:016x}",
            "parent": f"{span.parent.span_id:016x}" if span.parent else None,
            "events": [event.name for event in span.events],
            "kind": span.kind.name,
            "attributes": dict(span.attributes or {}),
        }
        for span in exporter.get_finished_spans()
    ]
    said = {"spans": spans, "tick": result.trace_context, "run": runner.result().trace_id}
    print(json.dumps(said | {"metrics": collected(reader)}))


def collected(reader: InMemoryMetricReader) -> dict[str, Any]:
    """Unit, description, and count (or sum) and sum of each series of each metric."""
    data = reader.get_metrics_data()
    assert data is not None
    return {
        metric.name: {
            "unit": metric.unit,
            "description": metric.description,
            "points": [
                {
                    "labels": dict(point.attributes),
                    "count": getattr(point, "count", None) or getattr(point, "value", None),
                    "sum": getattr(point, "sum", None),
                }
                for point in metric.data.data_points
            ],
        }
        for group in data.resource_metrics
        for scope in group.scope_metrics
        for metric in scope.metrics
    }


if __name__ == "__main__":
    main()
