"""Performs effects, in order: one match over all of them. Slow ones (samples) end by posting an
event.

Runs on the thread of the event loop and never blocks, except for journal writes (a local SQLite
commit without fsync, tens of microseconds). Must not decide anything; sockets, files and threads
are behind the protocols below. Mints the ids of the daemon's spans (`SpanIds`).
"""

import logging
import random
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from vram_arbiter.arbiter.core import effects as fx
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import JournalUnavailable
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.telemetry.traceparent import read as read_traceparent
from vram_arbiter.schemas.wire import notes
from vram_arbiter.schemas.wire.errors import ErrorView, Refusal
from vram_arbiter.schemas.wire.pushes import AnyPush, RevokePush
from vram_arbiter.schemas.wire.replies import AnyReply

log = logging.getLogger(__name__)

_RECORDS = (fx.JournalPut, fx.JournalDelete)
_NOTHING: Mapping[str, JournalUnavailable] = {}

OPEN_MAX = 32_768
"""Waits that are open at a time, and as many evictions: twice the waiters that the default limits
allow. The oldest is forgotten when one more begins."""
_TRACE_BITS, _SPAN_BITS = 128, 64
_NO_SPAN: Mapping[str, str] = {}


class Outbox(Protocol):
    """The way to the clients (`rpc.session.SessionTable`)."""

    def reply(self, client: ClientId, request: RequestId, body: AnyReply) -> None: ...

    def refuse(self, client: ClientId, request: RequestId, error: ErrorView) -> None: ...

    def push(self, client: ClientId, body: AnyPush) -> None: ...

    def broadcast(self, event: JsonMap) -> None: ...


class Records(Protocol):
    """The journal. `apply` writes all changes or none; None deletes. Raises JournalUnavailable."""

    def apply(self, changes: Sequence[tuple[str, JsonMap | None]]) -> None: ...


class Chronicle(Protocol):
    """The history: gives a fact its number and time, and keeps it."""

    def append(self, kind: str, data: JsonMap) -> JsonMap: ...


@dataclass(frozen=True, slots=True)
class SpanId:
    """One span in hexadecimal. `flags`: sampled (01) or not, as its trace began."""

    trace: str
    span: str
    parent: str = ""
    flags: str = "01"

    @property
    def traceparent(self) -> str:
        return f"00-{self.trace}-{self.span}-{self.flags}"


