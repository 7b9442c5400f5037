"""Text of other programs, made safe for a terminal or a log.

Names, labels and reasons come from any process that may connect. A terminal obeys escape sequences
and C1 controls in them, bidirectional marks reorder the text, and a line break forges a line.
"""

from collections.abc import Callable
from functools import wraps


def printable(text: object) -> str:
    """Return `str(text)` with control, format and unassigned characters escaped (`\\x1b`)."""
    said = str(text)
    if said.isprintable():
        return said
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii")
        for letter in said
    )


def printable_lines(text: object) -> str:
    """Return the same for text of several lines, such as a traceback: its line breaks stay."""
    return "\n".join(printable(line) for line in str(text).split("\n"))


def makes_printable[**P](make: Callable[P, list[str]]) -> Callable[P, list[str]]:
    """Let a function that returns lines for people return them `printable`."""

    @wraps(make)
    def made(*arguments: P.args, **named: P.kwargs) -> list[str]:
        return [printable(line) for line in make(*arguments, **named)]

    return made
