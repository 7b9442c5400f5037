"""A gateway under attack by its clients: refused, bounded in memory, and others are served.

Each attack is bounded in what it sends. How long honest requests took meanwhile is told as the
property `honest_p99_ms` of a test, not asserted: other tests run beside this one.
"""

import contextlib
import os
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from urllib.parse import urlsplit

import httpx
import pytest

pytest.importorskip("aiohttp", reason="the extra `gateway`")

from tests.sidecars.gateway.conftest import GatewayProcess, stand_in
from tests.support.process import ArbiterProcess
from tests.support.processes import rss_bytes
from tests.support.waiting import PATIENCE_S, until

pytestmark = pytest.mark.e2e
MIB = 1 << 20
HEAD_S = 1.0
HEADER_MAX, BODY_MAX = 8192, MIB // 2
MEMORY_MAX = 48 * MIB
"""Growth of the gateway in an attack: what it may hold of bodies, and buffers of sockets."""
ECHO = b"POST /upstream/a/first HTTP/1.1\r\nHost: localhost\r\n"
SMUGGLED = b"GET /upstream/a/smuggled HTTP/1.1\r\nHost: localhost\r\n\r\n"


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GatewayProcess]:
    """One gateway for all attacks, whose server is awake: what each leaves adds up."""
    arbiter = ArbiterProcess(prepared=True)
    folder = tmp_path_factory.mktemp("gateway")
    try:
        arbiter.start()
        limits = {
            "head_s": HEAD_S,
            "header_max_bytes": HEADER_MAX,
            "body_max_bytes": BODY_MAX,
            "held_max_bytes": 2 * BODY_MAX,
            "connections_per_peer": 600,
        }
        servers = {"a": stand_in(arbiter, 1, parallel=24), "b": stand_in(arbiter, 1)}
        config = {"listen": "127.0.0.1:0", "servers": servers, "limits": limits}
        started = GatewayProcess(arbiter, config, folder)
        try:
            assert started.client.get("/upstream/a/x").status_code == 200
            yield started
            assert "Traceback" not in (folder / "gateway.log").read_text()
        finally:
            started.close()
    finally:
        arbiter.close()


@pytest.fixture(autouse=True)
def asked_meanwhile(
    attacked: GatewayProcess, record_property: Callable[[str, object], None]
) -> Iterator[None]:
    """Ask as others do, all the time. The gateway keeps nothing of an attack, and little in it."""
    before, files = rss_bytes(attacked.process.pid), open_files(attacked)
    took_s, grown, stop = [], 0, threading.Event()
    problems: list[str] = []

    def ask() -> None:
        nonlocal grown
        with httpx.Client(base_url=attacked.url, timeout=PATIENCE_S) as client:
            while not (took_s and stop.wait(0.02)):
                began = time.monotonic()
                answer = client.post("/v1/echo", content=b'{"model": "b"}')
                took_s.append(time.monotonic() - began)
                grown = max(grown, rss_bytes(attacked.process.pid) - before)
                if answer.status_code != 200:
                    problems.append(answer.text)

    asking = threading.Thread(target=ask)
    assert attacked.client.post("/v1/echo", content=b'{"model": "b"}').status_code == 200  # awake
    asking.start()
    try:
        yield
    finally:
        stop.set()
        asking.join()
    record_property("honest_p99_ms", round(sorted(took_s)[int(0.99 * len(took_s))] * 1e3, 1))
    assert not problems
    assert grown <= MEMORY_MAX
    until(lambda: not unanswered(attacked))
    until(lambda: open_files(attacked) <= files + 8)  # kept connections to servers


def unanswered(gateway: GatewayProcess) -> int:
    return sum(one["in_flight"] + one["waiting"] for one in gateway.running().values())


def open_files(gateway: GatewayProcess) -> int:
    return len(os.listdir(f"/proc/{gateway.process.pid}/fd"))


def connection_to(gateway: GatewayProcess) -> socket.socket:
    found = urlsplit(gateway.url)
    return socket.create_connection((found.hostname, found.port), PATIENCE_S)


