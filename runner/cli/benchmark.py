"""`vram-runner benchmark`: success rates of skills and policies over scenes and seeds, and by
`lerobot-eval` in lerobot's environments.

Composes the parts, writes the report and prints the table.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vram_arbiter.clients.cli.arguments import count, positive
from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.runner.benchmark import folder
from vram_arbiter.runner.benchmark.entries import SO101, VIDEOS, Entry, entries_of
from vram_arbiter.runner.benchmark.outcomes import Cell, SeedOutcome, given_up
from vram_arbiter.runner.benchmark.progress import ProgressLine
from vram_arbiter.runner.benchmark.report import MAX_STEPS, PAGE, REPORT, table, write_report
from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.common import add_skill_flags, install_signals
from vram_arbiter.runner.cli.recording import add_record_flags
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.printable import printable_lines

if TYPE_CHECKING:
    from vram_arbiter.runner.benchmark.boxes import Boxes
    from vram_arbiter.runner.benchmark.processes import Processes

    Players = Boxes | Processes

HUNG_S = 300.0
"""Beyond `--episode-seconds`, after which a worker is killed: its model loads meanwhile."""


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner benchmark`."""
    bench = commands.add_parser(
        "benchmark", help="measure success rates of skills and policies, with videos"
    )
    bench.add_argument(
        "--env", default=SO101, metavar="TYPE",
        help="so101 (default), or an environment of lerobot (pusht, aloha, libero, metaworld …), in"
        " which lerobot-eval plays the skill's checkpoint under a lease",
    )  # fmt: skip
    bench.add_argument(
        "lerobot_flags", nargs="*", metavar="-- FLAGS", help="passed to lerobot-eval as they are"
    )
    bench.add_argument(
        "--scene", type=Path, action="append", default=[], help="scene file of so101; repeatable"
    )
    bench.add_argument("--task", help="grab or navigate (default: by the skill's actions)")
    bench.add_argument(
        "--skill", action="append", default=[], help="an installed skill; repeatable"
    )
    bench.add_argument(
        "--policy", action="append", default=[],
        help="random, expert (grabs), scripted:FILE; repeatable",
    )  # fmt: skip
    bench.add_argument(
        "--episodes", type=count(1), default=10, help="episodes per cell; default 10"
    )
    bench.add_argument("--seed", type=count(0), default=0, help="seed of the first episode")
    bench.add_argument(
        "--max-steps", type=count(1), default=MAX_STEPS, help="limit of an episode; default 600"
    )
    time = bench.add_mutually_exclusive_group()
    time.add_argument(
        "--latency-steps", type=count(0), metavar="N",
        help="a policy's answer takes N control steps; default: as many as it had actions left to"
        " play when it was asked",
    )  # fmt: skip
    time.add_argument(
        "--real-time", action="store_true",
        help="tick at the world's rate, with the policy's latency on this machine",
    )  # fmt: skip
    bench.add_argument(
        "--episode-seconds", type=positive, default=600.0,
        help="wall time limit of an episode; default 600",
    )  # fmt: skip
    bench.add_argument(
        "--out", type=Path, default=Path("out/benchmark"),
        help="folder of results, report and videos; the same command goes on with what is missing",
    )  # fmt: skip
    bench.add_argument(
        "--workers", type=count(1), default=1, metavar="N",
        help="processes that play at the same time, with --ray on each box; default 1",
    )  # fmt: skip
    bench.add_argument(
        "--ray", metavar="ADDRESS",
        help="play on the boxes of this Ray cluster (HOST:PORT, or auto), each with its own arbiter"
        " and sidecars",
    )  # fmt: skip
    bench.add_argument("--worker", type=int, nargs=2, help=argparse.SUPPRESS)  # cell, descriptor
    bench.add_argument("--videos", action=argparse.BooleanOptionalAction, default=True)
    add_record_flags(bench, "every episode of the one contestant")
    add_skill_flags(bench)
    return bench


