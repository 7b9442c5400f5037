"""Performs effects, in order: one match over all of them. Slow ones (samples) end by posting an
event.

Runs on the thread of the event loop and never blocks, except for journal writes (a local SQLite
commit without fsync, tens of microseconds). Must not decide anything; sockets, files and threads
are behind the protocols below.
"""

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from vram_arbiter.arbiter.core import effects as fx
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.host.span_ids import SpanIds
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import JournalUnavailable
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey, RequestId
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.errors import ErrorView, Refusal
from vram_arbiter.schemas.wire.pushes import AnyPush
from vram_arbiter.schemas.wire.replies import AnyReply

log = logging.getLogger(__name__)

_RECORDS = (fx.JournalPut, fx.JournalDelete)
_NOTHING: Mapping[str, JournalUnavailable] = {}


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
        notes: list[fx.Note] = []
        samples: list[fx.Sample] = []
        for effect in some:
            match effect:
                case fx.Note():
                    notes.append(effect)
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
        for note in notes:
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
