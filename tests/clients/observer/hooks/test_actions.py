"""Commands and webhooks: real processes, and a real HTTP server on loopback."""

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import eventually, until
from vram_arbiter.clients.observer.hooks.actions import post, read_headers, retry_after_s
from vram_arbiter.clients.observer.hooks.command import run_command
from vram_arbiter.clients.observer.hooks.events import Delivery
from vram_arbiter.schemas.config.observer import Hook
from vram_arbiter.schemas.errors import ActionFailed, ConfigError
from vram_arbiter.schemas.runtime import procfs

DELIVERY = Delivery("h", "granted", {"seq": 5, "kind": "granted"}, "n-5-h", 2)


def run(script: str, timeout_s: float = 60.0, delivery: Delivery = DELIVERY) -> None:
    command = ("sh", "-c", script)
    asyncio.run(run_command(command, delivery.body, {"WORD": "y"}, timeout_s, grace_s=0.05))


def gone(file: Path) -> bool:
    stat = procfs.read_stat(int(file.read_text()))
    return stat is None or not stat.alive


# -- commands
def test_a_command_gets_event_and_variables(tmp_path: Path) -> None:
    long = Delivery("h", "granted", {"text": "x" * 200_000}, "k")
    run(f"cat > {tmp_path}/a; echo $WORD >> {tmp_path}/a", delivery=long)
    assert (tmp_path / "a").read_text() == f"{long.body.decode()}y\n"


@pytest.mark.parametrize(
    ("script", "problem"), [("exit 3", "exit code 3"), ("kill -9 $$", "signal 9")]
)
def test_a_command_that_fails_says_how(script: str, problem: str) -> None:
    with pytest.raises(ActionFailed, match=problem):
        run(script)


def test_a_command_that_cannot_be_started() -> None:
    with pytest.raises(ActionFailed, match="/nowhere cannot be started"):
        asyncio.run(run_command(["/nowhere"], b"", {}, 60.0))


def test_a_command_that_ignores_sigterm_is_killed_with_its_children(tmp_path: Path) -> None:
    script = f"trap '' TERM; sleep 600 & echo $! > {tmp_path}/pid; wait; wait"
    with pytest.raises(ActionFailed, match=r"not done within 0\.3 s"):
        run(script, timeout_s=0.3)
    until(lambda: gone(tmp_path / "pid"))


def test_what_a_command_leaves_behind_ends_with_it(tmp_path: Path) -> None:
    run(f"sleep 600 & echo $! > {tmp_path}/pid")
    until(lambda: gone(tmp_path / "pid"))


def test_all_that_it_leaves_is_ended(tmp_path: Path) -> None:
    """In sessions of their own they were in no group that is killed, and outlived every run."""
    left = f"setsid sh -c 'echo $$ > {tmp_path}/$0; exec sleep 600' $one &"
    wait = f"until [ -s {tmp_path}/$one ]; do sleep 0.01; done"
    run(f"for one in a b c; do {left} {wait}; done")
    until(lambda: all(gone(tmp_path / one) for one in "abc"))


def test_a_run_that_leaves_nothing_is_searched_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of /proc was read three times after each command."""
    opened: list[int] = []
    real = os.pidfd_open

    def counting(pid: int, flags: int = 0) -> int:
        opened.append(pid)
        return real(pid, flags)

    monkeypatch.setattr(os, "pidfd_open", counting)
    run("true")
    assert opened.count(os.getpid()) == 1


def test_a_command_that_closes_its_output_costs_no_time_of_the_observer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At its end the pipe was readable for ever, and the loop turned until the command ended."""
    ends, real = [0], os.read

    def counting(descriptor: int, most: int) -> bytes:
        came = real(descriptor, most)
        ends[0] += not came
        return came

    monkeypatch.setattr(os, "read", counting)
    run("exec >&- 2>&-; sleep 0.3")
    assert ends[0] < 10, "not once a turn of the loop"


def test_the_output_of_a_command_is_bounded_and_escaped(caplog: pytest.LogCaptureFixture) -> None:
    """It went to the log as it was: without a bound, with escape sequences and forged lines."""
    caplog.set_level("INFO", "vram_arbiter.clients.observer.hooks.command")
    run("printf 'one\\n\\033[2Jtwo\\n' >&2; yes | head -c 1000000")
    (said,) = caplog.messages
    assert said.startswith(r"sh: one\n\x1b[2Jtwo\ny\ny")
    assert 4096 < len(said) < 8 * 4096


def test_a_canceled_command_is_killed(tmp_path: Path) -> None:
    async def test() -> None:
        script = f"echo $$ > {tmp_path}/new; mv {tmp_path}/new {tmp_path}/pid; sleep 600"
        running = asyncio.create_task(run_command(["sh", "-c", script], b"", {}, 600.0))
        await eventually((tmp_path / "pid").exists)
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running

    asyncio.run(test())
    until(lambda: gone(tmp_path / "pid"))


# -- webhooks
class Server(HTTPServer):
    """Answers with `script`, one after the other, and keeps what came."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.script: list[tuple[int, dict[str, str]]] = []
        self.requests: list[tuple[dict[str, str], bytes]] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/secret?token=s"


class _Handler(BaseHTTPRequestHandler):
    server: Server

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.requests.append(({k.lower(): v for k, v in self.headers.items()}, body))
        status, headers = self.server.script.pop(0)
        self.send_response(status)
        for name, value in {"Content-Length": "2", **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(b"no")

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet."""


