"""`schemas.runtime.router` with real sockets: honest ZeroMQ peers beside peers that break every
rule.

libzmq's ROUTER, which served before, aborted the process or grew without bound under most of these.
"""

import asyncio
import os
import stat
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import zmq

from tests.support.waiting import PATIENCE_S
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import router as router_module
from vram_arbiter.schemas.runtime.connection import OUT_MESSAGES_MAX, Bounds, Connection
from vram_arbiter.schemas.runtime.peercred import Peer
from vram_arbiter.schemas.runtime.router import Router
from vram_arbiter.schemas.runtime.zmtp import FRAMES_MAX, GREETING, READY, Oversize, encode

pytestmark = [pytest.mark.anyio, pytest.mark.timeout(60)]

GREETING_AND_READY = (
    bytes.fromhex("ff00000000000000017f03014e554c4c")
    + bytes(48)
    + (b"\x04)\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER\x08Identity\x00\x00\x00\x00")
)
LIMITS = Bounds(
    message_max_bytes=1 << 20,
    process_share=1.0,
    user_share=1.0,
    handshake_s=30,
    hello_s=30,
    rate_per_client_per_s=1e6,
    rate_per_process_per_s=1e6,
    charge_bytes=1 << 20,
)


@dataclass
class Echo:
    """Admits every connection and sends every payload back."""

    admits: bool = True
    open: dict[int, Connection] = field(default_factory=dict)
    ended: list[str] = field(default_factory=list)
    received_from: list[int] = field(default_factory=list)
    dropped: int = 0

    def connected(self, connection: Connection) -> None:
        self.open[connection.serial] = connection
        if self.admits:
            connection.admit()

    def received(self, connection: Connection, payload: bytes | bytearray | Oversize) -> None:
        self.received_from.append(connection.serial)
        if payload == b"fail":
            raise RuntimeError("a defect of the handler")
        if payload == b"close":
            connection.send(b"closing")
            connection.close("as asked")
            return
        answer = b"oversize %d" % payload.size if isinstance(payload, Oversize) else bytes(payload)
        self.dropped += not connection.send(answer)

    def disconnected(self, connection: Connection, reason: str) -> None:
        del self.open[connection.serial]
        self.ended.append(reason)


@pytest.fixture
def path() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="va") as name:
        yield Path(name) / "router.sock"


@asynccontextmanager
async def serving_router(
    path: Path, handler: Echo, limits: Bounds = LIMITS
) -> AsyncIterator[Router]:
    router = Router(path, handler, limits)
    router.bind()
    router.start(asyncio.get_running_loop())
    try:
        yield router
    finally:
        await router.aclose()
    assert not path.exists()
    assert len(router) == 0


async def comes_true(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0.001)