class SpanIds:
    """Ids of the daemon's spans. They are minted here and exported by an observer.

    A wait (from the request to `ready`) and an eviction (from the first `revoke` to the verdict)
    are a span each. Its ids are random numbers that are sent in the events about it, and an
    eviction's in `revoke`: a holder's unload is a child of its eviction, with or without an
    observer. No decision reads them; of the effects they change the `traceparent` of a `revoke`.

    `outgoing` before a batch is performed, `revoke` for each push of it, `of` for each note.
    """

    def __init__(self) -> None:
        self._waits: dict[LeaseId, SpanId] = {}
        self._evictions: dict[LeaseId, SpanId] = {}

    def outgoing(self, effects: Sequence[fx.Effect]) -> None:
        """Mint the ids of evictions before their `revoke` is sent."""
        asked = {
            effect.about.lease_id: effect.body
            for effect in effects
            if isinstance(effect, fx.Note)
            and isinstance(effect.body, notes.RevokeAskedNote)
            and effect.about is not None
        }
        for effect in effects if asked else ():
            match effect:
                case fx.Push(_, RevokePush(lease_id=holder) as push) if LeaseId(holder) in asked:
                    waiter = asked.pop(LeaseId(holder)).wanted_by_lease
                    self._begin_eviction(LeaseId(holder), waiter, push.traceparent or None)

    def revoke(self, body: AnyPush) -> AnyPush:
        """Return a push as it is sent: a `revoke` names the span of its eviction."""
        if not isinstance(body, RevokePush):
            return body
        eviction = self._evictions.get(LeaseId(body.lease_id))
        return body if eviction is None else replace(body, traceparent=eviction.traceparent)

    def of(self, note: fx.Note) -> Mapping[str, str]:
        """Return `trace_id`, `span_id`, and of a first `revoke` `parent_id`, for a note's event."""
        about = note.about
        if about is None or about.lease_id is None:
            return _NO_SPAN
        lease, found = about.lease_id, None
        match note.body:
            case notes.QueuedNote():
                found = self._wait(lease, about.traceparent)
            case notes.GrantedNote(by_itself=by_itself):
                found = self._wait(lease, None if by_itself else about.traceparent)
            case notes.ReadyNote() | notes.DeniedNote() | notes.CancelledNote():
                found = self._waits.pop(lease, None)
            case notes.ReleasedNote() | notes.LostNote() | notes.ExpiredNote():
                found = self._left(about, lease)
            case notes.RevokeWithdrawnNote() | notes.VerifiedNote(resolved=True):
                found = self._evictions.pop(lease, None)
            case _:
                found = self._evictions.get(lease)
        return _NO_SPAN if found is None else _fields(found, note)

    def _left(self, about: notes.About, lease: LeaseId) -> SpanId | None:
        """A lease gives its bytes up, or had none."""
        wait = self._waits.pop(lease, None)
        return self._evictions.get(lease) if about.gpu is not None else wait

    def _begin_eviction(
        self, holder: LeaseId, waiter: LeaseId | None, traceparent: str | None
    ) -> None:
        """It belongs to the waiter's trace; under pressure it is a trace of its own."""
        if waiter is None:
            made = self._minted(None)
        else:
            above = self._wait(waiter, traceparent)
            made = replace(above, span=_hex(_SPAN_BITS), parent=above.span)
        self._evictions.pop(holder, None)
        _keep(self._evictions, holder, made)

    def _wait(self, lease: LeaseId, traceparent: str | None) -> SpanId:
        if (found := self._waits.get(lease)) is None:
            found = self._minted(traceparent)
            _keep(self._waits, lease, found)
        return found

    def _minted(self, traceparent: str | None) -> SpanId:
        """Return a child of a W3C traceparent, else the first span of a trace."""
        span, given = _hex(_SPAN_BITS), read_traceparent(traceparent)
        if given is None:
            return SpanId(_hex(_TRACE_BITS), span)
        _, trace, parent, flags = given.split("-")
        return SpanId(trace, span, parent, flags)


def _hex(bits: int) -> str:
    """A random number, as OpenTelemetry's own generator makes it; zero means "no id" there."""
    return f"{random.getrandbits(bits) or 1:0{bits // 4}x}"


def _keep(spans: dict[LeaseId, SpanId], lease: LeaseId, made: SpanId) -> None:
    while len(spans) >= OPEN_MAX:
        del spans[next(iter(spans))]
    spans[lease] = made


def _fields(found: SpanId, note: fx.Note) -> Mapping[str, str]:
    ids = {"trace_id": found.trace, "span_id": found.span}
    if found.parent and isinstance(note.body, notes.RevokeAskedNote):
        ids["parent_id"] = found.parent
    if found.flags != "01":
        ids["trace_flags"] = found.flags
    return ids


@dataclass(slots=True)
class Writes:
    """Transactions of the journal since the start."""

    count: int = 0
    failures: int = 0
    seconds: float = 0.0


class Words(Protocol):
    """What the engine's codes are in words (`rpc.words`)."""

    def error_view(self, refusal: Refusal) -> ErrorView: ...

    def event(self, note: fx.Note) -> JsonMap: ...


