"""Prints the spans and metrics of some ticks on a robot as JSON, and the pages that Prometheus
would read: when the robot is ready, after its first ticks, and at the end.

A program of its own, because a process has one tracer provider for good.
"""

import asyncio
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from opentelemetry import metrics, trace
from opentelemetry.exporter.prometheus import PrometheusMetricReader
from opentelemetry.sdk.metrics import MeterProvider
from opentelemetry.sdk.metrics.export import InMemoryMetricReader
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import generate_latest

from tests.runner.manual_clock import ManualClock
from tests.runner.small_robots import FedCamera, Nod, Twin, hardware_runner
from vram_arbiter.runner.protocols import Act, ChunkStart, Goal, Hold, StepOutcome
from vram_arbiter.runner.safety.ranges import JointRanges
from vram_arbiter.runner.sensors.detections import DetectionSlot
from vram_arbiter.runner.sensors.detector import ContinuousDetector
from vram_arbiter.runner.skills.base import SkillState
from vram_arbiter.schemas.config.robot import DetectorConfig
from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import process
from vram_arbiter.schemas.world import Action, JointState, WorldState

READ_S, SEND_S = 0.004, 0.008


class BrokenDetector:
    async def ping(self) -> None:
        raise ModelError("no memory left")

    def picture(self, sensor_id: str, max_age_s: float) -> None:
        raise AssertionError("a detector that is not loaded looks at no picture")


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
    registry = CollectorRegistry()
    pages = PrometheusMetricReader(scope_info_enabled=False, registry=registry)
    metrics.set_meter_provider(MeterProvider([reader, pages]))
    process.observe()
    clock = ManualClock()
    twin, camera = SlowTwin(clock), FedCamera("front", clock)
    limits = {joint.name: (joint.lower_rad, joint.upper_rad) for joint in twin.description.joints}
    runner = hardware_runner(
        twin, [(camera, 1000.0)], lambda skill: JointRanges(limits), clock=clock
    )
    runner.activate()
    ready = generate_latest(registry).decode()
    skill = Nod(load_manifest(Path(sys.argv[1])), cameras=("front",))
    skill.state = SkillState.ACTIVE
    runner.begin_skill(skill, Goal("g", "a/nod", traceparent=sys.argv[2]), lambda ended: None)
    result = runner.tick()
    moving = generate_latest(registry).decode()
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
            "events": [[event.name, dict(event.attributes or {})] for event in span.events],
            "kind": span.kind.name,
            "attributes": dict(span.attributes or {}),
        }
        for span in exporter.get_finished_spans()
    ]
    said = {"spans": spans, "tick": result.trace_context, "run": runner.result().trace_id}
    said["metrics"] = collected(reader)
    said["pages"] = [ready, moving, generate_latest(registry).decode()]
    exporter.clear()
    fall_behind(clock)
    said["slow"] = [
        [span.name, event.name, dict(event.attributes or {})]
        for span in exporter.get_finished_spans()
        for event in span.events
    ]
    said["metrics_of_slow"] = collected(reader)
    look_in_vain(clock)
    said["pages"].append(generate_latest(registry).decode())
    exporter.clear()
    said["some"] = some_ticks(clock, exporter)
    print(json.dumps(said))


def some_ticks(clock: ManualClock, exporter: InMemorySpanExporter) -> dict[str, Any]:
    """What a robot's ticks record when one in four is to be traced."""
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
    runner.mailbox.post(lambda: runner.begin_skill(skill, goal, lambda ended: None))
    ticks += [runner.tick() for _ in range(9)]
    runner.mailbox.post(runner.end_skill)
    ticks.append(runner.tick())
    runner.deactivate()
    spans = exporter.get_finished_spans()
    return {
        "idle_spans": idle_spans,
        "tick_spans": [f"{s.context.span_id:016x}" for s in spans if s.name == telemetry.SPAN_TICK],
        "send_parents": [
            f"{s.parent.span_id:016x}" for s in spans if s.name == telemetry.SPAN_SEND and s.parent
        ],
        "traces": sorted({f"{span.context.trace_id:032x}" for span in spans}),
        "ticks": [tick.trace_context and tick.trace_context["traceparent"] for tick in ticks],
    }


class Slow(Nod):
    """Waits for a chunk, then takes too long, then goes where the robot may not."""

    def _step(self, world: WorldState) -> StepOutcome:
        outcome = super()._step(world)
        assert isinstance(outcome, Act)
        match self.taken:
            case 1:
                return Hold("no chunk yet", standing=True)
            case 2:
                return replace(outcome, chunk=ChunkStart(0.05, in_time=False))
            case _:
                far = outcome.action.model_copy(update={"joint_targets": ((9.0,),)})
                return replace(outcome, action=far)


def fall_behind(clock: ManualClock) -> None:
    twin, camera = Twin(clock), FedCamera("wrist", clock, 1000.0)
    limits = {joint.name: (joint.lower_rad, joint.upper_rad) for joint in twin.description.joints}
    runner = hardware_runner(
        twin, [(camera, 1000.0)], lambda skill: JointRanges(limits), clock=clock
    )
    runner.activate()
    skill = Slow(load_manifest(Path(sys.argv[1])), on_step=lambda world: clock.advance(0.05))
    skill.state = SkillState.ACTIVE
    runner.begin_skill(skill, Goal("h", "a/slow", traceparent=sys.argv[2]), lambda ended: None)
    runner.run(4)
    camera.always = False  # it hangs
    clock.advance(2.0)
    twin.silent = True
    runner.run(2)
    runner.deactivate()


def look_in_vain(clock: ManualClock) -> None:
    """A detector that does not load, after an answer that came too late."""
    slot = DetectionSlot("front", 1000.0)
    slot.put([], clock.now_ns() - 2_000_000_000, clock.now_ns())
    config = DetectorConfig(id="lab/detector", sensor_id="front")
    broken: Any = BrokenDetector()
    asyncio.run(ContinuousDetector(config, ("cube",), broken, broken.picture, slot, clock).look())


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
