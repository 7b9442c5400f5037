"""The socket: one ROUTER on `ipc://`, drained from the event loop. Frames in, frames out; must not know what they mean.

libzmq's file descriptor is edge-triggered: it becomes readable once when something happened, and any call on the socket (a send
too) may consume that edge. So the reader drains until the socket is empty, and every send outside a drain schedules one.
"""

import asyncio
import contextlib
import errno
import logging
import os
from collections import deque
from collections.abc import Callable
from pathlib import Path

import zmq

from arbiter.rpc.peer import parse_peer_address
from schemas.errors import ConfigError, InternalError

log = logging.getLogger(__name__)

DRAIN_MAX = 64
"""Messages handled in one go; then timers and deaths get their turn before the rest."""
SEND_QUEUE_MAX = 4096
"""Messages queued per peer that does not read; more are dropped, and the peer's own ttl decides."""
SELF_TEST_S = 2.0
SELF_TEST_LOOKS = 10
"""A look that ends without an answer may have been one in which this process did not run: a machine that boots, or swaps."""
LINGER_MS = 200
"""At shutdown answers under way get so long to leave."""

FLOOD = 8
"""Messages over their sender's rate in one drain; then the socket rests. libzmq hands over messages of its peers in turns, so nobody
waits for more than one of a flooder's, but answering a flood as fast as it comes takes the processor from everybody."""
FLOOD_REST_S = 0.0003

OnFrame = Callable[[bytes, bool, str | None, bytes], bool]
"""`on_frame(routing_id, delimiter, peer_address, payload)`; False: its sender is over its rate."""


