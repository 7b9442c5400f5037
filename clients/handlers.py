"""What a holder does when the arbiter wants something: its handlers, and how one is called."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import anyio
import anyio.to_thread

from vram_arbiter.clients._protocol.records import Eviction
from vram_arbiter.schemas.errors import VramError

type Handler = Callable[[], object]


@dataclass(frozen=True)
class Handlers[L]:
    """Handlers of a lease. `L` is the lease that they are given: `Lease` or `AsyncLease`.

    Each is a coroutine function or a plain function. A coroutine function runs on the client's
    event loop; a plain one runs in a worker thread, so it may block. An exception is logged.
    """

    unload: Handler | None = None
    """Free the bytes. Called at a safe point, at most once per grant."""
    park: Handler | None = None
    """Free the bytes on the GPU and keep the weights in host RAM. Called in place of `unload` where
    the spec has `park_bytes` and the arbiter has host RAM for them."""
    restore: Callable[[L], object] | None = None
    """Load again: a lease on standby, or a parked one, was granted again."""
    on_revoke: Callable[[L, Eviction], object] | None = None
    """The arbiter asks for the room. The lease leaves at its next safe point by itself."""
    on_lost: Callable[[L, VramError], object] | None = None
    """The lease ended without the holder's doing, and `unload` has run."""
    safe_point_eta_s: Callable[[], float | None] | None = None
    """Estimate the seconds until the next safe point. A plain function; must not block."""

    def merged(self, **named: object) -> "Handlers[L]":
        """Return these handlers with those given by name. Raises TypeError for a clash."""
        given = {name: handler for name, handler in named.items() if handler is not None}
        for name in given:
            if getattr(self, name) is not None:
                raise TypeError(f"handler {name!r} was given twice: in `handlers` and by name")
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return Handlers(**(fields | given))


async def call(handler: Callable[..., object], *arguments: object) -> None:
    """Run a handler to its end: a coroutine function here, a plain one in a worker thread.

    Where the caller is canceled, a thread is left to itself.
    """
    if inspect.iscoroutinefunction(handler):
        await handler(*arguments)
        return
    own_thread = anyio.CapacityLimiter(1)  # one that hangs must not keep others from running
    result = await anyio.to_thread.run_sync(
        partial(handler, *arguments), abandon_on_cancel=True, limiter=own_thread
    )
    if inspect.isawaitable(result):
        await result


def with_signature_of[F: Callable[..., object]](model: Callable[..., object], function: F) -> F:
    """Return a function that takes the parameters of another, shown as its own by `help`."""
    shown = inspect.signature(model).replace(return_annotation=inspect.Signature.empty)
    vars(function)["__signature__"] = shown
    return function
