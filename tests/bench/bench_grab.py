"""Success of the shipped grab over many seeds, with shapes and kinds of failure.

    python -m tests.bench.bench_grab [--episodes 1000] [--seed 10000] [--table]

The runner's own benchmark in this process, and the real sidecar beside it, without arbiter. The
simulated world waits for the policy, whose answers take as many steps as `prefetch_at` says, so
that a seed's episode does not depend on the machine. Grabs were trained on seeds k * 1,000,000 +
500,000 and up; 10,000 to 10,999 were never used for training or tuning.
Writes one JSON line a seed to `out/bench/grab.jsonl`; seeds that are there already, of the same
commit, are not played again. `--table` prints the table of what is there.
"""

import argparse
import asyncio
import dataclasses
import json
import math
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict

from tests.bench.grabs import MANIFEST, benchmark_arguments, grab_sidecar
from tests.support.paths import ROOT
from vram_arbiter.runner.benchmark.entries import entries_of, player_of
from vram_arbiter.runner.benchmark.outcomes import wilson
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.tasks import GRAB

PUSHED_M = 0.05


class Line(TypedDict):
    """Outcome of one seed. `kind` is empty for a success."""

    seed: int
    commit: str
    target: str
    success: bool
    steps: int
    kind: str


class Witness:
    """Judge of the grab that notes how the episode went, for the kind of a failure."""

    def __init__(self) -> None:
        self.episodes: list[str] = []
        self.targets: list[str] = []
        self._key: tuple[int, str] | None = None
        self._at = (0.0, 0.0)
        self._was_held = False

    def judge(self, env: SimEnv) -> bool:
        assert env.layout is not None
        truth = env.ground_truth()
        x, y, _ = truth.objects[env.target].position_map
        if self._key != (env.layout.seed, env.target):
            self._key, self._at, self._was_held = (env.layout.seed, env.target), (x, y), False
            self.episodes.append("")
            self.targets.append(env.target)
        held = env.held_object()
        self._was_held = self._was_held or held == env.target
        if held is not None and held != env.target:
            kind = "another object held"
        elif self._was_held:
            kind = "dropped"
        elif math.dist((x, y), self._at) > PUSHED_M:
            kind = "pushed away"
        else:
            kind = "not grasped"
        self.episodes[-1] = kind
        return GRAB.judge(env)


async def play_seed(seeds: Sequence[int], endpoint: str, commit: str, out: Path) -> None:
    """Play seeds that are missing, and append a line each."""
    args = benchmark_arguments(endpoint, MANIFEST)
    (entry,) = entries_of(args, None)
    witness = Witness()
    entry = dataclasses.replace(entry, task=dataclasses.replace(GRAB, judge=witness.judge))
    async with player_of(entry, args) as player:
        for seed in seeds:
            one = await player.play(seed)
            if one.success is None:  # the next run plays it again
                print(f"seed {seed}: {one.message}", file=sys.stderr, flush=True)
                continue
            line: Line = {
                "seed": seed, "commit": commit, "target": witness.targets[-1],
                "success": one.success, "steps": one.steps,
                "kind": "" if one.success else witness.episodes[-1],
            }  # fmt: skip
            with out.open("a", encoding="utf-8") as sink:
                sink.write(json.dumps(line) + "\n")


def read_rows(out: Path, commit: str) -> dict[int, Line]:
    """Return the lines of this commit by seed."""
    if not out.exists():
        return {}
    lines: list[Line] = [json.loads(text) for text in out.read_text(encoding="utf-8").splitlines()]
    return {line["seed"]: line for line in lines if line["commit"] == commit}


def success_table(lines: Sequence[Line]) -> str:
    """Return rates by shape, steps of successes and kinds of failure, in Markdown."""
    rows = [
        "| objects | success | 95 % interval | mean steps | failures |",
        "| --- |" + " --- |" * 4,
    ]
    shapes = sorted({line["target"].split()[1] for line in lines})
    for name in ("all", *shapes):
        mine = [line for line in lines if name in ("all", line["target"].split()[1])]
        won = [line["steps"] for line in mine if line["success"]]
        low, high = wilson(len(won), len(mine)) or (0.0, 0.0)
        kinds = Counter(line["kind"] for line in mine if not line["success"])
        rows.append(
            f"| {name} | {len(won)}/{len(mine)} = {len(won) / len(mine):.1%} | {low:.1%} to "
            f"{high:.1%} | {sum(won) / max(1, len(won)):.1f} | "
            + ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
            + " |"
        )
    return "\n".join(rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=10_000)
    parser.add_argument("--out", type=Path, default=Path("out/bench/grab.jsonl"))
    parser.add_argument("--commit", help="name of the commit; default: git's")
    parser.add_argument("--table", action="store_true", help="play nothing")
    options = parser.parse_args()
    commit = (
        options.commit
        or subprocess.check_output(
            ["git", "describe", "--always", "--dirty"], cwd=ROOT, text=True
        ).strip()
    )
    seeds = range(options.seed, options.seed + options.episodes)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if seed not in read_rows(options.out, commit)]
    if missing and not options.table:
        with grab_sidecar() as endpoint:
            asyncio.run(play_seed(missing, endpoint, commit, options.out))
    lines = [line for seed, line in read_rows(options.out, commit).items() if seed in seeds]
    if lines:
        print(f"commit {commit}, seeds {seeds[0]} to {seeds[-1]}, {len(lines)} played\n")
        print(success_table(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
