"""The daemon's spans and metrics, made outside the core from the facts of its history and from what
it is about to say.

Imported only where telemetry is on. Runs on the loop's thread and never waits: exporting is the
SDK's threads' work. Every span that is begun is ended, by a fact or at the daemon's end, and their
number is bounded. Must not decide anything, nor change an effect but for the `traceparent` of a
`revoke`, which becomes that of its `lease.evict` span.

    lease.acquire (child of the acquirer's span)   from the request to `ready`
      lease.queue                                  until the grant, for one that had to wait
      lease.evict                                  one for each lease that had to leave, from the
      first `revoke` to the verdict
        lease.verify                               from the release to the verdict
      lease.load                                   from the grant to `ready`
"""

import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from opentelemetry import trace
from opentelemetry.context import Context
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from vram_arbiter.arbiter.core import effects as fx
from vram_arbiter.arbiter.core.model.refusals import LimitReached
from vram_arbiter.schemas.runtime.telemetry import names as names
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.pushes import AnyPush, RevokePush

OPEN_MAX = 32_768
"""Spans of acquires that are open at a time, and as many of evictions: twice the waiters that the
default limits allow. The oldest is ended when one more begins."""
REASON_CHARS = 300

_W3C = TraceContextTextMapPropagator()
_NONE: Mapping[str, str] = {}
_STEPS = {
    "revoke_acked": names.EVENT_REVOKE_ACKED,
    "reminded": names.EVENT_REMINDED,
    "deadline_passed": names.EVENT_DEADLINE_PASSED,
    "signalled": names.EVENT_SIGNALLED,
    "unloading": names.EVENT_UNLOADING,
}
_GOOD_VERDICTS = frozenset({"verified", "residue"})

Event = Mapping[str, Any]


class Counts(Protocol):
    """Where the numbers go (`otel_metrics.LeaseMetrics`)."""

    def granted(
        self, consumer: str, waited_s: float, handover_s: float | None, context: Context
    ) -> None:
        """`handover_s`: from the first revoke to the grant, where an eviction made room. `context`:
        its span, for exemplars."""

    def denied(self, code: str) -> None: ...

    def evicted(self, verdict: str) -> None: ...

    def wrote(self, seconds: float, *, failed: bool) -> None: ...


@dataclass(slots=True)
class _Acquire:
    """The open spans of a lease that is asked for and not ready. Times in nanoseconds
    since 1970."""

    consumer: str
    span: trace.Span
    started_ns: int
    queue: trace.Span | None = None
    load: trace.Span | None = None
    asked_ns: int | None = None  # when the first holder was revoked for it
    grows: str = ""  # it is no lease of its own: that one waits for more bytes


@dataclass(slots=True)
class _Leaving:
    """The open spans of a lease on its way out. `evict` None: it leaves by itself, or its process
    died."""

    evict: trace.Span | None = None
    verify: trace.Span | None = None


