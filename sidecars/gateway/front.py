"""What clients see: endpoints, who may use what, and limits.

Paths of llama-swap answer as there; `/upstream/NAME/…` goes to that server as it stands; any other
path goes to the server of the body's `model`, or to the only server.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Final
from urllib.parse import unquote

from aiohttp import web

from vram_arbiter.clients.observer.page.access import Access
from vram_arbiter.schemas.config.gateway import GatewayConfig
from vram_arbiter.schemas.errors import (
    BadRequest,
    LimitExceeded,
    MessageTooLarge,
    NotPermitted,
    UnknownModel,
    VramError,
)
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.urls import HttpAddress
from vram_arbiter.sidecars.gateway import proxy
from vram_arbiter.sidecars.gateway.keys import Asker, Keys
from vram_arbiter.sidecars.gateway.logs import following
from vram_arbiter.sidecars.gateway.reply import Reply, Sent, failure
from vram_arbiter.sidecars.gateway.routing import finder_of, no_model
from vram_arbiter.sidecars.gateway.server import Server, Turn

OWNER: Final = "vram-gateway"
UPSTREAM: Final = "/upstream/"
LOGS_STREAM: Final = "/logs/stream"
SLOW_S: Final = 10.0
TOO_SLOW: Final = b"vram-gateway: lines were lost: they came faster than they were read\n"
CONNECT_TRIES: Final = 10
LOOK_BYTES: Final = 4096
"""Of a body, looked through at a time."""
SHOWN_AS: Final = {"away": "stopped", "queued": "starting", "leaving": "stopping"}
"""llama-swap's word of a state, where it has another one."""

OPERATIONS: Final[Mapping[str, tuple[str, str, bool]]] = {
    "/v1/chat/completions": ("chat", "openai", True),
    "/v1/completions": ("text_completion", "openai", True),
    "/v1/responses": ("chat", "openai", False),
    "/v1/embeddings": ("embeddings", "openai", False),
    "/v1/messages": ("chat", "anthropic", False),
}
"""OpenTelemetry's names of what a path does, and of the API that it is of; whether its streams
begin with a token: others begin with an event before one. Requests of other paths are not
`gen_ai`."""

type Answer = Callable[[web.BaseRequest, Asker], web.StreamResponse]


