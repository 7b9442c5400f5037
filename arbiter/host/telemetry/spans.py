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

from opentelemetry import trace
from opentelemetry.context import Context

from vram_arbiter.arbiter.core import effects as fx
from vram_arbiter.arbiter.core.effects import Note
from vram_arbiter.arbiter.host.telemetry.facts import (
    REASON_CHARS,
    bytes_attribute,
    context_of,
    end_span,
    ids_of,
    labels_of,
    links_to,
    named_by,
    refuses_a_lease,
    traceparent_of,
)
from vram_arbiter.arbiter.host.telemetry.metrics import LeaseMetrics
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.telemetry import names
from vram_arbiter.schemas.wire.notes import (
    About,
    AnyNote,
    CancelledNote,
    DeadlinePassedNote,
    DeniedNote,
    ExpiredNote,
    GrantedNote,
    LostNote,
    OomNote,
    QueuedNote,
    ReadyNote,
    ReleasedNote,
    RemindedNote,
    RevokeAckedNote,
    RevokeAskedNote,
    RevokeWithdrawnNote,
    SignalledNote,
    UnloadingNote,
    VerifiedNote,
)
from vram_arbiter.schemas.wire.pushes import AnyPush, RevokePush

OPEN_MAX = 32_768
"""Spans of acquires that are open at a time, and as many of evictions: twice the waiters that the
default limits allow. The oldest is ended when one more begins."""

