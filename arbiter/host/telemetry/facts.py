"""Facts of the history as OpenTelemetry takes them: attributes, contexts, links, ids."""

from collections.abc import Mapping, Sequence

from opentelemetry import trace
from opentelemetry.context import Context
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from vram_arbiter.arbiter.core.model.refusals import LimitReached
from vram_arbiter.schemas.runtime.telemetry import names
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.notes import About

REASON_CHARS = 300
_W3C = TraceContextTextMapPropagator()


def bytes_attribute(count: int | None) -> dict[str, int]:
    return {} if count is None else {names.ATTR_BYTES: count}


def labels_of(about: About) -> dict[str, str]:
    return {
        names.ATTR_LEASE: str(about.lease_id),
        names.ATTR_CONSUMER: about.consumer,
        names.ATTR_GPU: str(about.gpu),
    }


def context_of(traceparent: str | None) -> Context:
    """Return the context in which the span that a W3C traceparent names is the parent."""
    return _W3C.extract({"traceparent": traceparent}, Context()) if traceparent else Context()


def links_to(context: Context) -> Sequence[trace.Link]:
    earlier = trace.get_current_span(context).get_span_context()
    return [trace.Link(earlier)] if earlier.is_valid else ()


def ids_of(span: trace.Span) -> Mapping[str, str]:
    context = span.get_span_context()
    if not context.is_valid:
        return {}  # only metrics are on, and no trace was named
    return {"trace_id": f"{context.trace_id:032x}", "span_id": f"{context.span_id:016x}"}


def named_by(about: About) -> Mapping[str, str]:
    """Return the ids of the acquirer's own span, as the request named it."""
    return ids_of(trace.get_current_span(context_of(about.traceparent)))


def traceparent_of(span: trace.Span) -> str | None:
    """Return the span's own traceparent; None where only metrics are on."""
    carrier: dict[str, str] = {}
    _W3C.inject(carrier, trace.set_span_in_context(span, Context()))
    return carrier.get("traceparent")


def end_span(span: trace.Span, at_ns: int, failed: str = "") -> None:
    """End a span, never before its beginning: the wall clock may be set back meanwhile."""
    if failed:
        span.set_status(trace.Status(trace.StatusCode.ERROR, failed[:REASON_CHARS]))
    span.end(max(at_ns, getattr(span, "start_time", None) or 0))


def refuses_a_lease(refusal: Refusal) -> bool:
    """Return whether a refusal at once is that of a lease."""
    if isinstance(refusal, LimitReached):
        return refusal.limit in ("waiters_max", "leases_per_client_max")
    return refusal.code in ("vram_insufficient", "load_failing", "unknown_gpu")
