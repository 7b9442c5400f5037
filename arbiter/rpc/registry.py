"""Sessions: connections that have said hello, by client, process and user.

A session belongs to the process that the kernel named when its connection was accepted. A hello
needs room (`Registry.open`): shares of the process and the user, places of all clients, and a
process that can be watched until it dies. A session whose connection is lost, or that is silent
and never held anything, leaves for a new one. Must not know requests, replies or time.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.rpc.peer import check_visible, how_to_operate, is_operator
from vram_arbiter.arbiter.rpc.roles import Role
from vram_arbiter.schemas.errors import LimitExceeded, NotPermitted
from vram_arbiter.schemas.ids import ClientId, ProcessKey
from vram_arbiter.schemas.runtime.peercred import Peer, is_guest
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import DemandView

SILENT_S = 10.0
"""At a limit of sessions a connection that never held anything and has been silent for so long
makes room."""
GUEST_HEARTBEAT_S = 1.0
GUEST_SILENT_BEATS = 4
"""A guest that said nothing for so many heartbeats has no network: its uses end. sshd is not waited
for: 9.2 takes 8 s for a nominal 4, and over 30 while the server has something to send."""
NEWCOMERS = 8
"""One in so many places is for processes that have no session yet."""


class Decisions(Protocol):
    """The owner of the engine (`arbiter.inbox.Inbox`), as sessions need it."""

    def post(self, event: ev.Event) -> None: ...

    def concerns(self, client: ClientId) -> bool:
        """Whether a lease, a request or a use is this client's."""
        ...

    def when_read(self, answer: Callable[[], None]) -> None:
        """Call `answer` once the GPUs were read, or when the time limit for that has passed."""
        ...

    def status(
        self,
        reader: ProcessKey | None,
        after: tuple[int, float, int] | None = None,
        *,
        details: bool = False,
    ) -> StatusReply: ...

    def why(self, consumer: str) -> WhyReply: ...


class PeerConnection(Protocol):
    """One peer's connection (`schemas.runtime.connection.Connection`), as sessions need it."""

    @property
    def serial(self) -> int: ...

    @property
    def peer(self) -> Peer: ...

    def admit(self) -> None: ...

    def send(self, payload: bytes) -> bool: ...

    def close(self, reason: str) -> None: ...


