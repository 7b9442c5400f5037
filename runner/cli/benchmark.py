"""`vram-runner benchmark`: success rates of skills and policies over scenes and seeds, and by
`lerobot-eval` in lerobot's environments.

Composes the parts, writes the report and prints the table.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.benchmark_report import MAX_STEPS, REPORT, table, write_report
from vram_arbiter.runner.cli.common import (
    add_skill_flags,
    check_sidecars,
    connect_arbiter,
    default_skills,
    install_signals,
    lease_rendering,
    sidecars_given,
    start_sidecars,
    unlicensed,
    warm_up,
)
from vram_arbiter.runner.cli.numbers import not_negative_int, positive, positive_int
from vram_arbiter.runner.cli.recording import add_record_flags, conclude_recording, record_sim
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.printable import printable_lines

if TYPE_CHECKING:
    from vram_arbiter.runner.protocols import Skill
    from vram_arbiter.runner.sim.arm_env import ArmEnvironment
    from vram_arbiter.runner.sim.benchmark import Benchmark, Cell, Told
    from vram_arbiter.runner.sim.tasks import Task

SO101 = "so101"


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
        help="random, expert (grabs), scripted:MODULE or scripted:FILE.py; repeatable",
    )  # fmt: skip
    bench.add_argument(
        "--episodes", type=positive_int, default=10, help="episodes per cell; default 10"
    )
    bench.add_argument("--seed", type=int, default=0, help="seed of the first episode")
    bench.add_argument(
        "--max-steps", type=positive_int, default=MAX_STEPS, help="limit of an episode; default 600"
    )
    time = bench.add_mutually_exclusive_group()
    time.add_argument(
        "--latency-steps", type=not_negative_int, metavar="N",
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
        "--out", type=Path, default=Path("out/benchmark"), help="folder of report and videos"
    )
    bench.add_argument("--videos", action=argparse.BooleanOptionalAction, default=True)
    add_record_flags(bench, "every episode of the one contestant")
    add_skill_flags(bench)
    return bench


@dataclasses.dataclass(frozen=True, slots=True)
class Entry:
    """One cell to be played: a contestant in a world, made when its turn comes."""

    world: ArmEnvironment
    world_name: str
    name: str
    task: Task
    skill: Callable[[], Skill]


async def run(args: argparse.Namespace) -> int:
    """Run the benchmark.

    Returns: 0 if every episode got a verdict, 1 after errors or a stop. The report lists what was
    played in either case.
    """
    if args.env != SO101:
        from vram_arbiter.runner.cli.lerobot_eval import evaluate

        return await evaluate(args)
    if args.lerobot_flags:
        raise ConfigError(
            f"unexpected {' '.join(args.lerobot_flags)}",
            hint="words after -- are for lerobot-eval: name an environment of lerobot by --env",
        )
    async with contextlib.AsyncExitStack() as stack:
        arbiter = None
        if args.skill and not args.no_arbiter:
            arbiter = await connect_arbiter(args.arbiter, stack)
            await lease_rendering(arbiter, stack)
        entries = entries_of(args, arbiter)
        if args.record is not None and len(entries) > 1:
            raise ConfigError("--record takes one contestant in one scene")
        check_output("--out", args.out / REPORT)
        if args.videos:
            check_output("--out", args.out / "videos" / "any")
        need("a benchmark", "numpy", "cv2", extra="runner")  # behind what is wrong with the flags
        await start_sidecars(args, stack)
        await asyncio.to_thread(warm_up)
        stopping = asyncio.Event()
        install_signals(stopping)
        cells: list[Cell] = []
        for entry in entries:
            if not stopping.is_set():
                cells.append(await _play(entry, args, stopping))
                write_report(args, cells, complete=False)
    complete = len(cells) == len(entries) and all(cell.complete for cell in cells)
    write_report(args, cells, complete=complete)
    rows = [cell.summary() for cell in cells]
    print(printable_lines(table(rows)))
    print(f"{args.out / REPORT}")
    return 0 if complete and not any(row["errors"] for row in rows) else 1


async def _play(entry: Entry, args: argparse.Namespace, stopping: asyncio.Event) -> Cell:
    """Play one cell. Raises the first error of its recording."""
    bench = benchmark_of(entry, args)

    async def forward() -> None:
        await stopping.wait()
        bench.stop()

    watching = asyncio.create_task(forward())
    seeds = range(args.seed, args.seed + args.episodes)
    try:
        async with contextlib.AsyncExitStack() as stack:
            rate_hz = bench.runner.rate_hz
            dataset = await record_sim(
                args, bench.runner, rate_hz, bench.stop, stack, robot="so101-mobile", strict=True
            )
            cell = await bench.run(entry.skill(), seeds)
    finally:
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)
    if dataset is not None and dataset.counts.error is not None:
        raise dataset.counts.error  # it was played for the recording
    await conclude_recording(dataset)
    return cell


def benchmark_of(entry: Entry, args: argparse.Namespace) -> Benchmark:
    """Return a benchmark of the entry's world and task."""
    from vram_arbiter.runner.sim.benchmark import Benchmark
    from vram_arbiter.runner.sim.config import CONTROL_HZ
    from vram_arbiter.runner.sim.robot import sim_runner
    from vram_arbiter.runner.sim.tasks import set_task

    def told() -> Told:
        return entry.task.told(entry.world.arm)

    set_task(entry.task, entry.world)
    runner = sim_runner(
        entry.world,
        rate_hz=CONTROL_HZ if args.real_time else 0,
        max_steps=args.max_steps,
        ends_with_skill=True,
    )
    runner.spans.share = args.trace_ticks
    return Benchmark(
        runner,
        world=entry.world_name,
        task=entry.task.name,
        told=told,
        videos=args.out / "videos" if args.videos else None,
        episode_s=args.episode_seconds,
    )


