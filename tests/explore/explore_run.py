"""All orders of events of small worlds: `python -m tests.explore.explore_run --minutes 60`.

Explores every scenario (`tests.explore.scenarios`) in a process of its own, `--jobs` at a time, the
small ones first: what they leave of their share of the time goes to the others. Prints a row for
each, what of `arbiter/core` was reached, and the shortest story of each failure. Exit status 1: a
failure.
"""

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict
from pathlib import Path
from types import CodeType
from typing import Any

from tests.explore.scenarios import SCENARIOS
from tests.explore.search import Report, Search
from vram_arbiter.arbiter import core

ROOT = Path(__file__).resolve().parents[2]
CORE = Path(core.__file__).resolve().parent
STATES_MAX = 1_500_000
"""In one world: some 4 GB, most of it for what is not explored yet."""
type Lines = set[tuple[str, int]]


def explore(name: str, seconds: float, states_max: int) -> tuple[Report, Lines]:
    """Explore one scenario; with the lines of the engine that it comes by."""
    reached: Lines = set()
    monitoring, tool = sys.monitoring, sys.monitoring.COVERAGE_ID

    def came_by(code: CodeType, line: int) -> object:
        path = Path(code.co_filename).resolve()
        if path.is_relative_to(CORE):
            reached.add((str(path.relative_to(CORE)), line))
        return monitoring.DISABLE

    monitoring.use_tool_id(tool, "explore")
    monitoring.register_callback(tool, monitoring.events.LINE, came_by)
    monitoring.set_events(tool, monitoring.events.LINE)
    try:
        return Search(SCENARIOS[name]).run(seconds, states_max), reached
    finally:
        monitoring.set_events(tool, 0)
        monitoring.free_tool_id(tool)


def lines_of(path: Path) -> Lines:
    """Return the lines inside functions of a module; `report` explains, and is not explored."""
    found: Lines = set()
    codes = [compile(path.read_text(), str(path), "exec")]
    while codes:
        code = codes.pop()
        codes += [inner for inner in code.co_consts if isinstance(inner, CodeType)]
        if code.co_flags & 2:  # a function: CO_NEWLOCALS
            lines = (line for _, _, line in code.co_lines() if line)
            found |= {(str(path.relative_to(CORE)), line) for line in lines}
    return found


def every(
    names: Sequence[str], minutes: float, jobs: int, states_max: int
) -> Iterable[tuple[Report, Lines]]:
    """Explore these scenarios, and yield each as it ends."""
    until = time.monotonic() + 60 * minutes
    left, running = list(names), set[Future[tuple[Report, Lines]]]()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, max_tasks_per_child=1) as pool:
        while left or running:
            while left and len(running) < jobs:
                seconds = (until - time.monotonic()) / -(-len(left) // jobs)
                running.add(pool.submit(explore, left.pop(0), max(1.0, seconds), states_max))
            done, running = wait(running, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)


def row(report: Report) -> str:
    """Return what one search came to, in a line."""
    how = "failed" if report.failure else "complete" if report.complete else "cut"
    merged, rate = report.merged / max(1, report.transitions), report.transitions / report.wall_s
    return (
        f"{report.scenario:14} {report.states:9,} states {report.transitions:10,} transitions "
        f"depth {report.depth:3} {how:8} merged {merged:4.0%} {rate:6,.0f}/s "
        f"({report.transitions / max(0.01, report.cpu_s):,.0f}/s of CPU), "
        f"served by hand {report.served:,}, unproven {report.unproven:,}"
    )


def summary(reports: Sequence[Report], reached: Lines) -> dict[str, Any]:
    """Return the sums, and where the engine was not reached."""
    paths = [path for path in CORE.rglob("*.py") if path.parent.name != "report"]
    lines = set[tuple[str, int]]().union(*map(lines_of, paths))
    missed: dict[str, list[int]] = {}
    for path, line in sorted(lines - reached):
        missed.setdefault(path, []).append(line)
    return {
        "states": sum(report.states for report in reports),
        "transitions": sum(report.transitions for report in reports),
        "complete": sum(report.complete for report in reports),
        "worlds": len(reports),
        "failures": [report.scenario for report in reports if report.failure],
        "unproven": sum(report.unproven for report in reports),
        "cpu_s": round(sum(report.cpu_s for report in reports), 1),
        "lines": len(lines),
        "reached": len(lines & reached),
        "missed": missed,
        "reports": [asdict(report) for report in reports],
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="for all worlds together")
    parser.add_argument("--world", action="append", choices=SCENARIOS, help="this one alone")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--states", type=int, default=STATES_MAX, help="of one world, at most")
    parser.add_argument("--out", type=Path, default=ROOT / "out/explore/explore.json")
    options = parser.parse_args()
    reports, reached = list[Report](), set[tuple[str, int]]()
    names = options.world or list(SCENARIOS)
    for report, lines in every(names, options.minutes, options.jobs, options.states):
        reports.append(report)
        reached |= lines
        print(row(report), flush=True)
        if report.failure:
            print(report.failure.told(report.scenario), flush=True)
    total = summary(reports, reached)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(total, indent=1) + "\n")
    print(
        f"{total['transitions']:,} transitions to {total['states']:,} states; {total['complete']} "
        f"of {total['worlds']} worlds to the end; {total['reached'] / total['lines']:.0%} of the "
        f"engine's lines reached; failed: {', '.join(total['failures']) or 'none'}"
    )
    return 1 if total["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
