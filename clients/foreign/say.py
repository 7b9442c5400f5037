"""Words of `vramctl run` to its user, on stderr: stdout is the program's."""

import contextlib
import sys

from vram_arbiter.schemas.runtime.printable import printable


def say(text: str) -> None:
    """Tell the user of `vramctl run`, if there still is one."""
    with contextlib.suppress(BrokenPipeError):
        print(f"vramctl run: {printable(text)}", file=sys.stderr)
