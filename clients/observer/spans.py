"""Spans of waits and evictions, made from the events of the history.

The daemon minted the ids of waits and evictions; `NotedIds` lets the SDK take them, so that a
holder's unload, which heard of its eviction's id in `revoke`, is its child. Every span that is
begun is ended, by an event or at the observer's end, and their number is bounded.

    lease.acquire (child of the acquirer's span)   from the request to `ready`
      lease.queue                                  until the grant, for one that had to wait
      lease.evict                                  one for each lease that had to leave, from the
      first `revoke` to the verdict
        lease.verify                               from the release to the verdict
      lease.load                                   from the grant to `ready`
"""

from collections.abc import Mapping
from dataclasses import dataclass

from opentelemetry import trace
from opentelemetry.context import Context
from opentelemetry.sdk.trace.id_generator import RandomIdGenerator
from opentelemetry.trace import NonRecordingSpan, SpanContext, TraceFlags

from vram_arbiter.clients.observer import names as own
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.telemetry import names
from vram_arbiter.schemas.runtime.telemetry.traceparent import read as read_traceparent

OPEN_MAX = 32_768
"""Waits that are open at a time, and as many evictions. The oldest is ended when one more
begins."""
REASON_CHARS = 300
_STEPS: Mapping[str, str] = {
    "revoke_acked": own.EVENT_REVOKE_ACKED,
    "reminded": own.EVENT_REMINDED,
    "deadline_passed": own.EVENT_DEADLINE_PASSED,
    "signalled": own.EVENT_SIGNALLED,
    "unloading": own.EVENT_UNLOADING,
}
_GOOD_VERDICTS = frozenset({"verified", "residue"})


class NotedIds(RandomIdGenerator):  # type: ignore[misc]  # OpenTelemetry is untyped here
    """Gives the next span the ids that the daemon minted for it."""

    def __init__(self) -> None:
        self._next: tuple[int, int] | None = None

    def note(self, trace_id: int, span_id: int) -> None:
        self._next = trace_id, span_id

    def generate_trace_id(self) -> int:
        return int(super().generate_trace_id()) if self._next is None else self._next[0]

    def generate_span_id(self) -> int:
        if self._next is None:
            return int(super().generate_span_id())
        span_id, self._next = self._next[1], None
        return span_id


@dataclass(slots=True)
class _Wait:
    """The open spans of a lease that is asked for and not ready."""

    span: trace.Span
    started_ns: int
    queue: trace.Span | None = None
    load: trace.Span | None = None


@dataclass(slots=True)
class _Leaving:
    """The open spans of a lease on its way out. `evict` None: it leaves by itself, or its process
    died."""

    evict: trace.Span | None = None
    verify: trace.Span | None = None


