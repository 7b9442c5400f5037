"""ssh's ProxyCommand: one TCP connection without Nagle's delay and without delayed ACKs, relayed to
standard input and output.

sshd writes a reply in pieces and, without TCP_NODELAY, waits for the ACK of one before it sends the
next; the robot's kernel delays that ACK by 40 ms. TCP_QUICKACK sends it at once. The kernel clears
the option by itself (tcp(7)), so it is set again around every read. 450 kB take 4 ms for 44.

Run as a file by its path, which takes 20 ms: it imports the standard library alone, not even this
package.
"""

import contextlib
import fcntl
import os
import socket
import sys
import threading

CONNECT_TIMEOUT_S = 10.0
CHUNK_BYTES = 1 << 18
PIPE_BYTES = 1 << 20
"""Of ssh's pipes, if the kernel allows it: a request of 450 kB passes 64 kB in seven turns."""
UNHEARD_MS = 10_000
"""For the server's kernel to confirm what was sent (TCP_USER_TIMEOUT), also the end of it: on a
silent network it never does."""


def main(argv: list[str]) -> int:
    """Relay until the server has hung up. Returns the exit code: 0, or 1 with one line on
    stderr."""
    host, port = argv
    for pipe in (sys.stdin, sys.stdout):
        with contextlib.suppress(OSError):  # no pipe, or this user has many
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    try:
        with socket.create_connection((host, int(port)), CONNECT_TIMEOUT_S) as connected:
            connected.settimeout(None)
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNHEARD_MS)
            threading.Thread(target=_send, args=(connected,), daemon=True).start()
            _receive(connected)
    except BrokenPipeError:
        return 0  # ssh has ended
    except OSError as error:
        print(f"dial {host} port {port}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0


def _send(connected: socket.socket) -> None:
    """Send what ssh writes, and pass its end on; answers are still read."""
    with contextlib.suppress(OSError):  # the server has hung up: the reader sees it too
        while chunk := os.read(sys.stdin.fileno(), CHUNK_BYTES):
            connected.sendall(chunk)
        # ssh has ended, and its starter waits for the last word
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
        connected.shutdown(socket.SHUT_WR)


def _receive(connected: socket.socket) -> None:
    """Write what the server sends, until it hangs up."""
    while True:
        _acknowledge_at_once(connected)
        chunk = memoryview(connected.recv(CHUNK_BYTES))
        _acknowledge_at_once(connected)
        if not chunk:
            return
        while chunk:
            chunk = chunk[os.write(sys.stdout.fileno(), chunk) :]


def _acknowledge_at_once(connected: socket.socket) -> None:
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)


if __name__ == "__main__":
    os._exit(main(sys.argv[1:]))  # the sender may wait for ssh
