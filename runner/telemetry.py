"""Names of the runner's spans and events, in one place. Recording costs nothing until an OpenTelemetry SDK is installed."""

from __future__ import annotations

from contextlib import AbstractContextManager

from opentelemetry import propagate, trace

SPAN_TICK = "rskill.tick"
SPAN_GOAL = "rskill.goal"
SPAN_SENSORS = "sensors.read"
SPAN_WORLD = "world_state.snapshot"
SPAN_INFERENCE = "inference"
SPAN_SAFETY = "safety.check"
SPAN_SEND = "hal.send_action"
EVENT_DEADLINE_MISSED = "vram.event.deadline_missed"
EVENT_ESTOP = "vram.event.estop_requested"
EVENT_STALE = "vram.event.staleness_latched"
EVENT_ACTION_WITHHELD = "vram.event.action_withheld"


def span(
    name: str, traceparent: str | None = None, attributes: dict[str, str] | None = None
) -> AbstractContextManager[trace.Span]:
    """A span, the present one's child, or the caller's when it sent a W3C traceparent."""
    context = propagate.extract({"traceparent": traceparent}) if traceparent else None
    made: AbstractContextManager[trace.Span] = trace.get_tracer("runner").start_as_current_span(
        name, context=context, attributes=attributes
    )
    return made


def carrier() -> dict[str, str] | None:
    """The present span as W3C headers, to be stored or sent along; None outside any trace."""
    headers: dict[str, str] = {}
    propagate.inject(headers)
    return headers or None


def event(name: str, **attributes: str | float) -> None:
    """Add an event to the present span."""
    trace.get_current_span().add_event(name, attributes)
