"""The status page of a real observer over raw HTTP: what it serves, to whom, what it withstands."""

import asyncio
import contextlib
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.support.observer import ObserverProcess
from tests.support.process import ArbiterProcess, vramctl
from tests.support.status_page import REPLY_S, EventStream, get, raw
from tests.support.waiting import until
from tests.support.wire import WireClient
from vram_arbiter.clients.observer.page import server
from vram_arbiter.clients.observer.page.server import (
    CONNECTIONS_PER_PEER,
    HEAD_MAX_BYTES,
    STREAMS_PER_PEER,
)
from vram_arbiter.schemas import strictjson
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.urls import HttpAddress

pytestmark = pytest.mark.e2e
NAME = "<script>alert(1)</script>"
WHOLE = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
HALF = b"GET / HTTP/1.1\r\nHost: "
RUNNING = {"since_s", "waited_s", "granted_s", "ttl_left_s", "uptime_s", "sample_age_s"}
"""Seconds that run on between two answers."""


@pytest.fixture(scope="module")
def serving_arbiter() -> Iterator[ArbiterProcess]:
    made = ArbiterProcess(prepared=True)
    try:
        yield made.start()
    finally:
        made.close()


@pytest.fixture(scope="module")
def observer(serving_arbiter: ArbiterProcess) -> Iterator[ObserverProcess]:
    with ObserverProcess(serving_arbiter) as made:
        yield made


@pytest.fixture(scope="module")
def port(observer: ObserverProcess) -> int:
    return observer.port


@pytest.fixture(scope="module")
def http_client(serving_arbiter: ArbiterProcess) -> Iterator[WireClient]:
    with WireClient(serving_arbiter.endpoint) as made:
        yield made.hello("client")


def still(value: Any) -> Any:
    """Plain values without the seconds that run on."""
    if isinstance(value, dict):
        return {key: still(item) for key, item in value.items() if key not in RUNNING}
    return [still(item) for item in value] if isinstance(value, list) else value


def test_the_files_and_their_headers(port: int) -> None:
    page = get(port)
    assert (page.status, page.headers["content-type"]) == (200, "text/html; charset=utf-8")
    text = page.body.decode()
    linked = re.findall(r'(?:src|href)="(/[^"]+)"', text)
    assert {"/page.js", "/page.css", "/icon.svg"} <= set(linked)
    found = [page, *(get(port, path) for path in linked)]
    modules = {
        name for file in found for name in re.findall(r'from "(/\w+\.js)"', file.body.decode())
    }
    found += [get(port, name) for name in modules - set(linked)]
    assert [file.status for file in found] == [200] * len(found)
    assert sum(len(file.body) for file in found) < 100_000
    for file in found:
        policy = file.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "http" not in policy
        assert file.headers["x-content-type-options"] == "nosniff"
        assert file.headers["referrer-policy"] == "no-referrer"
    # nothing inline: the policy would refuse it
    assert not re.search(r"<script>|<style|\son\w+=|\sstyle=|javascript:", text)
    head = get(port, method="HEAD")
    assert (head.status, head.body) == (200, b"")
    assert head.headers["content-length"] == page.headers["content-length"]


@pytest.mark.parametrize(
    ("path", "method", "status"),
    [
        ("/", "POST", 405),
        ("/events", "DELETE", 405),
        ("/", "OPTIONS", 405),
        ("/nothing", "GET", 404),
        ("/../daemon.py", "GET", 404),
        ("/%2e%2e/daemon.py", "GET", 404),
        ("//page.js", "GET", 404),
        ("/history?after=x", "GET", 400),
        ("/history?" + "&".join(f"kind={n}" for n in range(200)), "GET", 400),
        ("/history?after=-5&limit=99999999", "GET", 200),
        ("http://127.0.0.1/page.js", "GET", 404),
        ("//[", "GET", 404),
    ],
)
def test_what_is_not_served(port: int, path: str, method: str, status: int) -> None:
    assert get(port, path, method).status == status


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(200), 400),  # TLS
        (b"nonsense\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n", 400),
        (b"GET / HTTP/1.0\r\n\r\n", 421),
        (b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", 421),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: http://evil.example\r\n\r\n", 403),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\n\r\nbody", 413),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", 413),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\n\r\n", 200),
        (b"GET /" + b"a" * (HEAD_MAX_BYTES + 1000), 400),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"a: b\r\n" * (HEAD_MAX_BYTES // 6), 400),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: h2c\r\nConnection: Upgrade\r\n\r\n", 200),
    ],
)
def test_bytes_that_no_browser_sends(port: int, sent: bytes, status: int) -> None:
    assert raw(port, sent).split(b"\r\n")[0].split(b" ")[1] == str(status).encode()