class LeaseTelemetry:
    """`outgoing` before a batch is performed, `revoke` for each push of one, `observe` with every
    event of the history, `close` at the end."""

    def __init__(
        self, tracer: trace.Tracer, counts: Counts, wall_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._tracer = tracer
        self._counts = counts
        self._wall_ns = wall_ns
        self._acquires: OrderedDict[str, _Acquire] = OrderedDict()
        self._leaving: OrderedDict[str, _Leaving] = OrderedDict()
        self._growths: dict[str, str] = {}  # lease → the waiter for its growth

    # -- what the core wants done
    def outgoing(self, effects: Sequence[fx.Effect]) -> None:
        """Begin the spans of evictions before a revoke is sent, and count refusals, which history
        leaves out."""
        asked: dict[str, Event] = {}
        told: list[str] = []
        for effect in effects:
            if isinstance(effect, fx.Note):
                if effect.kind == "revoke_asked":
                    asked[effect.data["lease_id"]] = effect.data
                elif effect.kind == "denied":
                    told.append(effect.data["code"])  # counted with its event
        for effect in effects:
            match effect:
                case fx.Push(_, RevokePush() as push) if push.lease_id in asked:
                    traceparent = push.traceparent or None
                    self._begin_evict(asked.pop(push.lease_id), traceparent, self._wall_ns())
                case fx.Refuse(_, _, refusal) if refusal.code in told:
                    told.remove(refusal.code)
                case fx.Refuse(_, _, refusal) if _refuses_a_lease(refusal):
                    self._counts.denied(refusal.code)

    def revoke(self, body: AnyPush) -> AnyPush:
        """A push on its way out; a `revoke` names its own span, so that the holder's unloading
        becomes its child."""
        if not isinstance(body, RevokePush):
            return body
        leaving = self._leaving.get(body.lease_id)
        if leaving is None or leaving.evict is None:
            return body
        own: dict[str, str] = {}
        _W3C.inject(own, trace.set_span_in_context(leaving.evict, Context()))
        # nothing is added where only metrics are on
        return replace(body, traceparent=own.get("traceparent", body.traceparent))

    def wrote(self, seconds: float, *, failed: bool) -> None:
        """One transaction of the journal."""
        self._counts.wrote(seconds, failed=failed)

    # -- what has happened
    def observe(self, event: Event) -> Mapping[str, str]:
        """One event of the history. Returns `trace_id` and `span_id` of what it belongs to, for its
        line of the log."""
        lease_id = event.get("lease_id")
        if not isinstance(lease_id, str):
            return _NONE
        at_ns = int(event["at_wall_s"] * 1e9)
        span: trace.Span | None = None
        match event["kind"]:
            case "queued":
                span = self._queued(lease_id, event, at_ns)
            case "granted":
                span = self._granted(lease_id, event, at_ns)
            case "ready":
                span = self._end_acquire(
                    lease_id, at_ns, attributes=_bytes(event, "measured_bytes")
                )
            case "denied" | "cancelled":
                if event["kind"] == "denied":
                    self._counts.denied(str(event["code"]))
                why = str(event.get("code", event["kind"]))
                span = self._end_acquire(lease_id, at_ns, failed=f"{why}: {event['reason']}")
            case "revoke_asked":
                leaving = self._leaving.get(lease_id)
                span = None if leaving is None else leaving.evict
            case "released" | "lost" | "expired":
                span = self._let_go(lease_id, event, at_ns)
            case "verified":
                span = self._verdict(lease_id, event, at_ns)
            case "resized" if lease_id in self._growths:
                span = self._end_acquire(self._growths[lease_id], at_ns)
            case kind if kind in _STEPS:
                span = self._step(lease_id, _STEPS[kind], event, at_ns)
        return _named_by(event) if span is None else _ids(span)

    def close(self) -> None:
        """The daemon ends. Its leases go on; their spans are exported as far as they came."""
        now_ns = self._wall_ns()
        for lease_id in list(self._acquires):
            self._acquires[lease_id].span.add_event(names.EVENT_DAEMON_STOPPED, timestamp=now_ns)
            self._end_acquire(lease_id, now_ns)
        for lease_id in list(self._leaving):
            self._end_leaving(lease_id, now_ns, names.EVENT_DAEMON_STOPPED)

    # -- asking and getting
    def _queued(self, lease_id: str, event: Event, at_ns: int) -> trace.Span:
        acquire = self._acquire(lease_id, event["consumer"], event.get("traceparent"), at_ns)
        if (grows := event.get("grows")) is not None:
            acquire.grows = grows
            self._growths[grows] = lease_id
        if acquire.queue is None:
            acquire.queue = self._child(names.SPAN_QUEUE, acquire.span, at_ns)
        acquire.queue.set_attribute(names.ATTR_REASON, str(event["reason"])[:REASON_CHARS])
        return acquire.span

    def _granted(self, lease_id: str, event: Event, at_ns: int) -> trace.Span:
        waited_ns = int(event["waited_ms"] * 1e6)
        acquire = self._acquires.get(lease_id)
        if acquire is None:
            acquire = self._acquire(
                lease_id,
                event["consumer"],
                event.get("traceparent"),
                at_ns - waited_ns,
                by_itself=bool(event.get("by_itself")),
            )
        if acquire.queue is None and waited_ns > 0:
            acquire.queue = self._child(names.SPAN_QUEUE, acquire.span, acquire.started_ns)
        if acquire.queue is not None:
            _end(acquire.queue, at_ns)
            acquire.queue = None
        where = {
            names.ATTR_GPU: str(event["gpu"]),
            names.ATTR_REASON: str(event["reason"])[:REASON_CHARS],
        }
        acquire.span.set_attributes(where)
        acquire.load = self._child(
            names.SPAN_LOAD, acquire.span, at_ns, _bytes(event, "charge_bytes")
        )
        handover_s = None
        if acquire.asked_ns is not None and event.get("evicted"):
            handover_s = max(0, at_ns - acquire.asked_ns) / 1e9
        context = trace.set_span_in_context(acquire.span, Context())
        self._counts.granted(event["consumer"], waited_ns / 1e9, handover_s, context)
        return acquire.span

    def _acquire(
        self,
        lease_id: str,
        consumer: str,
        traceparent: str | None,
        at_ns: int,
        *,
        by_itself: bool = False,
    ) -> _Acquire:
        """The open acquire, or a new one. One that comes back by itself does so long after its
        acquirer's trace: it only points there."""
        if (found := self._acquires.get(lease_id)) is not None:
            return found
        parent = _W3C.extract({"traceparent": traceparent}, Context()) if traceparent else Context()
        links: list[trace.Link] = []
        if by_itself:
            links, parent = _links(parent), Context()
        span = self._tracer.start_span(
            names.SPAN_ACQUIRE,
            context=parent,
            kind=trace.SpanKind.SERVER,
            links=links,
            start_time=at_ns,
            attributes={names.ATTR_LEASE: lease_id, names.ATTR_CONSUMER: consumer},
        )
        while len(self._acquires) >= OPEN_MAX:
            self._end_acquire(next(iter(self._acquires)), at_ns, failed="too many spans are open")
        made = self._acquires[lease_id] = _Acquire(consumer, span, at_ns)
        return made

    def _end_acquire(
        self,
        lease_id: str,
        at_ns: int,
        *,
        failed: str = "",
        attributes: Mapping[str, int] | None = None,
    ) -> trace.Span | None:
        acquire = self._acquires.pop(lease_id, None)
        if acquire is None:
            return None  # granted before the daemon started, or never asked for here
        if acquire.grows and self._growths.get(acquire.grows) == lease_id:
            del self._growths[acquire.grows]
        for child in (acquire.queue, acquire.load):
            if child is not None:
                child.set_attributes(attributes or {})
                _end(child, at_ns, failed)
        _end(acquire.span, at_ns, failed)
        return acquire.span

    # -- leaving
    def _begin_evict(self, asked: Event, traceparent: str | None, at_ns: int) -> None:
        """`asked`: the note `revoke_asked`. It belongs to the request's trace; under pressure it is
        a trace of its own."""
        lease_id, wanted_by = asked["lease_id"], asked["wanted_by_lease"]
        parent = Context()
        if wanted_by is not None:
            acquire = self._acquire(wanted_by, asked["wanted_by"], traceparent, at_ns)
            acquire.asked_ns = acquire.asked_ns or at_ns
            parent = trace.set_span_in_context(acquire.span, parent)
        span = self._tracer.start_span(
            names.SPAN_EVICT,
            context=parent,
            start_time=at_ns,
            attributes={
                names.ATTR_LEASE: lease_id,
                names.ATTR_CONSUMER: asked["consumer"],
                names.ATTR_GPU: str(asked["gpu"]),
                names.ATTR_WANTED_BY: asked["wanted_by"],
                names.ATTR_REASON: str(asked["cause"]),
            },
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

    def _step(self, lease_id: str, name: str, event: Event, at_ns: int) -> trace.Span | None:
        leaving = self._leaving.get(lease_id)
        if leaving is None or leaving.evict is None:
            return None
        facts = {
            key: event[key]
            for key in ("uses", "signal", "safe_point_eta_s")
            if event.get(key) is not None
        }
        leaving.evict.add_event(name, facts, at_ns)
        return leaving.evict

    def _let_go(self, lease_id: str, event: Event, at_ns: int) -> trace.Span | None:
        """Its bytes are looked for from now on; one that was away has none."""
        before = "" if event["kind"] == "released" else f"{event['kind']}: {event['reason']}"
        acquire = self._end_acquire(
            lease_id, at_ns, failed=before or "released before it was ready"
        )
        if event["gpu"] is None:
            return acquire
        leaving = self._leave(lease_id, at_ns)
        if leaving.evict is not None and before:
            leaving.evict.set_status(trace.Status(trace.StatusCode.ERROR, before))
        return self._verifying(leaving, event, at_ns)

    def _verifying(self, leaving: _Leaving, event: Event, at_ns: int) -> trace.Span:
        if leaving.verify is None:
            links: list[trace.Link] = []
            parent = Context()
            if leaving.evict is not None:
                parent = trace.set_span_in_context(leaving.evict, parent)
            elif traceparent := event.get(
                "traceparent"
            ):  # came back by itself: not part of its acquirer's trace
                links = _links(_W3C.extract({"traceparent": traceparent}, Context()))
            leaving.verify = self._tracer.start_span(
                names.SPAN_VERIFY,
                context=parent,
                links=links,
                start_time=at_ns,
                attributes={
                    names.ATTR_LEASE: event["lease_id"],
                    names.ATTR_CONSUMER: event["consumer"],
                    names.ATTR_GPU: str(event["gpu"]),
                },
            )
        return leaving.verify

    def _verdict(self, lease_id: str, event: Event, at_ns: int) -> trace.Span:
        leaving = self._leave(lease_id, at_ns)
        verify = self._verifying(leaving, event, at_ns - int(event["ms"] * 1e6))
        verdict = str(event["verdict"])
        if not event["resolved"]:
            verify.add_event(names.EVENT_VERDICT, {names.ATTR_VERDICT: verdict}, at_ns)
            return verify
        found = {names.ATTR_VERDICT: verdict, **_bytes(event, "residue_bytes")}
        for key, name in (
            ("before_bytes", names.ATTR_BYTES_BEFORE),
            ("after_bytes", names.ATTR_BYTES_AFTER),
        ):
            if event[key] is not None:
                found[name] = event[key]
        verify.set_attributes(found)
        if verdict not in _GOOD_VERDICTS:
            verify.set_status(trace.Status(trace.StatusCode.ERROR, verdict))
        if leaving.evict is not None:
            leaving.evict.set_attribute(names.ATTR_VERDICT, verdict)
            self._counts.evicted(verdict)
        self._end_leaving(lease_id, at_ns)
        return verify

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
        return self._tracer.start_span(
            name, context=context, start_time=at_ns, attributes=attributes
        )


def _end(span: trace.Span, at_ns: int, failed: str = "") -> None:
    """The wall clock may be set back meanwhile: nothing ends before it began."""
    if failed:
        span.set_status(trace.Status(trace.StatusCode.ERROR, failed[:REASON_CHARS]))
    span.end(max(at_ns, getattr(span, "start_time", None) or 0))


def _refuses_a_lease(refusal: Refusal) -> bool:
    """Of what is refused at once, what is the refusal of a lease."""
    if isinstance(refusal, LimitReached):
        return refusal.limit in ("waiters_max", "leases_per_client_max")
    return refusal.code in ("vram_insufficient", "load_failing", "unknown_gpu")


def _bytes(event: Event, key: str) -> dict[str, Any]:
    return {} if event.get(key) is None else {names.ATTR_BYTES: event[key]}


def _links(context: Context) -> list[trace.Link]:
    earlier = trace.get_current_span(context).get_span_context()
    return [trace.Link(earlier)] if earlier.is_valid else []


def _ids(span: trace.Span) -> Mapping[str, str]:
    context = span.get_span_context()
    if not context.is_valid:
        return _NONE  # only metrics are on, and no trace was named
    return {"trace_id": f"{context.trace_id:032x}", "span_id": f"{context.span_id:016x}"}


def _named_by(event: Event) -> Mapping[str, str]:
    """The acquirer's own span, as it was told us."""
    traceparent = event.get("traceparent")
    if traceparent is None:
        return _NONE
    return _ids(trace.get_current_span(_W3C.extract({"traceparent": traceparent}, Context())))
