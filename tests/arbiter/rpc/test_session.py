"""Sessions: identity, roles, limits, and requests that become events. No socket: the wire is a list."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgpack
import pytest

from arbiter.core import events as ev
from arbiter.rpc.peer import start_ticks
from arbiter.rpc.session import SessionSettings, SessionTable
from schemas import wire
from schemas.ids import ClientId, LeaseId, ModelKey, ProcessKey, RequestId, Token, UseId

ME = f"localhost:{os.getuid()}:{os.getgid()}:{os.getpid()}"
PARENT = f"localhost:{os.getuid()}:{os.getgid()}:{os.getppid()}"
STRANGER = f"localhost:54321:54321:{os.getpid()}"
LEASE, USE = LeaseId("L3-1"), UseId("u")
FOOTPRINT = {"load_peak_bytes": 10, "steady_bytes": 8, "residue_bytes": 2}


@dataclass
class Bench:
    """A session table with a list for a socket and a list for a core."""

    sent: list[tuple[bytes, bool, dict[str, Any]]] = field(default_factory=list)
    events: list[ev.Event] = field(default_factory=list)
    watched: list[ProcessKey] = field(default_factory=list)
    questions: list[tuple[int, int, tuple[str, ...]]] = field(default_factory=list)
    now: float = 100.0
    reachable: bool = True
    watchable: bool = True
    next_id: int = 0
    table: SessionTable = None  # type: ignore[assignment]  # made by `bench`

    # Wire
    def send(self, routing_id: bytes, delimiter: bool, payload: bytes) -> bool:
        if self.reachable:
            self.sent.append((routing_id, delimiter, msgpack.unpackb(payload)))
        return self.reachable

    # Decisions
    def post(self, event: ev.Event) -> None:
        self.events.append(event)

    def when_read(self, answer: Callable[[], None]) -> None:
        answer()

    def status(
        self, reader: ProcessKey | None, after: tuple[int, float, int] | None = None
    ) -> dict[str, Any]:
        return {"phase": "serving", "reader": str(reader), "after": after}

    def why(self, consumer: str) -> dict[str, Any]:
        return {"consumer": consumer, "leases": []}

    def history(
        self, after: int, limit: int, kinds: tuple[str, ...], done: Callable[[Mapping[str, Any]], None]
    ) -> None:
        self.questions.append((after, limit, kinds))
        done({"events": [], "last_seq": 0})

    def watch(self, process: ProcessKey) -> None:
        if not self.watchable:
            raise OSError(24, "Too many open files")
        self.watched.append(process)

    # the peer's side
    def ask(
        self, op: str, routing: bytes = b"a", address: str | None = ME, delimiter: bool = False, **fields: Any
    ) -> dict[str, Any]:
        """Send a request; its reply, or {} if there is none yet."""
        self.next_id += 1
        payload = msgpack.packb({"op": op, "id": self.next_id, **fields})
        return self.raw(payload, routing, address, delimiter)

    def raw(
        self, payload: bytes, routing: bytes = b"a", address: str | None = ME, delimiter: bool = False
    ) -> dict[str, Any]:
        before = len(self.sent)
        self.table.receive(routing, delimiter, address, payload)
        return self.sent[-1][2] if len(self.sent) > before else {}

    def hello(
        self, routing: bytes = b"a", address: str | None = ME, role: str = "client", **fields: Any
    ) -> dict[str, Any]:
        fields = {"version": 1, "name": "n", "instance": f"i-{routing.hex()}", **fields}
        return self.ask("hello", routing, address, role=role, **fields)


def make(**changes: Any) -> Bench:
    values: dict[str, Any] = {
        "epoch": 3, "boot_id": "boot", "server": "test", "heartbeat_s": 2.0, "grace_s": 5.0, "message_max_bytes": 4096,
        "sessions_max": 3, "rate_per_s": 100, "subscribers_max": 1, "operators_gid": None,
    }  # fmt: skip
    bench = Bench()
    settings = SessionSettings(**{**values, **changes})
    bench.table = SessionTable(settings, bench, bench, bench.history, bench.watch, lambda: bench.now)
    return bench


@pytest.fixture
def bench() -> Bench:
    return make()


def code(reply: Mapping[str, Any]) -> str:
    assert reply["ok"] is False, reply
    return str(reply["error"]["code"])


def test_hello_is_welcomed_and_the_core_hears_the_kernels_word(bench: Bench) -> None:
    reply = bench.hello()
    assert reply == {
        "re": 1, "epoch": 3, "ok": True, "version": 1, "boot_id": "boot", "server": "test", "role": "client",
        "heartbeat_s": 2.0, "grace_s": 5.0,
    }  # fmt: skip
    ticks = start_ticks(os.getpid())
    assert ticks is not None
    me = ProcessKey(os.getpid(), ticks)
    assert bench.events == [ev.ClientConnected(ClientId(b"a".hex()), me, os.getuid(), "n", "i-61")]
    assert bench.watched == [me]


def test_nothing_goes_before_hello(bench: Bench) -> None:
    for op in ("ping", "status", "bye"):
        assert code(bench.ask(op)) == "unknown_session"
    assert bench.events == []


def test_another_version_is_refused(bench: Bench) -> None:
    reply = bench.hello(version=2)
    assert code(reply) == "version_mismatch"
    assert reply["error"]["details"] == {"server": 1, "client": 2}
    assert len(bench.table) == 0


@pytest.mark.parametrize("address", [None, "", "127.0.0.1", "localhost:0:0:0"])
def test_a_peer_whom_the_kernel_does_not_name_is_refused(bench: Bench, address: str | None) -> None:
    assert code(bench.hello(address=address)) == "not_permitted"
    assert bench.events == []


def test_a_frame_of_another_process_is_refused_and_the_session_lives_on(bench: Bench) -> None:
    bench.hello()
    assert code(bench.ask("ping", address=PARENT)) == "not_permitted"
    assert code(bench.ask("bye", address=PARENT)) == "not_permitted"
    assert bench.ask("ping")["ok"]


def test_hello_again_is_idempotent_but_not_under_another_name(bench: Bench) -> None:
    bench.hello()
    assert bench.hello()["ok"]
    assert code(bench.hello(name="other")) == "bad_state"
    assert len(bench.events) == 1


def test_roles(bench: Bench) -> None:
    assert code(bench.hello(routing=b"x", address=STRANGER, role="operator")) == "not_permitted"
    assert bench.hello(routing=b"x", address=STRANGER)["ok"]
    assert bench.hello(routing=b"o", role="operator")["role"] == "operator"
    bench.hello(routing=b"v", role="observer")
    me = str(ProcessKey(os.getpid(), start_ticks(os.getpid()) or 0))
    assert bench.ask("status", b"v")["reader"] == me, "only its own tokens are for it"
    assert bench.ask("status", b"o", after=[1, 2.5, 3])["reader"] == "None"
    assert bench.ask("status", b"o", after=[1, 2.5, 3])["after"] == [1, 2.5, 3]
    lease = {"lease_id": "L1-1", "token": [1, 1]}
    for op, fields in (
        ("ready", lease),
        ("release", lease),
        ("renew", {"leases": []}),
        ("cancel", {"lease_id": "L"}),
    ):
        assert code(bench.ask(op, b"v", **fields)) == "not_permitted"


def test_requests_of_leases_that_come_back(bench: Bench) -> None:
    bench.hello()
    bench.events.clear()
    me, token, on = ClientId(b"a".hex()), Token(3, 7), {"lease_id": "L3-1", "token": [3, 7]}
    wanted = {"consumer": "detector", "model_id": "m", "footprint": FOOTPRINT, "standby": True}
    bench.ask("reacquire", **on, wait_timeout_s=4.0)
    bench.ask("reattach", leases=[{**on, "spec": wanted, "state": "standby"}])
    bench.ask("resize", **on, footprint=FOOTPRINT, wait_timeout_s=2.0)
    reacquired, reattached, resized = bench.events
    assert resized == ev.ResizeAsked(me, RequestId(bench.next_id), LEASE, token, 10, 8, 2, 2.0)
    assert reacquired == ev.Reacquired(me, RequestId(bench.next_id - 2), LEASE, token, 4.0)
    assert isinstance(reattached, ev.Reattached)
    (item,) = reattached.leases
    assert (item.away, item.held, item.spec.standby) == (True, False, True)


def test_every_request_on_leases_becomes_its_event(bench: Bench) -> None:
    bench.hello()
    bench.events.clear()
    me, token, on = ClientId(b"a".hex()), Token(3, 7), {"lease_id": "L3-1", "token": [3, 7]}
    wanted = {"consumer": "detector", "model_id": "m", "revision": "r", "footprint": FOOTPRINT, "mode": "exclusive",
              "priority": 60, "evictable": False, "on_deadline": "deny"}  # fmt: skip
    spec = ev.Spec("detector", ModelKey("m", "r"), "any", True, 10, 8, 2, 60, False, 10.0, 2.0, True)
    trace = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
    bench.ask("acquire", nonce="n1", spec=wanted, wait_timeout_s=4.0, traceparent=trace)
    bench.ask("ready", **on, measured_bytes=5)
    bench.ask("use_begin", **on, use_id="u", label="goal")
    bench.ask("use_end", **on, use_id="u")
    bench.ask("yield", **on, use_id="u")
    bench.ask("renew", leases=[on])
    bench.ask("revoke_ack", **on, safe_point_eta_s=1.5)
    bench.ask("unloading", **on)
    bench.ask("release", **on, exiting=True)
    bench.ask("cancel", lease_id="L3-1")
    bench.ask("reattach", leases=[{**on, "spec": wanted, "state": "held", "use_ids": ["u"]}])
    bench.ask("oom", **on, requested_bytes=11, allocated_bytes=12)
    first = bench.next_id - 11
    ids = iter([RequestId(first + n) for n in range(12)])
    assert bench.events == [
        ev.AcquireRequested(me, next(ids), "n1", spec, 4.0, trace),
        ev.ReadyReported(me, next(ids), LEASE, token, 5),
        ev.UseBegan(me, next(ids), LEASE, token, USE, "goal"),
        ev.UseEnded(me, next(ids), LEASE, token, USE),
        ev.UseYielded(me, next(ids), LEASE, token, USE),
        ev.Renewed(me, next(ids), ((LEASE, token),)),
        ev.RevokeAcknowledged(me, next(ids), LEASE, token, 1.5),
        ev.UnloadStarted(me, next(ids), LEASE, token),
        ev.ReleaseReported(me, next(ids), LEASE, token, True),
        ev.CancelRequested(me, next(ids), LEASE),
        ev.Reattached(me, next(ids), (ev.ReattachedLease(LEASE, token, spec, True, None, (USE,)),)),
        ev.OomReported(me, next(ids), LEASE, token, 11, 12),
    ]


def test_only_an_operator_acts_by_hand_and_is_named_by_the_kernel(bench: Bench) -> None:
    bench.hello(routing=b"c")
    bench.hello(routing=b"v", role="observer")
    bench.hello(routing=b"o", role="operator", name="ops")
    bench.events.clear()
    for routing in (b"c", b"v"):
        for op in ("evict", "pin", "unpin", "release_dead"):
            assert code(bench.ask(op, routing, target="det", reason="r")) == "not_permitted"
        for op in ("drain", "resume"):
            assert code(bench.ask(op, routing, reason="r")) == "not_permitted"
    assert bench.events == []
    bench.ask("evict", b"o", target="det", reason="r")
    bench.ask("drain", b"o", reason="new driver")
    by = f"ops (uid {os.getuid()}, pid {os.getpid()})"
    me, last = ClientId(b"o".hex()), bench.next_id
    assert bench.events == [
        ev.OperatorAsked(me, RequestId(last - 1), "evict", "det", by, "r"),
        ev.OperatorAsked(me, RequestId(last), "drain", "", by, "new driver"),
    ]
    assert code(bench.ask("evict", b"o", target="det")) == "bad_request", "an action without a reason"
    assert code(bench.ask("drain", b"o", reason="a\nb")) == "bad_request", "a reason is one line of history"


def test_every_op_of_the_wire_is_dispatched(bench: Bench) -> None:
    """A new op without a case in `_dispatch` would be answered by nobody."""
    on = {"lease_id": "L3-1", "token": [3, 7]}
    fields: dict[str, dict[str, Any]] = {
        "hello": {"version": 1, "name": "n", "instance": "i-61"},
        "acquire": {"nonce": "n", "spec": {"consumer": "c", "model_id": "m", "footprint": FOOTPRINT}},
        "use_begin": {**on, "use_id": "u"}, "use_end": {**on, "use_id": "u"}, "renew": {"leases": []},
        "cancel": {"lease_id": "L"}, "reacquire": on, "resize": {**on, "footprint": FOOTPRINT}, "reattach": {"leases": []}, "oom": {**on, "requested_bytes": 1},
        "why": {"consumer": "c"}, **dict.fromkeys(("ready", "revoke_ack", "unloading", "release"), on),
    }  # fmt: skip
    bench.hello()
    for op in wire.OPS:
        before = (len(bench.sent), len(bench.events))
        bench.ask(op, **fields.get(op, {}))
        assert (len(bench.sent), len(bench.events)) != before, f"{op} is answered by nobody"


def test_reads_are_answered_at_once(bench: Bench) -> None:
    bench.hello()
    assert bench.ask("ping")["server"] == "test"
    assert bench.ask("why", consumer="c")["leases"] == []
    assert bench.ask("history", after=-5, limit=9, kinds=["granted"])["events"] == []
    bench.ask("history", after=(1 << 64) - 1)
    for typed, hint in (("grant", "did you mean granted?"), ("?" * 99, "known: ")):
        refused = bench.ask("history", kinds=["denied", typed])["error"]
        assert (refused["code"], refused["hint"][: len(hint)]) == ("bad_request", hint)
        assert len(refused["message"]) < 100
    assert bench.questions == [(0, 9, ("granted",)), ((1 << 63) - 1, 500, ())]


def test_bye_ends_the_session_and_tells_the_core(bench: Bench) -> None:
    bench.hello()
    assert bench.ask("bye")["ok"]
    assert bench.events[-1] == ev.ClientLeft(ClientId(b"a".hex()), "bye")
    assert code(bench.ask("ping")) == "unknown_session"


def test_a_dead_process_takes_its_sessions_along(bench: Bench) -> None:
    bench.hello(b"a")
    bench.hello(b"b")
    bench.table.process_died(bench.watched[0])
    assert len(bench.table) == 0
    bench.table.push(ClientId(b"a".hex()), {"push": "revoke"})  # nobody there: nothing happens
    assert all("push" not in message for _, _, message in bench.sent)


def test_an_instance_on_a_new_connection_replaces_its_old_one(bench: Bench) -> None:
    """ROUTER never says that a peer is gone: the client object that says hello again does."""
    for routing in (b"a", b"b", b"c"):
        assert bench.hello(routing, instance="same")["ok"]
    assert len(bench.table) == 1
    assert not any(isinstance(event, ev.ClientLeft) for event in bench.events), (
        "nothing is lost by reconnecting"
    )
    for routing in (b"b", b"c"):
        bench.table.push(ClientId(routing.hex()), {"push": "granted"})
        assert bench.sent[-1][0] == b"c", "what is sent to an old connection reaches the new one"
    bench.ask("bye", b"c")
    left = [event.client for event in bench.events if isinstance(event, ev.ClientLeft)]
    assert left == [ClientId(b"c".hex())], "the core has moved what was the earlier ones'"


def test_a_connection_that_was_replaced_and_comes_back_hears_its_own_answers(bench: Bench) -> None:
    bench.hello(b"a", instance="one")
    bench.hello(b"b", instance="one")
    assert bench.hello(b"a", instance="two")["ok"]
    assert bench.sent[-1][0] == b"a", "they used to go to the connection that had replaced it"
    assert bench.ask("ping", b"a")["ok"]
    assert bench.sent[-1][0] == b"a"


def test_the_same_instance_of_another_process_is_another_client(bench: Bench) -> None:
    assert bench.hello(b"a", instance="same")["ok"]
    assert bench.hello(b"b", address=PARENT, instance="same")["ok"]
    assert len(bench.table) == 2


def test_the_rate_is_limited_per_session_and_refills(bench: Bench) -> None:
    bench.hello(b"a")
    bench.hello(b"b")
    replies = [bench.ask("ping") for _ in range(150)]
    refused = [reply for reply in replies if not reply["ok"]]
    assert len(refused) == 51  # a hundred a second, the hello was one of them
    assert code(refused[0]) == "limit_exceeded"
    assert refused[0]["error"]["details"] == {"limit": "rate_per_client_per_s", "value": 100}
    assert bench.ask("ping", b"b")["ok"], "another client is not affected"
    bench.now += 0.5
    assert sum(bench.ask("ping")["ok"] for _ in range(60)) == 50


def test_who_is_over_the_rate_is_told_so_whatever_it_sent(bench: Bench) -> None:
    """Each is answered to its id, and nothing of it is looked at but that."""
    bench.hello(b"a")
    receive = bench.table.receive
    assert [receive(b"a", False, ME, msgpack.packb({"op": "ping", "id": n})) for n in range(100)] == [
        *[True] * 99, False
    ]  # fmt: skip
    for payload, request in (
        (msgpack.packb({"op": "acquire", "id": 7, "spec": 3}), 7),
        (msgpack.packb({"op": "no such", "id": -1}), None),
        (msgpack.packb({"id": True}), None),
        (msgpack.packb([7]), None),
        (b"\xc1", None),
        (msgpack.packb({"op": "ping", "id": 8, "pad": "x" * 5000}), None),
    ):
        reply = bench.raw(payload)
        assert (code(reply), reply["re"]) == ("limit_exceeded", request)


def test_strangers_share_one_budget(bench: Bench) -> None:
    for _ in range(100):
        bench.raw(b"junk", b"z")
    assert code(bench.raw(b"junk", b"y")) == "limit_exceeded"
    bench.now += 1
    assert code(bench.raw(b"junk", b"y")) == "bad_frame"


def test_at_the_limit_of_sessions_the_silent_ones_make_room(bench: Bench) -> None:
    for routing in (b"a", b"b", b"c"):
        bench.hello(routing)
    reply = bench.hello(b"d")
    assert code(reply) == "limit_exceeded"
    assert reply["error"]["details"] == {"limit": "sessions_max", "value": 3}
    bench.ask("acquire", b"a", nonce="n", spec={"consumer": "c", "model_id": "m", "footprint": FOOTPRINT})
    bench.now += 8
    bench.ask("ping", b"c")
    bench.now += 8
    assert bench.hello(b"d")["ok"]
    left = [event for event in bench.events if isinstance(event, ev.ClientLeft)]
    assert [event.client for event in left] == [ClientId(b"b".hex())], "a holds a lease, c spoke a moment ago"


def test_no_descriptor_left_is_a_typed_error(bench: Bench) -> None:
    bench.watchable = False
    reply = bench.hello()
    assert code(reply) == "limit_exceeded"
    assert reply["error"]["details"] == {"limit": "open_files"}
    assert len(bench.table) == 0


def test_subscribers_receive_events_and_are_limited(bench: Bench) -> None:
    bench.hello(b"a")
    bench.hello(b"b")
    assert bench.ask("subscribe", b"a")["ok"]
    assert bench.ask("subscribe", b"a")["ok"], "twice is once"
    assert code(bench.ask("subscribe", b"b")) == "limit_exceeded"
    bench.table.broadcast({"seq": 1, "kind": "granted"})
    routing, _, message = bench.sent[-1]
    assert (routing, message) == (
        b"a",
        {"push": "event", "seq": 1, "epoch": 3, "event": {"seq": 1, "kind": "granted"}},
    )


def test_pushes_are_numbered_per_session(bench: Bench) -> None:
    bench.hello(b"a")
    for _ in range(3):
        bench.table.push(ClientId(b"a".hex()), {"push": "revoke"})
    assert [message["seq"] for _, _, message in bench.sent if "push" in message] == [1, 2, 3]


def test_a_req_socket_is_answered_with_its_delimiter(bench: Bench) -> None:
    bench.raw(
        msgpack.packb({"op": "hello", "id": 1, "version": 1, "name": "n", "instance": "i"}), delimiter=True
    )
    assert bench.sent[-1][1] is True
    bench.table.reply(ClientId(b"a".hex()), RequestId(9), {})
    assert bench.sent[-1][1] is True


def test_an_unreachable_peer_is_no_error(bench: Bench) -> None:
    bench.hello()
    bench.reachable = False
    bench.table.push(ClientId(b"a".hex()), {"push": "revoke"})
    assert bench.ask("ping") == {}
    bench.reachable = True
    assert bench.ask("ping")["ok"]


def test_bad_frames_change_nothing(bench: Bench) -> None:
    bench.hello()
    bench.events.clear()
    for payload in (b"", b"\xc1", msgpack.packb([1]), b"x" * 5000):
        assert bench.raw(payload)["ok"] is False
    assert bench.events == []
    assert bench.ask("ping")["ok"]
