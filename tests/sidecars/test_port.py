"""The port in front of a sidecar's socket: what passes, and who is refused."""

import asyncio
import gc
import os
import pwd
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.ports import free_port
from vram_arbiter.sidecars import port as port_module
from vram_arbiter.sidecars.port import (
    CONNECTIONS_MAX,
    FREE_BYTES,
    REFUSED_S,
    UNPROVEN_BYTES_PER_S,
    Conduct,
    _pass_on,
    on_port,
)

BYTES = bytes(range(256)) * 4096  # more than one read


async def echo(reader, writer):
    while data := await reader.read(1 << 16):
        writer.write(data)
        await writer.drain()
    writer.close()


def test_bytes_pass_both_ways_and_a_hang_up_too(tmp_path, caplog):
    """Regression: at its end the port logged a traceback for each connection."""

    async def story():
        served = await asyncio.start_unix_server(echo, tmp_path / "s")
        port = free_port()
        async with served, on_port(port, tmp_path / "s"):
            with pytest.raises(ConfigError, match=f"port {port} of 127.0.0.1 cannot be served"):
                await on_port(port, tmp_path / "s").__aenter__()
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(BYTES)
            assert await reader.readexactly(len(BYTES)) == BYTES
            (tmp_path / "s").rename(tmp_path / "away")
            other, other_writer = await asyncio.open_connection("127.0.0.1", port)
            assert await other.read() == b"", "nothing serves the socket"
            (tmp_path / "away").rename(tmp_path / "s")
            crowd = [
                await asyncio.open_connection("127.0.0.1", port) for _ in range(CONNECTIONS_MAX)
            ]
            assert await crowd[-1][0].read() == b"", "one too many"
            for _, one in [*crowd, (other, other_writer)]:
                one.close()
        assert await reader.read() == b"", "the port has ended"
        writer.close()

    asyncio.run(asyncio.wait_for(story(), 60))
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


def test_a_connection_that_comes_too_soon_waits_in_the_kernel(tmp_path, monkeypatch):
    """A client that only connects, as fast as it can, took the event loop from the robots: the 99th
    percentile of their waits doubled."""
    monkeypatch.setattr(port_module, "ACCEPT_PAUSE_S", 3600.0)

    async def story():
        came = []

        async def count(reader, writer):
            came.append(reader)
            await echo(reader, writer)

        served = await asyncio.start_unix_server(count, tmp_path / "s")
        port = free_port()
        async with served, on_port(port, tmp_path / "s"):
            (reader, writer), *crowd = [
                await asyncio.open_connection("127.0.0.1", port) for _ in range(8)
            ]
            for _ in range(100):
                writer.write(BYTES[:1024])
                assert await reader.readexactly(1024) == BYTES[:1024]
            assert len(came) == 1
            for _, one in [(reader, writer), *crowd]:
                one.close()

    asyncio.run(asyncio.wait_for(story(), 60))


def test_a_cancellation_at_any_moment_closes_the_inner_connection(tmp_path):
    """Regression: a cancellation that came while the copies ended left the socket behind the port
    open until the collector ran."""

    async def ends(steps: int):
        """Cancel `_pass_on` so many steps after it can see the client's end."""
        came, ended = asyncio.Event(), asyncio.Event()

        async def serve(reader, writer):
            came.set()
            await reader.read()
            ended.set()

        path = tmp_path / f"{steps}"
        served = await asyncio.start_unix_server(serve, path)
        ours, theirs = socket.socketpair()
        reader, writer = await asyncio.open_connection(sock=theirs)
        passing = asyncio.create_task(_pass_on(reader, writer, path))
        await came.wait()
        ours.close()
        while not reader.at_eof():
            await asyncio.sleep(0)
        for _ in range(steps):
            await asyncio.sleep(0)
        passing.cancel()
        await asyncio.wait([passing])
        await asyncio.wait_for(ended.wait(), 30)
        served.close()
        writer.close()

    async def story():
        for steps in range(31):
            await ends(steps)

    gc.disable()
    try:
        asyncio.run(story())
    finally:
        gc.enable()


