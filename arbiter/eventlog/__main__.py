"""`python -m vram_arbiter.arbiter.eventlog`: the program behind `vramctl replay`.

Exit codes: 0 identical, 1 a divergence or an input that cannot be read, 2 wrong usage;
130 Ctrl-C, 141 the reader of the output left.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from vram_arbiter.arbiter.eventlog import text
from vram_arbiter.arbiter.eventlog.codec import to_json
from vram_arbiter.arbiter.eventlog.replay import load, replay, report
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.version import add_version

IDENTICAL, NO = 0, 1


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="vramctl replay",
        description="Feed an event log to the engine again and compare every decision.",
        epilog="With --policy NAME, or --policy all: simulate what other policies would have "
        "decided. exit codes: 0 identical · 1 a divergence, or an input that cannot be read · "
        "2 wrong usage",
    )
    made.add_argument(
        "log",
        metavar="LOG",
        type=Path,
        help="a .jsonl file, or the state folder of a daemon (its newest start)",
    )
    made.add_argument("--json", action="store_true", dest="as_json", help="print JSON")
    add_version(made)
    return made


@terminal.program
def main(argv: Sequence[str] | None = None) -> int:
    """Replay one log. Returns the exit code."""
    flags = parser().parse_args(argv)
    try:
        found = replay(load(flags.log))
    except VramError as error:
        if flags.as_json:
            print(json.dumps({"error": error.to_wire()}, indent=2))
        else:
            terminal.complain("vramctl", error)
        return NO
    if flags.as_json:
        print(json.dumps(json.loads(to_json(report(found))), indent=2))
    else:
        print("\n".join(text.replay_lines(found)))
    return IDENTICAL if found.identical else NO


if __name__ == "__main__":
    sys.exit(main())