def test_a_page_gets_what_vramctl_gets_again_and_again(
    serving_arbiter: ArbiterProcess, port: int, http_client: WireClient
) -> None:
    """The first events are the status, equal to `vramctl status --json`; a lease that comes, waits
    and goes is told with the next ones; no event has a token."""
    first = http_client.granted(NAME, 64 * MIB)
    on = {"lease_id": first["lease_id"], "token": first["token"]}
    assert http_client.ask("ready", **on)["ok"]
    with EventStream(port) as page:
        assert page.status == 200
        assert page.reply.headers["Content-Type"].startswith("text/event-stream")
        snapshot = page.until("snapshot")
        usage, history = page.until("usage"), page.until("history")
        told = vramctl("status", "--json", environ=serving_arbiter.environ)
        status = strictjson.loads(told.stdout)
        assert still(snapshot["leases"]) == still(status["leases"])
        gpu, shown = still(status["gpus"][0]), still(snapshot["gpus"][0])
        assert gpu == {**shown, "processes": gpu["processes"]}
        assert NAME in usage["consumers"]
        assert {"started", "granted", "ready"} <= {event["kind"] for event in history["events"]}

        second = http_client.granted("second", 64 * MIB)
        waiter = http_client.acquire("waiter", 128 * MIB, mode="exclusive")["lease"]["lease_id"]
        found: dict[str, Any] = {}
        for name, data in page.events():
            if name == "snapshot":
                found = {lease["lease_id"]: lease for lease in data["leases"]}
            if name == "waits" and waiter in {wait["lease_id"] for wait in data["waits"]}:
                break
        assert {second["lease_id"], waiter} <= found.keys()
        assert not any("token" in lease and lease["token"] for lease in found.values())
        reason = next(wait for wait in data["waits"] if wait["lease_id"] == waiter)["next"]
        assert "second is loading" in reason
        http_client.ask("cancel", lease_id=waiter)
        http_client.ask("release", lease_id=second["lease_id"], token=second["token"])
        for name, data in page.events():
            if name == "snapshot":
                found = {lease["lease_id"]: lease for lease in data["leases"]}
            if not {waiter, second["lease_id"]} & found.keys():
                break
    newest = strictjson.loads(get(port, "/history?limit=3&kind=cancelled").body.decode())
    assert [event["lease_id"] for event in newest["events"]] == [waiter]
    http_client.ask("release", **on)


def test_open_pages_are_limited_and_idle_connections_make_room(port: int) -> None:
    with contextlib.ExitStack() as stack:
        pages = [stack.enter_context(opened_page(port)) for _ in range(STREAMS_PER_PEER)]
        assert all(page.until("snapshot") for page in pages)
        refused = get(port, "/events", method="HEAD")
        assert (refused.status, refused.headers["retry-after"]) == (503, "5")
        idle = [
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
            for _ in range(CONNECTIONS_PER_PEER)
        ]
        assert get(port).status == 200  # the oldest connections went for it
        assert pages[0].reply.read1(1) is not None
        assert idle[0].recv(1) == b""


AS_USER = """
import encodings.idna, os, socket, sys
uid, port, count = map(int, sys.argv[1:])
os.setgroups([]); os.setgid(uid); os.setuid(uid)
held = []
for _ in range(count):
    held.append(socket.create_connection(("127.0.0.1", port)))
    held[-1].sendall(b"GET /events HTTP/1.1\\r\\nHost: localhost\\r\\n\\r\\n")
    print(held[-1].recv(12).split()[1].decode(), flush=True)
sys.stdin.read()
"""


@pytest.mark.skipif(os.getuid() != 0, reason="only root can connect as another user")
def test_two_users_leave_open_pages_to_root(port: int) -> None:
    """They took all of them, and no operator could open the page."""
    with contextlib.ExitStack() as stack:
        told = []
        for uid, count in ((54_321, STREAMS_PER_PEER), (54_322, 5)):
            user = stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", AS_USER, str(uid), str(port), str(count)],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                )
            )  # fmt: skip
            told += [user.stdout.readline().strip() for _ in range(count)]
        assert told == ["200"] * 10 + ["503"]
        for _ in range(2):
            assert stack.enter_context(opened_page(port)).until("snapshot")
        assert get(port, "/events", method="HEAD").status == 503


def test_a_peer_that_does_not_read_its_answers_costs_no_memory(
    observer: ObserverProcess, port: int
) -> None:
    """Requests that are pipelined by the thousand are answered one after the other, and the next
    one only once the answer before has left."""
    before = rss_kib(observer.pid)
    with socket.create_connection(("127.0.0.1", port)) as greedy:
        greedy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        greedy.settimeout(1.0)
        request = b"GET /page.css HTTP/1.1\r\nHost: localhost\r\n\r\n"
        with contextlib.suppress(TimeoutError, ConnectionError):
            for _ in range(40):
                greedy.sendall(request * 1000)
        assert get(port).status == 200
        assert rss_kib(observer.pid) - before < 8 * 1024


