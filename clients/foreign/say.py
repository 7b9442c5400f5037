"""Words of `vramctl run` to its user, on stderr: stdout is the program's."""

import sys

from vram_arbiter.schemas.runtime.printable import printable


def say(text: str) -> None:
    """Tell the user of `vramctl run`."""
    print(f"vramctl run: {printable(text)}", file=sys.stderr)