class Spans:
    """`take` with each event of the history; `close` at the end."""

    def __init__(self, tracer: trace.Tracer, ids: NotedIds) -> None:
        self._tracer = tracer
        self._ids = ids
        self._waits: dict[str, _Wait] = {}
        self._leaving: dict[str, _Leaving] = {}

    def take(self, event: JsonMap) -> None:
        kind, at_ns = event["kind"], int(event["at_wall_s"] * 1e9)
        if kind == "started":  # the daemon knows the spans of its former run no more
            self.close(at_ns)
        lease_id = event.get("lease_id")
        if lease_id is None:
            return
        match kind:
            case "queued":
                self._queued(event, at_ns)
            case "granted":
                self._granted(event, at_ns)
            case "ready":
                size = _bytes(event.get("measured_bytes"))
                self._end_wait(lease_id, at_ns, attributes=size)
            case "denied":
                self._end_wait(lease_id, at_ns, f"{event.get('code')}: {event.get('reason')}")
            case "cancelled":
                self._end_wait(lease_id, at_ns, f"cancelled: {event.get('reason')}")
            case "revoke_asked":
                self._revoked(event, at_ns)
            case "revoke_withdrawn":
                self._end_leaving(lease_id, at_ns, own.EVENT_REVOKE_WITHDRAWN)
            case "released":
                self._released(event, at_ns)
            case "lost" | "expired":
                self._released(event, at_ns, f"{kind}: {event.get('reason')}")
            case "verified":
                self._verdict(event, at_ns)
            case step if step in _STEPS:
                self._step(event, at_ns)

    def close(self, at_ns: int) -> None:
        """The daemon or the observer ends. Leases go on; their spans are exported as far as they
        came."""
        for lease_id in list(self._waits):
            self._waits[lease_id].span.add_event(own.EVENT_DAEMON_STOPPED, timestamp=at_ns)
            self._end_wait(lease_id, at_ns)
        for lease_id in list(self._leaving):
            self._end_leaving(lease_id, at_ns, own.EVENT_DAEMON_STOPPED)

    # -- waiting and getting
    def _queued(self, event: JsonMap, at_ns: int) -> None:
        wait = self._wait(event, at_ns)
        if wait.queue is None:
            wait.queue = self._child(own.SPAN_QUEUE, wait.span, at_ns)
        wait.queue.set_attribute(names.ATTR_REASON, _reason(event))

    def _granted(self, event: JsonMap, at_ns: int) -> None:
        waited_ns = int(event["waited_ms"] * 1e6)
        wait = self._wait(event, at_ns - waited_ns)
        if wait.queue is None and waited_ns > 0:
            wait.queue = self._child(own.SPAN_QUEUE, wait.span, wait.started_ns)
        if wait.queue is not None:
            _end(wait.queue, at_ns)
            wait.queue = None
        where = {names.ATTR_GPU: str(event.get("gpu")), names.ATTR_REASON: _reason(event)}
        wait.span.set_attributes(where)
        size = _bytes(event["charge_bytes"])
        wait.load = self._child(own.SPAN_LOAD, wait.span, at_ns, size)

    def _wait(self, event: JsonMap, at_ns: int) -> _Wait:
        """Return the open wait, or a new one. A lease that comes back by itself does so long after
        its acquirer's trace: it only points there."""
        lease_id = event["lease_id"]
        if (found := self._waits.get(lease_id)) is not None:
            return found
        acquirer = _acquirer(event)
        context, links = Context(), []
        if acquirer is not None and not event.get("by_itself"):
            context = _within(acquirer)
        elif acquirer is not None:
            links = [trace.Link(acquirer)]
        self._minted(event)
        labels = {names.ATTR_LEASE: lease_id, names.ATTR_CONSUMER: event["consumer"]}
        span = self._tracer.start_span(
            own.SPAN_ACQUIRE,
            context,
            trace.SpanKind.SERVER,
            labels,
            links=links,
            start_time=at_ns,
        )
        while len(self._waits) >= OPEN_MAX:
            self._end_wait(next(iter(self._waits)), at_ns, "too many spans are open")
        made = self._waits[lease_id] = _Wait(span, at_ns)
        return made

    def _end_wait(
        self,
        lease_id: str,
        at_ns: int,
        failed: str = "",
        attributes: Mapping[str, int] | None = None,
    ) -> None:
        wait = self._waits.pop(lease_id, None)
        if wait is None:
            return  # granted before the observer started
        for child in (wait.queue, wait.load):
            if child is not None:
                child.set_attributes(dict(attributes or {}))
                _end(child, at_ns, failed)
        _end(wait.span, at_ns, failed)

    # -- leaving
    def _revoked(self, event: JsonMap, at_ns: int) -> None:
        """Begin an eviction: a child of its waiter's span, under pressure a trace of its own."""
        lease_id, context = event["lease_id"], Context()
        if parent := event.get("parent_id"):
            context = _within(_context(event["trace_id"], parent, event.get("trace_flags", "01")))
        self._minted(event)
        why = {own.ATTR_WANTED_BY: event["wanted_by"], names.ATTR_REASON: event["cause"]}
        span = self._tracer.start_span(
            own.SPAN_EVICT, context, attributes=_labels(event) | why, start_time=at_ns
        )
        # it was never measured: asked again, the earlier way out has no end of its own
        self._end_leaving(lease_id, at_ns)
        self._leave(lease_id, at_ns).evict = span

    def _leave(self, lease_id: str, at_ns: int) -> _Leaving:
        if (found := self._leaving.get(lease_id)) is not None:
            return found
        while len(self._leaving) >= OPEN_MAX:
            self._end_leaving(next(iter(self._leaving)), at_ns)
        made = self._leaving[lease_id] = _Leaving()
        return made

    def _step(self, event: JsonMap, at_ns: int) -> None:
        leaving = self._leaving.get(event["lease_id"])
        if leaving is not None and leaving.evict is not None:
            keys = ("uses", "signal", "safe_point_eta_s")
            facts = {key: event[key] for key in keys if event.get(key) is not None}
            leaving.evict.add_event(_STEPS[event["kind"]], facts, at_ns)

    def _released(self, event: JsonMap, at_ns: int, failed: str = "") -> None:
        """Its bytes are looked for from now on; one that was away has none. `failed`: it did not
        release them."""
        lease_id = event["lease_id"]
        self._end_wait(lease_id, at_ns, failed or "released before it was ready")
        if event.get("gpu") is None:
            return
        leaving = self._leave(lease_id, at_ns)
        if leaving.evict is not None and failed:
            leaving.evict.set_status(trace.Status(trace.StatusCode.ERROR, failed))
        self._verifying(leaving, event, at_ns)

    def _verifying(self, leaving: _Leaving, event: JsonMap, at_ns: int) -> trace.Span:
        if leaving.verify is None:
            context, links = Context(), []
            # a lease that left by itself is not part of its acquirer's trace
            if leaving.evict is not None:
                context = trace.set_span_in_context(leaving.evict, context)
            elif (acquirer := _acquirer(event)) is not None:
                links = [trace.Link(acquirer)]
            leaving.verify = self._tracer.start_span(
                own.SPAN_VERIFY,
                context,
                attributes=_labels(event),
                links=links,
                start_time=at_ns,
            )
        return leaving.verify

    def _verdict(self, event: JsonMap, at_ns: int) -> None:
        lease_id, verdict = event["lease_id"], event["verdict"]
        leaving = self._leave(lease_id, at_ns)
        verify = self._verifying(leaving, event, at_ns - int(event["ms"] * 1e6))
        if not event["resolved"]:
            verify.add_event(own.EVENT_VERDICT, {own.ATTR_VERDICT: verdict}, at_ns)
            return
        sizes = {
            names.ATTR_BYTES: event["residue_bytes"],
            own.ATTR_BYTES_BEFORE: event["before_bytes"],
            own.ATTR_BYTES_AFTER: event["after_bytes"],
        }
        verify.set_attribute(own.ATTR_VERDICT, verdict)
        verify.set_attributes({key: count for key, count in sizes.items() if count is not None})
        if verdict not in _GOOD_VERDICTS:
            verify.set_status(trace.Status(trace.StatusCode.ERROR, verdict))
        if leaving.evict is not None:
            leaving.evict.set_attribute(own.ATTR_VERDICT, verdict)
        self._end_leaving(lease_id, at_ns)

    def _end_leaving(self, lease_id: str, at_ns: int, why: str = "") -> None:
        leaving = self._leaving.pop(lease_id, None)
        if leaving is None:
            return
        for span in (leaving.verify, leaving.evict):
            if span is not None:
                if why:
                    span.add_event(why, timestamp=at_ns)
                _end(span, at_ns)

    def _child(
        self, name: str, parent: trace.Span, at_ns: int, attributes: Mapping[str, int] | None = None
    ) -> trace.Span:
        context = trace.set_span_in_context(parent, Context())
        return self._tracer.start_span(name, context, start_time=at_ns, attributes=attributes)

    def _minted(self, event: JsonMap) -> None:
        if "span_id" in event:  # not in a history of an older daemon
            self._ids.note(int(event["trace_id"], 16), int(event["span_id"], 16))