@pytest.fixture(scope="module")
def serving_hook() -> Iterator[Server]:
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def send(serving_hook: Server) -> Callable[..., list[float]]:
    """`send(script)` delivers one event and returns the pauses."""
    serving_hook.requests.clear()

    def deliver_one(*script: tuple[int, dict[str, str]], **fields: object) -> list[float]:
        serving_hook.script = list(script)
        wanted = {"name": "h", "on": "granted", "webhook": serving_hook.url, **fields}
        pauses: list[float] = []

        async def pause(seconds: float) -> None:
            pauses.append(seconds)

        asyncio.run(post(Hook.model_validate(wanted), DELIVERY, sleep=pause))
        return pauses

    return deliver_one


def test_a_webhook_gets_the_event(
    send: Callable[..., list[float]], serving_hook: Server, tmp_path: Path
) -> None:
    headers = tmp_path / "headers"
    headers.write_text("# secret\nAuthorization: Bearer abc\n")
    headers.chmod(0o600)
    assert send((204, {}), headers_file=str(headers)) == []
    ((found, body),) = serving_hook.requests
    assert body == b'{"seq":5,"kind":"granted"}'
    assert found["authorization"] == "Bearer abc"
    assert found["content-type"] == "application/json"
    assert found["idempotency-key"] == "n-5-h"
    assert found["x-vram-arbiter-dropped"] == "2"


def test_a_webhook_is_repeated_with_growing_pauses(
    send: Callable[..., list[float]], serving_hook: Server
) -> None:
    pauses = send((503, {}), (429, {"Retry-After": "7"}), (500, {}), (200, {}))
    first, asked, third = pauses
    assert 0.5 <= first <= 1.0
    assert asked == 7.0
    assert 2.0 <= third <= 4.0
    assert len({found["idempotency-key"] for found, _ in serving_hook.requests}) == 1


@pytest.mark.parametrize(
    ("script", "problem", "requests"),
    [([(404, {})], "answered 404: no", 1), ([(307, {"Location": "/x"})], "answered 307", 1),
     ([(500, {}), (500, {})], "took none of 2 requests: answered 500", 2)],
)  # fmt: skip
def test_a_webhook_that_fails_says_how_and_no_secret(
    script: list[tuple[int, dict[str, str]]],
    problem: str,
    requests: int,
    send: Callable[..., list[float]],
    serving_hook: Server,
) -> None:
    with pytest.raises(ActionFailed) as error:
        send(*script, attempts=2)
    assert problem in str(error.value)
    assert "secret" not in str(error.value)
    assert len(serving_hook.requests) == requests


def test_a_server_that_is_away_is_asked_again(send: Callable[..., list[float]]) -> None:
    with pytest.raises(ActionFailed, match="took none of 2 requests") as error:
        send(webhook="http://127.0.0.1:1/secret", attempts=2)
    assert "secret" not in str(error.value)


@pytest.mark.parametrize("url", ["http://[v1.x]/secret", "http://999.1.1.1/?token=secret"])
def test_a_url_that_names_no_host_fails_and_is_not_raised_as_another_error(
    send: Callable[..., list[float]], url: str
) -> None:
    """The client's own error ended the observer."""
    with pytest.raises(ActionFailed, match="took none of 1 requests: Invalid IPv") as error:
        send(webhook=url, attempts=1)
    assert "secret" not in str(error.value)


@pytest.mark.parametrize("told", [b"HTTP/1.1 500 No\r\n\r\n", b""], ids=["endless", "silent"])
def test_the_whole_exchange_with_a_webhook_is_bounded(told: bytes) -> None:
    """An answer that went on byte by byte was read for ever: the limit was that of each byte."""

    async def story() -> None:
        ended = asyncio.Event()

        async def drip(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readuntil(b"\r\n\r\n")
            writer.write(told)
            with contextlib.suppress(ConnectionError):
                while told and not ended.is_set():
                    writer.write(b"x")
                    await writer.drain()
                    await asyncio.sleep(0.05)
            await ended.wait()
            writer.close()

        server = await asyncio.start_server(drip, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        wanted = {"webhook": f"http://127.0.0.1:{port}/", "attempts": 1, "timeout_s": 0.3}
        hook = Hook.model_validate({"name": "h", "on": "granted", **wanted})
        try:
            with pytest.raises(ActionFailed, match=r"took none of 1 requests: \w*Time"):
                async with asyncio.timeout(30.0):
                    await post(hook, DELIVERY)
        finally:
            ended.set()
            server.close()
            await server.wait_closed()

    asyncio.run(story())


def test_a_pause_in_seconds_is_bounded() -> None:
    assert [retry_after_s(text) for text in ("30", "86400", "soon", "")] == [30.0, 600.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("text", "mode", "problem"),
    [
        ("A: b\n", 0o644, "may be read by every user"),
        ("A b\n", 0o600, r":1: expected `Name: value`"),
        ("A: b\nB: \x1bc\n", 0o600, r":2: expected `Name: value`"),
        ("A: b\n" * 4000, 0o600, "has more than 16384 bytes"),  # they were cut, and sent so
    ],
)
def test_headers_that_are_refused(text: str, mode: int, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "headers"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(ConfigError, match=problem):
        read_headers(str(path))
