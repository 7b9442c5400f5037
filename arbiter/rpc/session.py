"""Connections: their processes, what they may do, and requests turned into events of the engine.

One `SessionTable` is the router's handler. It runs on the thread of the event loop, never blocks,
and knows neither sockets (it is given `Connection`) nor how the engine decides (it is given
`Decisions`). Rules: nothing but `hello` before a hello; a connection belongs to the process that
the kernel named when it was accepted; every limit's breach is a typed reply; no input raises.
"""

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.report.explain import DAEMON_KINDS, NOTE_KINDS
from vram_arbiter.arbiter.log import RefusalLog
from vram_arbiter.arbiter.rpc import codec
from vram_arbiter.arbiter.rpc.peer import Role, check_visible, how_to_operate, is_operator
from vram_arbiter.arbiter.rpc.requests import BY_HAND, HOLDING, event_of
from vram_arbiter.arbiter.rpc.shares import (
    Budget,
    ProcessBudgets,
    WatchedProcesses,
    cost_of,
    share_of,
    spend,
)
from vram_arbiter.schemas.defaults import KIB, WIRE_VERSION
from vram_arbiter.schemas.errors import (
    BadRequest,
    BadState,
    LimitExceeded,
    MessageTooLarge,
    NotPermitted,
    UnknownSession,
    VersionMismatch,
    VramError,
)
from vram_arbiter.schemas.ids import ClientId, ProcessKey, RequestId
from vram_arbiter.schemas.runtime.peercred import Peer
from vram_arbiter.schemas.runtime.zmtp import Oversize
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.pushes import AnyPush, EventPush
from vram_arbiter.schemas.wire.replies import (
    AnyReply,
    DoneReply,
    HistoryReply,
    PingReply,
    StatusReply,
    WelcomeReply,
)

HISTORY_PAGE = 2000
"""Events in one reply, whatever was asked for: packing more would hold the loop for too long."""
SILENT_S = 10.0
"""At a limit of sessions a connection that never held anything and has been silent for so long
makes room."""
REFUSED_MAX_BYTES = 64 * KIB
"""Of a message over the rate the id is read, if it is no larger than this."""

_READS = ("status", "why", "history", "subscribe", "ping", "bye")  # all that an observer may do
_KINDS = frozenset((*NOTE_KINDS, *DAEMON_KINDS))


class Connection(Protocol):
    """A peer's connection (`schemas.runtime.connection.Connection`), as sessions need it."""

    serial: int
    peer: Peer

    def admit(self) -> None:
        """The peer has said hello."""
        ...

    def send(self, payload: bytes) -> bool:
        """Queue one message without blocking. False: the peer is gone or does not read."""
        ...

    def close(self, reason: str) -> None:
        """Hang up when what was sent has left."""
        ...


class Decisions(Protocol):
    """The owner of the engine, as sessions need it."""

    def post(self, event: ev.Event) -> None: ...

    def when_read(self, answer: Callable[[], None]) -> None:
        """Call `answer` once the GPUs were read, or when the time limit for that has passed."""
        ...

    def status(
        self, reader: ProcessKey | None, after: tuple[int, float, int] | None = None
    ) -> StatusReply: ...

    def why(self, consumer: str) -> WhyReply: ...

    def concerns(self, client: ClientId) -> bool:
        """Whether a lease, a request or a use is this client's."""
        ...


class Watch(Protocol):
    """Deaths of processes (`arbiter.host.process_watch.ProcessWatch`), as sessions need them."""

    def take(self, process: ProcessKey, pidfd: int) -> bool:
        """Watch a process by a copy of `pidfd`. False: it was watched before. Raises OSError where
        no descriptor is left."""
        ...

    def drop(self, process: ProcessKey) -> None:
        """Watch it no longer."""
        ...


