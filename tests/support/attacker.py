"""A process that attacks a ZeroMQ server's unix socket by hand, until it is killed or has sent
enough. Not a test module.

Usage: attacker.py MODE SOCKET. Prints a line when the attack is under way; bounded in count and
bytes whatever the server does.
"""

import contextlib
import resource
import select
import socket
import sys
import time

GREETING = bytes.fromhex("ff00000000000000017f03014e554c4c") + bytes(48)
READY = b"\x04)\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER\x08Identity\x00\x00\x00\x00"
CONNECTIONS_MAX = 4000
EMPTY_FRAMES = 3_000_000
SECONDS_MAX = 120.0


def greeted(path: str) -> socket.socket:
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    peer.connect(path)
    peer.sendall(GREETING + READY)
    return peer


def push(peer: socket.socket, data: bytes) -> None:
    """Send without ever reading an answer, until all is sent, the server hangs up, or the time is
    over.
    """
    left, ends = memoryview(data), time.monotonic() + SECONDS_MAX
    with contextlib.suppress(OSError):
        while left and time.monotonic() < ends:
            left = left[peer.send(left[: 1 << 18]) :]


def zmtp_frame(payload: bytes, flags: int = 0) -> bytes:
    return bytes((flags | 2,)) + len(payload).to_bytes(8) + payload


def empties(path: str) -> None:
    """Three million messages of one empty frame."""
    say_under_way()
    push(greeted(path), b"\x00\x00" * EMPTY_FRAMES)


def maps(path: str) -> None:
    """Messages of 1 MiB and of 16 MiB that hold nothing but empty maps, and as many values as the
    server builds.
    """
    say_under_way()
    ends = time.monotonic() + SECONDS_MAX
    allowed = zmtp_frame(b"\x81\xa1x\xdc\x0f\xa0" + b"\x80" * 4000)
    bombs = [
        zmtp_frame(b"\xdd" + n.to_bytes(4) + b"\x80" * n) for n in ((1 << 20) - 5, (16 << 20) - 5)
    ]
    while time.monotonic() < ends:
        for bomb in (*bombs, *[allowed] * 100):
            push(greeted(path), bomb)


def more(path: str) -> None:
    """Frames with MORE set for ever, each of 64 KiB, on one connection after the other."""
    say_under_way()
    ends = time.monotonic() + SECONDS_MAX
    while time.monotonic() < ends:
        push(greeted(path), zmtp_frame(bytes(1 << 16), 1) * 64)


def connects(path: str) -> None:
    """Connections that say nothing, up to a thousand a second and as many as this process may have;
    those that are cut are made again.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, CONNECTIONS_MAX + 64), hard))
    peers: list[socket.socket] = []
    ends = time.monotonic() + SECONDS_MAX
    announced = False
    while time.monotonic() < ends:
        with contextlib.suppress(OSError):
            peer = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            peer.setblocking(False)
            peer.connect(path)
            peers.append(peer)
        if len(peers) == CONNECTIONS_MAX or (peers and len(peers) % 200 == 0):
            if not announced:
                announced = True
                say_under_way()
            cut = set(select_closed(peers))
            peers = [one for one in peers if one not in cut]
        time.sleep(0.001)


def select_closed(peers: list[socket.socket]) -> list[socket.socket]:
    poll = select.poll()
    by_number = {one.fileno(): one for one in peers}
    for number in by_number:
        poll.register(number, select.POLLHUP)
    closed = [by_number[number] for number, _ in poll.poll(0)]
    for one in closed:
        one.close()
    return closed


def say_under_way() -> None:
    print("under way", flush=True)


if __name__ == "__main__":
    {"empties": empties, "maps": maps, "more": more, "connects": connects}[sys.argv[1]](sys.argv[2])
    time.sleep(SECONDS_MAX)  # what it holds it keeps