class Watch(Protocol):
    """Deaths of processes (`arbiter.host.process_watch.ProcessWatch`), as sessions need them."""

    def take(self, process: ProcessKey, pidfd: int) -> bool:
        """Watch a process by a copy of `pidfd`. False: it was watched before. Raises OSError where
        no descriptor is left."""
        ...

    def drop(self, process: ProcessKey) -> None:
        """Watch it no longer."""
        ...


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Constants of the wire, from the configuration."""

    epoch: int
    boot_id: str
    server: str
    heartbeat_s: float
    fence_grace_s: float
    message_max_bytes: int
    sessions_max: int
    processes_max: int
    operator_reserve: int
    user_share: float
    process_share: float
    subscribers_max: int
    operators_gid: int | None
    guests_gid: int | None = None
    cgroup_root: Path | None = None
    """Where the cgroup v2 hierarchy is mounted."""


@dataclass(slots=True)
class Session:
    """One connection after its hello, and after its loss if the engine still knows its client."""

    client: ClientId
    connection: PeerConnection
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
    demands: tuple[DemandView, ...] = ()
    """What it told of requests at consumers that it serves."""


@dataclass(slots=True)
class _Watched:
    """A process watched since a hello: it costs a descriptor until it dies."""

    uid: int
    casual: bool = True
    """It never had a lease or a use: the watch ends with its last session."""


class Registry:
    """All sessions. Those of a process that has held something outlive their connections."""

    def __init__(self, settings: SessionSettings, decisions: Decisions, watch: Watch) -> None:
        self._settings = settings
        self._decisions = decisions
        self._watch = watch
        self.sessions: dict[ClientId, Session] = {}
        self.subscribers: dict[ClientId, Session] = {}
        self._of_process: dict[ProcessKey, dict[ClientId, Session]] = {}
        self._of_user: Counter[int] = Counter()
        self._instances: dict[tuple[ProcessKey, str], ClientId] = {}
        self.moved: dict[ClientId, ClientId] = {}
        """The connection that a client object had before → the one that it has: answers to the
        first go there."""
        self._watched: dict[ProcessKey, _Watched] = {}

    # -- in
    def open(self, connection: PeerConnection, hello: w.Hello, now: float) -> Session:
        """Make the session of a hello, or raise what refuses it.

        1. A process that can be seen. 2. Its role. 3. Room. 4. A watch on the process. 5. The
        session, in the place of the one that the same client object had. 6. The engine hears of it.
        """
        peer = connection.peer
        check_visible(peer)  # 1
        role = self.role_of(peer, hello)  # 2
        client = ClientId(f"c{connection.serial}")
        session = Session(client, connection, peer, role, hello.name, hello.instance, now)
        if (peer.process, hello.instance) not in self._instances:
            self._make_room(session)  # 3
        self._begin_watch(session)  # 4
        self._replace_earlier(session)  # 5
        self.sessions[client] = session
        self._of_process.setdefault(peer.process, {})[client] = session
        self._of_user[peer.uid] += 1
        connection.admit()
        self._decisions.post(  # 6
            ev.ClientConnected(client, peer.process, peer.uid, session.name, session.instance)
        )
        return session

    def role_of(self, peer: Peer, hello: w.Hello) -> Role:
        """Return the role that a hello gets: a guest is one whatever it asks for. Raises
        NotPermitted."""
        if is_guest(peer, self._settings.guests_gid):
            return "guest"
        if hello.role == "operator" and not is_operator(peer, self._settings.operators_gid):
            raise NotPermitted(
                "only the daemon's user, root and the operators' group may be operator",
                hint=how_to_operate(self._settings.operators_gid),
                details={"uid": peer.uid},
            )
        return hello.role

    def _make_room(self, session: Session) -> None:
        """A place within the shares of the process and the user, beside the operators' reserve and,
        for a process that has a session, beside that of the processes that have none. A session
        whose connection is lost, or that is silent and never held anything, leaves for it.
        """
        settings, peer = self._settings, session.peer
        every, operator = settings.sessions_max, session.role == "operator"
        count = len(self._of_process.get(peer.process, ()))

        def left(places: int) -> int:
            return places - places // NEWCOMERS if count else places

        self._need(
            count, share_of(every, settings.process_share),
            "process_share", f"process {peer.process.pid}", session,
            lambda other: other.peer.process == peer.process,
        )  # fmt: skip
        if not operator:
            self._need(
                self._of_user[peer.uid], left(share_of(every, settings.user_share)),
                "user_share", f"uid {peer.uid}", session, lambda other: other.peer.uid == peer.uid,
            )  # fmt: skip
        allowed = every if operator else left(every - min(settings.operator_reserve, every - 1))
        self._need(
            len(self.sessions), allowed, "sessions_max", "all clients", session, lambda other: True
        )

    def _need(
        self,
        count: int,
        most: int,
        limit: str,
        whose: str,
        session: Session,
        among: Callable[[Session], bool],
    ) -> None:
        """Let one of the sessions `among` leave where there are as many as may be. Raises
        LimitExceeded where none can."""
        if count < most:
            return
        leaving = [
            other
            for other in self.sessions.values()
            if among(other)
            and (other.lost or session.heard_at - other.heard_at > SILENT_S)
            and not self._is_known(other)
        ]
        if not leaving:
            raise LimitExceeded(
                f"{whose}: {count} connections are open, the limit is {most}",
                hint=f"close unused connections, or raise limits.sessions_max or limits.{limit}",
                details={"limit": limit, "value": most},
            )
        oldest = min(leaving, key=lambda other: (not other.lost, other.heard_at))
        self.leave(oldest, "silent while connections were needed")

    def _begin_watch(self, session: Session) -> None:
        """A process that has held something is watched until it dies, also after its last
        connection: such processes have shares too."""
        peer, settings = session.peer, self._settings
        if peer.process not in self._watched:
            count, most = len(self._watched), settings.processes_max
            of_user = sum(watched.uid == peer.uid for watched in self._watched.values())
            if count >= most or (
                of_user >= share_of(most, settings.user_share) and session.role != "operator"
            ):
                raise LimitExceeded(
                    f"{count} processes are watched, {of_user} of them of uid {peer.uid}",
                    hint="end processes that no longer use the arbiter, or raise "
                    "limits.connections_max and LimitNOFILE of the daemon",
                    details={"limit": "connections_max", "value": most},
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
            self._watched[peer.process] = _Watched(peer.uid)

    def _replace_earlier(self, session: Session) -> None:
        """A client object that comes back on a new connection: the old one ends. The engine moves
        what was its own to the new one; answers under way to the old one, and to no older one, go
        there too.
        """
        key = (session.peer.process, session.instance)
        earlier = self._instances.get(key)
        if earlier is not None and (replaced := self.sessions.get(earlier)) is not None:
            self._forget(replaced)
            session.leased = replaced.leased
            replaced.connection.close("its client came back on another connection")
            self.moved[earlier] = session.client
        self._instances[key] = session.client

    def holds(self, session: Session) -> None:
        """The client asks for a lease or a use: from here on the engine may know it."""
        session.leased = True
        if (watched := self._watched.get(session.peer.process)) is not None:
            watched.casual = False

    # -- out
    def lost(self, client: ClientId) -> None:
        """A connection has ended. Its session ends with it, unless the engine knows the client: a
        holder keeps its lease and its uses until it reattaches, its ttl is over or its process
        dies. A guest's process does not die with the robot's program, so its uses end at once.
        """
        if (session := self.sessions.get(client)) is not None:
            session.lost = True
            session.demands = ()
            self.subscribers.pop(client, None)
            if session.role == "guest":
                self.leave(session, "its connection was lost")
            else:
                self._end_if_forgotten(session)

    def end_silent_guests(self, now: float) -> None:
        """End the uses of guests that have said nothing for a few heartbeats. Their process is the
        server's end of a tunnel: it may live on without a network, and without the robot's
        program."""
        limit_s = GUEST_SILENT_BEATS * self.heartbeat_s("guest")
        for session in list(self.sessions.values()):
            silent_s = now - session.heard_at
            if session.role == "guest" and silent_s > limit_s and self._is_known(session):
                session.connection.close("a guest that was silent in a use")
                self.leave(session, f"it was silent for {silent_s:.1f} s")

    def heartbeat_s(self, role: Role) -> float:
        """Return how often a client of a role is asked to say that it is there."""
        every_s = self._settings.heartbeat_s
        return min(every_s, GUEST_HEARTBEAT_S) if role == "guest" else every_s

    def sweep(self) -> None:
        """End the sessions of lost connections whose clients have nothing left. Called now and
        then."""
        for session in [session for session in self.sessions.values() if session.lost]:
            self._end_if_forgotten(session)

    def process_died(self, process: ProcessKey) -> None:
        """The kernel said so: forget its sessions. The engine hears it from the watch."""
        self._watched.pop(process, None)  # the watch has ended
        for session in list(self._of_process.get(process, {}).values()):
            self._drop(session)

    def leave(self, session: Session, reason: str) -> None:
        """End a session, and tell the engine."""
        self._drop(session)
        self._decisions.post(ev.ClientLeft(session.client, reason))

    def _is_known(self, session: Session) -> bool:
        return session.leased and self._decisions.concerns(session.client)

    def _end_if_forgotten(self, session: Session) -> None:
        if not self._is_known(session):
            self.leave(session, "its connection was lost")

    def _drop(self, session: Session) -> None:
        process = session.peer.process
        self._forget(session)
        self._instances.pop((process, session.instance), None)
        watched = self._watched.get(process)
        if watched is not None and watched.casual and process not in self._of_process:
            del self._watched[process]
            self._watch.drop(process)

    def _forget(self, session: Session) -> None:
        """Take a session out of the tables, with the connection that it stands for."""
        del self.sessions[session.client]
        self.subscribers.pop(session.client, None)
        siblings = self._of_process[session.peer.process]
        del siblings[session.client]
        if not siblings:
            del self._of_process[session.peer.process]
        self._of_user[session.peer.uid] -= 1
        if not self._of_user[session.peer.uid]:
            del self._of_user[session.peer.uid]
        for old in [old for old, new in self.moved.items() if new == session.client]:
            del self.moved[old]


def share_of(total: int, share: float) -> int:
    """Places of one process or user; at least one."""
    return max(1, int(total * share))
