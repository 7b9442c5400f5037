"""Session table with lists in the place of sockets and engine."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgpack

from tests.support.connections import KeptConnection, peer_of
from tests.support.messages import IDLE_STATUS, NO_EVENTS, no_reason
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.rpc.registry import SessionSettings
from vram_arbiter.arbiter.rpc.session import SessionTable
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import ClientId, ProcessKey
from vram_arbiter.schemas.runtime.peercred import Peer
from vram_arbiter.schemas.runtime.zmtp import Oversize
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import HistoryReply, StatusReply

ME = peer_of(os.getpid())


@dataclass
class Bench:
    """A session table with a list for a socket and a list for a core."""

    events: list[ev.Event] = field(default_factory=list)
    watched: list[ProcessKey] = field(default_factory=list)
    questions: list[tuple[int, int, tuple[str, ...]]] = field(default_factory=list)
    concerned: set[ClientId] = field(default_factory=set)
    connections: dict[bytes, KeptConnection] = field(default_factory=dict)
    now: float = 100.0
    watchable: bool = True
    next_id: int = 0
    serial: int = 0
    table: SessionTable = None  # type: ignore[assignment]  # made by `make`

    # Decisions
    def post(self, event: ev.Event) -> None:
        self.events.append(event)

    def when_read(self, answer: Callable[[], None]) -> None:
        answer()

    def status(
        self,
        reader: ProcessKey | None,
        after: tuple[int, float, int] | None = None,
        *,
        details: bool = False,
    ) -> StatusReply:
        self.asked_status = (reader, after)
        return IDLE_STATUS

    def why(self, consumer: str) -> WhyReply:
        return no_reason(consumer)

    def history(
        self,
        after: int,
        limit: int,
        kinds: tuple[str, ...],
        done: Callable[[HistoryReply], None],
        before: int | None,
    ) -> None:
        self.questions.append((after, limit, kinds))
        done(NO_EVENTS)

    def concerns(self, client: ClientId) -> bool:
        return client in self.concerned

    # Watch
    def take(self, process: ProcessKey, pidfd: int) -> bool:
        if not self.watchable:
            raise OSError(24, "Too many open files")
        if process in self.watched:
            return False
        self.watched.append(process)
        return True

    def drop(self, process: ProcessKey) -> None:
        self.watched.remove(process)

    # the peer's side
    def connection(self, via: bytes = b"a", peer: Peer = ME) -> KeptConnection:
        """The open connection of that name; a new one if there is none."""
        if via not in self.connections:
            self.serial += 1
            self.connections[via] = KeptConnection(self.serial, peer)
            self.table.connected(self.connections[via])
        return self.connections[via]

    def client(self, via: bytes = b"a") -> ClientId:
        return ClientId(f"c{self.connections[via].serial}")

    def hang_up(self, via: bytes = b"a") -> None:
        connection = self.connections.pop(via)
        connection.reachable = False
        self.table.disconnected(connection, "the peer hung up")

    def ask(self, op: str, via: bytes = b"a", peer: Peer = ME, **fields: Any) -> dict[str, Any]:
        """Send a request; its reply, or {} if there is none yet."""
        self.next_id += 1
        return self.raw(msgpack.packb({"op": op, "id": self.next_id, **fields}), via, peer)

    def raw(self, payload: bytes | Oversize, via: bytes = b"a", peer: Peer = ME) -> dict[str, Any]:
        connection = self.connection(via, peer)
        before = len(connection.sent)
        self.table.received(connection, payload)
        return connection.sent[-1] if len(connection.sent) > before else {}

    def hello(
        self, via: bytes = b"a", peer: Peer = ME, role: str = "client", **fields: Any
    ) -> dict[str, Any]:
        facts = {"version": d.WIRE_VERSION, "name": "n", "instance": f"i-{via.hex()}", **fields}
        return self.ask("hello", via, peer, role=role, **facts)

    def left(self) -> list[ClientId]:
        return [event.client for event in self.events if isinstance(event, ev.ClientLeft)]


def make_bench(**changes: Any) -> Bench:
    values: dict[str, Any] = {
        "epoch": 3, "boot_id": "boot", "server": "test", "heartbeat_s": 2.0, "fence_grace_s": 5.0,
        "message_max_bytes": 4096,
        "sessions_max": 3, "processes_max": 1000, "operator_reserve": 0, "user_share": 1.0,
        "process_share": 1.0, "subscribers_max": 1, "operators_gid": None,
    }  # fmt: skip
    session_bench = Bench()
    settings = SessionSettings(**{**values, **changes})
    session_bench.table = SessionTable(
        settings, session_bench, session_bench.history, session_bench, lambda: session_bench.now
    )
    return session_bench
