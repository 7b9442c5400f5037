"""Which uses the running code is inside of.

An acquire inside a use may wait for what that use keeps, and then it would wait forever. The kernel
shows the arbiter processes only; a context variable shows more: a wait beside the use, in another
task or thread of the same process (a prefetch, the next request of a server), is none of these. A
task inherits the uses of the task that made it, which mostly awaits it. Threads do not inherit
them.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from vram_arbiter.schemas.defaults import WAIT_IN_USE_S
from vram_arbiter.schemas.errors import WaitTimeout, WouldDeadlock

_entered: ContextVar[frozenset[str]] = ContextVar("uses_entered", default=frozenset())
_running: dict[str, str] = {}  # a use may be ended by another task than the one that began it


def enter(use_id: str, name: str) -> None:
    """Note that the calling task or thread began a use. `name`: how an error names it."""
    _running[use_id] = name
    _entered.set((_entered.get() & _running.keys()) | {use_id})


def named(label: str, lease_id: str) -> str:
    """Return how an error names a use."""
    return f"use {label!r} of {lease_id}" if label else f"a use of {lease_id}"


def leave(use_id: str) -> None:
    """Note that a use is over. Any task or thread may call."""
    _running.pop(use_id, None)


@contextmanager
def bounded(consumer: str, wait_timeout_s: float | None) -> Iterator[float | None]:
    """Bound a wait that has no limit of its own where the caller is inside a use; yield its limit.

    Raises: WouldDeadlock when that bound ends the wait.
    """
    uses = sorted([_running[use_id] for use_id in _entered.get() & _running.keys()])
    if wait_timeout_s is not None or not uses:
        yield wait_timeout_s
        return
    try:
        yield WAIT_IN_USE_S
    except WaitTimeout as ended:
        told = ", ".join(uses)
        raise WouldDeadlock(
            f"{consumer} waited {WAIT_IN_USE_S:g} s inside {told}, which may keep its room",
            hint="end the use first, acquire beside it, or say `wait_timeout_s`",
            details={"uses": uses, "waited": ended.details},
        ) from ended