@pytest.mark.parametrize(
    "sent", [(b"",), (HALF,), (WHOLE, HALF)], ids=["silent", "half", "half of the second"]
)
def test_a_connection_ends_without_a_whole_request(
    monkeypatch: pytest.MonkeyPatch, sent: Sequence[bytes]
) -> None:
    """Half of a request behind an answered one kept a connection for ever."""
    monkeypatch.setattr(server, "REQUEST_S", 0.2)
    monkeypatch.setattr(server, "IDLE_S", 0.2)

    async def answer(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})

    async def story() -> bytes:
        listening = server.bound(HttpAddress("127.0.0.1", 0))
        connections = server.Connections(loopback=True)
        serving = asyncio.create_task(server.serve(answer, listening, connections))
        reader, writer = await asyncio.open_connection(*listening.getsockname())
        writer.write(sent[0])
        for part in sent[1:]:
            assert b"204 No Content" in await reader.readuntil(b"\r\n\r\n")
            writer.write(part)
        told = b""
        with contextlib.suppress(ConnectionError):
            async with asyncio.timeout(REPLY_S):
                while came := await reader.read(1000):
                    told += came
        writer.close()
        serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await serving
        return told

    assert asyncio.run(story()) == b""


def test_the_token_of_a_page(tmp_path: Path, serving_arbiter: ArbiterProcess) -> None:
    """With a token file loopback needs the token too, /metrics as well; a browser trades it for a
    cookie; a restart does not invalidate that."""
    token = "0123456789abcdef" * 2
    file = tmp_path / "token"
    file.write_text(token)
    file.chmod(0o600)
    config = f"http:\n  listen: 127.0.0.1:0\n  token_file: {file}\n"
    with ObserverProcess(serving_arbiter, (), config=config) as observer:
        port = observer.port
        paths = ("/", "/events", "/page.js", "/metrics", "/history")
        assert [get(port, path).status for path in paths] == [401] * 5
        assert get(port, "/?token=wrong").status == 401
        assert get(port, "/", Authorization=f"Bearer {token}").status == 200
        traded = get(port, f"/?token={token}")
        assert traded.status == 200
        assert token.encode() not in traded.body
        cookie = traded.headers["set-cookie"].split(";")[0]
        assert get(port, "/metrics", Cookie=cookie).status == 200
    with ObserverProcess(serving_arbiter, (), config=config) as observer:
        cookie = cookie.replace(str(port), str(observer.port))
        assert get(observer.port, "/events", method="HEAD", Cookie=cookie).status == 200
        assert token not in observer.log


def test_a_start_that_is_refused(serving_arbiter: ArbiterProcess, port: int) -> None:
    for given, words in (
        ("0.0.0.0:0", "needs http.token_file there"),
        ("somewhere", "expected ADDRESS:PORT such as 127.0.0.1:9870"),
        (f"127.0.0.1:{port}", f"cannot listen on 127.0.0.1:{port}"),
    ):
        refused = ObserverProcess(serving_arbiter, ("--http", given)).spawn()
        assert refused.process.wait(REPLY_S) == 2
        assert words in refused.log


def test_a_restart_of_the_arbiter_ends_the_stream_and_the_hour_stays(make_arbiter: Any) -> None:
    """An open page sees the end of its stream, is told that the arbiter is away, and is served
    again by the next daemon, with the history and the readings of before."""
    arbiter = make_arbiter().start()
    with ObserverProcess(arbiter) as observer, WireClient(arbiter.endpoint) as client:
        client.hello("client").granted("before", 64 * MIB)
        with EventStream(observer.port) as page:
            page.until("snapshot")
            assert arbiter.stop() == 0
            assert [name for name, _ in page.events() if name == "snapshot"] == []
        until(lambda: get(observer.port, "/events", method="HEAD").status == 502)
        assert get(observer.port, "/metrics").status == 200
        arbiter.start()
        until(lambda: get(observer.port, "/events", method="HEAD").status == 200)
        with EventStream(observer.port) as page:
            usage = page.until("usage")
            kinds = [event["kind"] for event in page.until("history")["events"]]
        assert {"stopped", "started"} <= set(kinds)
        assert "before" in usage["consumers"]
        assert usage["samples"][0][0] < 0, "before the start of this daemon"


def test_broken_connections_leave_nothing_behind(observer: ObserverProcess, port: int) -> None:
    """Pages that end by a reset are gone, with their descriptors."""
    opened_page(port).close()
    before = len(os.listdir(f"/proc/{observer.pid}/fd"))
    for _ in range(3):
        page = opened_page(port)
        page.until("snapshot")
        page.reset()
    deadline = time.monotonic() + REPLY_S
    while len(os.listdir(f"/proc/{observer.pid}/fd")) > before:
        assert time.monotonic() < deadline
        get(port)


def opened_page(port: int) -> EventStream:
    """An open page, once the server has noticed the end of those before."""
    deadline = time.monotonic() + REPLY_S
    while (page := EventStream(port)).status == 503:
        assert time.monotonic() < deadline
        page.close()
    return page


def rss_kib(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(re.findall(r"VmRSS:\s+(\d+)", status)[0])