def answers(peer: socket.socket) -> bytes:
    """Return all that comes until the gateway hangs up."""
    came = b""
    with contextlib.suppress(ConnectionResetError):
        while data := peer.recv(1 << 16):
            came += data
    return came


def statuses(came: bytes) -> list[int]:
    return [int(one) for one in re.findall(rb"HTTP/1\.[01] (\d{3}) ", came)]


# -- what is not HTTP
HEADS = {
    "both lengths": ECHO + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    "two lengths": ECHO + b"Content-Length: 1\r\nContent-Length: 60\r\n\r\nx",
    "length list": ECHO + b"Content-Length: 1, 60\r\n\r\nx",
    "negative length": ECHO + b"Content-Length: -1\r\n\r\n",
    "signed length": ECHO + b"Content-Length: +1\r\n\r\nx",
    "endless length": ECHO + b"Content-Length: " + b"9" * 40 + b"\r\n\r\n",
    "unknown coding": ECHO + b"Transfer-Encoding: xchunked\r\n\r\n0\r\n\r\n",
    "chunked not last": ECHO + b"Transfer-Encoding: chunked, identity\r\n\r\n0\r\n\r\n",
    "chunked twice": ECHO + b"Transfer-Encoding: chunked, chunked\r\n\r\n0\r\n\r\n",
    "hidden coding": ECHO + b"Transfer-Encoding : chunked\r\n\r\n0\r\n\r\n",
    "folded coding": ECHO + b"Transfer-Encoding:\r\n chunked\r\n\r\n0\r\n\r\n",
    "folded header": ECHO + b"X-A: b\r\n c\r\n\r\n",
    "space in a name": ECHO + b"X A: b\r\n\r\n",
    "zero byte": ECHO + b"X-A: \0\r\n\r\n",
    "lone return": ECHO + b"X-A: b\rX-B: c\r\n\r\n",
    "hexadecimal sign": ECHO + b"Transfer-Encoding: chunked\r\n\r\n0x1\r\nx\r\n0\r\n\r\n",
    "negative chunk": ECHO + b"Transfer-Encoding: chunked\r\n\r\n-1\r\nx\r\n0\r\n\r\n",
    "unended chunk": ECHO + b"Transfer-Encoding: chunked\r\n\r\n1\r\nxx\r\n0\r\n\r\n",
    "huge chunk": ECHO + b"Transfer-Encoding: chunked\r\n\r\n" + b"F" * 32 + b"\r\n",
    "long header": ECHO + b"X-A: " + b"x" * 2 * HEADER_MAX + b"\r\n\r\n",
    "many headers": ECHO + b"X-A: b\r\n" * 200 + b"\r\n",
    "long target": b"GET /" + b"x" * HEADER_MAX + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
    "no target": b"GET HTTP/1.1\r\n\r\n",
    "version": b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n",
    "second version": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(64),
    "noise": bytes(range(256)) * 16,
}


def test_a_request_that_can_be_read_two_ways_is_refused(attacked: GatewayProcess) -> None:
    """What follows it is not taken for another request."""
    told = {}
    for name, head in HEADS.items():
        with connection_to(attacked) as peer:
            peer.sendall(head + SMUGGLED)
            peer.settimeout(PATIENCE_S)
            told[name] = statuses(answers(peer))
    assert told == {name: [400] for name in HEADS}


@pytest.mark.parametrize(
    "head", [b"GET http://localhost/x HTTP/1.1\r\n", b"CONNECT localhost:80 HTTP/1.1\r\n"]
)
def test_the_gateway_leads_nowhere_else(attacked: GatewayProcess, head: bytes) -> None:
    with connection_to(attacked) as peer:
        peer.sendall(head + b"Host: localhost\r\n\r\n")
        assert statuses(peer.recv(1 << 16)) == [400]


