"""Requests and their replies over one connection at a time, for asyncio programs.

The connection is made by the first request and again by the first one after a loss of contact. The
module must not know what requests and replies mean.

Our servers repeat a request's `id` as `re`. A server of the field, with a REP socket, does not:
`in_order` says which of both was met, by the first answer of the connection. To be understood by
both, a request stands behind an empty frame, so that a wrong guess cannot be made, nor waited for.
"""

import asyncio
import itertools
from collections.abc import Callable
from typing import Any

from vram_arbiter.clients.net.answer import Answer
from vram_arbiter.clients.net.dealer import Dealer
from vram_arbiter.clients.net.link import MESSAGE_LIMIT_BYTES
from vram_arbiter.schemas.defaults import IMAGE_MESSAGE_MAX_BYTES, KIB
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.runtime.trust import Program

IMAGES_REQUEST_MAX_BYTES = IMAGE_MESSAGE_MAX_BYTES + 64 * KIB


class RpcClient:
    """`lost(reason)` makes the error that requests fail with when contact is lost;
    `pushed(message)` gets what is not a reply, `dropped` is called when a connection ends.
    `enveloped` as in `Dealer`. `request_max_bytes`: our server refuses more, without `re`.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        program: Program,
        lost: Callable[[str], VramError],
        pushed: Callable[[Message], None] = lambda message: None,
        dropped: Callable[[], None] = lambda: None,
        enveloped: bool = False,
        request_max_bytes: int = IMAGES_REQUEST_MAX_BYTES,
    ) -> None:
        self.proven = False
        """Whether the present connection was answered once."""
        self.in_order: bool | None = None if enveloped else False
        """Whether replies come without `re`, to one request at a time; None before the first."""
        self._enveloped = enveloped
        self._request_max_bytes = request_max_bytes
        self._endpoint = endpoint
        self._program: Program = program
        self._lost = lost
        self._pushed = pushed
        self._dropped = dropped
        self._ids = itertools.count(1)
        self._waiting: dict[int, Answer[Any]] = {}
        self._dealer: Dealer | None = None
        self._running: asyncio.Task[None] | None = None

    async def exchange(self, request: JsonMap, timeout_s: float) -> Any:
        """Return the reply to a request, which gets an `id` here. A map where the server is ours.

        Unless `in_order` is False, callers make one exchange after the other, and `drop` the
        connection where they gave one up: its late reply would pass for the next one's.

        Raises: TimeoutError; UntrustedServer before anything is sent; the error of `lost`;
        MessageTooLarge; ModelError for a reply that is not msgpack, where `enveloped`.
        """
        dealer = self._connected()
        request_id = next(self._ids)
        answer = self._waiting[request_id] = Answer[Any]()
        try:
            limit = self._request_max_bytes if self.in_order is False else MESSAGE_LIMIT_BYTES
            message = {"id": 0} | dict(request) | {"id": request_id}  # first: see `leading_id`
            if not dealer.send(message, limit):
                raise self._lost("it accepts no more requests; restart it")
            return await answer.within(timeout_s)
        finally:
            self._waiting.pop(request_id, None)

    def drop(self, error: VramError) -> None:
        """Close the connection; requests that wait fail with `error`. Idempotent."""
        running, self._running, self._dealer = self._running, None, None
        self.proven = False
        self.in_order = None if self._enveloped else False
        if running is not None:
            running.cancel()
        waiting, self._waiting = self._waiting, {}
        for answer in waiting.values():
            answer.fail(error)
        self._dropped()

    def _connected(self) -> Dealer:
        if self._dealer is None:
            self._dealer = Dealer(
                self._endpoint,
                self._received,
                self._hung_up,
                self.drop,
                program=self._program,
                enveloped=self._enveloped,
            )
            self._running = asyncio.get_running_loop().create_task(
                self._dealer.run(), name=f"socket to {self._program}"
            )
        return self._dealer

    def _received(self, message: Any) -> None:
        of_map = message if isinstance(message, dict) else {}
        number = of_map.get("re")
        if isinstance(number, int) and (answer := self._waiting.get(number)):
            self.proven, self.in_order = True, False
            answer.set(message)
        elif "push" in of_map:
            self._pushed(of_map)
        elif self.in_order is not False and len(self._waiting) == 1:
            if "error" not in of_map:  # our servers, too, refuse without `re` what they cannot read
                self.proven, self.in_order = True, True
            (answer,) = self._waiting.values()
            answer.set(message)

    def _hung_up(self) -> None:
        self.drop(self._lost("it hung up"))
