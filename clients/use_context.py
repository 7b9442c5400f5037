"""Which uses the code that runs now is in the middle of.

A wait from inside a use may be a wait for oneself: the arbiter looks for a circle and refuses it (`would_deadlock`). A wait beside one, in
another task or thread of the same process (a prefetch, the next request of a server), is nobody's circle, because the use ends without
it. The kernel shows the arbiter processes only; a context variable knows better. Tasks inherit it from who made them, as whoever makes one
mostly awaits it; one that does not says `independent`. Threads do not inherit it.
"""

from contextvars import ContextVar

_entered: ContextVar[frozenset[str]] = ContextVar("uses_entered", default=frozenset())
_running: set[str] = set()  # a use may be ended by another task than the one that began it


def enter(use_id: str) -> None:
    """A use has begun, by the task or thread that calls."""
    _running.add(use_id)
    _entered.set((_entered.get() & _running) | {use_id})


def leave(use_id: str) -> None:
    """It is over, or pauses. Whoever says so."""
    _running.discard(use_id)


def a_use() -> bool:
    """Is the caller in the middle of a use?"""
    return not _running.isdisjoint(_entered.get())
