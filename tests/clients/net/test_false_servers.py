"""A process of another user serves where ours should: no client says a word to it, and none
believes what it says.

A false arbiter was believed by every client, and a false runner answered an emergency stop with
"the motors hold".
"""

import asyncio
import contextlib
import json
import logging
import os
import pwd
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.paths import SUPPORT
from tests.support.process import ArbiterProcess, vramctl
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.cli.replies import UNREACHABLE
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.net import request
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import DetectorClient
from vram_arbiter.clients.sync import Client
from vram_arbiter.reasoner.server import send
from vram_arbiter.schemas.errors import ConfigError, UntrustedServer
from vram_arbiter.schemas.wire.requests import Status

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0, reason="only root can start a server of another user"
)

SCRIPT = SUPPORT / "false_server.py"
Heard = Callable[[], list[str]]


@contextlib.contextmanager
def false_server(short_folder: Path, name: str) -> Iterator[Heard]:
    """A server of the user nobody on `folder/name`. What it yields ends it, and returns what it
    heard."""
    nobody = pwd.getpwnam("nobody").pw_uid
    owner = short_folder.stat().st_uid
    os.chown(short_folder, nobody, -1)
    command = [sys.executable, str(SCRIPT), str(short_folder), name, str(nobody)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        said: list[str] = []

        def heard() -> list[str]:
            if child.poll() is None:
                out, _ = child.communicate()
                said.extend(out.splitlines())
            return said

        try:
            assert child.stdout.readline() == "listening\n"
            yield heard
        finally:
            heard()
            os.chown(short_folder, owner, -1)


async def ask_arbiter(endpoint: str) -> None:
    async with AsyncClient("t", endpoint=endpoint):
        pass


async def ask_runner(endpoint: str) -> None:
    async with RunnerClient(endpoint) as runner:
        await runner.send_goal("a/grab")


async def stop_runner(endpoint: str) -> None:
    async with RunnerClient(endpoint) as runner:
        await runner.shutdown()


async def ask_sidecar(endpoint: str) -> None:
    async with DetectorClient(endpoint) as sidecar:
        await sidecar.load()


async def ask_reasoner(endpoint: str) -> None:
    await send(endpoint, {"op": "say", "text": "stop"})


@pytest.mark.parametrize("ask", [ask_arbiter, ask_runner, stop_runner, ask_sidecar, ask_reasoner])
def test_nothing_is_said_to_a_false_server(
    ask: Callable[[str], object], short_folder: Path
) -> None:
    """Regression: clients believed any process that served the path."""
    with false_server(short_folder, "s") as heard:
        with pytest.raises(UntrustedServer, match=r"served by uid \d+ \(nobody\)"):
            asyncio.run(ask(f"ipc://{short_folder}/s"))  # type: ignore[arg-type]
        assert heard() == []


LISTENER = """
import os, socket, sys
os.setuid(int(sys.argv[1]))
server = socket.create_server(("127.0.0.1", 0))
print(server.getsockname()[1], flush=True)
if sys.argv[2] == "accepts":
    connection, _ = server.accept()
    print(connection.recv(1), flush=True)
    while data := connection.recv(4096):
        print(data, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("how", ["accepts", "waits"])
def test_nothing_is_said_to_a_false_server_on_a_port(how: str) -> None:
    """A port has no permissions: any user may listen where a server of the field is expected."""
    nobody = pwd.getpwnam("nobody").pw_uid
    command = [sys.executable, "-c", LISTENER, str(nobody), how]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        port = int(child.stdout.readline())
        with pytest.raises(UntrustedServer, match=r"served by uid \d+ \(nobody\)"):
            asyncio.run(ask_sidecar(f"tcp://127.0.0.1:{port}"))
        said, _ = child.communicate()
    assert "get_action" not in said
    assert "ping" not in said


def test_vramctl_says_who_serves_there(short_folder: Path) -> None:
    """Regression: clients believed any process that served the path."""
    environ = {**os.environ, "VRAM_ARBITER_ENDPOINT": f"ipc://{short_folder}/s"}
    with false_server(short_folder, "s") as heard:
        for command in (["status"], ["status", "--json"], ["resume"], ["history", "-f"]):
            done = vramctl(*command, environ=environ)
            assert done.returncode == UNREACHABLE, done
            if "--json" in command:
                assert json.loads(done.stdout)["error"]["code"] == "untrusted_server"
            else:
                assert "is served by uid" in done.stderr
                assert done.stdout == ""
        assert heard() == []


def test_a_user_that_was_named_is_believed(
    short_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VRAM_ARBITER_SERVER_USERS", "nobody")
    with false_server(short_folder, "s") as heard:
        assert request.ask(Status(), f"ipc://{short_folder}/s")["ok"]
        assert any("'op': 'hello'" in line for line in heard())


@pytest.mark.e2e
def test_a_lease_is_not_told_to_a_server_that_took_the_arbiters_place(
    arbiter_daemon: ArbiterProcess, spec: Callable[..., object], caplog: pytest.LogCaptureFixture
) -> None:
    """libzmq reconnects by itself, to whatever listens then; the reattachment holds every
    token."""
    with Client("t", endpoint=arbiter_daemon.endpoint) as client:
        lease = client.acquire(spec("detector", 1))  # type: ignore[arg-type]
        lease.ready()
        assert arbiter_daemon.stop() == 0
        with (
            caplog.at_level(logging.ERROR, "vram_arbiter.clients.client"),
            false_server(arbiter_daemon.runtime, "arbiter.sock") as heard,
        ):
            deadline = time.monotonic() + PATIENCE_S
            while not any("is served by uid" in record.getMessage() for record in caplog.records):
                assert time.monotonic() < deadline
                time.sleep(0.01)
            assert heard() == []
        (arbiter_daemon.runtime / "arbiter.sock").unlink(missing_ok=True)
        arbiter_daemon.start()
        assert client.status().leases[0].lease_id == lease.lease_id
        assert lease.state == "held"
        lease.release()


@pytest.mark.parametrize("endpoint", ["ipc://@vram-arbiter", "tcp://127.0.0.1:5555"])
def test_what_has_no_user_is_not_connected_to(endpoint: str) -> None:
    """Any user may serve on an abstract name or a port."""
    with pytest.raises(ConfigError, match="refused"):
        asyncio.run(ask_runner(endpoint))
    with pytest.raises(ConfigError, match="refused"):
        asyncio.run(ask_arbiter(endpoint))
    with pytest.raises(ConfigError, match="refused"):
        request.ask(Status(), endpoint)
