"""Messages in and out: requests become events of the engine, and its answers become frames.

One `SessionTable` is the router's handler. It runs on the thread of the event loop, never blocks,
and does not know how the engine decides (it is given `Decisions`). Rules: nothing but `hello`
before a hello; a connection belongs to the process that the kernel named when it was accepted;
every limit's breach is a typed reply; no input raises.
"""

import difflib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.log import RefusalLog
from vram_arbiter.arbiter.rpc import codec, roles
from vram_arbiter.arbiter.rpc.peer import check_cgroup
from vram_arbiter.arbiter.rpc.registry import (
    Decisions,
    PeerConnection,
    Registry,
    Session,
    SessionSettings,
    Watch,
    share_of,
)
from vram_arbiter.schemas.defaults import DEMANDS_MAX, WIRE_VERSION
from vram_arbiter.schemas.errors import (
    BadRequest,
    BadState,
    LimitExceeded,
    MessageTooLarge,
    UnknownSession,
    VersionMismatch,
    VramError,
)
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey, RequestId
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.peercred import Peer
from vram_arbiter.schemas.runtime.zmtp import Oversize
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.notes import DAEMON_KINDS, NOTES
from vram_arbiter.schemas.wire.pushes import AnyPush, EventPush, PreparePush
from vram_arbiter.schemas.wire.replies import (
    AnyReply,
    DoneReply,
    HistoryReply,
    PingReply,
    PrepareReply,
    WelcomeReply,
)
from vram_arbiter.schemas.wire.spec import LeaseSpec
from vram_arbiter.schemas.wire.views import DaemonView, DemandView, SensorsView

HISTORY_PAGE = 2000
"""Events in one reply, whatever was asked for: packing more would hold the loop for too long."""
SEQ_END = (1 << 63) - 1
"""SQLite knows no greater number."""
_HOLDING = (w.Acquire, w.Reacquire, w.Reattach, w.UseBegin)
"""Requests that can make the engine remember something of a client beyond its connection."""
_KINDS = frozenset((*NOTES, *DAEMON_KINDS))