# -- what is to be played
def entries_of(args: argparse.Namespace, arbiter: Any) -> list[Entry]:
    """Return every contestant in every scene.

    Raises ConfigError and UnknownSkill before anything is played.
    """
    from vram_arbiter.runner.goals.catalogue import Catalogue, read_manifests
    from vram_arbiter.runner.robots.body import SIMULATED
    from vram_arbiter.runner.sim.config import CONTROL_DT_S
    from vram_arbiter.runner.sim.policies import EXPERT, PolicySkill, policy_of
    from vram_arbiter.runner.sim.tasks import GRAB, TASKS, task_of
    from vram_arbiter.runner.sim.worlds import makers_of, so101_world
    from vram_arbiter.runner.skills.sidecar_policy import HUNG_WAITING_MIN_S

    if not args.skill and not args.policy:
        raise ConfigError("expected --skill RSKILL or --policy NAME", hint="any number of them")
    if args.task is not None and args.task not in TASKS:
        raise ConfigError(f"unknown --task {args.task}", hint=" or ".join(TASKS))
    given_task = TASKS[args.task] if args.task is not None else None
    policies = {name: policy_of(name) for name in dict.fromkeys(args.policy)}
    if EXPERT in policies and given_task not in (None, GRAB):
        raise ConfigError(f"--policy {EXPERT} grabs, and does nothing else")
    manifests = read_manifests(args.skills or [default_skills()]) if args.skill else []
    refused = unlicensed(manifests, allow_noncommercial=args.allow_noncommercial)
    given = sidecars_given(args.sidecar)
    if args.skill:
        check_sidecars(given, manifests)
    entries = []
    for scene in dict.fromkeys(args.scene) or [None]:
        world = so101_world(scene)
        world_name = SO101 if scene is None else f"{SO101}:{scene.stem}"
        makers = makers_of(
            world,
            given,
            arbiter,
            period_s=CONTROL_DT_S,
            wait_s=0.0 if args.real_time else HUNG_WAITING_MIN_S,
            latency_steps=args.latency_steps,
        )
        catalogue = Catalogue(manifests, makers, refused=refused, body=SIMULATED)
        for name in dict.fromkeys(args.skill):
            _, make, manifest = catalogue.find(name)
            task = given_task or task_of(manifest)
            entries.append(Entry(world, world_name, name, task, make))
        for name, begin in policies.items():
            policy = functools.partial(PolicySkill, name, begin, world)
            entries.append(Entry(world, world_name, name, given_task or GRAB, policy))
    _check_names(entries)
    return entries


def _check_names(entries: Sequence[Entry]) -> None:
    """Raise ConfigError for cells with the same name: their videos would overwrite each other."""
    from vram_arbiter.runner.sim.benchmark import file_name

    taken: dict[tuple[str, str], Entry] = {}
    for entry in entries:
        other = taken.setdefault((file_name(entry.world_name), file_name(entry.name)), entry)
        if other is not entry:
            raise ConfigError(
                f"{entry.world_name}, {entry.name} and {other.world_name}, {other.name}"
                " would have one name",
                hint="rename one of the files, or run them one after another with an --out each",
            )