class Executor:
    """`perform` is called by the inbox with the effects of one event."""

    def __init__(
        self,
        outbox: Outbox,
        journal: Records,
        history: Chronicle,
        sample: Callable[[GpuId], None],
        post: Callable[[ev.Event], None],
        log_event: Callable[[JsonMap], None],
        signal: Callable[[ProcessKey, str], None],
        words: Words,
    ) -> None:
        self._outbox = outbox
        self._journal = journal
        self._history = history
        self._sample = sample
        self._post = post
        self._log_event = log_event
        self._signal = signal
        self._words = words
        self._spans = SpanIds()
        self.writes = Writes()
        self.owed: dict[str, None] = {}
        """Records still to be deleted: the disk was full when they ended. The next write
        does it."""

    def perform(self, effects: Sequence[fx.Effect]) -> None:
        """One batch. Its records are written first, all in one transaction, so a grant is on disk
        before its holder hears of it. If that fails, what the batch says about a lease after it was
        granted is not said (the waiting request is refused instead).

        Answers go out first: facts are written down after all answers, and readings are begun last
        of all, since their thread takes the interpreter from this one.
        """
        self._spans.outgoing(effects)
        some: Iterable[fx.Effect] = effects
        records = [effect for effect in effects if isinstance(effect, _RECORDS)]
        if records and (failed := self._write(records)):
            some = self._without(failed, effects)
        facts: list[fx.Note] = []
        samples: list[fx.Sample] = []
        for effect in some:
            match effect:
                case fx.Note():
                    facts.append(effect)
                case fx.Reply():
                    self._outbox.reply(effect.client, effect.request, effect.body)
                case fx.Push(body=body):
                    self._outbox.push(effect.client, self._spans.revoke(body))
                case fx.Sample():
                    samples.append(effect)
                case fx.Refuse(refusal=refusal):
                    error = self._words.error_view(refusal)
                    self._outbox.refuse(effect.client, effect.request, error)
                case fx.Signal():
                    self._signal(effect.process, effect.kind)
        for note in facts:
            told = {**self._words.event(note), **self._spans.of(note)}
            event = self._history.append(note.body.TAG[1], told)
            self._log_event(event)
            self._outbox.broadcast(event)
        for sample in samples:
            self._sample(sample.gpu)

    def _without(
        self, failed: Mapping[str, JournalUnavailable], effects: Sequence[fx.Effect]
    ) -> Iterator[fx.Effect]:
        """Yield what may be said although grants could not be written. A reply that says more is
        refused in its place."""
        refused: dict[str, JournalUnavailable] = {}  # lease id → why
        for effect in effects:
            if isinstance(effect, fx.JournalPut) and effect.key in failed:
                refused[effect.key.removeprefix("lease:")] = failed[effect.key]
            if (why := refused.get(_lease_of(effect) or "")) is None:
                yield effect
            elif isinstance(effect, fx.Reply):
                self._outbox.refuse(effect.client, effect.request, why.view())

    def settle(self) -> None:
        """Try again to delete what could not be deleted, if anything is left of that."""
        if self.owed:
            self._write(())

    def _write(
        self, records: Sequence[fx.JournalPut | fx.JournalDelete]
    ) -> Mapping[str, JournalUnavailable]:
        """Write records, and delete what is owed. Keys of grants that could not be written, with
        the reason."""
        changes: list[tuple[str, JsonMap | None]] = [
            (e.key, to_map(e.record) if isinstance(e, fx.JournalPut) else None) for e in records
        ]
        if self.owed:
            named = {key for key, _ in changes}
            changes = [*((key, None) for key in self.owed if key not in named), *changes]
        began, failure = time.monotonic(), None
        try:
            self._journal.apply(changes)
        except JournalUnavailable as error:
            failure = error
        self.writes.count += 1
        self.writes.seconds += time.monotonic() - began
        self.writes.failures += failure is not None
        if failure is None:
            self.owed.clear()
            return _NOTHING
        log.error("journal: %s", failure)
        failed: dict[str, JournalUnavailable] = {}
        gates = {e.key for e in records if isinstance(e, fx.JournalPut) and e.gates}
        for key, record in changes:
            if record is None:
                self.owed[key] = None
                continue
            self.owed.pop(key, None)
            if key in gates:
                failed[key] = failure
            self._post(ev.JournalFailed(key, failure.message, key in gates))
        return failed


def _lease_of(effect: fx.Effect) -> str | None:
    """The lease that an effect is about, if any."""
    match effect:
        case fx.Reply(_, _, body) | fx.Push(_, body):
            lease = getattr(body, "lease", None)
            found = getattr(body, "lease_id", None) if lease is None else lease.lease_id
        case fx.Note(_, about):
            found = None if about is None else about.lease_id
        case _:
            return None
    return found if isinstance(found, str) else None
