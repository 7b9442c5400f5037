"""Times in tests: waiting for a condition that shows from outside, and times as they are written."""

import re
import threading
import time
from collections.abc import Callable
from typing import Final

WITHIN_S: Final = 60.0
"""Limit of a wait: a machine with other work takes its time, and only a failing test takes all."""
POLL_S: Final = 0.01
LAG: Final = re.compile(r"(\d+(?:\.\d+)?) ?(ms|s)")


def parse_lag(text: object) -> float:
    """Read `500ms` or `1.5s`. Raises ValueError, also for a number without a unit."""
    if (found := LAG.fullmatch(str(text))) is None:
        raise ValueError(f"expected a time such as 500ms or 1.5s, got {text!r}")
    return float(found[1]) / (1000 if found[2] == "ms" else 1)


def eventually[T](condition: Callable[[], T], within_s: float = WITHIN_S) -> T:
    """Poll `condition` until it returns a true value, and return that value.

    An AssertionError that it raises counts as not yet. Raises AssertionError at the limit, with
    what was seen last.
    """
    ends, pause = time.monotonic() + within_s, threading.Event()
    while True:
        try:
            if found := condition():
                return found
            seen = repr(found)
        except AssertionError as error:
            seen = str(error)
        if time.monotonic() >= ends:
            raise AssertionError(f"not true within {within_s:g} s, last seen: {seen}")
        pause.wait(POLL_S)
