"""Spans and the way of a trace over a socket. On the API alone: costs next to nothing until
`schemas.runtime.telemetry.setup` has installed an SDK.

The wire is W3C `traceparent` whatever `OTEL_PROPAGATORS` says: it is a field of our messages.
Without an SDK a caller's trace is not recorded here, but handed on to what is called next.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

from opentelemetry import context as present_context
from opentelemetry import trace
from opentelemetry.context import Context
from opentelemetry.trace import SpanKind
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry.traceparent import read as read_traceparent

Attributes = Mapping[str, str | int | float | Sequence[str]]

_TRACER = trace.get_tracer(telemetry.TRACER)  # a proxy: it finds the SDK whenever that comes
_W3C = TraceContextTextMapPropagator()
_KINDS = {
    telemetry.SPAN_GOAL: SpanKind.SERVER,
    telemetry.SPAN_SIDECAR_REQUEST: SpanKind.SERVER,
    telemetry.SPAN_GATEWAY_REQUEST: SpanKind.SERVER,
    telemetry.SPAN_CHUNK: SpanKind.CLIENT,
    telemetry.SPAN_TOOL: SpanKind.CLIENT,
}
"""Spans that answer or send a request; all others are internal."""
_LEFT_OUT = present_context.create_key("left-out")


def span(
    name: str,
    traceparent: str | None = None,
    attributes: Attributes | None = None,
    *,
    client: bool = False,
) -> AbstractContextManager[trace.Span]:
    """A span, the present one's child, or the caller's when it sent a W3C traceparent. A bad one
    begins a trace of its own. An exception that leaves the block is its `error.type`. `client`: a
    request to a server of others, whatever its name."""
    if traceparent is None and present_context.get_value(_LEFT_OUT):
        return nullcontext(trace.get_current_span())
    kind = SpanKind.CLIENT if client else _KINDS.get(name, SpanKind.INTERNAL)
    return _recorded(name, traceparent, attributes, kind)


@contextmanager
def _recorded(
    name: str, traceparent: str | None, attributes: Attributes | None, kind: SpanKind
) -> Iterator[trace.Span]:
    with _TRACER.start_as_current_span(
        name,
        context=_of(traceparent) if traceparent else None,
        kind=kind,
        attributes=attributes,
    ) as present:
        try:
            yield present
        except Exception as error:
            present.set_attribute(telemetry.ATTR_ERROR_TYPE, error_type(error))
            raise


def error_type(error: Exception) -> str:
    """Return the value of `error.type`: the code of our errors, else the exception's class."""
    return error.code if isinstance(error, VramError) else type(error).__qualname__


def failed(span: trace.Span, code: str) -> None:
    """Mark a span as failed where no exception passes through it."""
    span.set_attribute(telemetry.ATTR_ERROR_TYPE, code)
    span.set_status(trace.Status(trace.StatusCode.ERROR, code))


def begin(
    name: str, traceparent: str | None = None, attributes: Attributes | None = None
) -> trace.Span:
    """A span for work that is spread over several tasks: `inside` makes it the present one, `end()`
    ends it."""
    return _TRACER.start_span(
        name,
        context=_of(traceparent) if traceparent else None,
        kind=_KINDS.get(name, SpanKind.INTERNAL),
        attributes=attributes,
    )


def inside(span: trace.Span) -> AbstractContextManager[trace.Span]:
    """Within the block the span is the present one, also for the tasks that are made there. It is
    not ended."""
    made: AbstractContextManager[trace.Span] = trace.use_span(
        span, record_exception=False, set_status_on_exception=False
    )
    return made


@contextmanager
def joined(traceparent: str | None) -> Iterator[None]:
    """Within the block the caller's span is the present one, or none where it sent none: whatever
    was present before is left alone."""
    token = present_context.attach(
        _of(traceparent) if traceparent else trace.set_span_in_context(trace.INVALID_SPAN)
    )
    try:
        yield
    finally:
        present_context.detach(token)


@contextmanager
def left_out(traceparent: str | None) -> Iterator[None]:
    """Within the block nothing is recorded, here or in anything called from here. What the work
    would have joined (the caller's span or the present one, if any) is still what `carrier` names,
    marked as not sampled.
    """
    caller = trace.get_current_span(_of(traceparent)) if traceparent else trace.get_current_span()
    known = caller.get_span_context()
    unsampled = trace.SpanContext(
        known.trace_id, known.span_id, is_remote=True, trace_flags=trace.TraceFlags()
    )
    standing = trace.NonRecordingSpan(unsampled) if known.is_valid else trace.INVALID_SPAN
    quiet = present_context.set_value(_LEFT_OUT, True)
    token = present_context.attach(trace.set_span_in_context(standing, quiet))
    try:
        yield
    finally:
        present_context.detach(token)


def traceparent() -> str | None:
    """The present span as W3C traceparent, to be sent along; None outside any trace."""
    return (carrier() or {}).get("traceparent")


def carrier() -> dict[str, str] | None:
    """The present span as W3C headers, to be stored or sent along; None outside any trace."""
    headers: dict[str, str] = {}
    _W3C.inject(headers)
    return headers or None


def log_ids() -> dict[str, str]:
    """`trace_id` and `span_id` of the present span for a line of a log, in hexadecimal; {} outside
    any trace."""
    context = trace.get_current_span().get_span_context()
    if not context.is_valid:
        return {}
    return {"trace_id": f"{context.trace_id:032x}", "span_id": f"{context.span_id:016x}"}


def traced() -> bool:
    """Whether there is a present span, recorded here or elsewhere."""
    return bool(trace.get_current_span().get_span_context().is_valid)


def recorded() -> bool:
    """Whether the present span is recorded in this process."""
    return bool(trace.get_current_span().is_recording())


def event(name: str, **attributes: str | float) -> None:
    """Add an event to the present span."""
    trace.get_current_span().add_event(name, attributes)


def refused(error: Exception, attributes: Attributes) -> None:
    """Record an error in the present span that no exception carries through it."""
    present = trace.get_current_span()
    present.record_exception(error, dict(attributes))
    failed(present, error_type(error))


def note(attributes: Attributes) -> None:
    """Add attributes to the present span."""
    trace.get_current_span().set_attributes(dict(attributes))


def _of(traceparent: str) -> Context:
    read = read_traceparent(traceparent)
    return _W3C.extract({"traceparent": read}) if read else Context()
