"""Uses that this client has on leases of other processes, by their tokens.

A use that has begun is resumed after every reconnect until it ends; if the arbiter refuses that,
the owner gets `UseLost`. The module must not know the client's own leases: their uses are part of
what is reattached (`clients._protocol.leases`).
"""

from vram_arbiter.clients._protocol.connection import Connection
from vram_arbiter.clients._protocol.records import ForeignUseRecord, UseLost
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.wire.replies import UsesReply
from vram_arbiter.schemas.wire.requests import UseBegin, UseEnd


class ForeignUses:
    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._uses: dict[str, ForeignUseRecord] = {}

    def __len__(self) -> int:
        return len(self._uses)

    def begin(
        self,
        request: UseBegin,
        now: float,
        timeout_s: float,
        traceparent: str | None = None,
    ) -> int:
        use_id, use = request.use_id, ForeignUseRecord(request, traceparent)
        self._uses[use_id] = use

        def begun(_: UsesReply, __: float) -> None:
            use.begun = True

        def refused(_: VramError, __: float) -> None:
            if self._uses.get(use_id) is use:
                del self._uses[use_id]

        return self._connection.ask(
            request,
            now,
            timeout_s,
            on_reply=begun,
            on_error=refused,
            traceparent=traceparent,
        )

    def end(self, request: UseEnd, now: float) -> int:
        """Also right while the begin is under way: the arbiter hears both in order."""
        self._uses.pop(request.use_id, None)
        return self._connection.ask(request, now, quiet=True)

    def say_again(self, now: float) -> None:
        for use in self._uses.values():
            if use.begun:  # else its begin has no reply yet, and is repeated itself
                self._begin_again(use, now)

    def _begin_again(self, use: ForeignUseRecord, now: float) -> None:
        use_id = use.request.use_id

        def lost(error: VramError, _: float) -> None:
            if self._uses.pop(use_id, None) is not None:
                self._connection.events.append(UseLost(use_id, error))

        self._connection.ask(
            use.request, now, on_error=lost, quiet=True, traceparent=use.traceparent
        )
