"""Guests: what the table of roles lets them do, and the end of their uses. No socket."""

import os
import random
import socket
from pathlib import Path

import msgpack
import pytest

from tests.arbiter.rpc.session_bench import Bench, make_bench
from tests.support.hostile import Forger
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime.peercred import Peer, identify
from vram_arbiter.schemas.wire.requests import REQUESTS

GUESTS, MEMBERS, OPERATORS = 5900, 5901, 5902
GUEST = Peer(ProcessKey(7001, 7), 5001, 5001, -1, (GUESTS, MEMBERS))
NEIGHBOUR = Peer(ProcessKey(7002, 7), 5002, 5002, -1, (GUESTS, MEMBERS))
MAY = {"hello", "ping", "bye", "status", "why", "subscribe", "prepare", "use_begin", "use_end"}
USE = {"lease_id": "L1-1", "token": [1, 2], "use_id": "u"}


@pytest.fixture
def session_bench() -> Bench:
    return make_bench(guests_gid=GUESTS, operators_gid=OPERATORS)


def in_a_use(session_bench: Bench, via: bytes = b"g", peer: Peer = GUEST) -> None:
    session_bench.hello(via, peer)
    session_bench.ask("use_begin", via, **USE)
    session_bench.concerned.add(session_bench.client(via))


@pytest.mark.parametrize("op", REQUESTS)
def test_a_guest_tries_everything(session_bench: Bench, op: str) -> None:
    """A request that is new on the wire is refused until the table names it."""
    session_bench.hello(b"g", GUEST)
    before = list(session_bench.events)
    request = {**Forger(random.Random(op)).request(op), "id": 99}
    reply = session_bench.raw(msgpack.packb(request), b"g")
    if op in MAY:
        assert reply == {} or reply["ok"] or reply["error"]["code"] != "not_permitted"
        return
    expected = "remote_may_not_hold" if op == "acquire" else "not_permitted"
    assert reply["error"]["code"] == expected
    assert os.uname().nodename in reply["error"]["hint"]
    assert session_bench.events == before, "the engine hears of no refused request"


def test_the_refusal_of_an_acquire_says_what_to_run_where(session_bench: Bench) -> None:
    session_bench.hello(b"g", GUEST)
    footprint = {"load_peak_bytes": 5 << 30, "steady_bytes": 1}
    spec = {"consumer": "a b", "model_id": "m", "footprint": footprint}
    error = session_bench.ask("acquire", b"g", nonce="n", spec=spec)["error"]
    assert "`vramctl run --name 'a b' --vram 5GiB -- PROGRAM`" in error["hint"]
    assert error["details"] == {"host": os.uname().nodename}


@pytest.mark.parametrize("asked", ["client", "observer", "operator"])
def test_a_guest_is_one_whatever_it_asks_for(session_bench: Bench, asked: str) -> None:
    both = Peer(ProcessKey(7003, 7), 5003, 5003, -1, (OPERATORS, GUESTS))
    assert session_bench.hello(b"g", both, role=asked)["role"] == "guest"
    assert session_bench.hello(b"g", both, role=asked)["ok"], "a repeat is the same"


def test_root_and_the_daemons_user_are_no_guests(session_bench: Bench) -> None:
    for via, uid in ((b"r", 0), (b"d", os.getuid())):
        peer = Peer(ProcessKey(7004, 7), uid, GUESTS, -1, (GUESTS,))
        assert session_bench.hello(via, peer, role="operator")["role"] == "operator"


def test_without_a_group_nobody_is_a_guest() -> None:
    assert make_bench().hello(b"g", GUEST)["role"] == "client"


def test_a_member_by_its_account_alone_is_a_guest() -> None:
    """A process that has left its supplementary groups has not left the guests."""
    group = 1  # user and group `daemon`
    bench = make_bench(guests_gid=group)
    assert bench.hello(b"g", Peer(ProcessKey(7005, 7), 1, 5900, -1))["role"] == "guest"


def test_the_kernel_names_supplementary_groups(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener, socket.socket(socket.AF_UNIX) as mine:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        mine.connect(str(tmp_path / "s"))
        accepted, _ = listener.accept()
        with accepted:
            peer = identify(accepted)
        os.close(peer.pidfd)
    assert set(peer.groups) == set(os.getgroups())


# -- the end of a use
def test_a_lost_connection_ends_a_guests_uses_at_once(session_bench: Bench) -> None:
    """The process that the kernel names is the tunnel's: it outlives the robot's program, so the
    use would have lasted as long as the tunnel."""
    in_a_use(session_bench)
    session_bench.hello(b"c")
    session_bench.ask("use_begin", b"c", **USE)
    session_bench.concerned.add(session_bench.client(b"c"))
    guest = session_bench.client(b"g")
    session_bench.hang_up(b"g")
    session_bench.hang_up(b"c")
    assert session_bench.left() == [guest], "any other client may come back to its uses"


def test_a_silent_guest_loses_its_uses(session_bench: Bench) -> None:
    assert session_bench.hello(b"g", GUEST)["heartbeat_s"] == 1.0
    in_a_use(session_bench, b"g")
    in_a_use(session_bench, b"n", NEIGHBOUR)
    session_bench.now += 3.9
    session_bench.ask("ping", b"n")
    session_bench.table.end_silent_guests()
    assert session_bench.left() == []
    session_bench.now += 0.2
    session_bench.table.end_silent_guests()
    assert session_bench.left() == [session_bench.client(b"g")], "its neighbour was heard"
    assert "silent" in session_bench.connections[b"g"].closed
    left = [event for event in session_bench.events if isinstance(event, ev.ClientLeft)]
    assert left[0].reason == "it was silent for 4.1 s"


def test_silence_costs_only_guests_in_a_use(session_bench: Bench) -> None:
    session_bench.hello(b"g", GUEST)
    session_bench.hello(b"c")
    session_bench.ask("use_begin", b"c", **USE)
    session_bench.concerned.add(session_bench.client(b"c"))
    session_bench.now += 60
    session_bench.table.end_silent_guests()
    assert session_bench.left() == []


def test_a_shorter_heartbeat_is_kept() -> None:
    bench = make_bench(guests_gid=GUESTS, heartbeat_s=0.1)
    assert bench.hello(b"g", GUEST)["heartbeat_s"] == 0.1
