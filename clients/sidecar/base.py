"""Talk to one sidecar: lazy connection, replies matched by id, typed errors.

Rules. The first call connects, and waits for a sidecar that is starting; a socket that timed out or
was hung up on is replaced before the next call. No failure here reads as an answer: *evicted* or
*unavailable* is never "not found". It knows nothing of images or actions.

The server may be one of the field, with a REP socket. The `ping` that begins each connection finds
out (`clients.net.rpc_client`), so that nothing has to be configured and a server may be replaced by
one of the other kind. It gets one request at a time, in the shapes of `clients.sidecar.field`.
"""

import asyncio
from collections.abc import Sequence
from time import monotonic
from typing import Any, ClassVar, Protocol, Self, cast

from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients.net.rpc_client import RpcClient
from vram_arbiter.clients.sidecar import field
from vram_arbiter.schemas.errors import (
    BadRequest,
    FrameStale,
    ModelError,
    SidecarUnavailable,
    VramError,
    from_wire,
)
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.sidecar import LoadResult, PingResult

CALL_TIMEOUT_S = 180.0  # a cold load of a large model; the field's clients wait as long
CONNECT_TIMEOUT_S = 10.0  # for a sidecar that another program starts
PROBE_S = 1.0  # one ping


class Exchanges(Protocol):
    """Requests and replies over one connection at a time (`clients.net.rpc_client.RpcClient`)."""

    proven: bool

    @property
    def in_order(self) -> bool | None: ...

    async def exchange(self, request: JsonMap, timeout_s: float) -> Any: ...

    def drop(self, error: VramError) -> None: ...


