"""The gateway with stock clients, a real daemon and stand-in servers."""

import asyncio
import contextlib
import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

pytest.importorskip("aiohttp", reason="the extra `gateway`")

import aiohttp

from tests.sidecars.gateway.conftest import KEY, GatewayProcess, stand_in
from tests.support.collector import Collector
from tests.support.leases import view_of
from tests.support.prepared import start
from tests.support.process import ArbiterProcess
from tests.support.processes import rss_bytes
from tests.support.waiting import PATIENCE_S, eventually
from vram_arbiter.clients.sync import Client
from vram_arbiter.reasoner.llm.config import LlmConfig
from vram_arbiter.reasoner.llm.http import JsonHttp
from vram_arbiter.schemas.runtime.telemetry.names import (
    ATTR_CHAT_OPERATION,
    ATTR_CONSUMER,
    ATTR_PROVIDER,
    ATTR_REQUEST_MODEL,
    EVENT_FIRST_BYTE,
    EVENT_GRANTED,
    EVENT_WOKEN,
    METRIC_GATEWAY_FIRST_TOKEN,
    METRIC_GATEWAY_IN_FLIGHT,
    METRIC_GATEWAY_REQUEST,
    METRIC_GATEWAY_WAITING,
    SPAN_GATEWAY_REQUEST,
)
from vram_arbiter.schemas.wire.views import DemandView
from vram_arbiter.sidecars.gateway.gateway import NAME

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]
Start = Callable[..., GatewayProcess]
SENT_BYTES = 1 << 26
HELLO = [{"role": "user", "content": "hello"}]
ANSWER = "0 1 "


def openai_client(gateway: GatewayProcess, key: str = KEY) -> Any:
    import openai  # 1.6 s of a core, for each worker that collects this file

    return openai.AsyncOpenAI(
        base_url=f"{gateway.url}/v1", api_key=key, timeout=PATIENCE_S, max_retries=0
    )


async def ask(client: Any, model: str, **fields: object) -> str:
    answer = await client.chat.completions.create(model=model, messages=HELLO, **fields)
    return str(answer.choices[0].message.content)


