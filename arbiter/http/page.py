"""The status page as the daemon starts it: the parts joined, and its ear at the executor."""

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from vram_arbiter.arbiter.core.effects import Effect, Note
from vram_arbiter.arbiter.core.report.usage import GpuUsage
from vram_arbiter.arbiter.http.access import Access, read_token
from vram_arbiter.arbiter.http.feed import Feed, PageKey, Sources
from vram_arbiter.arbiter.http.server import History, HttpServer
from vram_arbiter.arbiter.http.usage_record import UsageRecord
from vram_arbiter.schemas.config.arbiter import HttpConfig
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.urls import HttpAddress, http_address
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import StatusReply

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DaemonParts:
    """What the page reads of the daemon. Replies are in words, and show no token."""

    status: Callable[[PageKey | None], StatusReply]
    leases: Callable[[Iterable[LeaseId]], StatusReply]
    why: Callable[[str], WhyReply]
    when_read: Callable[[Callable[[], None]], None]
    usage: Callable[[], Sequence[GpuUsage]]
    history: History
    last_seq: Callable[[], int]
    started_at: float  # of the engine's uptime
    server: str


class StatusPage:
    """`performed` after each batch of effects; `start` listens, `close` ends it."""

    def __init__(self, server: HttpServer, feed: Feed, record: UsageRecord) -> None:
        self._server = server
        self._feed = feed
        self._record = record

    @classmethod
    def open(cls, config: HttpConfig, parts: DaemonParts) -> Self:
        """Bind the address of a configuration that has one.

        Raises ConfigError for a token file that cannot be used or a port that is taken.
        """
        assert config.listen is not None
        token = None if config.token_file is None else read_token(Path(config.token_file))
        record = UsageRecord(parts.usage, parts.started_at)
        sources = Sources(
            parts.status,
            parts.leases,
            parts.why,
            parts.when_read,
            record.since,
            lambda: record.number,
            parts.history,
            parts.last_seq,
        )
        feed = Feed(sources)

        def access(address: HttpAddress) -> Access:
            return Access(address, config.hosts, token)

        server = HttpServer(http_address(config.listen), access, feed, parts.history, parts.server)
        return cls(server, feed, record)

    @property
    def address(self) -> HttpAddress:
        return self._server.address

    async def start(self) -> None:
        await self._server.start()

    def close(self) -> None:
        self._record.close()
        self._feed.close()
        self._server.close()

    def performed(self, effects: Sequence[Effect]) -> None:
        """Some effects were performed: what happened is shown at once, a reading with the next
        beat."""
        try:
            self._record.changed()
            notes = [effect for effect in effects if isinstance(effect, Note)]
            if notes and self._feed.read:
                about = [note.about.lease_id for note in notes if note.about is not None]
                self._feed.changed([lease for lease in about if lease is not None])
        except Exception:  # it runs between engine and inbox: a defect here must not stop these
            log.exception("http: the page is not kept up to date")