async def run(args: argparse.Namespace) -> int:
    """Run the benchmark.

    Returns: 0 if every episode got a verdict, 1 after errors or a stop. The report lists what was
    played in either case.
    """
    if args.worker is not None:
        from vram_arbiter.runner.benchmark.worker import serve

        return await serve(args)
    if args.env != SO101:
        from vram_arbiter.runner.cli.lerobot_eval import evaluate

        return await evaluate(args)
    entries = _checked(args)
    async with contextlib.AsyncExitStack() as stack:
        players = await _players(args, stack)
        stopping = asyncio.Event()
        install_signals(stopping)
        cells = await _play(args, entries, players, stopping)
    complete = all(cell.complete for cell in cells)
    write_report(args, cells, complete=complete)
    folder.tidy(args.out)
    print(printable_lines(table(cells)))
    print(f"{args.out / REPORT}\n{args.out / PAGE}")
    judged = all(one.success is not None for cell in cells for one in cell.episodes)
    return 0 if complete and judged else 1


def _checked(args: argparse.Namespace) -> list[Entry]:
    """Return what is to be played. Raises ConfigError, UnknownSkill for what cannot be."""
    if args.lerobot_flags:
        raise ConfigError(
            f"unexpected {' '.join(args.lerobot_flags)}",
            hint="words after -- are for lerobot-eval: name an environment of lerobot by --env",
        )
    entries = entries_of(args, None)
    if args.record is not None and (len(entries) > 1 or args.workers > 1 or args.ray):
        raise ConfigError("--record takes one contestant in one scene, and one local worker")
    if args.ray and args.workers > 1 and not all("=" in flag for flag in args.sidecar):
        raise ConfigError(
            "--ray with several workers a box does not start the sidecar that they share",
            hint="start it on each box, and name its endpoint: --sidecar RSKILL=ENDPOINT",
        )
    check_output("--out", args.out / REPORT)
    if args.videos:
        check_output("--out", args.out / VIDEOS / "any")
    need("a benchmark", "numpy", "cv2", extra="runner")  # behind what is wrong with the flags
    folder.claim(args.out, folder.flags_of(args, entries))
    return entries


async def _players(args: argparse.Namespace, stack: contextlib.AsyncExitStack) -> Players:
    """Return what plays; without Ray, with the sidecars of this machine."""
    deadline_s = args.episode_seconds + HUNG_S
    if args.ray:
        from vram_arbiter.clients.ray.fleet import connected
        from vram_arbiter.runner.benchmark.boxes import Boxes

        fleet = stack.enter_context(connected(args.ray))
        return Boxes(fleet, args.argv, args.workers, deadline_s)
    from vram_arbiter.runner.benchmark.processes import Processes
    from vram_arbiter.runner.benchmark.worker import open_sidecars

    await open_sidecars(args, stack)
    return Processes(args.argv, args.workers, deadline_s)


async def _play(
    args: argparse.Namespace, entries: Sequence[Entry], players: Players, stopping: asyncio.Event
) -> list[Cell]:
    """Play what is missing of every cell; return all, with what was played before."""
    cells = [entry.cell() for entry in entries]
    seeds = range(args.seed, args.seed + args.episodes)
    missing = [folder.take_up(args.out, cell, seeds) for cell in cells]
    progress = ProgressLine(sum(map(len, missing)))

    async def forward() -> None:
        await stopping.wait()
        players.stop()

    def tell(cell: Cell, ended: list[SeedOutcome], played: SeedOutcome) -> None:
        ended.append(played)
        progress.tell(cell, played)
        cell.why = cell.why or given_up(ended)
        if cell.why:
            players.stop()

    forwarding = asyncio.create_task(forward())
    try:
        for number, (cell, left) in enumerate(zip(cells, missing, strict=True)):
            if left and not stopping.is_set():
                told = functools.partial(tell, cell, [])
                await players.play(number, left, folder.results(args.out, cell), told)
            folder.read(args.out, cell)
            cell.complete = len(cell.episodes) == args.episodes
            cell.why = "" if cell.complete else cell.why or "stopped"
            write_report(args, cells, complete=False)
    finally:
        progress.end()
        forwarding.cancel()
    return cells
