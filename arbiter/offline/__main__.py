"""`python -m vram_arbiter.arbiter.offline`: recorded event logs, offline.

`vramctl replay` and `vramctl timeline` start it. Exit codes: 0 done (a replay: identical), 1 a
divergence or an input that cannot be read, 2 wrong usage; 130 Ctrl-C, 141 the reader of the output
left.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from vram_arbiter.arbiter.eventlog import replay, text
from vram_arbiter.arbiter.eventlog.codec import to_json
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.version import add_version

DONE, NO = 0, 1


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="vramctl", description="Recorded event logs, offline.")
    commands = made.add_subparsers(dest="command", required=True)
    again = commands.add_parser(
        "replay",
        help="a recorded log once more",
        description="Feed an event log to the engine again and compare every decision.",
        epilog="exit codes: 0 identical · 1 a divergence, or an input that cannot be read · "
        "2 wrong usage",
    )
    tell = commands.add_parser(
        "story",
        help="the events of a recorded log as the history has them, for `vramctl timeline`",
        description="Print the events, readings and GPUs of an event log as JSON.",
        epilog="exit codes: 0 done · 1 an input that cannot be read · 2 wrong usage",
    )
    log = "a .jsonl file, or the state folder of a daemon (its newest start)"
    for command, form in ((again, "print JSON"), (tell, "the only form")):
        command.add_argument("log", metavar="LOG", type=Path, help=log)
        command.add_argument("--json", action="store_true", dest="as_json", help=form)
    for command in (made, again, tell):
        add_version(command)
    return made


@terminal.program
def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. Returns the exit code."""
    flags = parser().parse_args(argv)
    try:
        if flags.command == "story":
            from vram_arbiter.arbiter.offline.story import story

            print(to_json(story(replay.load(flags.log))))
            return DONE
        found = replay.replay(replay.load(flags.log))
    except VramError as error:
        if flags.as_json:
            _print_json({"error": error.to_wire()})
        else:
            terminal.complain("vramctl", error)
        return NO
    if flags.as_json:
        _print_json(replay.report(found))
    else:
        print("\n".join(text.replay_lines(found)))
    return DONE if found.identical else NO


def _print_json(shown: JsonObject) -> None:
    print(json.dumps(json.loads(to_json(shown)), indent=2))


if __name__ == "__main__":
    sys.exit(main())
