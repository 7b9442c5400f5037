"""A Python text as a program: `script TEXT ARGUMENTS…` is what `python -c` would be, in a fork of an
interpreter that has imported the client."""

import sys


def main() -> None:
    text, *arguments = sys.argv[1:]
    sys.argv = ["-c", *arguments]
    exec(compile(text, "<string>", "exec"), {"__name__": "__main__"})
