"""Everything that the core can ask of the world, as imperatives. Performed in order by
`host.executor`. Plain values only."""

from dataclasses import dataclass
from typing import Literal

from vram_arbiter.arbiter.core.model.records import AnyRecord
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey, RequestId
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.notes import About, AnyNote
from vram_arbiter.schemas.wire.pushes import AnyPush
from vram_arbiter.schemas.wire.replies import AnyReply


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer a request."""

    client: ClientId
    request: RequestId
    body: AnyReply


@dataclass(frozen=True, slots=True)
class Refuse:
    """Answer a request with a typed error."""

    client: ClientId
    request: RequestId
    refusal: Refusal


@dataclass(frozen=True, slots=True)
class Push:
    """Send a push. A client that is away gets nothing: the lease's TTL and reattachment
    cover that."""

    client: ClientId
    body: AnyPush


@dataclass(frozen=True, slots=True)
class JournalPut:
    """Write a record durably *before* any later effect of the same batch. Failure posts
    JournalFailed(key); where the record `gates` what follows (a grant), the rest of the batch that
    names the same key's lease is dropped.
    """

    key: str
    record: AnyRecord
    gates: bool = False


@dataclass(frozen=True, slots=True)
class JournalDelete:
    key: str


@dataclass(frozen=True, slots=True)
class Sample:
    """Read a GPU now; posts MemorySampled or ProbeFailed. A second Sample while one is under way
    is merged into a fresh one after it."""

    gpu: GpuId


@dataclass(frozen=True, slots=True)
class Note:
    """A fact for history, subscribers, telemetry and the log, and the lease that it is about."""

    body: AnyNote
    about: About | None = None

    @property
    def kind(self) -> str:
        """The kind of its event."""
        kind: str = self.body.TAG[1]
        return kind


@dataclass(frozen=True, slots=True)
class Signal:
    """Send a signal to a process, by an operator's order, by the descriptor that its start was
    checked with. One that is gone already is fine: its death is told as an event."""

    process: ProcessKey
    kind: Literal["term", "kill"]


Effect = Reply | Refuse | Push | JournalPut | JournalDelete | Sample | Signal | Note
