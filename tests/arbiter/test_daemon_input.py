"""Whatever arrives on the socket: a typed answer, a daemon that goes on, and leases that stay."""

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import msgpack
import pytest
import zmq

from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient

pytestmark = pytest.mark.e2e
GIB = 1 << 30

Connect = Callable[..., WireClient]


@pytest.fixture
def holder(connect: Connect) -> WireClient:
    """A client with one lease that everything else must leave alone."""
    client = connect().hello("holder")
    assert client.granted("holder", GIB)["state"] == "loading"
    return client


def error_of(reply: dict[str, Any] | None) -> str:
    assert reply is not None, "no answer"
    assert reply["ok"] is False, reply
    return str(reply["error"]["code"])


def still_held(holder: WireClient) -> bool:
    return [(lease["consumer"], lease["state"]) for lease in holder.ask("status")["leases"]] == [
        ("holder", "loading")
    ]


def test_malformed_frames_get_an_answer_each(holder: WireClient, connect: Connect) -> None:
    client = connect().hello()
    bad = [
        b"",
        b"\xc1",
        b"{}",
        b"\x80\x80",
        msgpack.packb([1]),
        msgpack.packb({1: 2}),
        b"\xff" * 100,
        b"\x91" * 3000,
    ]
    for payload in bad:
        client.send_raw(payload)
        assert error_of(client.receive()) in ("bad_frame", "bad_request"), payload[:20]
    client.send_frames([b"a", b"b", b"c"])
    assert error_of(client.receive()) == "bad_frame"
    assert client.ask("ping")["ok"]
    assert still_held(holder)


def test_an_oversized_message_is_answered_and_a_huge_one_cuts_only_its_sender(
    holder: WireClient, connect: Connect
) -> None:
    client = connect().hello()
    client.send_raw(b"x" * (2 << 20))
    assert error_of(client.receive()) == "message_too_large"
    assert client.ask("ping")["ok"]
    client.send_raw(b"x" * (8 << 20))
    assert still_held(holder)


def test_unknown_ops_wrong_fields_and_wrong_order(holder: WireClient, connect: Connect) -> None:
    client = connect()
    assert error_of(client.ask("status")) == "unknown_session"
    assert error_of(client.ask("hello", version=99, name="n", instance="i")) == "version_mismatch"
    client.hello()
    unknown = client.ask("explode")
    assert error_of(unknown) == "unknown_op"
    assert "acquire" in unknown["error"]["details"]["known"]
    wrong = client.ask(
        "acquire",
        nonce="n",
        spec={"consumer": "c", "model_id": "m", "footprint": {"load_peak_bytes": "x"}},
    )
    assert error_of(wrong) == "bad_request"
    assert {"spec.footprint.load_peak_bytes", "spec.footprint.steady_bytes"} == {
        field["field"] for field in wrong["error"]["details"]["fields"]
    }
    assert still_held(holder)


def test_another_process_cannot_speak_for_a_lease(
    arbiter_daemon: ArbiterProcess, holder: WireClient, connect: Connect
) -> None:
    lease = holder.ask("status")["leases"][0]
    script = (
        "import sys; from tests.support.wire import WireClient\n"
        "with WireClient(sys.argv[1]) as c:\n"
        "    c.hello('thief')\n"
        "    reply = c.ask('release', lease_id=sys.argv[2], token=[int(n) for n in "
        "sys.argv[3:5]])\n"
        "    print(reply['error']['code'])\n"
    )
    token = [str(number) for number in lease["token"]]
    done = subprocess.run(
        [sys.executable, "-c", script, arbiter_daemon.endpoint, lease["lease_id"], *token],
        env=arbiter_daemon.environ, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.stdout.strip() == "not_permitted", done.stderr
    assert still_held(holder)


def test_a_forged_token_is_stale(holder: WireClient) -> None:
    lease = holder.ask("status")["leases"][0]
    epoch, serial = lease["token"]
    for token in ([epoch, serial + 1], [epoch + 1, serial], [0, 0], [-1, -1]):
        assert (
            error_of(holder.ask("release", lease_id=lease["lease_id"], token=token))
            == "stale_token"
        )
    assert error_of(holder.ask("release", lease_id="L9-9", token=[9, 9])) == "unknown_lease"
    assert still_held(holder)


def test_a_flood_is_limited_and_others_are_served(
    make_arbiter: Callable[..., ArbiterProcess],
) -> None:
    """The limit is low, so that a machine too busy to flood a daemon exceeds it all the same."""
    arbiter = make_arbiter(config="limits: {rate_per_client_per_s: 50}\n").start()
    with WireClient(arbiter.endpoint) as holder, WireClient(arbiter.endpoint) as flooder:
        holder.hello("holder").granted("holder", GIB)
        flooder.hello("flooder")
        ids = [flooder.send("ping") for _ in range(500)]
        codes = [
            reply["error"]["code"] if not (reply := flooder.reply(id_))["ok"] else "ok"
            for id_ in ids
        ]
        assert "limit_exceeded" in codes
        assert codes[0] == "ok"
        assert still_held(holder)


def test_a_req_client_is_served(arbiter_daemon: ArbiterProcess) -> None:
    with WireClient(arbiter_daemon.endpoint, kind=zmq.REQ) as client:
        client.hello()
        assert client.ask("status")["phase"] == "serving"


def test_hundreds_of_clients_that_vanish_at_once_cost_nothing(
    make_arbiter: Callable[..., ArbiterProcess],
) -> None:
    arbiter_daemon = make_arbiter(config="limits: {process_share: 0.5}\n").start()
    holder = WireClient(arbiter_daemon.endpoint).hello("holder")
    assert holder.granted("holder", GIB)["state"] == "loading"
    script = (
        "import os, sys; from tests.support.wire import WireClient\n"
        "clients = [WireClient(sys.argv[1]).hello(f'c{n}', instance=f'c{n}') for n in range(200)]\n"
        "for n, c in enumerate(clients): c.acquire(f'c{n}', 7 << 30)\n"
        "print('ready', flush=True); sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, arbiter_daemon.endpoint],
        env=arbiter_daemon.environ, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as child:  # fmt: skip
        assert child.stdout is not None
        assert child.stdout.readline() == b"ready\n"
        assert holder.ask("status")["totals"]["leases"] == 201
        holder.ask("subscribe")
        child.kill()
        child.communicate()
    for number in range(200):
        name = f"c{number}"
        holder.push(
            "event",
            where=lambda p, name=name: (
                p["event"]["kind"] in ("cancelled", "lost") and p["event"]["consumer"] == name
            ),
        )  # type: ignore[misc]
    assert still_held(holder)
    assert holder.ask("status")["clients"] == 1
    holder.close()
