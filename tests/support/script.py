"""A Python text or file as a program: `script TEXT ARGUMENTS…` is what `python -c` would be, and
`script FILE.py ARGUMENTS…` what `python` is, in a fork of an interpreter that has imported the
client."""

import runpy
import sys


def main() -> None:
    text, *arguments = sys.argv[1:]
    file = text.endswith(".py")
    sys.argv = [text if file else "-c", *arguments]
    if file:
        runpy.run_path(text, run_name="__main__")
    else:
        exec(compile(text, "<string>", "exec"), {"__name__": "__main__"})
