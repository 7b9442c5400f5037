"""Requests and their replies over one connection at a time, for asyncio programs.

The connection is made by the first request and again by the first one after a loss of contact. The
module must not know what requests and replies mean.
"""

import asyncio
import itertools
from collections.abc import Callable

from vram_arbiter.clients.net.answer import Answer
from vram_arbiter.clients.net.dealer import Dealer
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.runtime.trust import Program


class RpcClient:
    """`lost(reason)` makes the error that requests fail with when contact is lost;
    `pushed(message)` gets what is not a reply."""

    def __init__(
        self,
        endpoint: str,
        *,
        program: Program,
        lost: Callable[[str], VramError],
        pushed: Callable[[Message], None] = lambda message: None,
    ) -> None:
        self.proven = False
        """Whether the present connection was answered once."""
        self._endpoint = endpoint
        self._program: Program = program
        self._lost = lost
        self._pushed = pushed
        self._ids = itertools.count(1)
        self._waiting: dict[int, Answer[Message]] = {}
        self._dealer: Dealer | None = None
        self._running: asyncio.Task[None] | None = None

    async def exchange(self, request: JsonMap, timeout_s: float) -> Message:
        """Return the reply to a request, which gets an `id` here.

        Raises: TimeoutError; UntrustedServer before anything is sent; the error of `lost`.
        """
        dealer = self._connected()
        request_id = next(self._ids)
        answer = self._waiting[request_id] = Answer[Message]()
        try:
            if not dealer.send({**request, "id": request_id}):
                raise self._lost("it takes no more requests; restart it")
            return await answer.within(timeout_s)
        finally:
            self._waiting.pop(request_id, None)

    def drop(self, error: VramError) -> None:
        """Close the connection; requests that wait fail with `error`. Idempotent."""
        running, self._running, self._dealer = self._running, None, None
        self.proven = False
        if running is not None:
            running.cancel()
        for answer in self._waiting.values():
            answer.fail(error)

    def _connected(self) -> Dealer:
        if self._dealer is None:
            self._dealer = Dealer(
                self._endpoint, self._received, self._hung_up, self.drop, program=self._program
            )
            self._running = asyncio.get_running_loop().create_task(
                self._dealer.run(), name=f"socket to {self._program}"
            )
        return self._dealer

    def _received(self, message: Message) -> None:
        self.proven = True
        if answer := self._waiting.get(message.get("re", -1)):
            answer.set(message)
        elif "push" in message:
            self._pushed(message)

    def _hung_up(self) -> None:
        self.drop(self._lost("it hung up"))
