"""Attacks on a server's socket, by a process that may connect: what no libzmq client would send.

Plain blocking sockets that speak ZMTP by hand. Every attack ends by itself after the seconds it was
given, takes a refusal (a cut connection) as a reason to go on with the next connection, and keeps
at most `CONNECTIONS` of them, or `BARE_CONNECTIONS` that say nothing. Used by hostile tests, the
storm and the benchmarks; must not be pointed at anything but a server that the caller started.
"""

import contextlib
import resource
import socket
import sys
import time
from collections.abc import Callable, Iterator
from itertools import cycle

import msgpack

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.runtime.zmtp import GREETING, READY, encode

CONNECTIONS = 600
BARE_CONNECTIONS = 2000
"""More than the files that a process may open by default."""
BATCH = 64 * 1024
SEND_TIMEOUT_S = 0.2

_IDENTITY = b"\x00\x00\x00\x00\x01"
"""What libzmq would have chosen for the next connection."""


def peer_greeting(socket_type: bytes = b"DEALER", identity: bytes = b"") -> bytes:
    """What a peer of `socket_type` says until its first message: greeting and READY."""
    properties = b"".join(
        bytes((len(name),)) + name + len(value).to_bytes(4) + value
        for name, value in ((b"Socket-Type", socket_type), (b"Identity", identity))
    )
    body = b"\x05READY" + properties
    return GREETING + b"\x06" + len(body).to_bytes(8) + body


def raw_connection(path: str, first: bytes | None = None) -> socket.socket:
    """A connection that has said `first` (greeting and READY unless given). Raises OSError."""
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        peer.settimeout(SEND_TIMEOUT_S)
        peer.connect(path)
        peer.sendall(peer_greeting() if first is None else first)
    except BaseException:
        peer.close()
        raise
    return peer


def shaken(path: str) -> socket.socket:
    """A connection whose handshake is complete. Raises OSError where the server hangs up."""
    peer = raw_connection(path)
    left = len(GREETING) + len(READY)
    while left:
        if not (data := peer.recv(left)):
            peer.close()
            raise ConnectionError("the server hung up")
        left -= len(data)
    return peer


def _hello(path: str) -> socket.socket:
    hello = {
        "op": "hello",
        "id": 1,
        "version": d.WIRE_VERSION,
        "name": "attacker",
        "instance": str(time.monotonic_ns()),
    }
    peer = shaken(path)
    peer.sendall(encode(msgpack.packb(hello)))
    return peer


def _pour(
    path: str, end_s: float, open_one: Callable[[str], socket.socket], data: Iterator[bytes]
) -> None:
    """Send `data` over one connection after another, each until the server cuts it or reads no
    more."""
    while time.monotonic() < end_s:
        try:
            with contextlib.closing(open_one(path)) as peer:
                while time.monotonic() < end_s:
                    peer.sendall(next(data))
        except OSError:
            time.sleep(0.001)


def _hoard(
    path: str, end_s: float, open_one: Callable[[str], socket.socket], most: int = CONNECTIONS
) -> None:
    """Keep as many connections open as the server, or this process, allows."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    kept: list[socket.socket] = []
    try:
        while time.monotonic() < end_s:
            try:
                kept.append(open_one(path))
            except OSError:
                time.sleep(0.001)
            if len(kept) > most:
                kept.pop(0).close()
    finally:
        for peer in kept:
            peer.close()


def empty_frames(path: str, end_s: float) -> None:
    """One message of frames without bytes and without end."""
    _pour(path, end_s, shaken, cycle([b"\x01\x00" * (BATCH // 2)]))


def more_for_ever(path: str, end_s: float) -> None:
    """One message that never ends."""
    _pour(path, end_s, shaken, cycle([b"\x03" + BATCH.to_bytes(8) + bytes(BATCH)]))


def half_messages(path: str, end_s: float) -> None:
    """Many connections, each with a message that is almost complete."""

    def half(path: str) -> socket.socket:
        peer = _hello(path)
        peer.sendall(b"\x02" + (1 << 20).to_bytes(8) + bytes(1 << 18))
        return peer

    _hoard(path, end_s, half)


def bare_connects(path: str, end_s: float) -> None:
    """Connections that never say anything."""
    _hoard(path, end_s, lambda path: raw_connection(path, b""), BARE_CONNECTIONS)


def silent_peers(path: str, end_s: float) -> None:
    """Connections that complete the handshake and never say hello."""
    _hoard(path, end_s, shaken)


def forged_identity(path: str, end_s: float) -> None:
    """Connections under the identity that libzmq would give to the next one."""
    _hoard(path, end_s, lambda path: raw_connection(path, peer_greeting(identity=_IDENTITY)))


def unknown_keys(path: str, end_s: float) -> None:
    """Requests of a mebibyte of keys that mean nothing."""
    keys = {f"{number:x}": 0 for number in range(110_000)}
    _pour(path, end_s, _hello, cycle([encode(msgpack.packb({"op": "status", "id": 2, **keys}))]))


def empty_maps(path: str, end_s: float) -> None:
    """Requests of 1 MiB and of 16 MiB of empty maps, and as many values as a server builds."""

    def listed(count: int) -> bytes:
        request = msgpack.packb({"op": "status", "id": 2, "x": []})[:-1]
        return encode(request + b"\xdd" + count.to_bytes(4) + b"\x80" * count)

    requests = [listed(1_000_000), listed((16 << 20) - 64), *[listed(4000)] * 100]
    _pour(path, end_s, _hello, cycle(requests))


def slow_reader(path: str, end_s: float) -> None:
    """Requests with long answers, of which none is read."""
    ask = encode(msgpack.packb({"op": "history", "id": 3, "after": 0, "limit": 1000}))
    _pour(path, end_s, _hello, cycle([ask * 100]))


def pings(path: str, end_s: float) -> None:
    """Heartbeats as fast as they go, of which no answer is read."""
    _pour(path, end_s, shaken, cycle([b"\x04\x07\x04PING\x00\x00" * 4096]))


def flood(path: str, end_s: float) -> None:
    """Small valid requests as fast as they go, answers unread until the connection is full."""
    _pour(path, end_s, _hello, cycle([encode(msgpack.packb({"op": "ping", "id": 4})) * 1000]))


ATTACKS: dict[str, Callable[[str, float], None]] = {
    attack.__name__: attack
    for attack in (
        empty_frames,
        more_for_ever,
        half_messages,
        bare_connects,
        silent_peers,
        forged_identity,
        unknown_keys,
        empty_maps,
        slow_reader,
        pings,
        flood,
    )
}
"""By name: `attack(path, end_s)` goes on until `time.monotonic()` is `end_s`."""
WITHOUT_A_SESSION = ("empty_frames", "empty_maps", "more_for_ever", "bare_connects")
"""Those that harm a server without sessions, too."""


def main() -> None:
    """Attack as `ATTACK SOCKET SECONDS` on the command line say; print a line before."""
    name, path, seconds = sys.argv[1:]
    print("attacking", flush=True)
    ATTACKS[name](path, time.monotonic() + float(seconds))
