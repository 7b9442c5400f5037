"""A client that sends without end, and everybody else: what they release is still measured, so they
never run out of leases."""

import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient
from vram_arbiter.schemas import defaults as d

FLOODER = """
import sys, zmq, msgpack
from tests.support.wire import WireClient
client = WireClient(sys.argv[1]).hello("flooder")
print("up", flush=True)
while True:
    try:
        client.socket.send(msgpack.packb({"op": "ping", "id": 9}), zmq.NOBLOCK)
    except zmq.Again:
        while client.socket.poll(1):
            client.socket.recv()
"""


@pytest.fixture
def flooded(arbiter_daemon: ArbiterProcess) -> Iterator[ArbiterProcess]:
    flooder = subprocess.Popen(
        [sys.executable, "-c", FLOODER, arbiter_daemon.endpoint],
        env=arbiter_daemon.environ,
        stdout=subprocess.PIPE,
    )
    try:
        assert flooder.stdout.readline()
        yield arbiter_daemon
    finally:
        flooder.kill()
        flooder.wait()


def test_releases_are_measured_under_a_flood(flooded: ArbiterProcess) -> None:
    """Readings starved: their thread got the interpreter once in 5 ms and needs it twenty times a
    reading."""
    with WireClient(flooded.endpoint).hello("calm") as calm:
        for number in range(3 * d.LEASES_PER_CLIENT_MAX):
            lease = calm.granted("calm", 4096, nonce=f"n{number}", mode="shared")
            assert calm.ask("release", lease_id=lease["lease_id"], token=lease["token"])["ok"]
            calm.ask("status")
