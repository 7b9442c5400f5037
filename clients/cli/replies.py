"""Print an answer of the arbiter, as lines or as JSON, and choose the exit code."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence

from vram_arbiter.clients.cli import text
from vram_arbiter.schemas.plain import Message

OK, NO, USAGE, UNREACHABLE = 0, 1, 2, 3
"""Exit codes: done; refused or an error; wrong usage; the arbiter cannot be reached."""
ENVELOPE = frozenset({"re", "ok"})


def answer(
    question: Callable[[], Message],
    *,
    as_json: bool,
    lines: Callable[[Message], Sequence[str]],
    hidden: frozenset[str] = ENVELOPE,
) -> tuple[int, Message]:
    """Ask and print. Returns the exit code and the reply. Raises what the question raises.

    `--json` prints the reply of `schemas.wire` without the fields in `hidden`.
    """
    reply = question()
    if not reply.get("ok"):
        complain(reply["error"], as_json=as_json)
        return NO, {}
    if as_json:
        shown = {key: value for key, value in reply.items() if key not in hidden}
        print(json.dumps(shown, indent=2))
    elif said := lines(reply):
        print("\n".join(said))
    return OK, reply


def complain(error: Mapping[str, object], *, as_json: bool) -> None:
    """Print an error: as JSON on stdout, else as one line on stderr."""
    if as_json:
        print(json.dumps({"error": dict(error)}, indent=2))
    else:
        print(text.error_line(error), file=sys.stderr)