_NONE: Mapping[str, str] = {}
_STEPS: Mapping[type, str] = {
    RevokeAckedNote: names.EVENT_REVOKE_ACKED,
    RemindedNote: names.EVENT_REMINDED,
    DeadlinePassedNote: names.EVENT_DEADLINE_PASSED,
    SignalledNote: names.EVENT_SIGNALLED,
    UnloadingNote: names.EVENT_UNLOADING,
}
_GOOD_VERDICTS = frozenset({"verified", "residue"})


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
        self, tracer: trace.Tracer, counts: LeaseMetrics, wall_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._tracer = tracer
        self._counts = counts
        self._wall_ns = wall_ns
        self._acquires: OrderedDict[str, _Acquire] = OrderedDict()
        self._leaving: OrderedDict[str, _Leaving] = OrderedDict()

    # -- what the core wants done
    def outgoing(self, effects: Sequence[fx.Effect]) -> None:
        """Begin the spans of evictions before a revoke is sent, and count refusals, which history
        leaves out."""
        asked: dict[str, tuple[About, RevokeAskedNote]] = {}
        told: list[str] = []
        for effect in effects:
            if isinstance(effect, Note):
                match effect.body:
                    case RevokeAskedNote() as body if effect.about is not None:
                        asked[str(effect.about.lease_id)] = effect.about, body
                    case DeniedNote(refusal):
                        told.append(refusal.code)  # counted with its event
        for effect in effects:
            match effect:
                case fx.Push(_, RevokePush() as push) if push.lease_id in asked:
                    traceparent = push.traceparent or None
                    self._begin_evict(*asked.pop(push.lease_id), traceparent, self._wall_ns())
                case fx.Refuse(_, _, refusal):
                    self._counts.refused(refusal.code)
                    if refusal.code in told:
                        told.remove(refusal.code)
                    elif refuses_a_lease(refusal):
                        self._counts.denied(refusal.code)

    def revoke(self, body: AnyPush) -> AnyPush:
        """A push on its way out; a `revoke` names its own span, so that the holder's unloading
        becomes its child."""
        if not isinstance(body, RevokePush):
            return body
        leaving = self._leaving.get(body.lease_id)
        if leaving is None or leaving.evict is None:
            return body
        return replace(body, traceparent=traceparent_of(leaving.evict) or body.traceparent)

    def wrote(self, seconds: float, *, failed: bool) -> None:
        """One transaction of the journal."""
        self._counts.wrote(seconds, failed=failed)

    # -- what has happened
    def observe(self, note: Note, event: JsonMap) -> Mapping[str, str]:
        """One note and its event in the history. Returns `trace_id` and `span_id` of what it
        belongs to, for its line of the log."""
        about = note.about
        if isinstance(note.body, VerifiedNote):  # of a dead process without a lease too
            self._counts.judged(note.body.verdict)
        if about is None or about.lease_id is None:
            return _NONE
        lease_id, at_ns, reason = about.lease_id, int(event["at_wall_s"] * 1e9), event.get("reason")
        span: trace.Span | None = None
        match note.body:
            case QueuedNote() as queued:
                span = self._queued(about, queued, str(reason), at_ns)
            case GrantedNote() as granted:
                span = self._granted(about, granted, str(reason), at_ns)
            case ReadyNote(measured_bytes=measured):
                span = self._end_acquire(lease_id, at_ns, attributes=bytes_attribute(measured))
            case DeniedNote(refusal):
                self._counts.denied(refusal.code)
                span = self._end_acquire(lease_id, at_ns, failed=f"{refusal.code}: {reason}")
            case CancelledNote():
                span = self._end_acquire(lease_id, at_ns, failed=f"cancelled: {reason}")
            case RevokeAskedNote():
                leaving = self._leaving.get(lease_id)
                span = None if leaving is None else leaving.evict
            case RevokeWithdrawnNote():
                leaving = self._leaving.get(lease_id)
                span = None if leaving is None else leaving.evict
                self._end_leaving(lease_id, at_ns, names.EVENT_REVOKE_WITHDRAWN)
            case ReleasedNote():
                span = self._let_go(about, "", at_ns)
            case LostNote() | ExpiredNote():
                self._counts.lost(f"lease_{note.kind}")
                span = self._let_go(about, f"{note.kind}: {reason}", at_ns)
            case OomNote():
                self._counts.out_of_memory()
            case VerifiedNote() as verdict:
                span = self._verdict(about, verdict, at_ns)
            case body if type(body) in _STEPS:
                span = self._step(lease_id, _STEPS[type(body)], body, at_ns)
        return named_by(about) if span is None else ids_of(span)

    def close(self) -> None:
        """The daemon ends. Its leases go on; their spans are exported as far as they came."""
        now_ns = self._wall_ns()
        for lease_id in list(self._acquires):
            self._acquires[lease_id].span.add_event(names.EVENT_DAEMON_STOPPED, timestamp=now_ns)
            self._end_acquire(lease_id, now_ns)
        for lease_id in list(self._leaving):
            self._end_leaving(lease_id, now_ns, names.EVENT_DAEMON_STOPPED)

    # -- asking and getting
    def _queued(self, about: About, queued: QueuedNote, reason: str, at_ns: int) -> trace.Span:
        lease_id = str(about.lease_id)
        acquire = self._acquire(lease_id, about.consumer, about.traceparent, at_ns)
        if acquire.queue is None:
            acquire.queue = self._child(names.SPAN_QUEUE, acquire.span, at_ns)
        acquire.queue.set_attribute(names.ATTR_REASON, reason[:REASON_CHARS])
        return acquire.span

    def _granted(self, about: About, granted: GrantedNote, reason: str, at_ns: int) -> trace.Span:
        waited_ns = int(granted.waited_ms * 1e6)
        acquire = self._acquire(
            str(about.lease_id),
            about.consumer,
            about.traceparent,
            at_ns - waited_ns,
            by_itself=granted.by_itself,
        )
        if acquire.queue is None and waited_ns > 0:
            acquire.queue = self._child(names.SPAN_QUEUE, acquire.span, acquire.started_ns)
        if acquire.queue is not None:
            end_span(acquire.queue, at_ns)
            acquire.queue = None
        where = {
            names.ATTR_GPU: str(about.gpu),
            names.ATTR_REASON: reason[:REASON_CHARS],
        }
        acquire.span.set_attributes(where)
        size = bytes_attribute(granted.charge_bytes)
        acquire.load = self._child(names.SPAN_LOAD, acquire.span, at_ns, size)
        handover_s = None
        if acquire.asked_ns is not None and granted.evicted:
            handover_s = max(0, at_ns - acquire.asked_ns) / 1e9
        context = trace.set_span_in_context(acquire.span, Context())
        self._counts.granted(about.consumer, waited_ns / 1e9, handover_s, context)
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
        asked = context_of(traceparent)
        parent, links = (Context(), links_to(asked)) if by_itself else (asked, ())
        labels = {names.ATTR_LEASE: lease_id, names.ATTR_CONSUMER: consumer}
        kind = trace.SpanKind.SERVER
        span = self._tracer.start_span(
            names.SPAN_ACQUIRE, parent, kind, labels, links=links, start_time=at_ns
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
        for child in (acquire.queue, acquire.load):
            if child is not None:
                child.set_attributes(attributes or {})
                end_span(child, at_ns, failed)
        end_span(acquire.span, at_ns, failed)
        return acquire.span

    # -- leaving
    def _begin_evict(
        self, about: About, asked: RevokeAskedNote, traceparent: str | None, at_ns: int
    ) -> None:
        """It belongs to the request's trace; under pressure it is a trace of its own."""
        lease_id, wanted_by = str(about.lease_id), asked.wanted_by_lease
        parent = Context()
        if wanted_by is not None:
            acquire = self._acquire(wanted_by, asked.wanted_by, traceparent, at_ns)
            acquire.asked_ns = acquire.asked_ns or at_ns
            parent = trace.set_span_in_context(acquire.span, parent)
        why = {names.ATTR_WANTED_BY: asked.wanted_by, names.ATTR_REASON: asked.cause}
        span = self._tracer.start_span(
            names.SPAN_EVICT, parent, attributes=labels_of(about) | why, start_time=at_ns
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

    def _step(self, lease_id: str, name: str, body: AnyNote, at_ns: int) -> trace.Span | None:
        leaving = self._leaving.get(lease_id)
        if leaving is None or leaving.evict is None:
            return None
        facts = {
            key: value
            for key in ("uses", "signal", "safe_point_eta_s")
            if (value := getattr(body, key, None)) is not None
        }
        leaving.evict.add_event(name, facts, at_ns)
        return leaving.evict

    def _let_go(self, about: About, failed: str, at_ns: int) -> trace.Span | None:
        """Its bytes are looked for from now on; one that was away has none. `failed`: it did not
        release them."""
        lease_id = str(about.lease_id)
        early = failed or "released before it was ready"
        acquire = self._end_acquire(lease_id, at_ns, failed=early)
        if about.gpu is None:
            return acquire
        leaving = self._leave(lease_id, at_ns)
        if leaving.evict is not None and failed:
            leaving.evict.set_status(trace.Status(trace.StatusCode.ERROR, failed))
        return self._verifying(leaving, about, at_ns)

    def _verifying(self, leaving: _Leaving, about: About, at_ns: int) -> trace.Span:
        if leaving.verify is None:
            parent, links = Context(), links_to(context_of(about.traceparent))
            # a lease that left by itself is not part of its acquirer's trace
            if leaving.evict is not None:
                parent, links = trace.set_span_in_context(leaving.evict, parent), ()
            leaving.verify = self._tracer.start_span(
                names.SPAN_VERIFY,
                parent,
                attributes=labels_of(about),
                links=links,
                start_time=at_ns,
            )
        return leaving.verify

    def _verdict(self, about: About, found: VerifiedNote, at_ns: int) -> trace.Span:
        lease_id = str(about.lease_id)
        leaving = self._leave(lease_id, at_ns)
        verify = self._verifying(leaving, about, at_ns - int(found.ms * 1e6))
        verdict = {names.ATTR_VERDICT: found.verdict}
        if not found.resolved:
            verify.add_event(names.EVENT_VERDICT, verdict, at_ns)
            return verify
        sizes = {
            names.ATTR_BYTES: found.residue_bytes,
            names.ATTR_BYTES_BEFORE: found.before_bytes,
            names.ATTR_BYTES_AFTER: found.after_bytes,
        }
        verify.set_attributes(verdict)
        verify.set_attributes({key: count for key, count in sizes.items() if count is not None})
        if found.verdict not in _GOOD_VERDICTS:
            verify.set_status(trace.Status(trace.StatusCode.ERROR, found.verdict))
        if leaving.evict is not None:
            leaving.evict.set_attribute(names.ATTR_VERDICT, found.verdict)
            self._counts.evicted(found.verdict)
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
                end_span(span, at_ns)

    def _child(
        self, name: str, parent: trace.Span, at_ns: int, attributes: Mapping[str, int] | None = None
    ) -> trace.Span:
        context = trace.set_span_in_context(parent, Context())
        return self._tracer.start_span(
            name, context=context, start_time=at_ns, attributes=attributes
        )
