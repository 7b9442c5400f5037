"""A flood, a REQ socket and clients that vanish: the daemon goes on, and leases stay.

Hostile clients are in tests/e2e/test_hostile.py, malformed frames in tests/arbiter/rpc.
"""

import subprocess
import sys
from collections.abc import Callable

import pytest
import zmq

from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import GIB

pytestmark = pytest.mark.e2e


def still_held(holder: WireClient) -> bool:
    return [(lease["consumer"], lease["state"]) for lease in holder.ask("status")["leases"]] == [
        ("holder", "loading")
    ]


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
