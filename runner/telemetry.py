"""Names of the runner's spans and events, in one place. Recording costs nothing until an OpenTelemetry SDK is installed."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

from opentelemetry import propagate, trace

SPAN_TICK = "rskill.tick"
SPAN_GOAL = "rskill.goal"
SPAN_SENSORS = "sensors.read"
SPAN_WORLD = "world_state.snapshot"
SPAN_INFERENCE = "inference"
SPAN_SAFETY = "safety.check"
SPAN_SEND = "hal.send_action"
EVENT_DEADLINE_MISSED = "vram.event.deadline_missed"
EVENT_ACTION_WITHHELD = "vram.event.action_withheld"


def goal_span(traceparent: str | None, rskill_id: str) -> AbstractContextManager[Any]:
    """A span for a whole goal, as a child of the caller's when it sent a W3C traceparent."""
    context = propagate.extract({"traceparent": traceparent}) if traceparent else None
    span: AbstractContextManager[Any] = trace.get_tracer("runner").start_as_current_span(
        SPAN_GOAL, context=context, attributes={"rskill.id": rskill_id}
    )
    return span


def current_traceparent() -> str | None:
    """The W3C traceparent of the present span, to be sent along; None outside any trace."""
    carrier: dict[str, str] = {}
    propagate.inject(carrier)
    return carrier.get("traceparent")
