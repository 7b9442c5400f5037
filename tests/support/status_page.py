"""The status page of a real observer, read as by a browser: plain HTTP and server-sent events."""

import contextlib
import http.client
import json
import re
import socket
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

from tests.support.process import ArbiterProcess
from tests.support.waiting import until

REPLY_S = 60.0
"""Every wait here is for something that comes; a busy machine may take its time over it."""
LISTEN = ("--http", "127.0.0.1:0")


def port_of(arbiter: ArbiterProcess, starts: int = 1) -> int:
    """Return the port that a daemon named in its log at its last of so many starts. A thread writes
    the log, so the line may come after READY."""

    def named() -> list[str]:
        found = re.findall(r"status page: http://127\.0\.0\.1:(\d+)", arbiter.log)
        return found if len(found) >= starts else []

    return int(until(named)[-1])


@dataclass(frozen=True, slots=True)
class Got:
    """An answer. `headers` in lower case."""

    status: int
    headers: Mapping[str, str]
    body: bytes


def get(port: int, path: str = "/", method: str = "GET", **headers: str) -> Got:
    """One request on a connection of its own; `host_` would be sent as `Host-`, `Host` as it is."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=REPLY_S)
    try:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, headers=named)
        reply = connection.getresponse()
        told = {name.lower(): value for name, value in reply.getheaders()}
        return Got(reply.status, told, reply.read())
    finally:
        connection.close()


def raw(port: int, sent: bytes) -> bytes:
    """Everything that the server answers to some bytes until it closes."""
    with socket.create_connection(("127.0.0.1", port), timeout=REPLY_S) as connection:
        connection.sendall(sent)
        with contextlib.suppress(OSError):  # it has answered and closed already
            connection.shutdown(socket.SHUT_WR)
        found = b""
        while more := connection.recv(65_536):
            found += more
        return found


class EventStream:
    """An open page: `with EventStream(port) as page: for name, data in page.events(): ...`"""

    def __init__(self, port: int, **headers: str) -> None:
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=REPLY_S)
        self._connection.connect()
        self._socket = self._connection.sock
        self._connection.request("GET", "/events", headers=headers)
        self.reply = self._connection.getresponse()
        self.status = self.reply.status

    def events(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Every event until the server closes."""
        name = ""
        while line := self.reply.readline():
            key, _, value = line.decode().rstrip("\n").partition(": ")
            if key == "event":
                name = value
            elif key == "data":
                yield name, json.loads(value)

    def until(self, wanted: str) -> dict[str, Any]:
        """The next event of a name."""
        return next(data for name, data in self.events() if name == wanted)

    def reset(self) -> None:
        """End the connection as a host does that crashed and came back."""
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.close()

    def close(self) -> None:
        self.reply.close()
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
