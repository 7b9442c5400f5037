"""Spans and the way of a trace over a socket. On the API alone: costs next to nothing until `schemas.otel` has installed an SDK."""

from collections.abc import Mapping
from contextlib import AbstractContextManager

from opentelemetry import propagate, trace

from schemas import telemetry

_TRACER = trace.get_tracer(telemetry.TRACER)  # a proxy: it finds the SDK whenever that comes


def span(
    name: str, traceparent: str | None = None, attributes: Mapping[str, str | int | float] | None = None
) -> AbstractContextManager[trace.Span]:
    """A span, the present one's child, or the caller's when it sent a W3C traceparent. A bad one begins a trace of its own."""
    context = propagate.extract({"traceparent": traceparent}) if traceparent else None
    made: AbstractContextManager[trace.Span] = _TRACER.start_as_current_span(
        name, context=context, attributes=attributes
    )
    return made


def traceparent() -> str | None:
    """The present span as W3C traceparent, to be sent along; None outside any trace."""
    return (carrier() or {}).get("traceparent")


def carrier() -> dict[str, str] | None:
    """The present span as W3C headers, to be stored or sent along; None outside any trace."""
    headers: dict[str, str] = {}
    propagate.inject(headers)
    return headers or None


def log_ids() -> dict[str, str]:
    """`trace_id` and `span_id` of the present span for a line of a log, in hexadecimal; {} outside any trace."""
    context = trace.get_current_span().get_span_context()
    if not context.is_valid:
        return {}
    return {"trace_id": f"{context.trace_id:032x}", "span_id": f"{context.span_id:016x}"}


def event(name: str, **attributes: str | float) -> None:
    """Add an event to the present span."""
    trace.get_current_span().add_event(name, attributes)