@dataclass
class Raw:
    """A peer that speaks ZMTP by hand, or does not."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    @classmethod
    async def connect(cls, path: Path, first: bytes = GREETING_AND_READY) -> "Raw":
        raw = cls(*await asyncio.open_unix_connection(path))
        raw.writer.write(first)
        return raw

    async def ready(self) -> "Raw":
        await self.reader.readexactly(len(GREETING) + len(READY))
        return self

    async def echo(self, payload: bytes) -> bytes:
        self.writer.write(encode(payload))
        head = await self.reader.readexactly(2)
        return await self.reader.readexactly(head[1])

    async def ended(self) -> None:
        """Read until the server hangs up; a write may fail first."""
        try:
            while await self.reader.read(1 << 16):
                pass
        except ConnectionError:
            pass
        self.writer.close()

    def close(self) -> None:
        self.writer.transport.abort()


def ask_with_libzmq(
    path: Path, kind: int, *payloads: bytes, options: tuple[int, ...] = ()
) -> list[bytes]:
    """What an unmodified libzmq client is answered. Blocks: for a thread."""
    with zmq.Context() as context, context.socket(kind) as peer:
        for option in options:
            peer.setsockopt(option, 1)
        peer.setsockopt(zmq.LINGER, 0)
        peer.setsockopt(zmq.RCVTIMEO, int(PATIENCE_S * 1000))
        peer.connect(f"ipc://{path}")
        answers = []
        for payload in payloads:
            peer.send(payload)
            answers.append(peer.recv())
        return answers


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (zmq.DEALER, ()),
        (zmq.REQ, ()),
        (zmq.REQ, (zmq.REQ_CORRELATE,)),
        (zmq.REQ, (zmq.REQ_CORRELATE, zmq.REQ_RELAXED)),
    ],
    ids=["DEALER", "REQ", "REQ_CORRELATE", "REQ_RELAXED"],
)
async def test_an_unmodified_peer_is_answered(
    path: Path, kind: int, options: tuple[int, ...]
) -> None:
    """A REQ with request ids was answered without them, discarded every answer and waited on."""
    payloads = (b"", b"a", b"b" * 255, b"c" * 256, b"d" * ((1 << 20) - 4))

    handler = Echo()
    async with serving_router(path, handler):
        answers = await asyncio.to_thread(ask_with_libzmq, path, kind, *payloads, options=options)
        assert answers == list(payloads)
        await comes_true(lambda: len(handler.ended) == 1)


@pytest.mark.parametrize(
    "attack",
    [
        b"\x01\x00" * 2_000_000,
        (b"\x03" + (1 << 16).to_bytes(8) + bytes(1 << 16)) * (2 * FRAMES_MAX),
        b"\x02" + (1 << 62).to_bytes(8),
        b"GET / HTTP/1.1\r\n",
    ],
    ids=["empty frames", "MORE for ever", "a huge frame", "no frames at all"],
)
async def test_a_peer_that_breaks_the_protocol_is_cut_and_others_are_served(
    path: Path, attack: bytes
) -> None:
    """A message of two million empty frames let others wait for 18 s; MORE for ever grew without
    bound."""

    handler = Echo()
    async with serving_router(path, handler) as router:
        raw = await (await Raw.connect(path)).ready()
        raw.writer.write(attack)
        await raw.ended()
        await comes_true(lambda: len(handler.ended) == 1)
        assert "protocol error" in handler.ended[0]
        assert router._users == {}
        assert router._processes == {}
        assert await asyncio.to_thread(ask_with_libzmq, path, zmq.DEALER, b"honest") == [b"honest"]


async def test_a_message_over_the_limit_is_answered_and_the_connection_lives(path: Path) -> None:
    async with serving_router(path, Echo()):
        answers = await asyncio.to_thread(
            ask_with_libzmq, path, zmq.REQ, bytes((1 << 20) + 1), b"next"
        )
        assert answers == [b"oversize %d" % ((1 << 20) + 1), b"next"]


async def test_a_stranger_may_send_little_until_it_is_admitted(path: Path) -> None:
    handler = Echo(admits=False)
    async with serving_router(path, handler):
        raw = await (await Raw.connect(path)).ready()
        assert await raw.echo(b"hello") == b"hello"
        raw.writer.write(encode(bytes(1 << 17)))
        assert await raw.reader.readexactly(2 + 15) == encode(b"oversize 131072")
        next(iter(handler.open.values())).admit()
        raw.writer.write(encode(bytes(1 << 17)))
        assert len(await raw.reader.readexactly(9 + (1 << 17))) == 9 + (1 << 17)
        raw.close()


async def test_a_peer_that_does_not_read_is_not_read_either_and_its_bytes_come_back(
    path: Path,
) -> None:
    """One slow reader of `history` had 2.5 GiB queued: limits counted messages, not bytes."""

    handler = Echo()
    async with serving_router(path, handler) as router:
        slow = await (await Raw.connect(path)).ready()
        slow.writer.write(encode(bytes(1 << 19)) * 64)
        await comes_true(lambda: any(user.out_bytes for user in router._users.values()))
        connection = next(iter(handler.open.values()))
        handled = len(handler.received_from)
        assert await asyncio.to_thread(ask_with_libzmq, path, zmq.DEALER, b"honest") == [b"honest"]
        assert len(handler.received_from) - handled <= 2
        # pushes have a bound, too
        while connection.send(bytes(1 << 16)):
            pass
        assert connection._out_bytes <= LIMITS.out_max_bytes
        slow.close()
        await comes_true(lambda: not handler.open)
        assert router._users == {}
    assert handler.dropped == 0


async def test_small_messages_to_a_peer_that_does_not_read_are_counted(path: Path) -> None:
    handler = Echo()
    async with serving_router(path, handler):
        raw = await (await Raw.connect(path)).ready()
        await comes_true(lambda: bool(handler.open))
        connection = next(iter(handler.open.values()))
        connection.send(bytes(1 << 20))
        sent = 0
        while connection.send(b"push"):
            sent += 1
        assert sent <= OUT_MESSAGES_MAX
        raw.close()


async def test_silent_connections_are_cut(path: Path) -> None:
    """4,000 connections without hello were never cut."""

    handler = Echo(admits=False)
    limits = Bounds(handshake_s=0.0, hello_s=0.01, process_share=1.0, user_share=1.0)
    async with serving_router(path, handler, limits) as router:
        bare = [await Raw.connect(path, b"") for _ in range(50)]
        shaken = await Raw.connect(path)
        for raw in (*bare, shaken):
            await raw.ended()
        await comes_true(lambda: len(router) == 0)
        assert router._processes == {}


async def test_the_newest_connection_finds_room_among_silent_ones(path: Path) -> None:
    """Bare connects used up all places; each newcomer now takes that of the oldest silent one."""

    handler = Echo()
    limits = Bounds(
        connections_max=8, process_share=1.0, user_share=1.0, handshake_s=30, hello_s=30
    )
    async with serving_router(path, handler, limits) as router:
        bare = [await Raw.connect(path, b"") for _ in range(20)]
        honest = await (await Raw.connect(path)).ready()
        assert await honest.echo(b"here") == b"here"
        assert len(router) == 8
        for raw in (*bare, honest):
            raw.close()


_HONEST = """
import sys, zmq
peer = zmq.Context().socket(zmq.REQ)
peer.connect(sys.argv[1])
peer.send(b"x")
assert peer.recv() == b"x"
"""


async def test_a_process_has_a_share_of_the_connections(path: Path) -> None:
    handler = Echo()
    limits = Bounds(
        connections_max=8, process_share=0.5, user_share=1.0, handshake_s=30, hello_s=30
    )
    async with serving_router(path, handler, limits):
        greedy = [await (await Raw.connect(path)).ready() for _ in range(4)]
        refused = await Raw.connect(path)
        await refused.ended()
        other = await asyncio.create_subprocess_exec(sys.executable, "-c", _HONEST, f"ipc://{path}")
        assert await other.wait() == 0
        for raw in greedy:
            raw.close()


async def test_a_flood_of_one_connection_delays_another_by_a_few_messages(path: Path) -> None:
    handler = Echo()
    async with serving_router(path, handler):
        flood = await (await Raw.connect(path)).ready()
        honest = await (await Raw.connect(path)).ready()
        await comes_true(lambda: len(handler.open) == 2)
        flooder, other = handler.open
        reading = asyncio.create_task(flood.reader.read(-1))
        flood.writer.write(encode(b"") * 20_000)  # both lie in their sockets from here on
        assert await honest.echo(b"now") == b"now"
        assert handler.received_from.index(other) < 2_000  # a turn of the flood, or two
        await comes_true(lambda: handler.received_from.count(flooder) == 20_000)
        for raw in (flood, honest):
            raw.close()
        await reading


async def test_a_connection_over_its_rate_rests_and_loses_nothing(path: Path) -> None:
    """It was answered `limit_exceeded`, and what it had said was lost: a use whose end was refused
    kept its lease from every eviction."""
    limits = replace(LIMITS, rate_per_client_per_s=200.0)
    async with serving_router(path, Echo(), limits):
        raw = await (await Raw.connect(path)).ready()
        raw.writer.write(encode(b"abc") * 220)
        assert await raw.reader.readexactly(220 * 5) == encode(b"abc") * 220
        raw.close()


async def test_another_connection_does_not_pay_what_a_process_owes(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    limits, handler = replace(LIMITS, rate_per_process_per_s=10.0, charge_bytes=1), Echo()
    async with serving_router(path, handler, limits) as router:
        first = await (await Raw.connect(path)).ready()
        assert await first.echo(b"x" * 200) == b"x" * 200  # twenty seconds' worth
        again = await (await Raw.connect(path)).ready()
        again.writer.write(encode(b"again"))
        monkeypatch.setattr(router_module, "identify", lambda _: other)
        other = Peer(ProcessKey(1, 1), os.getuid(), os.getgid(), -1)
        stranger = await (await Raw.connect(path)).ready()
        assert await stranger.echo(b"me?") == b"me?", "another process owes nothing"
        assert handler.received_from == [1, 3]
        now, mine = asyncio.get_running_loop().time(), handler.open[1].peer.process
        router._watch_rates(now)
        assert f"read more slowly: processes {[mine]}" in caplog.text
        for raw in (first, again, stranger):
            raw.close()
    router._watch_rates(now + 1.0)
    assert list(router._rates) == [(os.getuid(), mine)], "what is owed is kept"
    router._watch_rates(now + 100.0)
    assert not router._rates


_ORPHAN = """
import os, socket, sys
peer = socket.socket(socket.AF_UNIX)
peer.connect(sys.argv[1])
peer.sendall(bytes.fromhex(sys.argv[2]))
peer.recv(107, socket.MSG_WAITALL)
if os.fork():
    os._exit(0)
