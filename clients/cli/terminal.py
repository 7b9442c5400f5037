"""Long lines on a terminal: folded between words, and indented below their own text."""

import shutil
import sys

FOLDED_MIN = 40
"""Columns below which folding does not help."""


def columns() -> int | None:
    """Return the width of the terminal; None where stdout is none, or too narrow to fold."""
    if not sys.stdout.isatty():
        return None
    width = shutil.get_terminal_size().columns
    return width if width >= FOLDED_MIN else None


def folded(line: str, indent: int, width: int | None) -> list[str]:
    """Fold a line to `width` columns, `indent` of them blank from the second line on."""
    if width is None or len(line) <= width:
        return [line]
    import textwrap  # not needed where a program reads the output

    rest = " " * indent
    return textwrap.wrap(
        line, width, subsequent_indent=rest, break_long_words=False, break_on_hyphens=False
    )
