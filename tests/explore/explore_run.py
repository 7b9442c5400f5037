"""All orders of events of small worlds: `python -m tests.explore.explore_run --minutes 60`.

Explores every scenario (`tests.explore.scenarios`) in a process of its own, the small ones first:
what they leave of the time goes to the others. Prints a line for each with the shortest story of a
failure, and the sums. Exit status 1: a failure.
"""

import argparse
import inspect
import json
import multiprocessing
import sys
import time
from dataclasses import asdict
from pathlib import Path
from types import CodeType
from typing import Any

from tests.explore.scenarios import SCENARIOS
from tests.explore.search import Report, Search
from tests.mutation.mutation_run import CORE, ROOT, Coverage

STATES_MAX = 1_500_000
"""In one world: some 4 GB, most of it for what is not explored yet."""
type Lines = set[tuple[str, int]]


def explore(task: tuple[str, int, float, int]) -> tuple[Report, Lines]:
    """Explore one scenario for its share of the time: name, how many are left, until when, jobs.
    Return also the lines of the engine that it comes by."""
    name, left, until, jobs = task
    seconds = (until - time.time()) * min(1.0, jobs / left)
    coverage = Coverage()
    return Search(SCENARIOS[name]).run(max(1.0, seconds), STATES_MAX), coverage.lines


def lines_of_the_engine() -> Lines:
    """Return the lines inside functions, but for `report`: what explains is not explored."""
    found: Lines = set()
    paths = [path for path in CORE.rglob("*.py") if path.parent.name != "report"]
    codes = [(path.stem, compile(path.read_text(), str(path), "exec")) for path in paths]
    while codes:
        stem, code = codes.pop()
        codes += [(stem, inner) for inner in code.co_consts if isinstance(inner, CodeType)]
        if code.co_flags & inspect.CO_NEWLOCALS:
            found |= {(stem, line) for _, _, line in code.co_lines() if line}
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="for all worlds together")
    parser.add_argument("--world", action="append", choices=SCENARIOS, help="this one alone")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=ROOT / "out/explore/explore.json")
    options = parser.parse_args()
    names, until = options.world or list(SCENARIOS), time.time() + 60 * options.minutes
    tasks = [(name, len(names) - n, until, options.jobs) for n, name in enumerate(names)]
    reports, reached = list[Report](), set[tuple[str, int]]()
    with multiprocessing.get_context("spawn").Pool(options.jobs, maxtasksperchild=1) as pool:
        for report, lines in pool.imap_unordered(explore, tasks):
            reports.append(report)
            reached |= lines
            print(report, flush=True)
    every, failed = lines_of_the_engine(), [one.scenario for one in reports if one.error]
    counted = ("states", "transitions", "complete")
    total: dict[str, Any] = {name: sum(getattr(one, name) for one in reports) for name in counted}
    total |= {"failed": failed, "lines": len(every), "reached": len(every & reached)}
    print(json.dumps(total))
    total |= {"missed": sorted(every - reached), "worlds": [asdict(report) for report in reports]}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(total, indent=1) + "\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
