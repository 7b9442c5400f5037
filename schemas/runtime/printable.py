"""Text of other programs, made safe for a terminal or a log that people read.

Names, labels and reasons come from any process that may connect. A terminal obeys escape sequences and C1 controls in them, bidirectional
marks reorder what is read, and a line break forges another line.
"""


def printable(text: object) -> str:
    """`str(text)` with every control, format and unassigned character escaped as Python writes it (`\\x1b`, `\\u202e`, `\\n`)."""
    said = str(text)
    if said.isprintable():
        return said
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii") for letter in said
    )


def printable_lines(text: object) -> str:
    """The same for text of several lines, such as a traceback: its line breaks stay."""
    return "\n".join(printable(line) for line in str(text).split("\n"))