while peer.recv(1 << 16):
    pass
"""


async def test_a_child_does_not_speak_on_its_dead_parents_connection(path: Path) -> None:
    """The kernel named the parent at accept: what a child sends later is not the parent's word."""

    handler = Echo()
    async with serving_router(path, handler):
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", _ORPHAN, path, GREETING_AND_READY.hex()
        )
        await process.wait()
        await comes_true(lambda: bool(handler.ended))
        assert handler.ended == ["its process has ended"]


async def test_a_defect_of_the_handler_costs_one_answer(path: Path) -> None:
    async with serving_router(path, Echo()):
        raw = await (await Raw.connect(path)).ready()
        raw.writer.write(encode(b"fail"))
        assert await raw.echo(b"next") == b"next"
        raw.close()


async def test_what_was_sent_before_closing_arrives(path: Path) -> None:
    handler = Echo()
    async with serving_router(path, handler):
        raw = await (await Raw.connect(path)).ready()
        assert await raw.echo(b"close") == b"closing"
        await raw.ended()
        assert handler.ended == ["as asked"]


async def test_the_last_answer_arrives_though_the_server_ends_behind_it(path: Path) -> None:
    """Regression: a finished connection was not read any more, so closing waited its whole flush
    time for absent peers."""

    handler = Echo()
    async with serving_router(path, handler) as router:
        raw = await (await Raw.connect(path)).ready()
        raw.writer.write(encode(bytes(1 << 19)))
        await comes_true(lambda: bool(handler.received_from))
        ending = asyncio.create_task(router.aclose(PATIENCE_S))
        assert len(await raw.reader.read(-1)) == 9 + (1 << 19)
        assert next(iter(handler.open.values())).send(b"late") is False
        raw.close()
        await ending


