"""Which uses the running code is inside of.

A wait from inside a use may wait for itself: the arbiter looks for a cycle and refuses it
(`would_deadlock`). A wait beside the use, in another task or thread of the same process (a
prefetch, the next request of a server), closes no cycle, because the use ends without it. The
kernel shows the arbiter processes only; a context variable shows more. A task inherits it from the
task that made it, which mostly awaits it; one that is not awaited says `independent`. Threads do
not inherit it.
"""

from contextvars import ContextVar

_entered: ContextVar[frozenset[str]] = ContextVar("uses_entered", default=frozenset())
_running: set[str] = set()  # a use may be ended by another task than the one that began it


def enter(use_id: str) -> None:
    """Note that the calling task or thread began a use."""
    _running.add(use_id)
    _entered.set((_entered.get() & _running) | {use_id})


def leave(use_id: str) -> None:
    """Note that a use is over, or pauses. Any task or thread may call."""
    _running.discard(use_id)


def a_use() -> bool:
    """Return whether the caller is inside a use."""
    return not _running.isdisjoint(_entered.get())
