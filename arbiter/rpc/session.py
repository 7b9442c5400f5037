"""Connections: who they are, what they may do, and requests turned into events of the core.

One `SessionTable` holds all of them. It runs on the thread of the event loop, never blocks, and knows neither sockets (it is given
`Wire`) nor how the core decides (it is given `Decisions`). Rules: nothing but `hello` before a hello; a session belongs to the process
that the kernel named at its hello; every limit's breach is a typed reply; no input raises.
"""

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from arbiter.core import events as ev
from arbiter.core.explain import DAEMON_KINDS, NOTE_KINDS
from arbiter.rpc import codec
from arbiter.rpc.peer import Peer, Role, how_to_operate, identify, is_operator
from schemas import wire as w
from schemas.defaults import WIRE_VERSION
from schemas.errors import (
    BadRequest,
    BadState,
    LimitExceeded,
    NotPermitted,
    UnknownSession,
    VersionMismatch,
    VramError,
)
from schemas.ids import ClientId, LeaseId, ModelKey, ProcessKey, RequestId, Token, UseId

SILENT_S = 10.0
"""At the limit of sessions a connection that never held anything and has been silent for so long makes room."""

_READS = ("status", "why", "history", "subscribe", "ping", "bye")  # all that an observer may do
_KINDS = frozenset((*NOTE_KINDS, *DAEMON_KINDS))
_BY_HAND = ("evict", "pin", "unpin", "release_dead", "drain", "resume")  # operators only


class Wire(Protocol):
    """The socket, as sessions need it."""

    def send(self, routing_id: bytes, delimiter: bool, payload: bytes) -> bool:
        """Queue one message without blocking. False: the peer is gone or does not read."""
        ...


class Decisions(Protocol):
    """The owner of the core, as sessions need it."""

    def post(self, event: ev.Event) -> None: ...

    def when_read(self, answer: Callable[[], None]) -> None:
        """Call `answer` once the GPUs were read, or when the time limit for that has passed."""
        ...

    def status(
        self, reader: ProcessKey | None, after: tuple[int, float, int] | None = None
    ) -> dict[str, Any]: ...

    def why(self, consumer: str) -> dict[str, Any]: ...


HistoryReader = Callable[[int, int, tuple[str, ...], Callable[[Mapping[str, Any]], None]], None]
"""`read(after, limit, kinds, done)`: `done` is called on the loop's thread, at once or later, with the body of the reply."""


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
    rate_per_s: int
    subscribers_max: int
    operators_gid: int | None


@dataclass(slots=True)
class Session:
    """One connection after its hello."""

    client: ClientId
    routing_id: bytes
    delimiter: bool  # a REQ socket: an empty frame stands before the payload
    address: str  # the kernel's words, compared on every frame
    peer: Peer
    role: Role
    name: str
    instance: str
    budget: float  # requests that may still come at once
    heard_at: float
    seq: int = 0
    leased: bool = False  # it asked for a lease at least once: never dropped for being silent