# -- a stock client
async def test_the_first_request_starts_its_server_and_an_idle_one_leaves(
    gateway: Start, arbiter_daemon: ArbiterProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Collector() as collector:
        for name, value in collector.environ().items():
            monkeypatch.setenv(name, value)
        started = gateway(
            {
                "a": stand_in(arbiter_daemon, 3, models=["gpt-4o-mini"], idle_s=0.2),
                "b": stand_in(arbiter_daemon, 3),
            }
        )
        async with openai_client(started) as client:
            models = [model.id async for model in client.models.list()]
            assert models == ["a", "gpt-4o-mini", "b"]
            assert not started.running()
            assert await ask(client, "gpt-4o-mini") == ANSWER
            assert await ask(client, "b") == ANSWER
            stream = await client.chat.completions.create(model="b", messages=HELLO, stream=True)
            assert [chunk.choices[0].delta.content async for chunk in stream] == ["0 ", "1 "]
        await eventually(lambda: set(started.running()) == {"b"})  # both fit; `a` was idle
        with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:
            await eventually(lambda: [one.consumer for one in arbiter.status().leases] == ["b"])
        assert "a: serves on" in started.logs()
        started.close()
        asked = [
            [event.name for event in span.events] for span in collector.spans(SPAN_GATEWAY_REQUEST)
        ]
        passed = [EVENT_GRANTED, EVENT_FIRST_BYTE]
        assert asked == [[EVENT_WOKEN, *passed], [EVENT_WOKEN, *passed], passed]
        for metric in (METRIC_GATEWAY_WAITING, METRIC_GATEWAY_IN_FLIGHT):
            points = collector.points(metric)  # the last of a server stays
            assert {one.attributes[ATTR_CONSUMER]: one.value for one in points} == {"a": 0, "b": 0}
        chat = {ATTR_CHAT_OPERATION: "chat", ATTR_PROVIDER: "openai"}
        chats = {
            name: chat | {ATTR_CONSUMER: server, ATTR_REQUEST_MODEL: name}
            for server, name in (("a", "gpt-4o-mini"), ("b", "b"))
        }
        for metric, counts in (
            (METRIC_GATEWAY_REQUEST, {"gpt-4o-mini": 1, "b": 2}),
            (METRIC_GATEWAY_FIRST_TOKEN, {"b": 1}),
        ):
            last = {one.attributes[ATTR_REQUEST_MODEL]: one for one in collector.points(metric)}
            assert {name: one.count for name, one in last.items()} == counts
            assert all(one.attributes == chats[name] for name, one in last.items())


async def test_an_eviction_waits_for_a_stream_and_equals_take_turns(shared: GatewayProcess) -> None:
    """The arbiter counts the stream as a use; the next request of the evicted one brings it
    back."""
    async with openai_client(shared) as client:
        stream = await client.chat.completions.create(
            model="a", messages=HELLO, stream=True, max_tokens=3, user="u"
        )
        shared.let("u", 0)
        words = aiter(stream)
        assert (await anext(words)).choices[0].delta.content == "0 "
        other = asyncio.create_task(ask(client, "b"))
        await eventually(lambda: shared.running()["a"]["lease"] == "leaving")
        late = asyncio.create_task(ask(client, "a"))  # waits for the next turn of `a`
        await eventually(lambda: shared.running()["a"]["waiting"] == 1)
        with Client("t", endpoint=shared.arbiter.endpoint) as arbiter:
            assert view_of(arbiter, "a").uses == 1
        shared.let("u", 1, 2)
        assert [chunk.choices[0].delta.content async for chunk in words] == ["1 ", "2 "]
        assert await other == ANSWER
        assert await late == ANSWER


async def test_clients_of_two_servers_on_room_for_one_all_get_their_answers(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    started = gateway({name: stand_in(arbiter_daemon, 5, min_residency_s=0.5) for name in "ab"})
    async with openai_client(started) as client:

        async def user(name: str) -> None:
            for _ in range(3):
                assert await ask(client, name) == ANSWER

        await asyncio.gather(*(user(name) for name in "ab" * 8))
    switches = {name: one["switches"] for name, one in started.running().items()}
    assert max(switches.values()) <= 4


@pytest.mark.nightly
async def test_three_servers_in_room_for_one_all_answer(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    """Evicted as soon as they had loaded, they threw each other out for ever."""
    started = gateway({name: stand_in(arbiter_daemon, 5) for name in "abc"})
    async with openai_client(started) as client:
        assert await asyncio.gather(*(ask(client, name) for name in "abcabc")) == [ANSWER] * 6


async def test_a_sleeping_server_wakes_for_a_request_and_not_before(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    started = gateway(
        {"a": stand_in(arbiter_daemon, 5, on_evict="vllm"), "b": stand_in(arbiter_daemon, 5)}
    )
    pid = await asyncio.to_thread(started.pid_of, "a")
    with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:
        for _ in range(2):
            await asyncio.to_thread(started.pid_of, "b")
            assert view_of(arbiter, "a").state == "parked"
            unload = await asyncio.to_thread(started.client.get, "/unload?model=b")
            assert unload.status_code == 200
            await eventually(lambda: not started.running())  # `a` sleeps on beside an empty GPU
            assert await asyncio.to_thread(started.pid_of, "a") == pid
    assert started.running()["a"]["switches"] == 3


@pytest.mark.nightly
async def test_a_thousand_waiting_clients_are_all_served(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    """Regression: with the usual soft limit of 1,024 files a server could not be started."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(1024, before[1]), before[1]))
    try:
        started = gateway(
            {name: stand_in(arbiter_daemon, 5, queue_max=500) for name in "ab"}, prepared=False
        )
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (before[1], before[1]))

    async def user(session: aiohttp.ClientSession, model: str) -> int:
        body = {"model": model, "messages": HELLO}
        async with session.post(f"{started.url}/v1/chat/completions", json=body) as answer:
            await answer.read()
            return answer.status

    try:
        async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as session:
            answers = await asyncio.gather(*(user(session, name) for name in "ab" * 500))
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert set(answers) == {200}


# -- ends
async def test_a_client_that_leaves_cancels_its_request_and_gives_up_its_place(
    shared: GatewayProcess,
) -> None:
    async with openai_client(shared) as client:
        first = asyncio.create_task(ask(client, "a", user="never"))
        await eventually(lambda: shared.running().get("a", {}).get("in_flight") == 1)
        second = asyncio.create_task(ask(client, "b"))
        await eventually(lambda: shared.running().get("b", {}).get("lease") == "queued")
        with Client("t", endpoint=shared.arbiter.endpoint) as arbiter:
            a, b = (DemandView(name, *of, NAME) for name, of in (("a", (1, 0)), ("b", (0, 1))))
            await eventually(lambda: arbiter.status().demands == (a, b))
            second.cancel()
            await eventually(lambda: "b" not in shared.running())
            await eventually(lambda: [lease.consumer for lease in arbiter.status().leases] == ["a"])
            await eventually(lambda: arbiter.status().demands == (a,))
            first.cancel()
            await eventually(lambda: shared.running()["a"]["in_flight"] == 0)
            await eventually(lambda: arbiter.status().demands == ())


async def test_a_request_that_does_not_end_is_ended_after_the_grace(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    import openai

    started = gateway(
        {"a": stand_in(arbiter_daemon, 5, grace_s=0.2), "b": stand_in(arbiter_daemon, 5)}
    )
    async with openai_client(started) as client:
        stuck = asyncio.create_task(ask(client, "a", user="never"))
        await eventually(lambda: started.running().get("a", {}).get("in_flight") == 1)
        assert await ask(client, "b") == ANSWER
        with pytest.raises(openai.InternalServerError) as raised:
            await stuck
    assert raised.value.status_code == 503
    assert "evicted" in str(raised.value)


async def test_a_server_that_dies_says_why_and_is_started_again(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    import openai

    started = gateway(
        {
            "a": stand_in(arbiter_daemon, 1),
            "broken": {
                "command": ["sh", "-c", "echo no such model >&2; exit 5", "{port}"],
                "vram": "1GiB",
            },
        }
    )
    async with openai_client(started) as client:
        with pytest.raises(openai.InternalServerError) as raised:
            await ask(client, "broken")
        assert raised.value.status_code == 502
        assert "exit code 5" in str(raised.value)
        assert "no such model" in str(raised.value)
        pid = await asyncio.to_thread(started.pid_of, "a")
        with started.client.stream("GET", "/logs/stream/a?no-history") as followed:
            with pytest.raises(openai.InternalServerError, match="about to die"):
                await client.chat.completions.create(
                    model="a", messages=[{"role": "user", "content": "die"}]
                )
            lines = followed.iter_lines()
            assert await asyncio.to_thread(next, lines) == "a: about to die"
        await eventually(lambda: "a" not in started.running())
        assert await asyncio.to_thread(started.pid_of, "a") != pid


@pytest.mark.nightly
async def test_what_can_never_fit_is_said_in_the_arbiters_words(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    import openai

    started = gateway({"a": stand_in(arbiter_daemon, 1), "b": stand_in(arbiter_daemon, 500)})
    async with openai_client(started) as client:
        with pytest.raises(openai.InternalServerError, match="500 GiB"):
            await ask(client, "b")


@pytest.mark.nightly
async def test_a_killed_server_is_started_again(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    started = gateway({"a": stand_in(arbiter_daemon, 1)})
    pid = await asyncio.to_thread(started.pid_of, "a")
    os.kill(pid, signal.SIGKILL)
    await eventually(lambda: "a" not in started.running())
    assert await asyncio.to_thread(started.pid_of, "a") != pid


async def test_vramctl_run_listens_for_one_server_without_a_file(
    arbiter_daemon: ArbiterProcess,
) -> None:
    import openai

    command = stand_in(arbiter_daemon, 1)["command"]
    flags = ["--vram", "1GiB", "--name", "llm", "--on-evict", "vllm", "--listen", "0"]
    said, says = os.pipe()
    with open(said) as output:
        child = start("vramctl-run", ["run", *flags, "--", *command], arbiter_daemon.environ, says)
        os.close(says)
        url = (await asyncio.to_thread(output.readline)).strip()
    async with openai.AsyncOpenAI(base_url=f"{url}/v1", api_key=KEY, max_retries=0) as client:
        assert await ask(client, "whatever") == ANSWER
    child.terminate()
    assert await asyncio.to_thread(child.wait, PATIENCE_S) == 0


# -- limits
async def test_beyond_the_queue_and_the_wait_the_reason_is_said(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    import openai

    started = gateway(
        {
            "a": stand_in(arbiter_daemon, 5),
            "b": stand_in(arbiter_daemon, 5, queue_max=1, wait_s=5.0),
        }
    )
    async with openai_client(started) as client:
        stuck = asyncio.create_task(ask(client, "a", user="u"))
        await eventually(lambda: started.running().get("a", {}).get("in_flight") == 1)
        waits = asyncio.create_task(ask(client, "b"))
        with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:
            await eventually(lambda: "b" in {lease.consumer for lease in arbiter.status().leases})
        with pytest.raises(openai.InternalServerError) as full:
            await ask(client, "b")
        with pytest.raises(openai.InternalServerError) as late:
            await waits
        started.let("u", 0)
        assert await stuck == ANSWER
    for raised, code in ((full, "limit_exceeded"), (late, "wait_timeout")):
        assert raised.value.status_code == 503
        assert raised.value.response.headers["retry-after"]
        assert raised.value.code == code
        assert isinstance(raised.value.body, dict)
        assert " a" in raised.value.body["why"]


async def test_a_streaming_client_hears_while_it_waits(shared: GatewayProcess) -> None:
    async with openai_client(shared) as client:
        stuck = asyncio.create_task(ask(client, "a", user="listener"))
        await eventually(lambda: shared.running().get("a", {}).get("in_flight") == 1)
        async with client.chat.completions.with_streaming_response.create(
            model="b", messages=HELLO, stream=True
        ) as response:
            lines = response.iter_lines()
            assert await anext(lines) == ": waiting"
            shared.let("listener", 0)
            assert [line async for line in lines][-2:] == ["data: [DONE]", ""]
        await stuck


async def test_the_reasoners_planner_asks_again_where_it_was_told_to_wait(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    started = gateway(
        {"a": stand_in(arbiter_daemon, 5), "b": stand_in(arbiter_daemon, 5, wait_s=5.0)}
    )
    config = LlmConfig(f"{started.url}/v1", "b", KEY, timeout_s=PATIENCE_S)
    pauses: list[float] = []

    async def pause(seconds: float) -> None:
        pauses.append(seconds)
        started.let("u", 0)
        await stuck

    async with openai_client(started) as client:
        stuck = asyncio.create_task(ask(client, "a", user="u"))
        await eventually(lambda: started.running().get("a", {}).get("in_flight") == 1)
        http = JsonHttp({"authorization": f"Bearer {KEY}"}, config, pause, lambda: None)
        body: dict[str, Any] = {"model": "b", "messages": HELLO}
        answer = await http.post(f"{config.base_url}/chat/completions", body)
        await http.close()
    assert answer["choices"][0]["message"]["content"] == ANSWER
    assert pauses[0] == 5.0  # Retry-After


async def test_keys_limit_who_may_use_what(
    gateway: Start, arbiter_daemon: ArbiterProcess, tmp_path: Path
) -> None:
    import openai

    keys = tmp_path / "keys.yaml"
    keys.write_text("keys: [{name: ann, key: sk-0123456789abcdef, servers: [a]}]")
    keys.chmod(0o600)
    upstream = tmp_path / "upstream"
    upstream.write_text("sk-upstream\n")
    upstream.chmod(0o600)
    started = gateway(
        {
            "a": stand_in(arbiter_daemon, 1, upstream_key_file=str(upstream)),
            "b": stand_in(arbiter_daemon, 1),
        },
        keys_file=str(keys),
    )
    async with openai_client(started) as client:
        with pytest.raises(openai.AuthenticationError):
            await ask(client, "a")
    async with openai_client(started, "sk-0123456789abcdef") as client:
        assert [model.id async for model in client.models.list()] == ["a"]
        with pytest.raises(openai.NotFoundError):
            await ask(client, "b")
    shown = {"x-api-key": "sk-0123456789abcdef"}
    async with httpx.AsyncClient(timeout=PATIENCE_S, headers=shown) as plain:
        echoed = (await plain.get(f"{started.url}/upstream/a/x?q=%2F")).json()
    assert echoed["target"] == "/x?q=%2F"
    assert echoed["headers"]["Authorization"] == "Bearer sk-upstream"
    assert "x-api-key" not in {name.lower() for name in echoed["headers"]}


async def test_bodies_pass_unchanged_and_within_bounds(shared: GatewayProcess) -> None:
    async with httpx.AsyncClient(timeout=PATIENCE_S, base_url=shared.url) as client:
        form = {"model": "a", "more": "x"}
        sent = await client.post("/v1/audio", data=form, files={"file": b"R" * 1_000_000})
        assert sent.json()["bytes"] == int(sent.request.headers["content-length"])
        assert sent.headers["x-own"] == "1"
        assert "x-secret" not in sent.headers  # hop by hop: named by Connection
        large = await client.get("/upstream/a/large?bytes=5000000")
        assert len(large.content) == 5_000_000
        refused = await client.post("/v1/x", content=b'{"a": "' + b"x" * (3 << 20) + b'"}')
        assert refused.status_code == 413
        for body, status in ((b"{}", 400), (b'{"model": "zz"}', 404)):
            answer = await client.post("/v1/x", content=body)
            assert answer.status_code == status, answer.text
        foreign = await client.get("/unload", headers={"Origin": "https://example.com"})
        assert foreign.status_code == 403
        assert (await client.get("/health")).text == "OK"


async def test_a_slow_reader_does_not_fill_memory(
    gateway: Start, arbiter_daemon: ArbiterProcess
) -> None:
    started = gateway({"a": stand_in(arbiter_daemon, 1)})
    await asyncio.to_thread(started.pid_of, "a")
    before = rss_bytes(started.process.pid)
    async with (
        httpx.AsyncClient(timeout=PATIENCE_S) as client,
        client.stream("GET", f"{started.url}/large?bytes={SENT_BYTES}") as response,
    ):
        pieces = response.aiter_raw(65536)
        count = len(await anext(pieces))
        async with openai_client(started) as other:
            assert await ask(other, "a") == ANSWER  # others are served meanwhile
        assert rss_bytes(started.process.pid) - before < 32 << 20
        async for piece in pieces:
            count += len(piece)
    assert count == SENT_BYTES


async def test_a_websocket_passes_and_does_not_keep_its_server(shared: GatewayProcess) -> None:
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{shared.url}/upstream/a/ws", protocols=("chat",)) as socket,
    ):
        assert socket.protocol == "chat"
        await socket.send_str("hi")
        assert await socket.receive_str() == "echo hi"
        await socket.send_bytes(b"\0" * 100_000)
        assert len(await socket.receive_bytes()) == 100_000
        async with openai_client(shared) as client:
            assert await ask(client, "b") == ANSWER
        with contextlib.suppress(ConnectionError):
            assert (await socket.receive()).type is aiohttp.WSMsgType.CLOSE
