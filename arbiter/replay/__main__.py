"""`python -m arbiter.replay`: what `vramctl replay` starts. Parse, call, print.

Exit codes: 0 identical or done, 1 a divergence or a log that cannot be read, 2 wrong usage.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from arbiter.replay import runner, text
from arbiter.replay.codec import to_json
from schemas.errors import VramError

IDENTICAL, NO = 0, 1


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="vramctl", description="Run a recorded event log through the engine again."
    )
    commands = made.add_subparsers(dest="command", required=True)
    again = commands.add_parser(
        "replay",
        help="the same decisions, byte for byte?",
        description="Feeds a log to the engine again and compares every decision: identical, or the first one that is another. "
        "LOG is a file, or the state folder of a daemon (its newest start).",
        epilog="exit codes: 0 identical · 1 a divergence, or a log that cannot be read · 2 wrong usage",
    )
    again.add_argument("log", metavar="LOG", type=Path)
    again.add_argument("--json", action="store_true", dest="as_json", help="print JSON")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    flags = parser().parse_args(argv)
    try:
        return replay(flags.log, as_json=flags.as_json)
    except VramError as error:
        if flags.as_json:
            print(json.dumps({"error": error.to_wire()}, indent=2))
        else:
            print(f"vramctl: {error}", file=sys.stderr)
        return NO


def replay(log: Path, *, as_json: bool) -> int:
    found = runner.replay(runner.load(log))
    if as_json:
        print(json.dumps(json.loads(to_json(runner.report(found))), indent=2))
    else:
        print("\n".join(text.replay_lines(found)))
    return IDENTICAL if found.identical else NO


if __name__ == "__main__":
    sys.exit(main())