class SessionTable:
    """All connections; also the way out for the executor (`reply`, `refuse`, `push`, `broadcast`)."""

    def __init__(
        self,
        settings: SessionSettings,
        wire: Wire,
        decisions: Decisions,
        history: HistoryReader,
        watch: Callable[[ProcessKey], None],
        clock: Callable[[], float],
        identify: Callable[[str], Peer] = identify,
        problems: Callable[[], list[str]] = list,
    ) -> None:
        self._settings = settings
        self._wire = wire
        self._decisions = decisions
        self._history = history
        self._watch = watch
        self._clock = clock
        self._identify = identify
        self._problems = problems
        self._sessions: dict[ClientId, Session] = {}
        self._of_process: dict[ProcessKey, dict[ClientId, Session]] = {}
        self._subscribers: dict[ClientId, Session] = {}
        self._instances: dict[tuple[ProcessKey, str], ClientId] = {}
        # the connection that each instance had before → the one that it has
        self._moved: dict[ClientId, ClientId] = {}
        self._strangers_budget = float(settings.rate_per_s)
        self._strangers_at = clock()
        self._too_fast = LimitExceeded(
            f"more than {settings.rate_per_s} requests a second",
            hint="send less often",
            details={"limit": "rate_per_client_per_s", "value": settings.rate_per_s},
        ).to_wire()

    # -- in ----------------------------------------------------------------------------------------------------
    def receive(self, routing_id: bytes, delimiter: bool, address: str | None, payload: bytes) -> bool:
        """One frame from the socket. Never raises for anything that a peer can send. False: its sender is over its rate.

        1. Charge the rate; over it: LimitExceeded, and nothing more is looked at. 2. Decode and validate. 3. No session: hello or UnknownSession.
        4. The frame's process is not the session's: NotPermitted. 5. Role. 6. Dispatch.
        """
        session = self._sessions.get(ClientId(routing_id.hex()))
        now = self._clock()
        if not self._charge_rate(session, now):  # 1
            request_id = codec.id_of(payload, self._settings.message_max_bytes)
            self._wire.send(
                routing_id, delimiter, codec.refusal(request_id, self._settings.epoch, self._too_fast)
            )
            return False
        try:
            request = codec.decode(payload, self._settings.message_max_bytes)  # 2
        except codec.Undecodable as bad:
            self._refuse_raw(routing_id, delimiter, bad.request_id, bad.error)
            return True
        try:
            if session is None:  # 3
                if not isinstance(request, w.Hello):
                    raise UnknownSession(
                        f"{request.op} before hello", hint="say hello first, then re-attach your leases"
                    )
                self._hello(routing_id, delimiter, address, request, now)
                return True
            if address != session.address:  # 4
                raise NotPermitted(
                    "this connection belongs to another process", hint="open a connection of your own"
                )
            session.delimiter = delimiter
            if session.role == "observer" and request.op not in _READS and request.op != "hello":  # 5
                raise NotPermitted(f"an observer may not {request.op}", hint="say hello as a client")
            if request.op in _BY_HAND and session.role != "operator":
                raise NotPermitted(f"only an operator may {request.op}", hint="say hello as operator")
            self._dispatch(session, request)  # 6
        except VramError as error:
            self._refuse_raw(routing_id, delimiter, request.id, error)
        return True

    def process_died(self, process: ProcessKey) -> None:
        """The kernel said so: forget its connections. The core hears it from whoever watches."""
        for session in list(self._of_process.get(process, {}).values()):
            self._drop(session)

    def __len__(self) -> int:
        return len(self._sessions)

    # -- out ---------------------------------------------------------------------------------------------------
    def reply(self, client: ClientId, request: RequestId, body: Mapping[str, Any]) -> None:
        if session := self._sessions.get(self._moved.get(client, client)):
            self._send(session, codec.reply(request, self._settings.epoch, body))

    def refuse(self, client: ClientId, request: RequestId, error: Mapping[str, Any]) -> None:
        if session := self._sessions.get(self._moved.get(client, client)):
            self._send(session, codec.refusal(request, self._settings.epoch, error))

    def push(self, client: ClientId, body: Mapping[str, Any]) -> None:
        if session := self._sessions.get(self._moved.get(client, client)):
            session.seq += 1
            self._send(session, codec.push(session.seq, self._settings.epoch, body))

    def broadcast(self, event: Mapping[str, Any]) -> None:
        """One history event to every subscriber. One that does not read loses events and can fetch them by `history`."""
        for client in list(self._subscribers):
            self.push(client, {"push": "event", "event": event})

    # -- steps -------------------------------------------------------------------------------------------------
    def _charge_rate(self, session: Session | None, now: float) -> bool:
        rate = float(self._settings.rate_per_s)
        if session is None:  # connections without a session share one budget: they cost nothing but an answer
            self._strangers_budget = min(rate, self._strangers_budget + (now - self._strangers_at) * rate)
            self._strangers_at = now
            if self._strangers_budget < 1:
                return False
            self._strangers_budget -= 1
            return True
        session.budget = min(rate, session.budget + (now - session.heard_at) * rate)
        session.heard_at = now
        if session.budget < 1:
            return False
        session.budget -= 1
        return True

    def _hello(
        self, routing_id: bytes, delimiter: bool, address: str | None, hello: w.Hello, now: float
    ) -> None:
        """1. Version. 2. The kernel's word on the process. 3. Role. 4. Room. 5. Watch it, tell the core, welcome it."""
        self._check_version(hello)  # 1
        peer = self._identify(address or "")  # 2
        if hello.role == "operator" and not is_operator(peer.credentials, self._settings.operators_gid):  # 3
            raise NotPermitted(
                "only the daemon's user, root and the operators' group may be operator",
                hint=how_to_operate(self._settings.operators_gid),
                details={"uid": peer.credentials.uid},
            )
        self._make_room(now)  # 4
        try:
            self._watch(peer.process)  # 5
        except OSError as error:
            raise LimitExceeded(
                f"no more processes can be watched: {error}",
                hint="raise LimitNOFILE of the daemon",
                details={"limit": "open_files"},
            ) from error
        session = Session(
            client=ClientId(routing_id.hex()),
            routing_id=routing_id,
            delimiter=delimiter,
            address=address or "",
            peer=peer,
            role=hello.role,
            name=hello.name,
            instance=hello.instance,
            budget=float(self._settings.rate_per_s - 1),
            heard_at=now,
        )
        self._replace_earlier(session)
        self._sessions[session.client] = session
        self._of_process.setdefault(peer.process, {})[session.client] = session
        self._connect(session)
        self._welcome(session, hello)

    def _replace_earlier(self, session: Session) -> None:
        """A client object that comes back on a new connection: the old one is gone, though ROUTER never says so. The core moves what was
        its own to the new one; answers under way to the old one, and to no older one, go there too."""
        key = (session.peer.process, session.instance)
        earlier = self._instances.get(key)
        if earlier is not None and earlier in self._sessions:
            self._forget(self._sessions[earlier])
            self._stop_standing_for(earlier)
            self._moved[earlier] = session.client
        self._moved.pop(session.client, None)  # it was replaced once; from here on it speaks for itself
        self._instances[key] = session.client

    def _connect(self, session: Session) -> None:
        uid = session.peer.credentials.uid
        self._decisions.post(
            ev.ClientConnected(session.client, session.peer.process, uid, session.name, session.instance)
        )

    def _check_version(self, hello: w.Hello) -> None:
        if hello.version != WIRE_VERSION:
            raise VersionMismatch(
                f"the arbiter speaks version {WIRE_VERSION} of the wire, the client {hello.version}",
                hint="install the same version of the client and of the arbiter",
                details={"server": WIRE_VERSION, "client": hello.version},
            )

    def _welcome(self, session: Session, hello: w.Hello) -> None:
        welcome: w.WelcomeReply = {
            "version": WIRE_VERSION,
            "boot_id": self._settings.boot_id,
            "server": self._settings.server,
            "role": session.role,
            "heartbeat_s": self._settings.heartbeat_s,
            "grace_s": self._settings.grace_s,
        }
        self.reply(session.client, RequestId(hello.id), {**welcome})

    def _hello_again(self, session: Session, hello: w.Hello) -> None:
        """A reconnect under the same routing id repeats its hello; under another name it is somebody else."""
        self._check_version(hello)
        if (hello.name, hello.instance, hello.role) != (session.name, session.instance, session.role):
            raise BadState(
                f"this connection already said hello as {session.name!r}", hint="open another connection"
            )
        self._welcome(session, hello)

    def _make_room(self, now: float) -> None:
        if len(self._sessions) < self._settings.sessions_max:
            return
        silent = [s for s in self._sessions.values() if not s.leased and now - s.heard_at > SILENT_S]
        if not silent:
            raise LimitExceeded(
                f"{self._settings.sessions_max} connections are open",
                hint="close connections that are not used, or raise limits.sessions_max",
                details={"limit": "sessions_max", "value": self._settings.sessions_max},
            )
        self._leave(min(silent, key=lambda s: s.heard_at), "silent while connections were needed")

    def _leave(self, session: Session, reason: str) -> None:
        self._drop(session)
        self._decisions.post(ev.ClientLeft(session.client, reason))

    def _forget(self, session: Session) -> None:
        del self._sessions[session.client]
        self._subscribers.pop(session.client, None)
        siblings = self._of_process[session.peer.process]
        del siblings[session.client]
        if not siblings:
            del self._of_process[session.peer.process]

    def _drop(self, session: Session) -> None:
        self._forget(session)
        self._instances.pop((session.peer.process, session.instance), None)
        self._stop_standing_for(session.client)

    def _stop_standing_for(self, client: ClientId) -> None:
        """Forget whom a connection has replaced."""
        for old in [old for old, new in self._moved.items() if new == client]:
            del self._moved[old]

    def _send(self, session: Session, payload: bytes) -> None:
        self._wire.send(session.routing_id, session.delimiter, payload)

    def _refuse_raw(
        self, routing_id: bytes, delimiter: bool, request_id: int | None, error: VramError
    ) -> None:
        self._wire.send(
            routing_id, delimiter, codec.refusal(request_id, self._settings.epoch, error.to_wire())
        )

    def _dispatch(self, session: Session, request: w.Request) -> None:
        """Reads are answered here; everything that can change the core becomes an event, whose effects answer."""
        post, client, re = self._decisions.post, session.client, RequestId(request.id)
        match request:
            case w.Hello():
                self._hello_again(session, request)
            case w.Ping():
                self.reply(client, re, {"server": self._settings.server})
            case w.Status():
                reader = None if session.role == "operator" else session.peer.process
                page = request.after
                self._decisions.when_read(
                    lambda: self.reply(
                        client,
                        re,
                        {**self._decisions.status(reader, page), "problems": self._problems()},
                    )
                )
            case w.Why():
                consumer = request.consumer
                self._decisions.when_read(lambda: self.reply(client, re, self._decisions.why(consumer)))
            case w.History():
                _check_kinds(request.kinds)
                after = max(0, min(request.after, (1 << 63) - 1))
                self._history(after, request.limit, request.kinds, lambda body: self.reply(client, re, body))
            case w.Subscribe():
                self._subscribe(session, re)
            case w.Bye():
                self.reply(client, re, {})
                self._leave(session, ev.BYE)
            case w.Acquire():
                session.leased = True
                post(
                    ev.AcquireRequested(
                        client,
                        re,
                        request.nonce,
                        to_spec(request.spec),
                        request.wait_timeout_s,
                        request.traceparent,
                    )
                )
            case w.Ready():
                post(ev.ReadyReported(client, re, *_on_lease(request), request.measured_bytes))
            case w.UseBegin():
                session.leased = True  # a use ends with its client: never drop it for being silent
                post(ev.UseBegan(client, re, *_on_lease(request), UseId(request.use_id), request.label))
            case w.UseEnd():
                post(ev.UseEnded(client, re, *_on_lease(request), UseId(request.use_id)))
            case w.Yield():
                post(ev.UseYielded(client, re, *_on_lease(request), UseId(request.use_id)))
            case w.Renew():
                post(
                    ev.Renewed(
                        client, re, tuple((LeaseId(r.lease_id), Token(*r.token)) for r in request.leases)
                    )
                )
            case w.RevokeAck():
                post(ev.RevokeAcknowledged(client, re, *_on_lease(request), request.safe_point_eta_s))
            case w.Unloading():
                post(ev.UnloadStarted(client, re, *_on_lease(request)))
            case w.Release():
                post(ev.ReleaseReported(client, re, *_on_lease(request), request.exiting, request.parked))
            case w.Cancel():
                post(ev.CancelRequested(client, re, LeaseId(request.lease_id)))
            case w.Reacquire():
                post(
                    ev.Reacquired(
                        client, re, *_on_lease(request), request.wait_timeout_s, request.traceparent
                    )
                )
            case w.Resize():
                size = request.footprint
                sizes = (size.load_peak_bytes, size.steady_bytes, size.residue_bytes)
                post(ev.ResizeAsked(client, re, *_on_lease(request), *sizes, request.wait_timeout_s))
            case w.Reattach():
                session.leased = True
                post(ev.Reattached(client, re, tuple(_reattached(lease) for lease in request.leases)))
            case w.Evict() | w.Pin() | w.Unpin() | w.ReleaseDead():
                post(
                    ev.OperatorAsked(
                        client, re, request.op, request.target, _operator(session), request.reason
                    )
                )
            case w.Drain() | w.Resume():
                post(ev.OperatorAsked(client, re, request.op, "", _operator(session), request.reason))
            case w.Oom():
                lease, token = LeaseId(request.lease_id), Token(*request.token)
                post(
                    ev.OomReported(client, re, lease, token, request.requested_bytes, request.allocated_bytes)
                )

    def _subscribe(self, session: Session, request: RequestId) -> None:
        subscribers = len(self._subscribers)
        if session.client not in self._subscribers and subscribers >= self._settings.subscribers_max:
            raise LimitExceeded(
                f"{subscribers} connections are subscribed",
                hint="poll history instead, or raise limits.subscribers_max",
                details={"limit": "subscribers_max", "value": self._settings.subscribers_max},
            )
        self._subscribers[session.client] = session
        self.reply(session.client, request, {})