HistoryReader = Callable[
    [int, int, tuple[str, ...], Callable[[HistoryReply], None], int | None], None
]
"""`read(after, limit, kinds, done)`: `done` is called on the loop's thread, at once or later, with
the body of the reply."""


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
        daemon: Callable[[], DaemonView | None] = lambda: None,
        ask_sensors: Callable[[], None] = lambda: None,
        sensors: Callable[[], Mapping[GpuId, SensorsView]] = dict,
    ) -> None:
        self._settings = settings
        self._epoch = settings.epoch
        self._decisions = decisions
        self._history = history
        self._clock = clock
        self._problems = problems
        self._daemon = daemon
        self._ask_sensors = ask_sensors
        self._sensors = sensors
        self.refused: Counter[str] = Counter()
        """Refused requests by code, since the start."""
        self._refusals = RefusalLog(clock)
        self._registry = Registry(settings, decisions, watch)
        self._sessions = self._registry.sessions
        self._moved = self._registry.moved

    # -- in
    def connected(self, connection: PeerConnection) -> None:
        """A peer has finished the handshake; it is a stranger until its hello."""

    def received(self, connection: PeerConnection, payload: bytes | bytearray | Oversize) -> None:
        """One message. Never raises for anything that a peer can send.

        1. Decode and validate. 2. Without a session: hello, or UnknownSession. 3. Check the role,
        and whose the cgroup of a lease is. 4. Answer a read here; everything that can change the
        engine becomes an event, whose effects answer.
        """
        now, request_id = self._clock(), None
        session = self._sessions.get(ClientId(f"c{connection.serial}"))
        try:
            if isinstance(payload, Oversize):  # 1
                raise _too_large(payload, stranger=session is None)
            envelope, request = codec.decode(payload, self._settings.message_max_bytes)
            request_id = envelope.id
            if session is None:  # 2
                if not isinstance(request, w.Hello):
                    raise UnknownSession(
                        f"{request.TAG[1]} before hello",
                        hint="say hello first, then reattach your leases",
                    )
                _check_version(request)
                self._welcome(self._registry.open(connection, request, now), request_id)
                return
            session.heard_at = now
            roles.check(session.role, request)  # 3
            by = _operator(session, request)
            for spec in _specs(request):
                if spec.cgroup is not None:
                    known = self._settings.cgroup_root, self._settings.operators_gid
                    check_cgroup(session.peer, spec.cgroup, *known)
            if isinstance(request, w.SessionRequest):  # 4
                self._answer(session, request_id, request)
                return
            if not session.leased and isinstance(request, _HOLDING):
                self._registry.holds(session)
            self._decisions.post(
                ev.Asked(session.client, request_id, request, envelope.traceparent, by)
            )
        except codec.Undecodable as bad:
            self._refuse(connection, session, bad.request_id, bad.error.view())
        except VramError as error:
            self._refuse(connection, session, request_id, error.view())

    def disconnected(self, connection: PeerConnection, reason: str) -> None:
        """A connection has ended."""
        self._registry.lost(ClientId(f"c{connection.serial}"))

    def sweep(self) -> None:
        """End the sessions of lost connections whose clients have nothing left. Called now and
        then."""
        self._registry.sweep()

    def end_silent_guests(self) -> None:
        """End the uses of guests that are heard of no longer. Called several times a second."""
        self._registry.end_silent_guests(self._clock())

    def process_died(self, process: ProcessKey) -> None:
        """The kernel said so: forget its sessions. The engine hears it from the watch."""
        self._registry.process_died(process)

    def __len__(self) -> int:
        return len(self._sessions)

    # -- out
    def reply(self, client: ClientId, request: RequestId, body: AnyReply) -> None:
        if session := self._sessions.get(self._moved.get(client, client)):
            session.connection.send(codec.reply(request, self._epoch, body))

    def refuse(self, client: ClientId, request: RequestId, error: ErrorView) -> None:
        if session := self._sessions.get(self._moved.get(client, client)):
            self._refuse(session.connection, session, request, error)

    def push(self, client: ClientId, body: AnyPush) -> None:
        if session := self._sessions.get(self._moved.get(client, client)):
            session.seq += 1
            session.connection.send(codec.push(session.seq, self._epoch, body))

    def broadcast(self, event: JsonMap) -> None:
        """One history event to every subscriber. One that does not read loses events and can fetch
        them by `history`."""
        for client in list(self._registry.subscribers):
            self.push(client, EventPush(event))

    # -- steps
    def _refuse(
        self,
        connection: PeerConnection,
        session: Session | None,
        request_id: int | None,
        error: ErrorView,
    ) -> None:
        self.refused[error.code] += 1
        connection.send(codec.refusal(request_id, self._epoch, error))
        peer, name = connection.peer, "" if session is None else session.name
        self._refusals.say(peer.uid, peer.process.pid, name, error.code, error.message)

    def _welcome(self, session: Session, re: RequestId) -> None:
        settings = self._settings
        welcome = WelcomeReply(
            version=WIRE_VERSION,
            boot_id=settings.boot_id,
            server=settings.server,
            role=session.role,
            heartbeat_s=self._registry.heartbeat_s(session.role),
            grace_s=settings.fence_grace_s,
        )
        self.reply(session.client, re, welcome)

    def _answer(self, session: Session, re: RequestId, request: w.AnyRequest) -> None:
        """Answer what changes nothing in the engine."""
        client, decisions = session.client, self._decisions
        match request:
            case w.Hello():
                _check_version(request)
                known = (session.name, session.instance, session.role)
                role = self._registry.role_of(session.peer, request)
                if (request.name, request.instance, role) != known:
                    raise BadState(
                        f"this connection already said hello as {session.name!r}",
                        hint="open another connection",
                    )
                self._welcome(session, re)
            case w.Ping():
                self.reply(client, re, PingReply(self._settings.server))
            case w.Status():
                reader = None if session.role == "operator" else session.peer.process
                self._ask_sensors()
                decisions.when_read(lambda: self._status(client, re, reader, request))
            case w.AskWhy(consumer=consumer):
                decisions.when_read(lambda: self.reply(client, re, decisions.why(consumer)))
            case w.History():
                _check_kinds(request.kinds)
                after = max(0, min(request.after, SEQ_END))
                before = None if request.before is None else min(request.before, SEQ_END)
                limit = min(request.limit, HISTORY_PAGE)
                self._history(
                    after, limit, request.kinds, lambda body: self.reply(client, re, body), before
                )
            case w.Subscribe():
                self._subscribe(session)
                self.reply(client, re, DoneReply())
            case w.Prepare():
                told = [
                    other
                    for other in self._sessions.values()
                    if other.name == request.consumer and other.role == "client"
                ]
                for other in told:
                    self.push(other.client, PreparePush(session.name))
                self.reply(client, re, PrepareReply(len(told)))
            case w.Demand():
                self._demand(session, request)
                self.reply(client, re, DoneReply())
            case w.Bye():
                self.reply(client, re, DoneReply())
                self._registry.leave(session, ev.BYE)

    def _status(
        self,
        client: ClientId,
        re: RequestId,
        reader: ProcessKey | None,
        request: w.Status,
    ) -> None:
        status = self._decisions.status(reader, request.after, details=request.details)
        demands = () if request.after else tuple(view for _, view in self._demands())
        known = self._sensors()
        told = replace(
            status,
            gpus=tuple(
                replace(gpu, sensors=known.get(GpuId(gpu.gpu), gpu.sensors)) for gpu in status.gpus
            ),
            problems=tuple(self._problems()),
            daemon=self._daemon(),
            demands=demands,
        )
        self.reply(client, re, told)

    def _demands(self) -> Iterable[tuple[Session, DemandView]]:
        return ((one, view) for one in self._sessions.values() for view in one.demands)

    def _demand(self, session: Session, request: w.Demand) -> None:
        others = [other.peer for other, _ in self._demands() if other is not session]
        wanted, hint = len(request.consumers), "tell of those with the most requests alone"
        self._check_shares(session.peer, others, wanted, "demands_max", DEMANDS_MAX, hint)
        session.demands = tuple(
            DemandView(one.consumer, one.in_flight, one.waiting, session.name)
            for one in request.consumers
        )

    def _subscribe(self, session: Session) -> None:
        subscribers, most = self._registry.subscribers, self._settings.subscribers_max
        if session.client not in subscribers:
            others = [other.peer for other in subscribers.values()]
            hint = "poll history instead, or raise limits.subscribers_max"
            self._check_shares(session.peer, others, 1, "subscribers_max", most, hint)
        subscribers[session.client] = session

    def _check_shares(
        self, peer: Peer, others: Sequence[Peer], wanted: int, limit: str, most: int, hint: str
    ) -> None:
        """Raise LimitExceeded where `wanted` places are not left of `most`, or of the share of the
        peer's user or process. `others`: the peer that has it, for each place that is taken."""
        settings = self._settings
        of_user = sum(other.uid == peer.uid for other in others)
        of_process = sum(other.process == peer.process for other in others)
        for count, allowed, name in (
            (len(others), most, limit),
            (of_user, share_of(most, settings.user_share), "user_share"),
            (of_process, share_of(most, settings.process_share), "process_share"),
        ):
            if count + wanted > allowed:
                raise LimitExceeded(
                    f"{limit}: {count} places are taken, the limit is {allowed} ({name})",
                    hint=hint,
                    details={"limit": name, "value": allowed},
                )


def _operator(session: Session, request: w.AnyRequest) -> str:
    """Return the name of the operator of an action by hand; "" for any other request."""
    if not isinstance(request, w.ByHand):
        return ""
    # the peer by the kernel's word; the name is what the connection calls itself
    return f"{session.name} (uid {session.peer.uid}, pid {session.peer.process.pid})"


def _specs(request: w.AnyRequest) -> Iterable[LeaseSpec]:
    """Return the specs that a request brings."""
    match request:
        case w.Acquire(spec=spec):
            return (spec,)
        case w.Reattach(leases=leases):
            return [lease.spec for lease in leases]
    return ()


def _check_version(hello: w.Hello) -> None:
    if hello.version != WIRE_VERSION:
        raise VersionMismatch(
            f"the arbiter speaks version {WIRE_VERSION} of the wire, the client speaks "
            f"{hello.version}",
            hint=f"upgrade the {'client' if hello.version < WIRE_VERSION else 'arbiter'}: both "
            "must speak the same version",
            details={"server": WIRE_VERSION, "client": hello.version},
        )


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
                f"there is no event kind {kind[:64]!r}",
                hint=hint,
                details={"known": sorted(_KINDS)},
            )