def test_requests_at_once_are_answered_in_their_order(attacked: GatewayProcess) -> None:
    body = b"GET /x HTTP/1.1\r\n\r\n"
    with connection_to(attacked) as peer:
        first = ECHO + b"Content-Length: %d\r\n\r\n" % len(body) + body
        second = SMUGGLED.replace(b"\r\n\r\n", b"\r\nConnection: close\r\n\r\n")
        peer.sendall(first + ECHO + b"Transfer-Encoding: chunked\r\n\r\n")
        peer.sendall(b"%x\r\n%b\r\n0\r\n\r\n" % (len(body), body) + second)
        came = answers(peer)
    assert statuses(came) == [200, 200, 200]
    assert re.findall(rb'"target": "([^"]*)"', came) == [b"/first", b"/first", b"/smuggled"]
    assert re.findall(rb'"bytes": (\d+)', came) == [b"%d" % len(body)] * 2 + [b"0"]


# -- bodies
CHAT = b"POST /v1/chat/completions HTTP/1.1\r\nHost: localhost\r\n"
FORM = CHAT + b"Content-Type: multipart/form-data; boundary=x\r\n"
ENDLESS = b"Transfer-Encoding: chunked\r\n\r\n"
BODIES = {
    "a late model": (CHAT + ENDLESS, b'{"a": "', b"x" * MIB, 413),
    "many values": (CHAT + ENDLESS, b'{"a": [', b"1," * (MIB // 2), 413),
    "many keys": (CHAT + ENDLESS, b"{", b'"a":{},' * (MIB // 7), 413),
    "deep lists": (CHAT + ENDLESS, b'{"a": ', b"[" * MIB, 400),
    "deep objects": (CHAT + ENDLESS, b"", b'{"a":' * (MIB // 5), 400),
    "an endless form": (FORM + ENDLESS, b"--x\r\n\r\n", b"x" * MIB, 413),
    "an endless part's head": (FORM + ENDLESS, b"--x\r\n", b"A: b\r\n" * (MIB // 6), 400),
    "empty parts": (FORM + ENDLESS, b"", b"--x\r\n\r\n\r\n" * (MIB // 9), 413),
    "a long name": (CHAT + ENDLESS, b'{"model": "', b"x" * MIB, 400),
    "compressed": (CHAT + b"Content-Encoding: gzip\r\n" + ENDLESS, b"", b"x" * MIB, 400),
}


@pytest.mark.parametrize(("head", "begin", "more", "status"), BODIES.values(), ids=BODIES)
def test_a_body_whose_model_does_not_come_is_refused(
    attacked: GatewayProcess, head: bytes, begin: bytes, more: bytes, status: int
) -> None:
    def chunk(data: bytes) -> bytes:
        return b"%x\r\n%b\r\n" % (len(data), data)

    with connection_to(attacked) as peer:
        peer.sendall(head + (chunk(begin) if begin else b""))
        with contextlib.suppress(OSError):  # it may hang up meanwhile
            peer.sendall(chunk(more))
        assert statuses(peer.recv(1 << 16)) == [status]


def test_bodies_in_wait_hold_no_more_than_allowed(attacked: GatewayProcess) -> None:
    """One that finds no room is told so, and finds it when others have left."""
    body = b'{"a": "' + b"x" * (BODY_MAX - 1000)
    with contextlib.ExitStack() as stack:
        peers = [stack.enter_context(connection_to(attacked)) for _ in range(8)]
        for peer in peers:
            peer.sendall(CHAT + b"Content-Length: %d\r\n\r\n" % BODY_MAX + body)
        told = [peer.recv(1 << 16) for peer in peers]  # the rest: nothing came for HEAD_S
    assert {*map(tuple, map(statuses, told))} == {(503,), (400,)}
    assert attacked.client.post("/v1/x", content=body + b'", "model": "a"}').status_code == 200


def test_a_silent_body_does_not_keep_its_server(attacked: GatewayProcess) -> None:
    with contextlib.ExitStack() as stack:
        peers = [stack.enter_context(connection_to(attacked)) for _ in range(24)]
        for peer in peers:
            peer.sendall(ECHO + b"Content-Length: 100\r\n\r\nslow")
        until(lambda: attacked.running()["a"]["in_flight"] == 24)  # `parallel`
        assert attacked.client.get("/upstream/a/x").status_code == 200
        assert [statuses(peer.recv(1 << 16)) for peer in peers] == [[400]] * 24


def test_a_silent_head_is_cut(attacked: GatewayProcess) -> None:
    with contextlib.ExitStack() as stack:
        peers = [stack.enter_context(connection_to(attacked)) for _ in range(300)]
        for number, peer in enumerate(peers):
            peer.sendall(ECHO[: number % len(ECHO)])
        for peer in peers:
            assert answers(peer) == b""


# -- clients that do not read, or leave
def test_slow_readers_hold_no_more_than_buffers(attacked: GatewayProcess) -> None:
    asks = b"GET /upstream/a/large?bytes=8000000 HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with contextlib.ExitStack() as stack:
        peers = [stack.enter_context(connection_to(attacked)) for _ in range(20)]
        for peer in peers:
            peer.sendall(asks * 50)
        until(lambda: attacked.running()["a"]["in_flight"] == 20)
        assert attacked.client.get("/upstream/a/x").status_code == 200
        assert all(peer.recv(1000).startswith(b"HTTP/1.1 200 OK") for peer in peers)


@pytest.mark.parametrize("leaving", ["closed", "reset", "half closed"])
def test_clients_that_leave_at_any_time_leave_nothing(
    attacked: GatewayProcess, leaving: str
) -> None:
    stream = b'{"model": "a", "stream": true, "max_tokens": 9, "messages": [{"content": ""}], '
    stream += b'"user": "nobody"}'
    asks = CHAT + b"Content-Length: %d\r\n\r\n" % len(stream) + stream
    large = b"GET /upstream/a/large?bytes=8000000 HTTP/1.1\r\nHost: localhost\r\n\r\n"
    parts = (b"", asks[:20], asks[:-20], asks, asks * 3, large, ECHO + b"Expect: 100-continue\r\n"
             b"Content-Length: 9\r\n\r\n")  # fmt: skip
    peers = [connection_to(attacked) for _ in parts * 3]
    for peer, part in zip(peers, parts * 3, strict=True):
        peer.sendall(part)
    until(lambda: attacked.running()["a"]["in_flight"] >= 12)
    for peer in peers:
        match leaving:
            case "half closed":
                peer.shutdown(socket.SHUT_WR)
            case "reset":
                peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    if leaving == "half closed":
        for peer in peers:
            answers(peer)
    for peer in peers:
        peer.close()


# -- WebSockets
UPGRADE = (
    b"GET /upstream/a/ws HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket"
    b"\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


def test_a_flood_of_websockets_holds_no_more_than_buffers(attacked: GatewayProcess) -> None:
    """Nothing that comes back is read; one sends pings alone, one a frame without end."""
    frame = b"\x82\xff" + (MIB).to_bytes(8) + bytes(4 + MIB)
    endless = b"\x82\xff" + (1 << 62).to_bytes(8) + bytes(4 + MIB)
    with contextlib.ExitStack() as stack:
        for flood in [frame, frame, frame, endless, b"\x89\x80mask" * 100_000]:
            peer = stack.enter_context(connection_to(attacked))
            peer.sendall(UPGRADE)
            assert statuses(peer.recv(1000)) == [101]
            peer.settimeout(0.05)
            with contextlib.suppress(OSError):
                for _ in range(4):
                    peer.sendall(flood)
        assert attacked.client.get("/upstream/a/x").status_code == 200


def test_a_refused_websocket_says_so(attacked: GatewayProcess) -> None:
    with connection_to(attacked) as peer:
        peer.sendall(UPGRADE.replace(b"/ws ", b"/x "))
        assert statuses(peer.recv(1 << 16)) == [200]  # the server's own answer
    with connection_to(attacked) as peer:
        peer.sendall(UPGRADE.replace(b"Version: 13", b"Version: 1"))
        assert statuses(peer.recv(1 << 16)) == [400]


def test_no_address_has_more_than_its_connections(attacked: GatewayProcess) -> None:
    with contextlib.ExitStack() as stack:
        peers = [stack.enter_context(connection_to(attacked)) for _ in range(590)]
        with connection_to(attacked) as one:
            one.sendall(SMUGGLED)
            assert statuses(one.recv(1 << 16)) == [200]
        beyond = [stack.enter_context(connection_to(attacked)) for _ in range(60)]
        assert any(answers(peer) == b"" for peer in beyond)
        assert peers
