"""A bare client of the wire for tests: one DEALER, one msgpack map per frame, nothing else.

It can also send what no real client sends. Blocking, with a deadline on every wait; knows nothing
of leases.
"""

import time
from collections.abc import Callable
from typing import Any, Self

import msgpack
import zmq

from vram_arbiter.schemas import defaults as d

REPLY_S = 60.0
"""Every wait here is for something that comes; a busy machine may take its time over it."""
TTL_S = 600.0
"""A bare client renews nothing: what it holds is to outlive its test, however slowly that runs."""


class WireClient:
    """One connection. Pushes that arrive while a reply is awaited are kept in `pushes`."""

    def __init__(
        self,
        endpoint: str,
        *,
        kind: int = zmq.DEALER,
        routing_id: bytes | None = None,
        context: "zmq.Context[Any] | None" = None,
    ) -> None:
        self._own: zmq.Context[Any] | None = None
        if context is None:
            self._own = context = zmq.Context()
        self.socket: zmq.Socket[bytes] = context.socket(kind)
        self.socket.setsockopt(zmq.LINGER, 0)
        if routing_id is not None:
            self.socket.setsockopt(zmq.ROUTING_ID, routing_id)
        self.socket.connect(endpoint)
        self._id = 0
        self.pushes: list[dict[str, Any]] = []
        self.replies: dict[int | None, dict[str, Any]] = {}

    def send_raw(self, payload: bytes) -> None:
        self.socket.send(payload)

    def send_frames(self, frames: list[bytes]) -> None:
        self.socket.send_multipart(frames)

    def send(self, op: str, **fields: Any) -> int:
        """Send a request without waiting for its reply; returns its id. A hello says the
        version."""
        self._id += 1
        if op == "hello":
            fields = {"version": d.WIRE_VERSION, **fields}
        self.send_raw(msgpack.packb({"op": op, "id": self._id, **fields}))
        return self._id

    def receive(self, timeout_s: float = REPLY_S) -> dict[str, Any] | None:
        """The next message of any kind; None if none comes in time."""
        if not self.socket.poll(int(timeout_s * 1000)):
            return None
        message = msgpack.unpackb(self.socket.recv())
        assert isinstance(message, dict)
        return message

    def reply(self, request_id: int | None, timeout_s: float = REPLY_S) -> dict[str, Any]:
        """The reply to a request. Raises TimeoutError."""
        deadline = time.monotonic() + timeout_s
        while request_id not in self.replies:
            message = self.receive(max(0.0, deadline - time.monotonic()))
            if message is None:
                raise TimeoutError(
                    f"no reply to request {request_id} within {timeout_s} s; pushes: {self.pushes}"
                )
            if "push" in message:
                self.pushes.append(message)
            else:
                self.replies[message["re"]] = message
        return self.replies.pop(request_id)

    def ask(self, op: str, **fields: Any) -> dict[str, Any]:
        """Send a request and wait for its reply, whether it says ok or not."""
        return self.reply(self.send(op, **fields))

    def hello(self, name: str = "test", **fields: Any) -> Self:
        """Say hello; raises AssertionError unless it is welcomed."""
        welcome = self.ask("hello", **{"name": name, "instance": f"{name}-1", **fields})
        assert welcome["ok"], welcome
        return self

    def push(
        self,
        kind: str,
        timeout_s: float = REPLY_S,
        where: Callable[[dict[str, Any]], bool] | None = None,
    ) -> dict[str, Any]:
        """The next push of a kind (and that fits `where`), past ones first. Raises TimeoutError."""
        deadline = time.monotonic() + timeout_s
        while True:
            for index, message in enumerate(self.pushes):
                if message["push"] == kind and (where is None or where(message)):
                    return self.pushes.pop(index)
            found = self.receive(max(0.0, deadline - time.monotonic()))
            if found is None:
                raise TimeoutError(f"no push {kind} within {timeout_s} s; others: {self.pushes}")
            if "push" in found:
                self.pushes.append(found)
            else:
                self.replies[found["re"]] = found

    def acquire(self, consumer: str, load_peak_bytes: int, **spec: Any) -> dict[str, Any]:
        """Ask for a lease of `load_peak_bytes` (steady the same, no residue unless given); the
        reply."""
        footprint = {
            "load_peak_bytes": load_peak_bytes,
            "steady_bytes": spec.pop("steady_bytes", load_peak_bytes),
            "residue_bytes": spec.pop("residue_bytes", 0),
        }
        fields: dict[str, Any] = {"nonce": spec.pop("nonce", f"{consumer}-{self._id}")}
        for name in spec.keys() & {"wait_timeout_s", "traceparent"}:
            fields[name] = spec.pop(name)
        wanted = {
            "consumer": consumer,
            "model_id": spec.pop("model_id", consumer),
            "footprint": footprint,
            "ttl_s": TTL_S,
            **spec,
        }
        return self.ask("acquire", spec=wanted, **fields)

    def granted(self, consumer: str, load_peak_bytes: int, **spec: Any) -> dict[str, Any]:
        """`acquire`, and wait for the grant, which a daemon that has just begun to read its GPU
        gives later; the lease."""
        reply = self.acquire(consumer, load_peak_bytes, **spec)
        assert reply["ok"], reply
        lease: dict[str, Any] = reply["lease"]
        if reply["state"] == "queued":
            wanted = lease["lease_id"]
            lease = self.push("granted", where=lambda push: push["lease"]["lease_id"] == wanted)[
                "lease"
            ]
        return lease

    def close(self) -> None:
        self.socket.close()
        if self._own is not None:
            self._own.term()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
