"""What happened on a private daemon and its simulated GPUs, and assertions on it.

Two witnesses: the daemon's history, and the GPUs' allocation logs, which the processes with bytes
write. A failed assertion names the lines that prove it.
"""

import contextlib
import json
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from operator import itemgetter
from typing import Final

from vram_arbiter.clients.cli.history import NEVER, Wanted, collect
from vram_arbiter.clients.cli.text import event_line
from vram_arbiter.clients.net.request import checked
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.fakegpu import LOG_FILE
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.testing.daemon import ArbiterProcess

ENDS: Final = frozenset({"released", "standby", "parked", "expired", "lost"})
"""Kinds of events with which a revoked lease has left."""


class Timeline:
    """Events of a daemon's history, which must run to be asked."""

    def __init__(self, arbiter: ArbiterProcess) -> None:
        self._arbiter = arbiter

    def events(self, *kinds: str, consumer: str | None = None) -> Sequence[JsonMap]:
        """Return the events of these kinds, by default all, in their order. Raises
        ArbiterUnreachable."""
        reply = checked(collect(Wanted(kinds, limit=NEVER, after=0), self._arbiter.endpoint))
        return [one for one in reply["events"] if consumer in (None, one.get("consumer"))]

    def text(self) -> str:
        """Return history and allocation logs as lines, in the order of time."""
        wall_minus_monotonic_s = time.time() - time.monotonic()
        try:
            lines = [(float(one["at_wall_s"]), _line(one)) for one in self.events()]
        except VramError as error:
            lines = [(0.0, f"no history: {error}")]
        for where, one in self._log_lines():
            by, used = f"{one['name']} ({one['pid']})", format_bytes(one["used_after"])
            told = f"{where}  {one['op']} {format_bytes(one['bytes'])} by {by}, then {used} in use"
            lines.append((one["t"] + wall_minus_monotonic_s, told))
        return "\n".join(line for _, line in sorted(lines, key=itemgetter(0)))

    # -- assertions
    def no_overcommit(self) -> None:
        """Assert that no GPU ever held more than it has, and refused no process an allocation."""
        __tracebackhide__ = True
        problems = [
            f"{where}  {one}"
            for where, one in self._log_lines()
            if one["op"] == "oom" or one["used_after"] > one["capacity"]
        ]
        if problems:
            raise AssertionError("\n".join(["a GPU was overcommitted", *problems]))

    def granted_before(self, first: str, second: str) -> None:
        """Assert that the first grant of one consumer came before the first one of another."""
        __tracebackhide__ = True
        events = self.events("granted")
        order = dict.fromkeys(one["consumer"] for one in events)
        if [name for name in order if name in (first, second)] != [first, second]:
            raise _disproved(f"{first} was not granted before {second}", events)

    def evicted_once(self, consumer: str) -> None:
        """Assert that a consumer was revoked and left exactly once; a revoke that was withdrawn
        does not count."""
        __tracebackhide__ = True
        events = self.events("revoke_asked", "revoke_withdrawn", *ENDS, consumer=consumer)
        by_lease = sorted(events, key=itemgetter("lease_id"))  # each one's stay in their order
        evictions = sum(
            one["lease_id"] == after["lease_id"]
            and (one["kind"], after["kind"] in ENDS) == ("revoke_asked", True)
            for one, after in pairwise(by_lease)
        )
        if evictions != 1:
            raise _disproved(f"{consumer} was evicted {evictions} times, not once", events)

    def _log_lines(self) -> Iterator[tuple[str, JsonMap]]:
        """Yield the lines of the allocation logs with their places."""
        for log in sorted(self._arbiter.runtime.glob(f"fakegpu*/{LOG_FILE}")):
            for number, piece in enumerate(log.read_text().splitlines(), 1):
                with contextlib.suppress(ValueError):  # one that a kill tore
                    yield f"{log.parent.name}/{log.name}:{number}", json.loads(piece)


def _line(event: JsonMap) -> str:
    return f"#{event['seq']}  {event_line(event)}"


def _disproved(problem: str, events: Sequence[JsonMap]) -> AssertionError:
    """Not an assert statement: pytest would reword it where it rewrites this module."""
    return AssertionError("\n".join([problem, *map(_line, events)]))
