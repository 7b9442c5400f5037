"""Steps and standing of the shipped grab, by how early its chunks are asked for.

    python -m tests.bench.bench_prefetch [--episodes 40] [--seed 0] [--cells 0/6 2/6 2/4 5/6]
        [--latency 0 1 2 3 5] [--real-time]

Real sidecar, real policy on the CPU, no arbiter; each row is one `vram-runner benchmark` over the
same seeds. The world waits for late chunks, and an answer takes `--latency` control steps, so that
the figures do not depend on the machine. `--real-time` adds rows at 30 Hz with the sidecar's own
latency: run it on a machine with nothing else to do.
A cell is `prefetch_at/n_action_steps`. Prints a table and writes `out/bench/prefetch.json`, the
summaries of the cells.
"""

import argparse
import asyncio
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import yaml

from tests.bench.grabs import MANIFEST, benchmark_arguments, grab_sidecar
from vram_arbiter.runner.benchmark.entries import entries_of, player_of
from vram_arbiter.schemas.plain import JsonObject

HEAD = (
    "| latency | prefetch_at | n_action_steps | steps | of them standing | success |\n"
    "| --- | --- | --- | --- | --- | --- |"
)


@dataclass(frozen=True, slots=True)
class Cell:
    """One row. `latency` in control steps; None: that of the sidecar, in real time."""

    latency: int | None
    prefetch_at: int
    keep: int

    def played(self, endpoint: str, seeds: range) -> JsonObject:
        """Return the summary of the benchmark. Raises RuntimeError without a verdict."""
        raw = yaml.safe_load(MANIFEST.read_text(encoding="utf-8"))
        raw["policy_extras"]["prefetch_at"] = self.prefetch_at
        raw["n_action_steps"] = self.keep
        told = ["--real-time"] if self.latency is None else ["--latency-steps", str(self.latency)]
        with tempfile.TemporaryDirectory() as name:
            manifest = Path(name) / "rskill.yaml"
            manifest.write_text(yaml.safe_dump(raw), encoding="utf-8")
            args = benchmark_arguments(endpoint, manifest, *told)
            (entry,) = entries_of(args, None)
        cell = entry.cell()

        async def play() -> None:
            async with player_of(entry, args) as player:
                for seed in seeds:
                    cell.episodes.append(await player.play(seed))
                    if cell.episodes[-1].success is None:
                        raise RuntimeError(f"{self}: {cell.episodes[-1].message}")

        asyncio.run(play())
        return cell.summary()

    def row(self, summary: JsonObject) -> str:
        """Return the line of the table."""
        latency = "real time" if self.latency is None else self.latency
        return (
            f"| {latency} | {self.prefetch_at} | {self.keep} | {summary['mean_steps']:.1f} | "
            f"{summary['mean_standing_steps']:.1f} | {summary['successes']}/{summary['judged']} |"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cells", nargs="+", default=["0/6", "2/6", "2/4", "5/6"])
    parser.add_argument("--latency", type=int, nargs="*", default=[0, 1, 2, 3, 5])
    parser.add_argument("--real-time", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out/bench/prefetch.json"))
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.episodes)
    rows: list[dict[str, object]] = []
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with grab_sidecar() as endpoint:
        print(HEAD, flush=True)
        for latency in [*options.latency, *([None] if options.real_time else [])]:
            for name in options.cells:
                prefetch_at, keep = (int(number) for number in name.split("/"))
                cell = Cell(latency, prefetch_at, keep)
                summary = cell.played(endpoint, seeds)
                print(cell.row(summary), flush=True)
                rows.append(
                    {"latency": latency, "prefetch_at": prefetch_at, "keep": keep, **summary}
                )
                options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
