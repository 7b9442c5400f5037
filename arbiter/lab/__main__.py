"""`python -m vram_arbiter.arbiter.lab`: policies compared offline.

`vramctl simulate` starts it, and `vramctl replay --policy`. Exit codes: 0 done, 1 an input that
cannot be read, 2 wrong usage; 130 Ctrl-C, 141 the reader of the output left.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from vram_arbiter.arbiter.core.settings import DEFAULT, SCHEDULING
from vram_arbiter.arbiter.eventlog import text as replay_text
from vram_arbiter.arbiter.eventlog.codec import to_json
from vram_arbiter.arbiter.eventlog.replay import load
from vram_arbiter.arbiter.lab import compare
from vram_arbiter.arbiter.lab.outcome import Outcome, as_plain
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.version import add_version

DONE, NO = 0, 1
TIMELINE_LINES = 40

_POLICIES = (
    "engine policies: "
    + "; ".join(f"{name}: {rules.summary}" for name, rules in SCHEDULING.items())
    + ". For comparison, rules of other programs: unmanaged (every model loads at once), "
    "ollama_rules, llama_swap_rules."
)
_WHAT_TO_SIMULATE = (
    "name a readable YAML file, or one that is shipped: "
    "desktop, find-navigate-grab, small-behind-large, two-thrashing"
)
_EXIT = "exit codes: 0 done · 1 an input that cannot be read · 2 wrong usage"


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="vramctl", description="Policies, compared offline.")
    commands = made.add_subparsers(dest="command", required=True)
    again = commands.add_parser(
        "replay",
        help="a recorded log under other policies",
        description="Simulate what other policies would have decided, with the arrivals, uses and "
        "loads of a log. LOG is a file, or the state folder of a daemon (its newest start).",
        epilog=f"{_POLICIES} {_EXIT}",
    )
    again.add_argument("log", metavar="LOG", type=Path)
    what = commands.add_parser(
        "simulate",
        help="a scenario under one or more policies",
        description="Run a scenario (YAML: GPUs, consumers, arrivals) through the engine and print "
        "the decisions, waits, switches and peak bytes; with several policies, side by side. "
        "SCENARIO is a file, or the name of one that is shipped in configs/scenarios.",
        epilog=f"{_POLICIES} {_EXIT}",
    )
    what.add_argument("scenario", metavar="SCENARIO", type=Path)
    what.add_argument(
        "--timeline",
        metavar="N",
        type=_count,
        default=None,
        help=f"print N decisions (default: {TIMELINE_LINES} for one policy, else 0)",
    )
    add_version(made)
    for command in (again, what):
        add_version(command)
        command.add_argument(
            "--policy",
            metavar="NAME",
            action="append",
            default=[],
            required=command is again,
            choices=(*compare.POLICIES, "all"),
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
    policies = list(compare.POLICIES if "all" in flags.policy else dict.fromkeys(flags.policy))
    try:
        if flags.command == "simulate":
            simulate(flags.scenario, policies or [DEFAULT], flags.timeline, as_json=flags.as_json)
        else:
            what_if(flags.log, policies, as_json=flags.as_json)
    except VramError as error:
        if flags.as_json:
            print(json.dumps({"error": error.to_wire()}, indent=2))
        else:
            terminal.complain("vramctl", error)
        return NO
    return DONE


def what_if(log: Path, policies: Sequence[str], *, as_json: bool) -> None:
    """Print what the log says beside what each policy would have decided."""
    from vram_arbiter.arbiter.lab.extract import extract

    found = extract(load(log))
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
    notices = replay_text.notices(found.replayed) + [
        f"note: {line}" for line in found.workload.approximations
    ]
    logged_and_all = [logged, *outcomes]
    lines = [
        *notices,
        *compare.total_lines(logged_and_all),
        "",
        *compare.consumer_lines(logged_and_all),
        "",
    ]
    logged.policy = found.settings.policy
    print("\n".join([*lines, *compare.check_lines(logged, again)]))


def simulate(path: Path, policies: Sequence[str], timeline: int | None, *, as_json: bool) -> None:
    """Print a scenario's decisions and tables under each policy."""
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
                    as_plain(outcome) | _timeline(outcome, timeline or 0) for outcome in outcomes
                ],
            }
        )
        return
    print(f"{scenario.about} ({scenario.seconds:g} s, seed {scenario.seed})")
    for outcome in outcomes:
        if shown:
            print("\n".join(["", *compare.timeline_lines(outcome.policy, outcome.timeline, shown)]))
    print("\n".join(["", *compare.total_lines(outcomes), "", *compare.consumer_lines(outcomes)]))


def _timeline(outcome: Outcome, limit: int) -> JsonObject:
    decided = [(at, note) for at, note in outcome.timeline if note.kind in compare.DECISIONS][
        :limit
    ]
    return (
        {"timeline": [{"at_s": at, **words.event(note)} for at, note in decided]} if limit else {}
    )


def _print_json(shown: JsonObject) -> None:
    print(json.dumps(json.loads(to_json(shown)), indent=2))


if __name__ == "__main__":
    sys.exit(main())