def to_spec(spec: w.LeaseSpec) -> ev.Spec:
    """The wire's lease spec as the core knows it."""
    return ev.Spec(
        consumer=spec.consumer,
        key=ModelKey(spec.model_id, spec.revision),
        gpu=spec.gpu,
        exclusive=spec.mode == "exclusive",
        load_peak_bytes=spec.footprint.load_peak_bytes,
        steady_bytes=spec.footprint.steady_bytes,
        residue_bytes=spec.footprint.residue_bytes,
        priority=spec.priority,
        evictable=spec.evictable,
        ttl_s=spec.ttl_s,
        min_residency_s=spec.min_residency_s,
        deny_on_deadline=spec.on_deadline == "deny",
        standby=spec.standby,
        on_overstay=spec.on_overstay,
        park_bytes=spec.park_bytes,
        parent=None if spec.parent is None else (LeaseId(spec.parent.lease_id), Token(*spec.parent.token)),
        independent=spec.independent,
        gang=None if spec.gang is None else (spec.gang.id, spec.gang.size),
    )


def _check_kinds(kinds: Sequence[str]) -> None:
    """A mistyped kind would look like a history in which nothing of the sort ever happened."""
    for kind in kinds:
        if kind not in _KINDS:
            close = difflib.get_close_matches(kind, _KINDS, n=1)
            hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(sorted(_KINDS))}"
            raise BadRequest(
                f"no event is of the kind {kind[:64]!r}", hint=hint, details={"known": sorted(_KINDS)}
            )


def _operator(session: Session) -> str:
    """Who it is by the kernel's word; the name is what the connection calls itself."""
    return f"{session.name} (uid {session.peer.credentials.uid}, pid {session.peer.process.pid})"


def _on_lease(
    request: w.Ready
    | w.UseBegin
    | w.UseEnd
    | w.Yield
    | w.RevokeAck
    | w.Unloading
    | w.Release
    | w.Reacquire
    | w.Resize,
) -> tuple[LeaseId, Token]:
    return LeaseId(request.lease_id), Token(*request.token)


def _reattached(lease: w.ReattachLease) -> ev.ReattachedLease:
    return ev.ReattachedLease(
        lease=LeaseId(lease.lease_id),
        token=Token(*lease.token),
        spec=to_spec(lease.spec),
        held=lease.state == "held",
        measured_bytes=lease.measured_bytes,
        uses=tuple(UseId(use) for use in lease.use_ids),
        away=lease.state in ("standby", "parked"),
        parked=lease.state == "parked",
    )