def test_bytes_that_no_request_makes_good_wait_and_others_do_not():
    """Fourteen hostile clients kept three quarters of a core busy, and robots waiting."""
    now = [100.0]
    conduct = Conduct(lambda: now[0])
    second = UNPROVEN_BYTES_PER_S
    with conduct.connected("honest"):
        with conduct.connected("hostile"), conduct.connected("another"):
            for end in ("hostile", "another"):
                assert conduct.came(end, FREE_BYTES) == 0.0
            assert [conduct.came(end, second) for end in ("hostile", "another")] == [1.0, 2.0]
            for _ in range(100):
                assert conduct.came("honest", FREE_BYTES - 1024) == 0.0, "its requests are served"
                conduct.served("honest", FREE_BYTES - 1024)
            conduct.served("hostile", 10)
            assert conduct.came("hostile", second) == 3.0, "a small one makes little good"
        assert conduct.debt_s() == 3.0 + 2 * FREE_BYTES / second, "hanging up is no way out"
    now[0] += conduct.debt_s()
    assert conduct.debt_s() == 0.0


def test_a_client_is_allowed_requests_as_large_as_those_that_were_served():
    conduct = Conduct(lambda: 0.0)
    with conduct.connected("robot"):
        assert conduct.came("robot", 2 * FREE_BYTES) > 0.0
        conduct.served("robot", 2 * FREE_BYTES)
        assert conduct.came("robot", 2 * FREE_BYTES) == 0.0


def test_after_a_refusal_a_connection_is_not_read():
    now = [0.0]
    conduct = Conduct(lambda: now[0])
    with conduct.connected("hostile"), conduct.connected("honest"):
        conduct.refused("hostile")
        assert (conduct.came("hostile", 1), conduct.came("honest", 1)) == (REFUSED_S, 0.0)
        now[0] = REFUSED_S
        assert conduct.came("hostile", 1) == 0.0
    conduct.refused("hostile")  # one that has hung up
    conduct.served("hostile", 1)


AS_USER = """
import encodings.idna, os, socket, sys
os.setgroups([]); os.setgid(int(sys.argv[2])); os.setuid(int(sys.argv[1]))
connection = socket.create_connection(("127.0.0.1", int(sys.argv[3])))
try:
    connection.sendall(b"hello")
    if sys.argv[4] == "listen":
        print(connection.recv(5))
except ConnectionError:
    print(b"")
"""


def as_nobody(port, then):
    """A command that says hello to the port as another user, then listens or hangs up at once."""
    nobody = pwd.getpwnam("nobody")
    return (
        sys.executable, "-c", AS_USER, str(nobody.pw_uid), str(nobody.pw_gid), str(port), then,
    )  # fmt: skip


only_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can connect as another user")


@only_root
def test_a_client_that_has_hung_up_is_refused(tmp_path):
    """Any user could command a sidecar blind: `unload` was sent, and the connection closed before
    the kernel was asked whose it was."""

    async def story(path: Path):
        served = await asyncio.start_unix_server(kept, path)
        port = free_port()
        async with served, on_port(port, path):
            # the event loop stands still: the port is looked at after the client has gone
            subprocess.run(as_nobody(port, "hang up"), check=True)
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(b"own")
            assert await reader.read(3) == b"own", "the port serves on"
            writer.close()
        assert heard == [b"own"]

    heard = []

    async def kept(reader, writer):
        heard.append(await reader.read(5))
        writer.write(heard[-1])
        writer.close()

    asyncio.run(asyncio.wait_for(story(tmp_path / "s"), 60))


@only_root
def test_only_users_who_may_open_the_socket_are_let_in(tmp_path):
    """On loopback any user of the machine could command the robot."""
    nobody = pwd.getpwnam("nobody")

    async def heard(port):
        child = await asyncio.create_subprocess_exec(
            *as_nobody(port, "listen"), stdout=subprocess.PIPE
        )
        out, _ = await child.communicate()
        return out.strip()

    async def story(path: Path):
        served = await asyncio.start_unix_server(echo, path)
        port = free_port()
        async with served, on_port(port, path):
            assert await heard(port) == b"b''"
            os.chown(path, -1, nobody.pw_gid)
            assert await heard(port) == b"b'hello'"

    asyncio.run(asyncio.wait_for(story(tmp_path / "s"), 60))
