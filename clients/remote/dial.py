"""ssh's ProxyCommand: one TCP connection without Nagle's delay and without delayed ACKs, relayed to
standard input and output.

sshd writes a reply in pieces and, without TCP_NODELAY, waits for the ACK of one before it sends the
next; the robot's kernel delays that ACK by 40 ms. TCP_QUICKACK sends it at once. The kernel clears
the option by itself (tcp(7)), so it is set again around every read. 450 kB take 4 ms for 44.

Run as a file by its path, which takes 20 ms: it imports the standard library alone, not even this
package.
"""

import fcntl
import os
import socket
import sys
import threading
import time

CONNECT_TIMEOUT_S = 10.0
CHUNK_BYTES = 1 << 18
PIPE_BYTES = 1 << 20
"""Of ssh's pipes, if the kernel allows it: a request of 450 kB passes 64 kB in seven turns."""
LINGER_S = 10.0
"""For the server's last words once ssh has ended: on a silent network they never come."""


def main(argv: list[str]) -> int:
    """Relay until the server has hung up. Returns the exit code: 0, or 1 with one line on
    stderr."""
    host, port = argv
    for pipe in (sys.stdin, sys.stdout):
        _enlarge(pipe.fileno())
    try:
        with socket.create_connection((host, int(port)), CONNECT_TIMEOUT_S) as connected:
            connected.settimeout(None)
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=_send, args=(connected,), daemon=True).start()
            _receive(connected)
    except BrokenPipeError:
        return 0  # ssh has ended
    except OSError as error:
        print(f"dial {host} port {port}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0


def _enlarge(pipe: int) -> None:
    try:
        fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    except OSError:
        return  # no pipe, or this user has many


def _send(connected: socket.socket) -> None:
    """Send what ssh writes; its end is passed on, and answers are read for a while."""
    try:
        while chunk := os.read(sys.stdin.fileno(), CHUNK_BYTES):
            connected.sendall(chunk)
        connected.shutdown(socket.SHUT_WR)
        time.sleep(LINGER_S)
        os._exit(1)
    except OSError:
        return  # the server has hung up: the reader sees it too


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
    code = main(sys.argv[1:])
    sys.stdout.flush()
    os._exit(code)  # the sender may wait for ssh
