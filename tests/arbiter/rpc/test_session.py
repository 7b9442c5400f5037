"""Sessions: identity, roles, limits, and requests that become events. No socket: the wire is a
list."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgpack
import pytest

from tests.arbiter.rpc.session_bench import ME, Bench, make_bench
from tests.support.connections import peer_of
from tests.support.messages import lease_view, revoke
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId, ProcessKey, RequestId, Token, UseId
from vram_arbiter.schemas.runtime.peercred import Peer
from vram_arbiter.schemas.runtime.zmtp import Oversize
from vram_arbiter.schemas.wire import requests as wire
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.pushes import GrantedPush
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

PARENT = peer_of(os.getppid())
STRANGER = peer_of(1, 54_321, 54_321)
LEASE, USE = LeaseId("L3-1"), UseId("u")
FOOTPRINT = {"load_peak_bytes": 10, "steady_bytes": 8, "residue_bytes": 2}


@pytest.fixture
def session_bench() -> Bench:
    return make_bench()


def code(reply: Mapping[str, Any]) -> str:
    assert reply["ok"] is False, reply
    return str(reply["error"]["code"])


def acquire(session_bench: Bench) -> None:
    session_bench.ask(
        "acquire", nonce="n", spec={"consumer": "c", "model_id": "m", "footprint": FOOTPRINT}
    )


def test_hello_is_welcomed_and_the_core_hears_the_kernels_word(session_bench: Bench) -> None:
    reply = session_bench.hello()
    assert reply == {
        "re": 1, "epoch": 3, "ok": True, "version": d.WIRE_VERSION, "boot_id": "boot",
        "server": "test", "role": "client",
        "heartbeat_s": 2.0, "grace_s": 5.0,
    }  # fmt: skip
    assert session_bench.events == [
        ev.ClientConnected(session_bench.client(), ME.process, os.getuid(), "n", "i-61")
    ]
    assert session_bench.watched == [ME.process]
    assert session_bench.connections[b"a"].admitted, "the time limit for hellos ends"


def test_nothing_goes_before_hello(session_bench: Bench) -> None:
    for op in ("ping", "status", "bye"):
        assert code(session_bench.ask(op)) == "unknown_session"
    assert session_bench.events == []


def test_another_version_is_refused(session_bench: Bench) -> None:
    for theirs, who in ((1, "client"), (d.WIRE_VERSION + 1, "arbiter")):
        reply = session_bench.hello(version=theirs)
        assert code(reply) == "version_mismatch"
        assert reply["error"]["details"] == {"server": d.WIRE_VERSION, "client": theirs}
        assert f"upgrade the {who}" in reply["error"]["hint"]
    assert len(session_bench.table) == 0


def test_a_peer_that_cannot_be_seen_is_refused(session_bench: Bench) -> None:
    """The kernel says pid 0 of a process of another pid namespace: its death would be heard by
    nothing."""
    reply = session_bench.hello(peer=Peer(ProcessKey(0, 0), 1000, 1000, -1))
    assert code(reply) == "not_permitted"
    assert "--pid=host" in reply["error"]["hint"]
    assert session_bench.events == []
    assert not session_bench.connections[b"a"].admitted


def test_hello_again_is_idempotent_but_not_under_another_name(session_bench: Bench) -> None:
    session_bench.hello()
    assert session_bench.hello()["ok"]
    assert code(session_bench.hello(name="other")) == "bad_state"
    assert len(session_bench.events) == 1


def test_roles(session_bench: Bench) -> None:
    assert code(session_bench.hello(via=b"x", peer=STRANGER, role="operator")) == "not_permitted"
    assert session_bench.hello(via=b"x", peer=STRANGER)["ok"]
    assert session_bench.hello(via=b"o", role="operator")["role"] == "operator"
    session_bench.hello(via=b"v", role="observer")
    assert session_bench.ask("status", b"v")["ok"]
    assert session_bench.asked_status[0] == ME.process, "only its own tokens are for it"
    assert session_bench.ask("status", b"o", after=[1, 2.5, 3])["ok"]
    assert session_bench.asked_status == (None, (1, 2.5, 3))
    lease = {"lease_id": "L1-1", "token": [1, 1]}
    for op, fields in (
        ("ready", lease),
        ("release", lease),
        ("renew", {"leases": []}),
        ("cancel", {"lease_id": "L"}),
    ):
        assert code(session_bench.ask(op, b"v", **fields)) == "not_permitted"


def test_every_request_on_leases_comes_to_the_engine(session_bench: Bench) -> None:
    session_bench.hello()
    session_bench.events.clear()
    me, token, on = session_bench.client(), Token(3, 7), {"lease_id": "L3-1", "token": [3, 7]}
    wanted = {"consumer": "detector", "model_id": "m", "revision": "r", "footprint": FOOTPRINT,
    "mode": "exclusive",
              "priority": 60, "evictable": False}  # fmt: skip
    spec = LeaseSpec(
        consumer="detector",
        model_id="m",
        revision="r",
        mode="exclusive",
        footprint=Footprint(10, 8, 2),
        priority=60,
        evictable=False,
    )
    trace = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
    session_bench.ask("acquire", nonce="n1", spec=wanted, wait_timeout_s=4.0, traceparent=trace)
    session_bench.ask("ready", **on, measured_bytes=5)
    session_bench.ask("use_begin", **on, use_id="u", label="goal")
    session_bench.ask("use_end", **on, use_id="u")
    session_bench.ask("renew", leases=[on])
    session_bench.ask("revoke_ack", **on, safe_point_eta_s=1.5)
    session_bench.ask("unloading", **on)
    session_bench.ask("release", **on, exiting=True)
    session_bench.ask("cancel", lease_id="L3-1")
    session_bench.ask(
        "reattach", leases=[{**on, "spec": wanted, "state": "held", "use_ids": ["u"]}]
    )
    session_bench.ask("oom", **on, requested_bytes=11, allocated_bytes=12)
    first = session_bench.next_id - 10
    held = wire.ReattachLease(LEASE, token, spec, "held", None, (USE,))
    acquire, *others = [
        wire.Acquire("n1", spec, 4.0),
        wire.Ready(LEASE, token, 5),
        wire.UseBegin(LEASE, token, USE, "goal"),
        wire.UseEnd(LEASE, token, USE),
        wire.Renew((wire.LeaseRef(LEASE, token),)),
        wire.RevokeAck(LEASE, token, 1.5),
        wire.Unloading(LEASE, token),
        wire.Release(LEASE, token, True),
        wire.Cancel(LEASE),
        wire.Reattach((held,)),
        wire.Oom(LEASE, token, 11, 12),
    ]
    assert session_bench.events == [
        ev.Asked(me, RequestId(first), acquire, trace),
        *[ev.Asked(me, RequestId(first + n), request) for n, request in enumerate(others, 1)],
    ]
    assert type(session_bench.events[1].request.token) is Token, "the log hides serials of tokens"


def test_only_an_operator_acts_by_hand_and_is_named_by_the_kernel(session_bench: Bench) -> None:
    session_bench.hello(via=b"c")
    session_bench.hello(via=b"v", role="observer")
    session_bench.hello(via=b"o", role="operator", name="ops")
    session_bench.events.clear()
    for via in (b"c", b"v"):
        for op in ("evict", "kill", "pin", "unpin", "release_dead"):
            assert code(session_bench.ask(op, via, target="det", reason="r")) == "not_permitted"
        for op in ("drain", "resume"):
            assert code(session_bench.ask(op, via, reason="r")) == "not_permitted"
    assert session_bench.events == []
    session_bench.ask("evict", b"o", target="det", reason="r")
    session_bench.ask("drain", b"o", reason="new driver")
    by = f"ops (uid {os.getuid()}, pid {os.getpid()})"
    me, last = session_bench.client(b"o"), session_bench.next_id
    assert session_bench.events == [
        ev.Asked(me, RequestId(last - 1), wire.Evict("r", "det"), operator=by),
        ev.Asked(me, RequestId(last), wire.Drain("new driver"), operator=by),
    ]
    assert code(session_bench.ask("evict", b"o", target="det")) == "bad_request", (
        "an action without a reason"
    )
    assert code(session_bench.ask("drain", b"o", reason="a\nb")) == "bad_request", (
        "a reason is one line of history"
    )


def test_every_op_of_the_wire_is_dispatched(session_bench: Bench) -> None:
    """A new op without a case in `_answer` or a row in `_REQUESTS` would get no answer."""
    on = {"lease_id": "L3-1", "token": [3, 7]}
    fields: dict[str, dict[str, Any]] = {
        "hello": {"version": d.WIRE_VERSION, "name": "n", "instance": "i-61"},
        "acquire": {"nonce": "n",
        "spec": {"consumer": "c", "model_id": "m", "footprint": FOOTPRINT}},
        "use_begin": {**on, "use_id": "u"}, "use_end": {**on, "use_id": "u"},
        "renew": {"leases": []},
        "cancel": {"lease_id": "L"}, "reacquire": on,
        "reattach": {"leases": []}, "oom": {**on, "requested_bytes": 1},
        "why": {"consumer": "c"},
        **dict.fromkeys(("ready", "revoke_ack", "unloading", "release"), on),
    }  # fmt: skip
    session_bench.hello()
    for op in wire.REQUESTS:
        before = len(session_bench.events)
        assert session_bench.ask(op, **fields.get(op, {})) or len(session_bench.events) > before, (
            f"{op} is answered by nothing"
        )


def test_reads_are_answered_at_once(session_bench: Bench) -> None:
    session_bench.hello()
    assert session_bench.ask("ping")["server"] == "test"
    assert session_bench.ask("why", consumer="c")["leases"] == []
    assert session_bench.ask("history", after=-5, limit=9, kinds=["granted"])["events"] == []
    session_bench.ask("history", after=(1 << 64) - 1)
    for typed, hint in (("grant", "did you mean granted?"), ("?" * 99, "known: ")):
        refused = session_bench.ask("history", kinds=["denied", typed])["error"]
        assert (refused["code"], refused["hint"][: len(hint)]) == ("bad_request", hint)
        assert len(refused["message"]) < 100
    assert session_bench.questions == [(0, 9, ("granted",)), ((1 << 63) - 1, 500, ())]


def test_bye_ends_the_session_and_tells_the_core(session_bench: Bench) -> None:
    session_bench.hello()
    assert session_bench.ask("bye")["ok"]
    assert session_bench.events[-1] == ev.ClientLeft(session_bench.client(), "bye")
    assert code(session_bench.ask("ping")) == "unknown_session"
    assert session_bench.hello()["ok"], "the connection may say hello again"


def test_a_dead_process_takes_its_sessions_along(session_bench: Bench) -> None:
    session_bench.hello(b"a")
    session_bench.hello(b"b")
    session_bench.table.process_died(ME.process)
    assert len(session_bench.table) == 0
    session_bench.table.push(session_bench.client(), revoke())  # no session: nothing happens
    assert not any("push" in message for message in session_bench.connections[b"a"].sent)
    session_bench.hang_up(b"a")  # the router hears of the death too
    assert session_bench.left() == []


# -- connections that are lost
def test_a_lost_connection_without_a_lease_ends_its_session_at_once(session_bench: Bench) -> None:
    """libzmq's ROUTER never said that a peer had gone: such sessions stayed until their process
    died."""
    session_bench.hello()
    client = session_bench.client()
    session_bench.hang_up()
    assert len(session_bench.table) == 0
    assert session_bench.events[-1] == ev.ClientLeft(client, "its connection was lost")
    assert session_bench.watched == [], (
        "the death of a process that never held anything concerns nothing"
    )


def test_a_holder_that_loses_its_connection_keeps_its_session(session_bench: Bench) -> None:
    """The end of a use makes a safe point: a connection that breaks while a robot moves must not
    make one."""
    session_bench.hello()
    acquire(session_bench)
    session_bench.concerned.add(session_bench.client())
    session_bench.hang_up()
    assert len(session_bench.table) == 1
    assert session_bench.left() == []
    session_bench.table.sweep()
    assert len(session_bench.table) == 1
    assert session_bench.hello(b"b", instance="i-61")["ok"], "it comes back on another connection"
    assert len(session_bench.table) == 1
    assert session_bench.left() == []
    assert session_bench.watched == [ME.process]


def test_a_lost_session_ends_when_the_engine_has_forgotten_its_client(session_bench: Bench) -> None:
    session_bench.hello()
    acquire(session_bench)
    client = session_bench.client()
    session_bench.concerned.add(client)
    session_bench.hang_up()
    session_bench.concerned.clear()  # its lease expired
    session_bench.table.sweep()
    assert len(session_bench.table) == 0
    assert session_bench.left() == [client]
    assert session_bench.watched == [ME.process], "it may keep bytes on a GPU until it dies"


def test_a_process_that_was_watched_before_its_hello_stays_watched(session_bench: Bench) -> None:
    """From the journal: its lease is recovered, whatever becomes of this connection."""
    session_bench.watched.append(ME.process)
    session_bench.hello()
    session_bench.hang_up()
    assert session_bench.watched == [ME.process]


def test_a_lost_subscriber_is_sent_nothing_more(session_bench: Bench) -> None:
    session_bench.hello()
    assert session_bench.ask("subscribe")["ok"]
    session_bench.hang_up()
    session_bench.table.broadcast({"seq": 1, "kind": "granted"})
    assert session_bench.hello(b"b")["ok"]
    assert session_bench.ask("subscribe", b"b")["ok"], "its place is free"


def test_a_stranger_that_hangs_up_is_no_event(session_bench: Bench) -> None:
    session_bench.raw(b"junk")
    session_bench.hang_up()
    assert session_bench.events == []


def test_an_instance_on_a_new_connection_replaces_its_old_one(session_bench: Bench) -> None:
    """The new connection may be read before the end of the old one."""
    for via in (b"a", b"b", b"c"):
        assert session_bench.hello(via, instance="same")["ok"]
    assert len(session_bench.table) == 1
    assert session_bench.left() == [], "nothing is lost by reconnecting"
    for via in (b"b", b"c"):
        session_bench.table.push(session_bench.client(via), GrantedPush(lease_view()))
        assert session_bench.connections[b"c"].sent[-1]["push"] == "granted", (
            "it reaches the new connection"
        )
    assert len(session_bench.connections[b"c"].sent) == 3
    assert session_bench.connections[b"a"].closed, "the old connection has no use any more"
    for via in (b"a", b"b"):
        session_bench.table.disconnected(session_bench.connections[via], "closed")
    assert len(session_bench.table) == 1
    session_bench.ask("bye", b"c")
    assert session_bench.left() == [session_bench.client(b"c")], (
        "the core has moved what was the earlier ones'"
    )


def test_the_same_instance_of_another_process_is_another_client(session_bench: Bench) -> None:
    assert session_bench.hello(b"a", instance="same")["ok"]
    assert session_bench.hello(b"b", peer=PARENT, instance="same")["ok"]
    assert len(session_bench.table) == 2


# -- shares
def test_a_message_that_was_skipped_is_answered(session_bench: Bench) -> None:
    refused = session_bench.raw(Oversize(70_000, 65_536))
    assert code(refused) == "message_too_large"
    assert refused["error"]["details"] == {"size_bytes": 70_000, "limit_bytes": 65_536}
    assert "hello" in refused["error"]["hint"], "a stranger may send less than a client"


def test_one_process_and_one_user_leave_room_for_others() -> None:
    """One process took all sessions, and neither another user nor an operator could connect."""
    session_bench = make_bench(
        sessions_max=10, process_share=0.4, user_share=0.6, operator_reserve=2
    )
    other_user, third = peer_of(os.getppid(), 54_321, 54_321), peer_of(os.getpid(), 7, 7)
    codes = [session_bench.hello(b"m%d" % number, peer=STRANGER) for number in range(6)]
    assert [reply["ok"] for reply in codes] == [True] * 4 + [False] * 2
    assert codes[4]["error"]["details"] == {"limit": "process_share", "value": 4}
    codes = [session_bench.hello(b"n%d" % number, peer=other_user) for number in range(3)]
    assert [reply["ok"] for reply in codes] == [True, True, False]
    assert codes[2]["error"]["details"] == {"limit": "user_share", "value": 6}
    codes = [session_bench.hello(b"o%d" % number, peer=third) for number in range(3)]
    assert [reply["ok"] for reply in codes] == [True, False, False]
    assert codes[2]["error"]["details"] == {"limit": "sessions_max", "value": 7}
    assert session_bench.hello(b"p", role="operator")["ok"], "places are kept for operators"


def test_processes_without_a_session_have_a_reserve() -> None:
    """Eight runaway processes of a user took all its places, and no further program of that user
    could connect."""

    def runaway(pid: int) -> Peer:
        return Peer(ProcessKey(pid, 7), 7, 7, -1)

    session_bench = make_bench(sessions_max=40, process_share=0.5, user_share=0.8)  # 32 of a user
    hellos = [
        session_bench.hello(b"r%d-%d" % (process, number), peer=runaway(1000 + process))
        for number in range(20)
        for process in range(2)
    ]
    refused = [reply["error"]["details"] for reply in hellos if not reply["ok"]]
    assert refused == [{"limit": "user_share", "value": 28}] * 12
    first = [session_bench.hello(b"n%d" % one, peer=runaway(2000 + one)) for one in range(5)]
    assert [reply["ok"] for reply in first] == [True] * 4 + [False]
    assert code(session_bench.hello(b"again", peer=runaway(2000))) == "limit_exceeded"


def test_processes_that_held_something_and_left_have_a_share() -> None:
    """Each costs a descriptor until it dies: processes of one user that lease, leave and live on
    took all there are."""
    session_bench = make_bench(processes_max=4, user_share=0.5)

    def holder(number: int, uid: int, role: str = "client") -> dict[str, Any]:
        via, peer = b"%d" % number, Peer(ProcessKey(1000 + number, 7), uid, uid, -1)
        reply = session_bench.hello(via, peer=peer, role=role)
        session_bench.ask(
            "acquire",
            via,
            peer,
            nonce="n",
            spec={"consumer": "c", "model_id": "m", "footprint": FOOTPRINT},
        )
        session_bench.hang_up(via)
        return reply

    assert [holder(number, 1000)["ok"] for number in range(3)] == [True, True, False]
    assert holder(4, 2000)["ok"], "another user"
    assert holder(5, 0, "operator")["ok"], "an operator"
    assert code(holder(6, 2000)) == "limit_exceeded", "all descriptors are taken"
    session_bench.table.process_died(ProcessKey(1000, 7))
    assert holder(7, 2000)["ok"]
    assert len(session_bench.watched) == 5


def test_lost_and_silent_sessions_of_a_process_make_room_for_it() -> None:
    session_bench = make_bench(sessions_max=8, process_share=0.25)
    session_bench.hello(b"a", peer=PARENT)
    assert session_bench.hello(b"b")["ok"]
    assert session_bench.hello(b"c")["ok"]
    assert code(session_bench.hello(b"d")) == "limit_exceeded"
    session_bench.now += 11
    session_bench.ask("ping", b"c")
    assert session_bench.hello(b"d")["ok"]
    assert session_bench.left() == [session_bench.client(b"b")], "the other process keeps its own"


def test_at_the_limit_of_sessions_the_silent_ones_make_room(session_bench: Bench) -> None:
    for via in (b"a", b"b", b"c"):
        session_bench.hello(via)
    reply = session_bench.hello(b"d")
    assert code(reply) == "limit_exceeded"
    assert reply["error"]["details"]["value"] == 3
    acquire(session_bench)
    session_bench.concerned.add(session_bench.client())
    session_bench.now += 8
    session_bench.ask("ping", b"c")
    session_bench.now += 8
    assert session_bench.hello(b"d")["ok"]
    assert session_bench.left() == [session_bench.client(b"b")], (
        "a holds a lease, c spoke a moment ago"
    )


def test_no_descriptor_left_is_a_typed_error(session_bench: Bench) -> None:
    session_bench.watchable = False
    reply = session_bench.hello()
    assert code(reply) == "limit_exceeded"
    assert reply["error"]["details"] == {"limit": "open_files"}
    assert len(session_bench.table) == 0


def test_subscribers_receive_events_and_are_limited(session_bench: Bench) -> None:
    session_bench.hello(b"a")
    session_bench.hello(b"b")
    assert session_bench.ask("subscribe", b"a")["ok"]
    assert session_bench.ask("subscribe", b"a")["ok"], "twice is once"
    assert code(session_bench.ask("subscribe", b"b")) == "limit_exceeded"
    session_bench.table.broadcast({"seq": 1, "kind": "granted"})
    assert session_bench.connections[b"a"].sent[-1] == {
        "push": "event", "seq": 1, "epoch": 3, "event": {"seq": 1, "kind": "granted"},
    }  # fmt: skip


def test_one_process_does_not_take_all_subscriptions() -> None:
    session_bench = make_bench(subscribers_max=4, process_share=0.5, sessions_max=20)
    for via in (b"a", b"b", b"c"):
        session_bench.hello(via)
    answers = [session_bench.ask("subscribe", via) for via in (b"a", b"b", b"c")]
    assert [answer["ok"] for answer in answers] == [True, True, False]
    assert answers[2]["error"]["details"] == {"limit": "process_share", "value": 2}
    session_bench.hello(b"p", peer=PARENT)
    assert session_bench.ask("subscribe", b"p")["ok"]


# -- requests at consumers
def at_consumer(consumer: str, in_flight: int = 1, waiting: int = 0) -> dict[str, Any]:
    return {"consumer": consumer, "in_flight": in_flight, "waiting": waiting}


def test_a_status_counts_requests_as_long_as_their_client_is_there(session_bench: Bench) -> None:
    """The engine hears nothing of it. Only the first page of a status has it."""
    session_bench.hello(b"a", name="gateway")
    session_bench.hello(b"v", role="observer")
    acquire(session_bench)
    session_bench.concerned.add(session_bench.client(b"a"))
    session_bench.events.clear()
    assert session_bench.ask("demand", b"a", consumers=[at_consumer("x"), at_consumer("y")])["ok"]
    assert session_bench.ask("demand", b"a", consumers=[at_consumer("llm", 3, 12)])["ok"]
    shown = session_bench.ask("status", b"v")["demands"]
    assert shown == [at_consumer("llm", 3, 12) | {"client": "gateway"}], "the last replaces all"
    assert "demands" not in session_bench.ask("status", b"v", after=[1, 2.5, 3])
    assert code(session_bench.ask("demand", b"v", consumers=[])) == "not_permitted"
    for wrong in (
        at_consumer("llm", -1),
        at_consumer("llm", 1 << 31),
        at_consumer("a\nb"),
        {"consumer": "llm"},
    ):
        assert code(session_bench.ask("demand", b"a", consumers=[wrong])) == "bad_request"
    assert session_bench.events == []
    session_bench.hang_up(b"a")
    assert session_bench.left() == [], "its leases stay for a while"
    assert "demands" not in session_bench.ask("status", b"v")


def test_one_process_does_not_tell_of_all_consumers_of_a_status() -> None:
    share = 4 / d.DEMANDS_MAX
    session_bench = make_bench(process_share=share, sessions_max=1000)
    for via in (b"a", b"b"):
        session_bench.hello(via)
    three, two = ([at_consumer(f"m{number}") for number in range(count)] for count in (3, 2))
    assert session_bench.ask("demand", b"a", consumers=three)["ok"]
    assert session_bench.ask("demand", b"a", consumers=three)["ok"], "in place of the same"
    refused = session_bench.ask("demand", b"b", consumers=two)
    assert refused["error"]["details"] == {"limit": "process_share", "value": 4}
    session_bench.hello(b"p", peer=PARENT)
    assert session_bench.ask("demand", b"p", consumers=two)["ok"]
    assert len(session_bench.ask("status", b"p")["demands"]) == 5


def test_pushes_are_numbered_per_session(session_bench: Bench) -> None:
    session_bench.hello(b"a")
    for _ in range(3):
        session_bench.table.push(session_bench.client(), revoke())
    sent = session_bench.connections[b"a"].sent
    assert [message["seq"] for message in sent if "push" in message] == [1, 2, 3]


def test_an_unreachable_peer_is_no_error(session_bench: Bench) -> None:
    session_bench.hello()
    connection = session_bench.connections[b"a"]
    connection.reachable = False
    session_bench.table.push(session_bench.client(), revoke())
    assert session_bench.ask("ping") == {}
    connection.reachable = True
    assert session_bench.ask("ping")["ok"]


def ask_with_cgroup(bench: Bench, via: bytes, cgroup: str) -> Mapping[str, Any]:
    spec = {"consumer": "c", "model_id": "m", "footprint": FOOTPRINT, "cgroup": cgroup}
    return bench.ask("acquire", via, nonce="n", spec=spec)


def test_a_cgroup_is_its_owners_and_the_operators(tmp_path: Path) -> None:
    """As long as it does not exist it is of the nearest folder above it, whose user can make it."""
    session_bench = make_bench(cgroup_root=tmp_path)
    (tmp_path / "user.slice/user-54321").mkdir(parents=True)
    os.chown(tmp_path / "user.slice/user-54321", STRANGER.uid, STRANGER.gid)
    session_bench.hello()
    session_bench.hello(via=b"x", peer=STRANGER)
    session_bench.events.clear()
    long = "/user.slice/user-54321/" + "n" * 900  # longer than a name may be: it has no folder
    for mine in ("/user.slice/user-54321", "/user.slice/user-54321/new.slice/a.service", long):
        assert ask_with_cgroup(session_bench, b"x", mine) == {}
    for theirs in ("/user.slice", "/user.slice/user-1", "/system.slice/a.service"):
        refused = ask_with_cgroup(session_bench, b"x", theirs)
        assert code(refused) == "not_permitted"
        assert f"belongs to uid {os.getuid()}, not to 54321" in refused["error"]["message"]
        lease = {"lease_id": "L3-1", "token": [3, 1], "state": "held"}
        spec = {"consumer": "c", "model_id": "m", "footprint": FOOTPRINT, "cgroup": theirs}
        again = session_bench.ask("reattach", b"x", leases=[{**lease, "spec": spec}])
        assert code(again) == "not_permitted"
        assert ask_with_cgroup(session_bench, b"a", theirs) == {}, "its user is the daemon's own"
    assert len(session_bench.events) == 6


def test_paths_that_are_not_a_cgroups_and_machines_without_any_are_refused() -> None:
    session_bench = make_bench()
    session_bench.hello()
    for wrong in (
        "",
        "/",
        "a",
        "/a/",
        "//a",
        "/.",
        "/..",
        "/a/../b",
        "/a/./b",
        "/a\n",
        "/" + "a/" * 600,
    ):
        assert code(ask_with_cgroup(session_bench, b"a", wrong)) == "bad_request", wrong
    refused = ask_with_cgroup(session_bench, b"a", "/.hidden/..b/...")
    assert code(refused) == "not_permitted"
    assert "cgroupns=host" in refused["error"]["hint"]


def test_bad_frames_change_nothing(session_bench: Bench) -> None:
    session_bench.hello()
    session_bench.events.clear()
    for payload in (b"", b"\xc1", msgpack.packb([1]), b"x" * 5000):
        assert session_bench.raw(payload)["ok"] is False
    assert session_bench.events == []
    assert session_bench.ask("ping")["ok"]


def test_every_refusal_is_in_the_log_with_its_reason(
    session_bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    """A request that was refused at once was nowhere but in its own program's error message."""
    caplog.set_level("INFO")
    session_bench.ask("status")
    session_bench.hello()
    session_bench.ask("evict", target="L3-1", reason="by hand")
    session_bench.table.refuse(
        session_bench.client(), RequestId(9), ErrorView("vram_insufficient", "9 GiB of 8")
    )
    said = [record.getMessage() for record in caplog.records if record.name == "arbiter.refusals"]
    whose = f"pid {ME.process.pid}, uid {ME.uid}"
    assert said == [
        f"refused {whose}: unknown_session: status before hello",
        f"refused n ({whose}): not_permitted: only an operator may evict",
        f"refused n ({whose}): vram_insufficient: 9 GiB of 8",
    ]