class SidecarClient:
    """Base of the sidecars' clients. `family` says how requests are tagged: `op` (perception) or
    `endpoint` (policy).

    Several calls may be under way. One loop, one process.
    """

    family: ClassVar[field.Family] = "op"

    def __init__(
        self,
        endpoint: str,
        *,
        timeout_s: float = CALL_TIMEOUT_S,
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
    ) -> None:
        self.endpoint = endpoint
        self.identity: PingResult | None = None
        """The last answer to `ping`."""
        self._timeout_s = timeout_s
        self._connect_timeout_s = connect_timeout_s
        self._rpc: Exchanges = RpcClient(
            endpoint, program="sidecar", lost=self._lost, enveloped=True
        )
        self._connecting = asyncio.Lock()
        self._turn = asyncio.Lock()  # of requests whose replies are matched by their order

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    @property
    def of_field(self) -> bool:
        """Whether the present connection is to a server of the field: no lease, no `unload`."""
        return self._rpc.in_order is True

    @property
    def connected(self) -> bool:
        """Whether the server that answered last still holds the connection."""
        return self._rpc.proven

    # -- ops of both families
    async def ping(self, *, timeout_s: float = PROBE_S) -> PingResult:
        """Identity and state. Does not start anything. A server of the field, which tells its
        model at most, is resident: it listens once that is loaded. Raises SidecarUnavailable."""
        answer = await self._exchange("ping", {}, timeout_s)
        if not isinstance(answer, dict):
            self._drop("it answered a ping with something else")
            raise ModelError(
                f"{self.endpoint} answered a ping with {type(answer).__name__}",
                hint="is this the endpoint of a sidecar?",
            )
        if self.of_field:
            model = str(answer.get("model") or self.endpoint)
            answer = {"ok": True, "model": model, "rskill": model, "state": "resident"}
        self.identity = cast(PingResult, answer)
        return self.identity

    async def load(self, timeout_s: float | None = None) -> LoadResult:
        """Make the model resident (the sidecar acquires its lease). `timeout_s` bounds the wait for
        the lease: WaitTimeout, OutOfMemory … A server of the field is asked nothing."""
        await self._ensure()
        if self.of_field:
            return {"ok": True, "lease_id": None, "token": None, "loaded": False}
        fields = (
            {"timeout_s": timeout_s} if self.family == "op" else {"data": {"timeout_s": timeout_s}}
        )
        limit_s = self._timeout_s if timeout_s is None else max(self._timeout_s, timeout_s)
        return cast(LoadResult, await self.call("load", fields, timeout_s=limit_s))

    async def unload(self) -> None:
        """Ask it to unload the model at its next safe point. Raises UnknownOp for a server of the
        field, which frees its memory when it ends."""
        await self.call("unload")

    async def shutdown(self) -> None:
        """Ask the process to end, also one that another program started."""
        if not self._rpc.proven:
            await self.ping(timeout_s=PROBE_S * 2)
        op, fields = (
            field.request(self.family, "shutdown", {}) if self.of_field else ("shutdown", {})
        )
        await self._exchange(op, fields, PROBE_S * 2)

    async def call(
        self,
        op: str,
        fields: JsonMap | None = None,
        *,
        token: Sequence[int] | None = None,
        timeout_s: float | None = None,
        fresh_s: float | None = None,
    ) -> Any:
        """One request, connecting first where needed. It carries the present span, if there is
        one.

        `fresh_s`: from now on, what was sent has to be looked at within so long; else FrameStale.
        Raises the type of the reply's code (Evicted, NotResident, Loading, OutOfMemory, ModelError,
        …) SidecarUnavailable, UntrustedServer or MessageTooLarge.
        """
        began_s = monotonic()
        await self._ensure()
        message = traces.along(fields)
        limit_s = self._timeout_s if timeout_s is None else timeout_s
        if fresh_s is not None:
            fresh_s = max(0.0, fresh_s - (monotonic() - began_s))
        if self.of_field:
            return await self._ask_field(op, message, token, limit_s, fresh_s)
        if fresh_s is not None:
            message["fresh_s"] = fresh_s
        if token is not None:
            message["token"] = [int(token[0]), int(token[1])]
        return await self._exchange(op, message, limit_s)

    async def close(self) -> None:
        """Leave the sidecar as it is. Idempotent."""
        self._drop("the client was closed")

    # -- steps: connection
    async def _ensure(self) -> None:
        """Connect, unless the server that answered last still holds the connection."""
        async with self._connecting:
            if self._rpc.proven:
                return
            try:
                await self.ping(timeout_s=self._connect_timeout_s)
            except SidecarUnavailable as error:
                raise SidecarUnavailable(
                    f"no sidecar answers at {self.endpoint}: {error.message}",
                    hint="start it with `vram-sidecar`, or the other project's server",
                    details={"endpoint": self.endpoint},
                ) from error

    # -- steps: one exchange
    async def _ask_field(
        self,
        op: str,
        fields: JsonMap,
        token: Sequence[int] | None,
        timeout_s: float,
        fresh_s: float | None,
    ) -> Any:
        """One request to a server of the field, which looks at it as soon as it is its turn."""
        if token is not None:
            raise BadRequest(
                f"{self.endpoint} is another project's server and knows no tokens",
                hint="load() answers with the token of the server that serves now",
            )
        if op == "score":  # pictures are decoded
            op, sent = await asyncio.to_thread(field.request, self.family, op, fields)
        else:
            op, sent = field.request(self.family, op, fields)
        reply = await self._exchange(op, sent, timeout_s, fresh_s=fresh_s)
        return field.result(op, sent, reply)

    async def _exchange(
        self, op: str, fields: JsonMap, timeout_s: float, *, fresh_s: float | None = None
    ) -> Any:
        """One exchange, after all before it unless replies tell which request they are for."""
        if self._rpc.in_order is False:
            return await self._exchange_now(op, fields, timeout_s)
        began_s = monotonic()
        try:
            async with asyncio.timeout(timeout_s if fresh_s is None else min(timeout_s, fresh_s)):
                await self._turn.acquire()
        except TimeoutError:
            if fresh_s is not None and fresh_s < timeout_s:
                raise FrameStale(
                    f"{op} waited {fresh_s:g} s for other requests; nothing was looked at",
                    hint="look again",
                ) from None
            raise self._no_answer(op, timeout_s) from None
        try:
            return await self._exchange_now(op, fields, timeout_s - (monotonic() - began_s))
        finally:
            self._turn.release()

    async def _exchange_now(self, op: str, fields: JsonMap, timeout_s: float) -> Any:
        try:
            reply = await self._rpc.exchange({self.family: op, **fields}, timeout_s)
        except TimeoutError:
            if op != "ping" or self._rpc.in_order is not False:
                self._drop(f"{op} was not answered")  # a fresh socket never sees the late answer
            raise self._no_answer(op, timeout_s) from None
        except asyncio.CancelledError:
            if self._rpc.in_order is not False:
                self._drop(f"{op} was given up")
            raise
        return _result(reply)

    def _no_answer(self, op: str, timeout_s: float) -> SidecarUnavailable:
        return SidecarUnavailable(
            f"no answer to {op} within {timeout_s:g} s from {self.endpoint}",
            hint="is it running? it may be loading a model or hang",
            details={"endpoint": self.endpoint, "op": op},
        )

    def _drop(self, reason: str) -> None:
        self._rpc.drop(self._lost(reason))

    def _lost(self, reason: str) -> SidecarUnavailable:
        return SidecarUnavailable(
            f"contact to {self.endpoint} lost: {reason}", hint="the next call tries again"
        )


def _result(reply: Any) -> Any:
    """The result without the envelope. Raises the typed error of a failure; one without a code is a
    foreign server's ModelError."""
    if not isinstance(reply, dict):
        return reply
    if reply.get("ok") is False or ("error" in reply and "ok" not in reply):
        error = reply.get("error", "")
        wire = {**error} if isinstance(error, dict) else {"message": str(error)}
        for key in ("code", "hint", "details"):
            if key in reply:
                wire.setdefault(key, reply[key])
        if "code" not in wire:
            raise ModelError(str(wire.get("message", "")), hint="see the sidecar's log")
        raise from_wire(wire)
    body = {key: value for key, value in reply.items() if key != "re"}
    return body["result"] if body.keys() == {"result"} else body