async def test_a_deleted_socket_file_is_bound_again(path: Path) -> None:
    """A cleaner of temporary folders made a running daemon unreachable until its restart."""

    handler = Echo()
    async with serving_router(path, handler):
        before = await (await Raw.connect(path)).ready()
        path.unlink()
        await comes_true(path.exists)
        assert await asyncio.to_thread(ask_with_libzmq, path, zmq.REQ, b"again") == [b"again"]
        assert await before.echo(b"still here") == b"still here"
        before.close()


async def test_another_file_in_the_place_of_the_socket_is_left_alone(path: Path) -> None:
    router = Router(path, Echo())
    router.bind()
    router.start(asyncio.get_running_loop())
    path.unlink()
    path.write_text("mine")
    router._restore_file()
    await router.aclose()
    assert path.read_text() == "mine"


def test_the_socket_is_for_user_and_group_from_the_first_instant(path: Path) -> None:
    before = os.umask(0)
    try:
        router = Router(path, Echo())
        router.bind()
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o660
    asyncio.run(router.aclose())


def test_a_stale_socket_is_replaced_and_another_file_is_not(path: Path) -> None:
    first, second = Router(path, Echo()), Router(path, Echo())
    first.bind()
    second.bind()
    asyncio.run(second.aclose())
    path.write_text("a file")
    with pytest.raises(ConfigError, match="not a socket"):
        first.bind()
    assert path.read_text() == "a file"
    asyncio.run(first.aclose())


def test_a_path_that_is_too_long_is_a_config_error(path: Path) -> None:
    with pytest.raises(ConfigError, match="too long"):
        Router(path.parent / ("x" * 120), Echo()).bind()
