"""`python -m vram_arbiter.arbiter.lab`: event logs replayed, and policies compared, offline.

`vramctl replay` and `vramctl simulate` start it. Exit codes: 0 done (a replay: identical), 1 a
divergence or an input that cannot be read, 2 wrong usage; 130 Ctrl-C, 141 the reader of the output
left.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from vram_arbiter.arbiter.core.settings import DEFAULT, SCHEDULING
from vram_arbiter.arbiter.eventlog import replay, text
from vram_arbiter.arbiter.eventlog.codec import to_json
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.version import add_version

DONE, NO = 0, 1
TIMELINE_LINES = 40

_POLICIES = "policies: " + "; ".join(f"{name}: {row.summary}" for name, row in SCHEDULING.items())
_WHAT_TO_SIMULATE = (
    "name a readable YAML file, or one that is shipped: "
    "desktop, find-navigate-grab, small-behind-large, two-thrashing"
)
_EXIT = "exit codes: 0 done · 1 an input that cannot be read · 2 wrong usage"


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="vramctl", description="Event logs and policies, offline.")
    commands = made.add_subparsers(dest="command", required=True)
    again = commands.add_parser(
        "replay",
        help="a recorded log once more, or under other policies",
        description="Feed an event log to the engine again and compare every decision. With "
        "--policy: simulate what other policies would have decided, with the arrivals, uses and "
        "loads of the log.",
        epilog=f"{_POLICIES}. {_EXIT}, or a divergence (1)",
    )
    again.add_argument(
        "log",
        metavar="LOG",
        type=Path,
        help="a .jsonl file, or the state folder of a daemon (its newest start)",
    )
    what = commands.add_parser(
        "simulate",
        help="a scenario under one or more policies",
        description="Run a scenario (YAML: GPUs, consumers, arrivals) through the engine and print "
        "the decisions, waits, switches and peak bytes; with several policies, side by side. "
        "SCENARIO is a file, or the name of one that is shipped in configs/scenarios.",
        epilog=f"{_POLICIES}. {_EXIT}",
    )
    what.add_argument("scenario", metavar="SCENARIO", type=Path)
    what.add_argument(
        "--timeline",
        metavar="N",
        type=_count,
        default=None,
        help=f"print N decisions (default: {TIMELINE_LINES} for one policy, else 0)",
    )
    tell = commands.add_parser(
        "story",
        help="the events of a recorded log as the history has them, for `vramctl timeline`",
        description="Print the events, readings and GPUs of an event log as JSON.",
        epilog=_EXIT,
    )
    tell.add_argument("log", metavar="LOG", type=Path)
    tell.add_argument("--json", action="store_true", dest="as_json", help="the only form")
    add_version(made)
    for command in (again, what, tell):
        add_version(command)
    for command in (again, what):
        command.add_argument(
            "--policy",
            metavar="NAME",
            action="append",
            default=[],
            choices=(*SCHEDULING, "all"),
            help="may be given several times; all: every one",
        )
        command.add_argument("--json", action="store_true", dest="as_json", help="print JSON")
    return made


def _count(written: str) -> int:
    if not written.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a line count, got {written!r}")
    return int(written)


@terminal.program
def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. Returns the exit code."""
    flags = parser().parse_args(argv)
    try:
        if flags.command == "story":
            from vram_arbiter.arbiter.lab.story import story

            print(to_json(story(replay.load(flags.log))))
            return DONE
        policies = list(SCHEDULING if "all" in flags.policy else dict.fromkeys(flags.policy))
        if flags.command == "simulate":
            simulate(flags.scenario, policies or [DEFAULT], flags.timeline, as_json=flags.as_json)
        elif policies:
            what_if(flags.log, policies, as_json=flags.as_json)
        else:
            return replay_log(flags.log, as_json=flags.as_json)
    except VramError as error:
        if flags.as_json:
            _print_json({"error": error.to_wire()})
        else:
            terminal.complain("vramctl", error)
        return NO
    return DONE


def replay_log(log: Path, *, as_json: bool) -> int:
    """Print whether the log's decisions are repeated. Returns the exit code."""
    found = replay.replay(replay.load(log))
    if as_json:
        _print_json(replay.report(found))
    else:
        print("\n".join(text.replay_lines(found)))
    return DONE if found.identical else NO


def what_if(log: Path, policies: Sequence[str], *, as_json: bool) -> None:
    """Print what the log says beside what each policy would have decided."""
    from vram_arbiter.arbiter.lab import compare
    from vram_arbiter.arbiter.lab.extract import extract
    from vram_arbiter.arbiter.lab.outcome import as_plain

    found = extract(replay.load(log))
    again = compare.under(found.workload, found.settings, found.settings.policy)
    outcomes = [
        again
        if name == found.settings.policy
        else compare.under(found.workload, found.settings, name)
        for name in policies
    ]
    logged = found.logged
    if as_json:
        _print_json(
            {
                "simulation": True,
                "logged": as_plain(logged),
                "check": as_plain(again),
                "policies": [as_plain(outcome) for outcome in outcomes],
                "approximations": found.workload.approximations,
            }
        )
        return
    logged.policy = f"{logged.policy} (logged)"
    notices = text.notices(found.replayed) + [
        f"note: {line}" for line in found.workload.approximations
    ]
    tables = compare.tables([logged, *outcomes])
    logged.policy = found.settings.policy
    print("\n".join([*notices, *tables, "", *compare.check_lines(logged, again)]))


def simulate(path: Path, policies: Sequence[str], timeline: int | None, *, as_json: bool) -> None:
    """Print a scenario's decisions and tables under each policy."""
    from vram_arbiter.arbiter.lab import compare
    from vram_arbiter.arbiter.lab.outcome import as_plain
    from vram_arbiter.arbiter.lab.scenarios import settings_of, workload_of
    from vram_arbiter.schemas.config.scenario import load_scenario
    from vram_arbiter.schemas.yamltext import read_text

    scenario = load_scenario(read_text(path, hint=_WHAT_TO_SIMULATE), path.name)
    settings = settings_of(scenario)
    outcomes = [compare.under(workload_of(scenario), settings, name) for name in policies]
    shown = (TIMELINE_LINES if len(outcomes) == 1 else 0) if timeline is None else timeline
    if as_json:
        _print_json(
            {
                "scenario": path.name,
                "about": scenario.about,
                "policies": [
                    as_plain(outcome) | compare.timeline(outcome, timeline or 0)
                    for outcome in outcomes
                ],
            }
        )
        return
    print(f"{scenario.about} ({scenario.seconds:g} s, seed {scenario.seed})")
    for outcome in outcomes:
        if shown:
            print("\n".join(["", *compare.timeline_lines(outcome, shown)]))
    print("\n".join(["", *compare.tables(outcomes)]))


def _print_json(shown: JsonObject) -> None:
    print(json.dumps(json.loads(to_json(shown)), indent=2))


if __name__ == "__main__":
    sys.exit(main())
