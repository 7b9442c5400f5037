"""Hostile clients against a real daemon: whatever they do, the one honest holder keeps its lease
and its answers, and when they are gone nothing of them is left: no session, no lease, no
descriptor, no memory. Floods and readers that do not read are in test_attacked_daemon.py.
"""

import json
import os
import random
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import msgpack
import pytest

from tests.support.honest import Honest
from tests.support.hostile import BOMBS, Forger
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from tests.support.wire import WireClient

pytestmark = pytest.mark.e2e
GIB, MIB = 1 << 30, 1 << 20
LARGE_BYTES = 8192
ATTACKER = """
import json, msgpack, os, sys, zmq
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import WIRE_VERSION
endpoint, words = sys.argv[1], json.loads(sys.argv[2])
def done(**facts):
    print(json.dumps(facts), flush=True)
"""

Connect = Callable[..., WireClient]


@pytest.fixture
def honest(arbiter_daemon: ArbiterProcess, connect: Connect) -> Honest:
    return Honest(arbiter_daemon, connect())


def attack(arbiter: ArbiterProcess, script: str, **words: Any) -> "subprocess.Popen[str]":
    """Another process that attacks; what it prints last are its findings. It is ended by the caller
    or by itself, and by us with its stdin."""
    return subprocess.Popen(
        [sys.executable, "-c", ATTACKER + script, arbiter.endpoint, json.dumps(words)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def report_of(attacker: "subprocess.Popen[str]") -> dict[str, Any]:
    out, _ = attacker.communicate(timeout=PATIENCE_S)
    assert attacker.returncode == 0, out
    found: dict[str, Any] = json.loads(out.splitlines()[-1])
    return found


# -- connections
def test_a_thousand_hellos_that_vanish_leave_nothing(honest: Honest) -> None:
    hasty = attack(
        honest.arbiter,
        """
context = zmq.Context()
context.set(zmq.MAX_SOCKETS, 1100)
for number in range(1000):
    socket = context.socket(zmq.DEALER)
    socket.connect(endpoint)
    name = f"h{number}"
    hello = {"op": "hello", "id": 1, "version": WIRE_VERSION, "name": name, "instance": name}
    socket.send(msgpack.packb(hello))
    if number % 2:
        socket.setsockopt(zmq.LINGER, 0)
        socket.close()
done()
os._exit(0)
""",
    )
    report_of(hasty)
    honest.is_alone()


# -- junk
def test_bombs_and_giants_are_answered_or_cut_off(honest: Honest, connect: Connect) -> None:
    bomber = connect().hello("bomber")
    for name, bomb in BOMBS.items():
        bomber.send_raw(bomb)
        answer = bomber.receive()
        assert answer is not None, name
        if name == "duplicate keys":  # its last op is `bye`
            bomber.hello("bomber")
    bomber.send_frames([b"a", b"b", b"c"])
    answer = bomber.receive()
    assert answer["error"]["code"] == "bad_frame"
    bomber.send_raw(b"\xc6" + (3 * MIB).to_bytes(4, "big") + bytes(3 * MIB))
    answer = bomber.receive()
    assert answer["error"]["code"] == "message_too_large"
    for _ in range(4):
        giant = connect().hello("giant")
        giant.send_raw(bytes(32 * MIB))  # beyond what is read at all: libzmq hangs up
    honest.is_served()


def test_thousands_of_forged_frames_are_answered_one_by_one(
    honest: Honest, connect: Connect
) -> None:
    """Valid requests, mutants and noise, with the honest one's lease and token among them."""
    forger = Forger(random.Random(5))
    forger.lease_ids += [honest.on["lease_id"], "honest"]
    # an observer can change nothing, whatever it knows
    liar = connect().hello("liar", role="observer")
    for number in range(1500):
        frame = forger.frame() if number % 2 else msgpack.packb(forger.request(id=number))
        if len(frame) > LARGE_BYTES:
            continue  # charged by its size: the others would be refused for the rate
        liar.send_raw(frame)
        answer = liar.receive()
        while answer is not None and "push" in answer:
            answer = liar.receive()
        assert answer is not None, frame[:80]
        if answer.get("ok") is False and answer["error"]["code"] == "unknown_session":
            liar.hello("liar", role="observer")  # one of them was a `bye`
    honest.is_served()


# -- somebody else's words
def test_a_stolen_token_lets_another_process_mark_a_use_and_nothing_else(honest: Honest) -> None:
    """Handing a token over is how a runner marks a goal; its thief can keep the holder resident,
    but never make it leave."""
    thief = attack(
        honest.arbiter,
        """
client = WireClient(endpoint).hello("thief")
on = words["on"]
codes = {}
for op in ("ready", "revoke_ack", "unloading", "release"):
    codes[op] = client.ask(op, **on)["error"]["code"]
codes["oom"] = client.ask("oom", **on, requested_bytes=1)["error"]["code"]
codes["cancel"] = client.ask("cancel", lease_id=on["lease_id"])["error"]["code"]
codes["renew"] = client.ask("renew", leases=[on])["gone"][0]["error"]["code"]
footprint = {"load_peak_bytes": 1, "steady_bytes": 1}
spec = {"consumer": "honest", "model_id": "m", "footprint": footprint}
held = {**on, "spec": spec, "state": "held"}
codes["reattach"] = client.ask("reattach", leases=[held])["leases"][0]["error"]["code"]
codes["end"] = client.ask("use_end", **on, use_id="work")["uses"]
old = {**on, "token": [0, 1]}
codes["stale"] = client.ask("use_begin", **old, use_id="x")["error"]["code"]
codes["use"] = client.ask("use_begin", **on, use_id="x")["uses"]
done(**codes)
""",
        on=honest.on,
    )
    found = report_of(thief)
    assert {found.pop(op) for op in ("ready", "revoke_ack", "unloading", "release", "oom", "cancel",
    "renew",
                                     "reattach")} == {"not_permitted"}  # fmt: skip
    assert found == {"end": 1, "stale": "stale_token", "use": 2}, (
        "the honest one's own use is not the thief's to end"
    )
    honest.is_alone()


def test_another_ones_routing_id_gives_nothing_of_it(honest: Honest, connect: Connect) -> None:
    """A connection is the kernel's word for it; the identity that a peer gives itself is
    ignored."""
    mine = connect(routing_id=b"mine").hello("mine")
    forger = attack(
        honest.arbiter,
        """
client = WireClient(endpoint, routing_id=b"mine").hello("mine", instance="mine-1")
clients = client.ask("status")["clients"]
done(clients=clients, left=client.ask("bye")["ok"])
""",
    )
    assert report_of(forger) == {"clients": 3, "left": True}, "it is a client of its own"
    assert mine.ask("ping")["ok"]
    assert mine.ask("bye")["ok"]
    honest.is_alone()


def test_a_pid_cannot_be_claimed_in_a_message(honest: Honest) -> None:
    """The kernel says who connected; there is no field for it."""
    liar = attack(
        honest.arbiter,
        """
client = WireClient(endpoint)
answer = client.ask("hello", name="liar", instance="i", pid=words["pid"])
done(code=answer["error"]["code"])
""",
        pid=os.getpid(),
    )
    assert report_of(liar)["code"] == "bad_request"
    honest.is_alone()