class Front:
    """`handle` answers one request. `servers` by name; `upstream_keys`: keys that servers ask
    for."""

    def __init__(
        self,
        config: GatewayConfig,
        address: HttpAddress,
        servers: Mapping[str, Server],
        keys: Keys,
        upstream_keys: Mapping[str, str],
    ) -> None:
        self._config, self._servers, self._keys = config, servers, keys
        self._upstream_keys = upstream_keys
        self._access = None if keys else Access(address, (), None)
        self._by_model = {
            model: server
            for name, server in servers.items()
            for model in (name, *server.config.models)
        }
        self._held_bytes = 0
        self._own: Mapping[str, Answer] = {
            "/v1/models": self._models,
            "/running": self._running,
            "/unload": self._unload,
            "/logs": self._logs,
        }

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Answer one request. Canceled where its client leaves."""
        try:
            if request.path == "/health":
                return web.Response(text="OK")
            asker = self._asker(request)
            if (own := self._own.get(request.path)) is not None:
                return own(request, asker)
            if f"{request.path}/".startswith(f"{LOGS_STREAM}/"):
                return await self._follow_logs(request, asker)
            return await self._serve(request, asker)
        except VramError as error:
            return failure(error)

    # -- who asks
    def _asker(self, request: web.BaseRequest) -> Asker:
        """Raises KeyRefused, NotPermitted."""
        if self._access is not None:
            headers = {name.lower(): value for name, value in request.raw_headers}
            if (denied := self._access.check(headers)) is not None:
                raise NotPermitted(
                    f"this request is refused: {denied.text}",
                    hint="without keys the gateway is for programs of this machine alone",
                )
        shown = request.headers.get("authorization", ""), request.headers.get("x-api-key", "")
        return self._keys.asker(*shown)

    def _server_of(self, model: str, asker: Asker) -> Server:
        """Raises UnknownModel, also for a server that the key may not use."""
        server = self._by_model.get(model)
        if server is None or not asker.may_use(server.name):
            models = self._models_of(asker)
            raise UnknownModel(
                f"unknown model {model!r}", hint="see /v1/models", details={"models": models}
            )
        return server

    def _models_of(self, asker: Asker) -> list[str]:
        return [model for model, server in self._by_model.items() if asker.may_use(server.name)]

    def _visible(self, asker: Asker) -> list[Server]:
        return [server for server in self._servers.values() if asker.may_use(server.name)]

    # -- requests for a server
    async def _serve(self, request: web.BaseRequest, asker: Asker) -> web.StreamResponse:
        target = request.raw_path
        if not target.startswith("/"):
            raise BadRequest(f"expected a path, got {target[:80]!r}")
        if request.path.startswith(UPSTREAM):
            name, slash, rest = target.removeprefix(UPSTREAM).partition("/")
            server = self._server_of(unquote(name.partition("?")[0]), asker)
            return await self._pass_on(Reply(request, None), asker, server, slash + rest or "/")
        if len(self._servers) == 1:
            (server,) = self._visible(asker) or [self._server_of("", asker)]
            return await self._pass_on(Reply(request, None), asker, server, target)
        body = bytearray()
        async with self._holding(request) as hold:
            reply = Reply(request, self._config.keep_alive_s)
            model, stream = await self._read_model(reply, body, hold)
            server = self._server_of(model, asker)
            reply = reply if stream else Reply(request, None)
            reply.model = model
            return await self._pass_on(reply, asker, server, target, bytes(body))

    async def _read_model(
        self, reply: Reply, body: bytearray, hold: Callable[[int], None]
    ) -> tuple[str, bool]:
        """Read the body into `body` until its model is known. Return it, and whether the answer is
        a stream. Raises BadRequest, MessageTooLarge, LimitExceeded."""
        request = reply.request
        if not request.body_exists:
            raise UnknownModel(f"nothing is served at {request.path}", hint="see /v1/models")
        if request.headers.get("content-encoding", "identity") != "identity":
            raise BadRequest("a compressed body cannot be routed", hint="use /upstream/NAME/…")
        kind = request.headers.get("content-type", "")
        finder = finder_of(kind, streams=self._config.keep_alive_s is not None)
        reply.ask_for_body()
        done, head_s = False, self._config.limits.head_s
        while not done and (data := await proxy.read_some(request, head_s, LOOK_BYTES)):
            hold(len(data))
            body += data
            done = finder.feed(data)
            await asyncio.sleep(0)  # others go on: a piece takes some milliseconds at worst
        if finder.model is None:
            raise no_model()
        return finder.model, finder.stream

    @asynccontextmanager
    async def _holding(self, request: web.BaseRequest) -> AsyncIterator[Callable[[int], None]]:
        """Count the bytes of a body that are held in memory. Raises MessageTooLarge,
        LimitExceeded."""
        limits, held = self._config.limits, 0

        def hold(count: int) -> None:
            nonlocal held
            if held + count > limits.body_max_bytes:
                raise MessageTooLarge(f"a body is at most {limits.body_max_bytes} bytes")
            if self._held_bytes + count > limits.held_max_bytes:
                raise LimitExceeded(
                    f"bodies of {limits.held_max_bytes} bytes are held already",
                    hint="try again later",
                    details={"limit": "held_max_bytes"},
                )
            held += count
            self._held_bytes += count

        if (request.content_length or 0) > limits.body_max_bytes:
            raise MessageTooLarge(f"a body is at most {limits.body_max_bytes} bytes")
        try:
            yield hold
        finally:
            self._held_bytes -= held

    async def _pass_on(
        self, reply: Reply, asker: Asker, server: Server, target: str, begun: bytes = b""
    ) -> web.StreamResponse:
        """Wait for the server, and let it answer. `begun`: what was read of the body."""
        fields = proxy.upstream_fields(
            reply.request,
            checked=bool(self._keys),
            upstream_key=self._upstream_keys.get(server.name),
        )

        def turn() -> AbstractAsyncContextManager[Turn]:
            return self._turn(reply, server, asker, target.partition("?")[0])

        tries = CONNECT_TRIES
        while True:
            try:
                reply.wait()
                async with turn() as current:
                    reply.go()
                    reply.ask_for_body()
                    silence_s = self._config.limits.head_s
                    upgraded = await proxy.forward(
                        current.upstream, reply, target, fields, begun, silence_s
                    )
                if upgraded is not None:
                    await proxy.tunnel(reply, upgraded, turn)
                return Sent(lasts=reply.lasts)
            except proxy.Unreached as error:
                tries -= 1
                if not tries:
                    return reply.fail(error)
                server.refused()
            except VramError as error:
                return reply.fail(error)
            finally:
                reply.go()

    @asynccontextmanager
    async def _turn(
        self, reply: Reply, server: Server, asker: Asker, path: str
    ) -> AsyncIterator[Turn]:
        """Record a turn of the request: span, wait, durations, and that it waits or is in
        flight."""
        now = asyncio.get_running_loop().time
        labels = {telemetry.ATTR_CONSUMER: server.name}
        came, traceparent = now(), reply.request.headers.get("traceparent")
        with tracing.span(telemetry.SPAN_GATEWAY_REQUEST, traceparent, labels):
            awake, phase = server.state == "ready", telemetry.METRIC_GATEWAY_WAITING
            meters.shift(phase, 1, labels)
            try:
                async with server.turn(asker) as turn:
                    meters.shift(phase, -1, labels)
                    phase = telemetry.METRIC_GATEWAY_IN_FLIGHT
                    meters.shift(phase, 1, labels)
                    if not awake:
                        tracing.event(telemetry.EVENT_WOKEN)
                    tracing.event(telemetry.EVENT_GRANTED)
                    granted = now()
                    meters.measure(telemetry.METRIC_GATEWAY_WAIT, granted - came, labels)
                    yield turn
            finally:
                meters.shift(phase, -1, labels)
            if path in OPERATIONS:
                _measure(reply, path, granted, labels)

    # -- the gateway's own answers
    def _models(self, request: web.BaseRequest, asker: Asker) -> web.Response:
        created = int(time.time())
        models = [
            {"id": model, "object": "model", "created": created, "owned_by": OWNER}
            for model in self._models_of(asker)
        ]
        return web.json_response({"object": "list", "data": models})

    def _running(self, request: web.BaseRequest, asker: Asker) -> web.Response:
        running = [
            {
                "model": server.name,
                "state": SHOWN_AS.get(server.state, server.state),
                "lease": server.state,
                "gpu": server.gpu,
                "in_flight": server.in_flight,
                "waiting": server.waiting,
                "switches": server.switches,
            }
            for server in self._visible(asker)
            if server.state != "away" or server.waiting
        ]
        return web.json_response({"running": running})

    def _unload(self, request: web.BaseRequest, asker: Asker) -> web.Response:
        for server in self._chosen(request, asker):
            server.unload()
        return web.Response(text="OK")

    def _logs(self, request: web.BaseRequest, asker: Asker) -> web.Response:
        return web.Response(text=_history(self._chosen(request, asker)))

    async def _follow_logs(self, request: web.BaseRequest, asker: Asker) -> web.StreamResponse:
        """Send what servers printed, and print until the client leaves or falls behind."""
        model = request.path.removeprefix(LOGS_STREAM).removeprefix("/")
        servers = [self._server_of(model, asker)] if model else self._visible(asker)
        response = web.StreamResponse(headers={"Content-Type": "text/plain; charset=utf-8"})
        await response.prepare(request)
        with following(server.log for server in servers) as reader:
            text = b"" if "no-history" in request.query else _history(servers).encode()
            while not reader.late:
                await _write(response, text)
                text = await reader.take()
            await _write(response, text + TOO_SLOW)
        return response

    def _chosen(self, request: web.BaseRequest, asker: Asker) -> list[Server]:
        """Return the servers that `?model=` names, or all. Raises UnknownModel."""
        model = request.query.get("model")
        return self._visible(asker) if model is None else [self._server_of(model, asker)]


def _measure(reply: Reply, path: str, granted: float, labels: Mapping[str, str]) -> None:
    """Measure an answered request of OPERATIONS by OpenTelemetry's names. `granted`: when its
    server could take it (seconds of the loop)."""
    operation, provider, begins_with_a_token = OPERATIONS[path]
    labels = {
        **labels,
        telemetry.ATTR_CHAT_OPERATION: operation,
        telemetry.ATTR_PROVIDER: provider,
        **({telemetry.ATTR_REQUEST_MODEL: reply.model} if reply.model else {}),
    }
    if reply.event_at is not None and begins_with_a_token:
        meters.measure(telemetry.METRIC_GATEWAY_FIRST_TOKEN, reply.event_at - granted, labels)
    failed = {telemetry.ATTR_ERROR_TYPE: str(reply.status)} if reply.status >= 400 else {}
    took_s = asyncio.get_running_loop().time() - granted
    meters.measure(telemetry.METRIC_GATEWAY_REQUEST, took_s, labels | failed)


async def _write(response: web.StreamResponse, data: bytes) -> None:
    """Send a part of an answer. Raises ConnectionAbortedError where it is not read for SLOW_S."""
    try:
        async with asyncio.timeout(SLOW_S):
            await response.write(data)
    except TimeoutError as error:
        raise ConnectionAbortedError(f"nothing was read for {SLOW_S:g} s") from error


def _history(servers: Iterable[Server]) -> str:
    return "".join(server.log.text() for server in servers)
