"""`make bench`: how fast the arbiter is, beside a bare ZeroMQ round trip and Redis locks, and how
even a runner's ticks are beside a switch.

Prints tables and writes `out/bench/arbiter.json` (`harness.Row` says what the fields mean) and
`runner.json` beside it (`bench_runner`). `--quick` (QUICK=1) takes less of everything, `--only
grants` one subject. Only ratios within one run mean anything. Rows against etcd and nvshare are
left out: neither is here to be measured.
"""

import argparse
import sys
import time
from pathlib import Path

from tests.bench import (
    bench_attacks,
    bench_core,
    bench_crowd,
    bench_death,
    bench_eviction,
    bench_grants,
    bench_handover,
    bench_page,
    bench_rest,
    bench_runner,
    bench_throughput,
)
from tests.bench.harness import Suite, summed

SUBJECTS = {
    "grants": bench_grants.run,
    "handover": bench_handover.run,
    "throughput": bench_throughput.run,
    "crowd": bench_crowd.run,
    "eviction": bench_eviction.run,
    "death": bench_death.run,
    "rest": bench_rest.run,
    "page": bench_page.run,
    "core": bench_core.run,
    "attacks": bench_attacks.run,
}
RUNNER = "runner"  # a file and a table of its own


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument(
        "--only", action="append", choices=[*SUBJECTS, RUNNER], help="one subject; may be repeated"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/bench/arbiter.json"), help="where the rows go"
    )
    options = parser.parse_args()
    suite = Suite(quick=options.quick)
    names = options.only or [*SUBJECTS, RUNNER]
    runner_rows: list[bench_runner.RunnerRow] = []
    runner_out = options.out.with_name("runner.json")
    for name in names:
        began = time.monotonic()
        if name == RUNNER:
            runner_rows = bench_runner.run(quick=options.quick, out=runner_out)
        else:
            SUBJECTS[name](suite)
        print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    if not options.only:
        suite.skipped("against etcd and nvshare", "not here")
    if names != [RUNNER]:
        suite.write(options.out)
        print(f"{suite.table()}\n{summed(row.ok for row in suite.rows)}; rows are in {options.out}")
    if runner_rows:
        targets = summed(row.ok for row in runner_rows)
        print(f"\n{bench_runner.table(runner_rows)}\n{targets}; rows are in {runner_out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
