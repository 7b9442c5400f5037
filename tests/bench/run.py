"""`make bench`: how fast the arbiter is, beside a bare ZeroMQ round trip and Redis locks, all in one run on one machine.

Prints a table and writes `out/bench/arbiter.json` (`harness.Row` says what the fields mean). `--quick` (QUICK=1) takes less of
everything, `--only grants` one subject. Only ratios within one run mean anything. Rows against etcd and nvshare are left out: neither is
here to be measured.
"""

import argparse
import sys
import time
from pathlib import Path

import bench_core
import bench_crowd
import bench_death
import bench_eviction
import bench_grants
import bench_handover
import bench_rest
import bench_throughput
from harness import Suite

SUBJECTS = {
    "grants": bench_grants.run,
    "handover": bench_handover.run,
    "throughput": bench_throughput.run,
    "crowd": bench_crowd.run,
    "eviction": bench_eviction.run,
    "death": bench_death.run,
    "rest": bench_rest.run,
    "core": bench_core.run,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument(
        "--only", action="append", choices=list(SUBJECTS), help="one subject; may be repeated"
    )
    parser.add_argument("--out", type=Path, default=Path("out/bench/arbiter.json"), help="where the rows go")
    options = parser.parse_args()
    suite = Suite(quick=options.quick)
    for name in options.only or SUBJECTS:
        began = time.monotonic()
        SUBJECTS[name](suite)
        print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    if not options.only:
        suite.skipped("against etcd and nvshare", "not here")
    suite.write(options.out)
    met, missed = (sum(row.ok is found for row in suite.rows) for found in (True, False))
    print(f"{suite.table()}\n\n{met} targets met, {missed} missed; rows are in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