class RouterServer:
    """Owns the ROUTER. `bind`, then `start` inside the running loop, then `send` from its thread, then `close`."""

    def __init__(self, path: Path, message_max_bytes: int, group: int | None) -> None:
        self._path = path
        self._group = group
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        # Larger frames must reach us to be answered with a typed error; libzmq cuts the connection beyond this.
        self._socket.setsockopt(zmq.MAXMSGSIZE, 4 * message_max_bytes)
        # A send to a peer that is gone fails instead of vanishing.
        self._socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
        # A second connection under a living one's routing id must not take its pushes over.
        self._socket.setsockopt(zmq.ROUTER_HANDOVER, 0)
        self._socket.setsockopt(zmq.SNDHWM, SEND_QUEUE_MAX)
        self._socket.setsockopt(zmq.RCVHWM, SEND_QUEUE_MAX)
        self._socket.setsockopt(zmq.LINGER, LINGER_MS)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_frame: OnFrame | None = None
        self._draining = False
        self._drain_scheduled = False
        self._resting: asyncio.TimerHandle | None = None
        self._early: deque[list[zmq.Frame]] = deque()

    def bind(self) -> None:
        """Bind with mode 0660 from the first instant. The caller holds the lock. Raises ConfigError."""
        previous = os.umask(0o117)
        try:
            self._socket.bind(f"ipc://{self._path}")
        except zmq.ZMQError as error:
            raise ConfigError(
                f"cannot bind ipc://{self._path}: {error.strerror}", hint="choose another --endpoint"
            ) from error
        finally:
            os.umask(previous)
        os.chmod(self._path, 0o660)
        if self._group is not None:
            os.chown(self._path, -1, self._group)
        self._self_test()

    def _self_test(self) -> None:
        """Send one frame to ourselves: the identity of every peer hangs on the kernel's word being there and readable.

        Clients of an earlier daemon are back the moment the socket is there; what they say meanwhile is kept for `start`.
        """
        word = os.urandom(16)
        with self._context.socket(zmq.DEALER) as probe:
            probe.setsockopt(zmq.LINGER, 0)
            probe.connect(f"ipc://{self._path}")
            probe.send(word)
            looks = 0
            while True:
                if not self._socket.poll(int(SELF_TEST_S * 1000)):
                    looks += 1
                    if looks < SELF_TEST_LOOKS:
                        continue
                    raise InternalError(
                        f"the socket did not answer its own self-test within {SELF_TEST_LOOKS * SELF_TEST_S:g} s"
                    )
                frames = self._socket.recv_multipart(copy=False)
                if frames[-1].bytes == word:
                    break
                self._early.append(frames)
        frame = frames[-1]
        address = _peer_address(frame)
        try:
            found = parse_peer_address(address or "")
        except ValueError as error:
            raise InternalError(
                "this libzmq does not tell who the peer is", hint="use pyzmq ≥ 27 with libzmq ≥ 4.3"
            ) from error
        if (found.uid, found.pid) != (os.geteuid(), os.getpid()):
            raise InternalError(f"the kernel names a wrong peer: {address} for pid {os.getpid()}")

    def start(self, loop: asyncio.AbstractEventLoop, on_frame: OnFrame) -> None:
        self._loop, self._on_frame = loop, on_frame
        loop.add_reader(self._socket.fileno(), self._drain)
        self._schedule_drain()

    def send(self, routing_id: bytes, delimiter: bool, payload: bytes) -> bool:
        """Queue one message. False where the peer is gone (EHOSTUNREACH) or its queue is full (EAGAIN)."""
        frames = [routing_id, b"", payload] if delimiter else [routing_id, payload]
        try:
            self._socket.send_multipart(frames, zmq.NOBLOCK)
        except zmq.ZMQError as error:
            if error.errno not in (errno.EHOSTUNREACH, errno.EAGAIN):
                raise
            return False
        finally:
            self._schedule_drain()
        return True

    def stop_receiving(self) -> None:
        """Shutdown, first half: no request is read any more; answers can still be sent."""
        if self._loop is not None:
            self._loop.remove_reader(self._socket.fileno())
            self._on_frame = None
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None

    def close(self) -> None:
        """Shutdown, second half. The socket's file goes away; the lock is still held by the caller."""
        self.stop_receiving()
        self._loop = None
        self._socket.close()
        self._context.term()
        with contextlib.suppress(FileNotFoundError):
            self._path.unlink()

    def _schedule_drain(self) -> None:
        if self._loop is None or self._draining or self._drain_scheduled or self._resting is not None:
            return
        self._drain_scheduled = True
        self._loop.call_soon(self._drain)

    def _rest(self) -> None:
        """Leave a flood where it is for a moment: what is queued in libzmq slows its sender down."""
        if self._loop is not None and self._on_frame is not None:
            self._loop.remove_reader(self._socket.fileno())
            self._resting = self._loop.call_later(FLOOD_REST_S, self._rested)

    def _rested(self) -> None:
        self._resting = None
        if self._loop is not None:
            self._loop.add_reader(self._socket.fileno(), self._drain)
            self._drain()

    def _drain(self) -> None:
        """Read until empty, or until `DRAIN_MAX`, and then again after others had their turn; in a flood after a rest."""
        self._drain_scheduled = False
        if self._draining or self._on_frame is None or self._resting is not None:
            return
        self._draining = True
        too_fast = 0
        try:
            for _ in range(DRAIN_MAX):
                if self._on_frame is None:
                    return
                try:
                    frames = self._early.popleft() if self._early else self._receive()
                except zmq.Again:
                    return
                try:
                    too_fast += not self._deliver(frames)
                except Exception:  # outermost: one bad message must not cost the others their wake-up
                    log.exception("a message could not be handled")
                if too_fast >= FLOOD:
                    self._rest()
                    return
        finally:
            self._draining = False
        self._schedule_drain()

    def _receive(self) -> list[zmq.Frame]:
        """Raises zmq.Again where nothing is there."""
        return self._socket.recv_multipart(zmq.NOBLOCK, copy=False)

    def _deliver(self, frames: list[zmq.Frame]) -> bool:
        """`[id, payload]` from a DEALER, `[id, "", payload]` from a REQ; any other count of frames is no message of ours."""
        assert self._on_frame is not None
        routing_id = frames[0].bytes
        delimiter = len(frames) == 3 and len(frames[1]) == 0
        # anything else goes on as an empty payload, which the codec answers with BadFrame
        payload = frames[-1].bytes if len(frames) == 2 or delimiter else b""
        return self._on_frame(routing_id, delimiter, _peer_address(frames[-1]), payload)


def _peer_address(frame: zmq.Frame) -> str | None:
    try:
        address = frame.get("Peer-Address")
    except zmq.ZMQError:  # a transport without it
        return None
    return address if isinstance(address, str) else None
