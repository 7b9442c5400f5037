"""Ids of the daemon's spans. They are minted here and exported by an observer.

A wait (from the request to `ready`) and an eviction (from the first `revoke` to the verdict) are a
span each. Its ids are random numbers that are sent in the events about it, and an eviction's in
`revoke`: so a holder's unload is a child of its eviction, whether or not somebody exports that one.
Must not decide anything, nor change an effect but for the `traceparent` of a `revoke`.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from vram_arbiter.arbiter.core import effects as fx
from vram_arbiter.arbiter.core.effects import Note
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.runtime.telemetry.traceparent import read as read_traceparent
from vram_arbiter.schemas.wire import notes
from vram_arbiter.schemas.wire.notes import About, RevokeAskedNote
from vram_arbiter.schemas.wire.pushes import AnyPush, RevokePush

OPEN_MAX = 32_768
"""Waits that are open at a time, and as many evictions: twice the waiters that the default limits
allow. The oldest is forgotten when one more begins."""
_TRACE_BYTES, _SPAN_BYTES = 16, 8
_NONE: Mapping[str, str] = {}


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
    """`outgoing` before a batch is performed, `revoke` for each push of it, `of` for each note."""

    def __init__(self, random: Callable[[int], bytes] = os.urandom) -> None:
        self._random = random
        self._waits: dict[LeaseId, SpanId] = {}
        self._evictions: dict[LeaseId, SpanId] = {}

    def outgoing(self, effects: Sequence[fx.Effect]) -> None:
        """Mint the ids of evictions before their `revoke` is sent."""
        asked = {
            effect.about.lease_id: effect.body
            for effect in effects
            if isinstance(effect, Note)
            and isinstance(effect.body, RevokeAskedNote)
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

    def of(self, note: Note) -> Mapping[str, str]:
        """Return `trace_id`, `span_id`, and of a first `revoke` `parent_id`, for a note's event."""
        about = note.about
        if about is None or about.lease_id is None:
            return _NONE
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
        return _NONE if found is None else _fields(found, note)

    def _left(self, about: About, lease: LeaseId) -> SpanId | None:
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
            made = replace(above, span=self._hex(_SPAN_BYTES), parent=above.span)
        self._evictions.pop(holder, None)
        _keep(self._evictions, holder, made)

    def _wait(self, lease: LeaseId, traceparent: str | None) -> SpanId:
        if (found := self._waits.get(lease)) is None:
            found = self._minted(traceparent)
            _keep(self._waits, lease, found)
        return found

    def _minted(self, traceparent: str | None) -> SpanId:
        """Return a child of a W3C traceparent, else the first span of a trace."""
        span, given = self._hex(_SPAN_BYTES), read_traceparent(traceparent)
        if given is None:
            return SpanId(self._hex(_TRACE_BYTES), span)
        _, trace, parent, flags = given.split("-")
        return SpanId(trace, span, parent, flags)

    def _hex(self, count: int) -> str:
        return self._random(count).hex()


def _keep(spans: dict[LeaseId, SpanId], lease: LeaseId, made: SpanId) -> None:
    while len(spans) >= OPEN_MAX:
        del spans[next(iter(spans))]
    spans[lease] = made


def _fields(found: SpanId, note: Note) -> Mapping[str, str]:
    ids = {"trace_id": found.trace, "span_id": found.span}
    if found.parent and isinstance(note.body, RevokeAskedNote):
        ids["parent_id"] = found.parent
    if found.flags != "01":
        ids["trace_flags"] = found.flags
    return ids