def context_of(event: JsonMap) -> Context:
    """Return the context of the span that an event belongs to, for log records and exemplars: the
    daemon's, else its acquirer's."""
    if "span_id" not in event:
        acquirer = _acquirer(event)
        return Context() if acquirer is None else _within(acquirer)
    flags = event.get("trace_flags", "01")
    return _within(_context(event["trace_id"], event["span_id"], flags))


def _acquirer(event: JsonMap) -> SpanContext | None:
    """Return the acquirer's own span, as its request named it."""
    given = read_traceparent(event.get("traceparent"))
    return None if given is None else _context(*given.split("-")[1:])


def _context(trace_id: str, span_id: str, flags: str) -> SpanContext:
    return SpanContext(
        int(trace_id, 16), int(span_id, 16), is_remote=True, trace_flags=TraceFlags(int(flags, 16))
    )


def _within(span: SpanContext) -> Context:
    return trace.set_span_in_context(NonRecordingSpan(span), Context())


def _labels(event: JsonMap) -> dict[str, str]:
    return {
        names.ATTR_LEASE: event["lease_id"],
        names.ATTR_CONSUMER: event["consumer"],
        names.ATTR_GPU: str(event.get("gpu")),
    }


def _bytes(count: int | None) -> dict[str, int]:
    return {} if count is None else {names.ATTR_BYTES: count}


def _reason(event: JsonMap) -> str:
    return str(event.get("reason"))[:REASON_CHARS]


def _end(span: trace.Span, at_ns: int, failed: str = "") -> None:
    """End a span, never before its beginning: the wall clock may be set back meanwhile."""
    if failed:
        span.set_status(trace.Status(trace.StatusCode.ERROR, failed[:REASON_CHARS]))
    span.end(max(at_ns, getattr(span, "start_time", None) or 0))