HistoryReader = Callable[[int, int, tuple[str, ...], Callable[[HistoryReply], None]], None]
"""`read(after, limit, kinds, done)`: `done` is called on the loop's thread, at once or later, with
the body of the reply."""


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Constants of the wire, from the configuration."""

    epoch: int
    boot_id: str
    server: str
    heartbeat_s: float
    grace_s: float
    message_max_bytes: int
    sessions_max: int
    processes_max: int
    operator_reserve: int
    user_share: float
    process_share: float
    rate_per_s: int
    process_rate_per_s: int
    subscribers_max: int
    operators_gid: int | None


@dataclass(slots=True)
class Session:
    """One connection after its hello, and after its loss if the engine still knows its client."""

    client: ClientId
    connection: Connection
    peer: Peer
    role: Role
    name: str
    instance: str
    heard_at: float
    seq: int = 0
    leased: bool = False
    """It asked for a lease or a use at least once: the engine is asked before the session ends
    without a `bye`."""
    lost: bool = False
    """Its connection is gone; the client may come back on another one."""


@dataclass(slots=True)
class _Entry:
    """An open connection; strangers have no session."""

    budget: Budget
    process_budget: Budget
    session: Session | None = None


class SessionTable:
    """All connections; also the way out for the executor (`reply`, `refuse`, `push`,
    `broadcast`)."""

    def __init__(
        self,
        settings: SessionSettings,
        decisions: Decisions,
        history: HistoryReader,
        watch: Watch,
        clock: Callable[[], float],
        problems: Callable[[], list[str]] = list,
    ) -> None:
        self._settings = settings
        self._decisions = decisions
        self._history = history
        self._watch = watch
        self._clock = clock
        self._problems = problems
        self._refusals = RefusalLog(clock)
        self._entries: dict[int, _Entry] = {}
        self._sessions: dict[ClientId, Session] = {}
        self._of_process: dict[ProcessKey, dict[ClientId, Session]] = {}
        self._sessions_of_user: dict[int, int] = {}
        self._subscribers: dict[ClientId, Session] = {}
        self._instances: dict[tuple[ProcessKey, str], ClientId] = {}
        # the connection that each instance had before → the one that it has
        self._moved: dict[ClientId, ClientId] = {}
        self._watched = WatchedProcesses(settings.processes_max, settings.user_share)
        self._casual: set[ProcessKey] = (
            set()
        )  # watched since a hello, and never had a lease or a use
        self._budgets = ProcessBudgets(settings.process_rate_per_s)
        self._too_fast = LimitExceeded(
            f"more than {settings.rate_per_s} requests a second of one connection, or "
            f"{settings.process_rate_per_s} of one process; "
            "each KiB of a message counts as one more",
            hint="send less often",
            details={
                "limit": "rate_per_client_per_s",
                "value": settings.rate_per_s,
                "process_value": settings.process_rate_per_s,
            },
        ).view()

    # -- in
    def connected(self, connection: Connection) -> None:
        """A peer has finished the handshake; it is a stranger until its hello."""
        now, rate = self._clock(), float(self._settings.rate_per_s)
        peer = connection.peer
        shared = self._budgets.of(peer.uid, peer.process, now)
        self._entries[connection.serial] = _Entry(Budget(rate, rate, now), shared)

    def received(self, connection: Connection, payload: bytes | bytearray | Oversize) -> bool:
        """One message. Never raises for anything that a peer can send. False: its sender is over
        its rate.

        1. Charge the rate; over it: LimitExceeded, and nothing more is looked at. 2. Decode and
           validate. 3. No session: hello or
        UnknownSession. 4. Role. 5. Dispatch.
        """
        entry, now = self._entries[connection.serial], self._clock()
        session, size_max = entry.session, self._settings.message_max_bytes
        if not spend(cost_of(payload), entry.budget, entry.process_budget, now):  # 1
            request_id = (
                None if isinstance(payload, Oversize) else codec.id_of(payload, REFUSED_MAX_BYTES)
            )
            connection.send(codec.refusal(request_id, self._settings.epoch, self._too_fast))
            self._log_refusal(connection, session, self._too_fast.code, self._too_fast.message)
            return False
        try:
            if isinstance(payload, Oversize):  # 2
                raise codec.Undecodable(_too_large(payload, stranger=session is None), None)
            request = codec.decode(payload, size_max)
        except codec.Undecodable as bad:
            self._refuse(connection, bad.request_id, bad.error)
            return True
        try:
            if session is None:  # 3
                if not isinstance(request, w.Hello):
                    raise UnknownSession(
                        f"{request.op} before hello",
                        hint="say hello first, then re-attach your leases",
                    )
                self._hello(connection, entry, request, now)
                return True
            session.heard_at = now
            if (
                session.role == "observer" and request.op not in _READS and request.op != "hello"
            ):  # 4
                raise NotPermitted(
                    f"an observer may not {request.op}", hint="say hello as a client"
                )
            if request.op in BY_HAND and session.role != "operator":
                raise NotPermitted(
                    f"only an operator may {request.op}", hint="say hello as operator"
                )
            self._dispatch(session, request)  # 5
        except VramError as error:
            self._refuse(connection, request.id, error)
        return True

    def disconnected(self, connection: Connection, reason: str) -> None:
        """A connection has ended. Its session ends with it, unless the engine knows the client: a
        holder keeps its lease and its uses until it reattaches, its ttl is over or its process
        dies.
        """
        session = self._entries.pop(connection.serial).session
        if session is None or self._sessions.get(session.client) is not session:
            return
        session.lost = True
        self._subscribers.pop(session.client, None)
        self._end_if_forgotten(session)

    def sweep(self) -> None:
        """End the sessions of lost connections whose clients have nothing left. Called now and
        then."""
        for session in [session for session in self._sessions.values() if session.lost]:
            self._end_if_forgotten(session)

    def process_died(self, process: ProcessKey) -> None:
        """The kernel said so: forget its sessions. The engine hears it from the watch."""
        self._casual.discard(process)  # the watch has ended
        self._watched.discard(process)
        for session in list(self._of_process.get(process, {}).values()):
            self._drop(session)

    def __len__(self) -> int:
        return len(self._sessions)

    # -- out
    def reply(self, client: ClientId, request: RequestId, body: AnyReply) -> None:
        if session := self._sessions.get(self._moved.get(client, client)):
            session.connection.send(codec.reply(request, self._settings.epoch, body))

    def refuse(self, client: ClientId, request: RequestId, error: ErrorView) -> None:
        if session := self._sessions.get(self._moved.get(client, client)):
            session.connection.send(codec.refusal(request, self._settings.epoch, error))
            self._log_refusal(session.connection, session, error.code, error.message)

    def push(self, client: ClientId, body: AnyPush) -> None:
        if session := self._sessions.get(self._moved.get(client, client)):
            session.seq += 1
            session.connection.send(codec.push(session.seq, self._settings.epoch, body))

    def broadcast(self, event: Mapping[str, Any]) -> None:
        """One history event to every subscriber. One that does not read loses events and can fetch
        them by `history`."""
        for client in list(self._subscribers):
            self.push(client, EventPush(event))

    # -- steps
    def _hello(self, connection: Connection, entry: _Entry, hello: w.Hello, now: float) -> None:
        """1.

        Version. 2. A process that can be seen. 3. Role. 4. Room. 5. Watch it, tell the engine,
        welcome it.
        """
        self._check_version(hello)  # 1
        peer = connection.peer
        check_visible(peer)  # 2
        if hello.role == "operator" and not is_operator(peer, self._settings.operators_gid):  # 3
            raise NotPermitted(
                "only the daemon's user, root and the operators' group may be operator",
                hint=how_to_operate(self._settings.operators_gid),
                details={"uid": peer.uid},
            )
        session = Session(
            client=ClientId(f"c{connection.serial}"),
            connection=connection,
            peer=peer,
            role=hello.role,
            name=hello.name,
            instance=hello.instance,
            heard_at=now,
        )
        if (peer.process, hello.instance) not in self._instances:
            self._make_room(session, now)  # 4
        self._begin_watch(session)  # 5
        self._replace_earlier(session)
        entry.session = self._sessions[session.client] = session
        self._of_process.setdefault(peer.process, {})[session.client] = session
        self._sessions_of_user[peer.uid] = self._sessions_of_user.get(peer.uid, 0) + 1
        connection.admit()
        self._connect(session)
        self._welcome(session, hello)

    def _begin_watch(self, session: Session) -> None:
        """A process that has held something is watched until it dies, also after its last
        connection: such processes have shares too."""
        peer = session.peer
        if peer.process not in self._watched:
            count, of_user = len(self._watched), self._watched.of_user(peer.uid)
            if count >= self._watched.most or (
                of_user >= self._watched.most_of_user and session.role != "operator"
            ):
                raise LimitExceeded(
                    f"{count} processes are watched, {of_user} of them of uid {peer.uid}",
                    hint="end processes that use the arbiter no longer, or raise "
                    "limits.connections_max and LimitNOFILE of the daemon",
                    details={"limit": "connections_max", "value": self._watched.most},
                )
        try:
            new = self._watch.take(peer.process, peer.pidfd)
        except OSError as error:
            raise LimitExceeded(
                f"no more processes can be watched: {error}",
                hint="raise LimitNOFILE of the daemon",
                details={"limit": "open_files"},
            ) from error
        if new:
            self._watched.add(peer.process, peer.uid)
            self._casual.add(peer.process)

    def _replace_earlier(self, session: Session) -> None:
        """A client object that comes back on a new connection: the old one ends. The engine moves
        what was its own to the new one; answers under way to the old one, and to no older one, go
        there too.
        """
        key = (session.peer.process, session.instance)
        earlier = self._instances.get(key)
        if earlier is not None and earlier in self._sessions:
            replaced = self._sessions[earlier]
            self._forget(replaced)
            session.leased = replaced.leased
            replaced.connection.close("its client came back on another connection")
            self._stop_standing_for(earlier)
            self._moved[earlier] = session.client
        self._instances[key] = session.client

    def _connect(self, session: Session) -> None:
        uid = session.peer.uid
        self._decisions.post(
            ev.ClientConnected(
                session.client, session.peer.process, uid, session.name, session.instance
            )
        )

    def _check_version(self, hello: w.Hello) -> None:
        if hello.version != WIRE_VERSION:
            raise VersionMismatch(
                f"the arbiter speaks version {WIRE_VERSION} of the wire, the client speaks "
                f"{hello.version}",
                hint=f"upgrade the {'client' if hello.version < WIRE_VERSION else 'arbiter'}: both "
                "must speak the same version",
                details={"server": WIRE_VERSION, "client": hello.version},
            )

    def _welcome(self, session: Session, hello: w.Hello) -> None:
        settings = self._settings
        welcome = WelcomeReply(
            version=WIRE_VERSION,
            boot_id=settings.boot_id,
            server=settings.server,
            role=session.role,
            heartbeat_s=settings.heartbeat_s,
            grace_s=settings.grace_s,
        )
        self.reply(session.client, RequestId(hello.id), welcome)

    def _hello_again(self, session: Session, hello: w.Hello) -> None:
        """A repeated hello is answered again; under another name it is another client's, which
        needs its own connection."""
        self._check_version(hello)
        if (hello.name, hello.instance, hello.role) != (
            session.name,
            session.instance,
            session.role,
        ):
            raise BadState(
                f"this connection already said hello as {session.name!r}",
                hint="open another connection",
            )
        self._welcome(session, hello)

    def _make_room(self, session: Session, now: float) -> None:
        """A place within the shares of the process and the user, and beside the operators' reserve.
        A session whose connection is lost, or that is silent and never held anything, leaves for
        it.
        """
        settings, peer = self._settings, session.peer
        operator = session.role == "operator"
        every = settings.sessions_max
        allowed = every if operator else every - min(settings.operator_reserve, every - 1)
        self._need(
            len(self._of_process.get(peer.process, ())), share_of(every, settings.process_share),
            "process_share",
            f"process {peer.process.pid}", lambda other: other.peer.process == peer.process, now,
        )  # fmt: skip
        if not operator:
            self._need(
                self._sessions_of_user.get(peer.uid, 0), share_of(every, settings.user_share),
                "user_share",
                f"uid {peer.uid}", lambda other: other.peer.uid == peer.uid, now,
            )  # fmt: skip
        self._need(
            len(self._sessions), allowed, "sessions_max", "all clients", lambda other: True, now
        )

    def _need(
        self,
        count: int,
        most: int,
        limit: str,
        whose: str,
        among: Callable[[Session], bool],
        now: float,
    ) -> None:
        """Raises LimitExceeded where `count` sessions are as many as may be, and none of those
        `among` can leave."""
        if count < most:
            return
        leaving = [
            other
            for other in self._sessions.values()
            if among(other)
            and (other.lost or now - other.heard_at > SILENT_S)
            and not (other.leased and self._decisions.concerns(other.client))
        ]
        if not leaving:
            raise LimitExceeded(
                f"{whose}: {count} connections are open, the limit is {most}",
                hint="close connections that are not used, or raise limits.sessions_max or "
                f"limits.{limit}",
                details={"limit": limit, "value": most},
            )
        oldest = min(leaving, key=lambda other: (not other.lost, other.heard_at))
        self._leave(oldest, "silent while connections were needed")

    def _end_if_forgotten(self, session: Session) -> None:
        if not (session.leased and self._decisions.concerns(session.client)):
            self._leave(session, "its connection was lost")

    def _leave(self, session: Session, reason: str) -> None:
        self._drop(session)
        self._decisions.post(ev.ClientLeft(session.client, reason))

    def _forget(self, session: Session) -> None:
        del self._sessions[session.client]
        if (entry := self._entries.get(session.connection.serial)) is not None:
            entry.session = None
        self._subscribers.pop(session.client, None)
        process, uid = session.peer.process, session.peer.uid
        siblings = self._of_process[process]
        del siblings[session.client]
        if not siblings:
            del self._of_process[process]
        self._sessions_of_user[uid] -= 1
        if not self._sessions_of_user[uid]:
            del self._sessions_of_user[uid]

    def _drop(self, session: Session) -> None:
        self._forget(session)
        process = session.peer.process
        self._instances.pop((process, session.instance), None)
        self._stop_standing_for(session.client)
        if process in self._casual and process not in self._of_process:
            self._casual.discard(process)
            self._watched.discard(process)
            self._watch.drop(process)

    def _stop_standing_for(self, client: ClientId) -> None:
        """Forget the connection that this one has replaced."""
        for old in [old for old, new in self._moved.items() if new == client]:
            del self._moved[old]

    def _refuse(self, connection: Connection, request_id: int | None, error: VramError) -> None:
        connection.send(codec.refusal(request_id, self._settings.epoch, error.view()))
        entry = self._entries.get(connection.serial)
        self._log_refusal(
            connection, None if entry is None else entry.session, error.code, error.message
        )

    def _log_refusal(
        self, connection: Connection, session: Session | None, code: str, message: str
    ) -> None:
        peer = connection.peer
        self._refusals.say(
            peer.uid, peer.process.pid, "" if session is None else session.name, code, message
        )

    def _dispatch(self, session: Session, request: w.Request) -> None:
        """Reads are answered here; everything that can change the engine becomes an event, whose
        effects answer."""
        client, re = session.client, RequestId(request.id)
        match request:
            case w.Hello():
                self._hello_again(session, request)
            case w.Ping():
                self.reply(client, re, PingReply(self._settings.server))
            case w.Status():
                reader = None if session.role == "operator" else session.peer.process
                page = request.after
                self._decisions.when_read(lambda: self._status(client, re, reader, page))
            case w.Why():
                consumer = request.consumer
                self._decisions.when_read(
                    lambda: self.reply(client, re, self._decisions.why(consumer))
                )
            case w.History():
                _check_kinds(request.kinds)
                after = max(0, min(request.after, (1 << 63) - 1))
                limit = min(request.limit, HISTORY_PAGE)
                self._history(
                    after, limit, request.kinds, lambda body: self.reply(client, re, body)
                )
            case w.Subscribe():
                self._subscribe(session, re)
            case w.Bye():
                self.reply(client, re, DoneReply())
                self._leave(session, ev.BYE)
            case _:
                if request.op in HOLDING and not session.leased:
                    session.leased = True
                    self._casual.discard(session.peer.process)
                event = event_of(
                    request, client, _operator(session) if request.op in BY_HAND else ""
                )
                assert event is not None, f"{request.op} is answered by nothing"
                self._decisions.post(event)

    def _status(
        self,
        client: ClientId,
        request: RequestId,
        reader: ProcessKey | None,
        page: tuple[int, float, int] | None,
    ) -> None:
        status = self._decisions.status(reader, page)
        self.reply(client, request, replace(status, problems=tuple(self._problems())))

    def _subscribe(self, session: Session, request: RequestId) -> None:
        most, peer = self._settings.subscribers_max, session.peer
        if session.client not in self._subscribers:
            others = [other.peer for other in self._subscribers.values()]
            for count, allowed, limit in (
                (len(others), most, "subscribers_max"),
                (sum(other.uid == peer.uid for other in others),
                share_of(most, self._settings.user_share), "user_share"),
                (sum(other.process == peer.process for other in others),
                 share_of(most, self._settings.process_share), "process_share"),
            ):  # fmt: skip
                if count >= allowed:
                    raise LimitExceeded(
                        f"{count} connections are subscribed, the limit is {allowed} ({limit})",
                        hint="poll history instead, or raise limits.subscribers_max",
                        details={"limit": limit, "value": allowed},
                    )
        self._subscribers[session.client] = session
        self.reply(session.client, request, DoneReply())


def _too_large(message: Oversize, *, stranger: bool) -> MessageTooLarge:
    return MessageTooLarge(
        f"the message has {message.size} bytes, the limit is {message.limit}",
        hint="say hello first, with a small message" if stranger else "send less in one message",
        details={"size_bytes": message.size, "limit_bytes": message.limit},
    )


def _check_kinds(kinds: Sequence[str]) -> None:
    """A mistyped kind would look like a history in which nothing of the sort ever happened."""
    for kind in kinds:
        if kind not in _KINDS:
            close = difflib.get_close_matches(kind, _KINDS, n=1)
            hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(sorted(_KINDS))}"
            raise BadRequest(
                f"no event is of the kind {kind[:64]!r}",
                hint=hint,
                details={"known": sorted(_KINDS)},
            )


def _operator(session: Session) -> str:
    """The peer by the kernel's word; the name is what the connection calls itself."""
    return f"{session.name} (uid {session.peer.uid}, pid {session.peer.process.pid})"
