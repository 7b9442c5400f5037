"""`vram-runner benchmark`: success rates of skills and policies over worlds and seeds.

Composes the parts, writes the report and prints the table.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import dataclasses
import functools
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.runner.cli.common import (
    add_license_flag,
    add_trace_flag,
    check_sidecars,
    connect_arbiter,
    default_skills,
    install_signals,
    sidecars_given,
    unlicensed,
    warm_up,
)
from vram_arbiter.runner.cli.numbers import not_negative_int, positive, positive_int
from vram_arbiter.schemas.errors import ConfigError, VramError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import ModelFamily
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.printable import printable_lines

if TYPE_CHECKING:
    from vram_arbiter.runner.protocols import Skill
    from vram_arbiter.runner.sim.benchmark import Benchmark, Cell, Contestant, Told
    from vram_arbiter.runner.sim.tasks import Task
    from vram_arbiter.runner.sim.worlds import World

log = logging.getLogger("runner")

WITHOUT_MEMORY = frozenset(
    {
        ModelFamily.ACT,
        ModelFamily.SMOLVLA,
        ModelFamily.PI0,
        ModelFamily.PI05,
        ModelFamily.PI0_FAST,
        ModelFamily.EO1,
        ModelFamily.EVO1,
        ModelFamily.XVLA,
    }
)
"""Families whose sidecar answers from one observation alone."""
REPORT = "benchmark.json"
MAX_STEPS = 600  # of an episode where neither the world nor --max-steps says


def add_parser(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner benchmark`."""
    bench = commands.add_parser(
        "benchmark", help="measure success rates of skills and policies, with videos"
    )
    bench.add_argument(
        "--env",
        action="append",
        default=[],
        help="so101 (default), pusht, aloha-insertion, aloha-transfer-cube or gym:ID; repeatable",
    )
    bench.add_argument(
        "--scene",
        type=Path,
        action="append",
        default=[],
        help="scene file of so101; repeatable",
    )
    bench.add_argument(
        "--env-config", type=Path, help="environment file of the gymnasium environment"
    )
    bench.add_argument(
        "--success",
        metavar="RULE",
        help="success in a gymnasium environment: info:KEY or return:NUMBER",
    )
    bench.add_argument(
        "--task", help="in so101: grab or navigate (default: by the skill's actions)"
    )
    bench.add_argument(
        "--skill",
        action="append",
        default=[],
        help="an installed skill; repeatable",
    )
    bench.add_argument(
        "--policy", action="append", default=[],
        help="random, scripted:MODULE, scripted:FILE.py or, for grabs in so101, expert; repeatable",
    )  # fmt: skip
    bench.add_argument(
        "--episodes", type=positive_int, default=10, help="episodes per cell; default 10"
    )
    bench.add_argument("--seed", type=int, default=0, help="seed of the first episode")
    bench.add_argument(
        "--max-steps",
        type=positive_int,
        help="limit of an episode; default 600 (20 s of the SO-101), or a known environment's own",
    )
    bench.add_argument(
        "--parallel", type=positive_int, default=1, metavar="N",
        help="play N episodes of a cell at once, each in its own world; default 1",
    )  # fmt: skip
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
        "--episode-seconds",
        type=positive,
        default=600.0,
        help="wall time limit of an episode; default 600",
    )
    bench.add_argument(
        "--out", type=Path, default=Path("out/benchmark"), help="folder of report and videos"
    )
    bench.add_argument("--videos", action=argparse.BooleanOptionalAction, default=True)
    bench.add_argument(
        "--skills",
        type=Path,
        nargs="+",
        action="extend",
        help="rskill.yaml files or folders of them",
    )
    bench.add_argument("--arbiter", help="the arbiter's endpoint")
    bench.add_argument(
        "--no-arbiter", action="store_true", help="run without an arbiter and leases"
    )
    bench.add_argument("--sidecar", action="append", default=[], metavar="RSKILL=ENDPOINT")
    add_license_flag(bench)
    add_trace_flag(bench)
    return bench


@dataclasses.dataclass(frozen=True, slots=True)
class Entry:
    """One cell to be played: a contestant in a world, made when its turn comes."""

    world: World
    name: str
    task: Task | None
    contestant: Callable[[], Contestant]


async def run(args: argparse.Namespace) -> int:
    """Run the benchmark.

    Returns: 0 if every episode got a verdict or the world does not judge, 1 after errors or a stop.
    The report lists what was played in either case.
    """
    from vram_arbiter.runner.gpu_lease import RENDERER_BYTES, RENDERING, gpu_lease, rendering_gpu

    async with contextlib.AsyncExitStack() as stack:
        arbiter = None
        if args.skill and not args.no_arbiter:
            arbiter = await connect_arbiter(args.arbiter, stack)
            gpu = rendering_gpu(os.environ)
            await stack.enter_async_context(gpu_lease(arbiter, gpu, RENDERING, RENDERER_BYTES))
        lanes = [entries_of(args, arbiter) for _ in range(args.parallel)]
        entries = lanes[0]
        check_output("--out", args.out / REPORT)
        if args.videos:
            check_output("--out", args.out / "videos" / "any")
        need("a benchmark", "numpy", "cv2", extra="runner")  # behind what is wrong with the flags
        await asyncio.to_thread(warm_up)
        stopping = asyncio.Event()
        install_signals(stopping)
        cells: list[Cell] = []
        for cell in zip(*lanes, strict=True):
            if stopping.is_set():
                break
            cells.append(await _play(cell, args, stopping))
            _write(args, entries, cells, complete=False)
    complete = len(cells) == len(entries) and all(cell.complete for cell in cells)
    _write(args, entries, cells, complete=complete)
    from vram_arbiter.runner.cli.benchmark_report import table

    print(printable_lines(table([cell.summary() for cell in cells])))
    print(f"{args.out / REPORT}")
    return 0 if complete and not any(cell.errors for cell in cells) else 1


async def _play(lanes: Sequence[Entry], args: argparse.Namespace, stopping: asyncio.Event) -> Cell:
    """Play one cell, its seeds dealt out to the lanes: each has its own world and contestant."""
    from vram_arbiter.runner.sim.benchmark import merged, release

    benches = [benchmark_of(entry, args) for entry in lanes]
    contestants = [entry.contestant() for entry in lanes]
    watching = asyncio.create_task(_stop_with(stopping, benches))
    seeds = range(args.seed, args.seed + args.episodes)
    try:
        async with asyncio.TaskGroup() as group:
            played = [
                group.create_task(bench.play(contestant, seeds[lane :: len(lanes)]))
                for lane, (bench, contestant) in enumerate(zip(benches, contestants, strict=True))
            ]
        return merged([task.result() for task in played])
    except* VramError as errors:
        raise errors.exceptions[0] from None
    finally:
        for contestant in contestants:  # not before all lanes are done: they share its sidecar
            await release(contestant)
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)


async def _stop_with(stopping: asyncio.Event, benches: Sequence[Benchmark]) -> None:
    await stopping.wait()
    for bench in benches:
        bench.stop()


def benchmark_of(entry: Entry, args: argparse.Namespace) -> Benchmark:
    """Return a benchmark of the entry's world and task."""
    from vram_arbiter.runner.sim.benchmark import Benchmark
    from vram_arbiter.runner.sim.robot import sim_runner
    from vram_arbiter.runner.sim.tasks import set_task

    world, task, arm = entry.world, entry.task, entry.world.arm

    def told() -> Told:
        return (world.instruction, {}) if arm is None or task is None else task.told(arm)

    if arm is not None and task is not None and world.environment is not None:
        set_task(task, arm, world.environment)
    runner = sim_runner(
        world.make,
        cameras=world.cameras,
        rate_hz=world.control_hz if args.real_time else 0,
        max_steps=longest_of(world, args),
        ends_with_skill=True,
        video_camera=world.video_camera,
        video_every=world.video_every,
    )
    runner.identity = dict(world.identity)
    runner.spans.share = args.trace_ticks
    return Benchmark(
        runner,
        world=world.name,
        task=task.name if task is not None else None,
        told=told,
        videos=args.out / "videos" if args.videos else None,
        video_every=world.video_every,
        episode_s=args.episode_seconds,
    )


def longest_of(world: World, args: argparse.Namespace) -> int:
    """Return the steps of an episode: as asked for, else the world's own."""
    asked: int | None = args.max_steps
    return asked or world.max_steps or MAX_STEPS


# -- what is to be played
def worlds_of(args: argparse.Namespace) -> list[World]:
    """Return the worlds. Raises ConfigError for unknown ones, and for ambiguous files."""
    from vram_arbiter.runner.sim.worlds import SO101, world_of

    names = list(dict.fromkeys(args.env or [SO101]))
    others = [name for name in names if name != SO101]
    if len(others) > 1 and (args.env_config is not None or args.success is not None):
        raise ConfigError(
            "--env-config and --success are for one gymnasium environment:"
            " run them one after another"
        )
    if (args.scene or args.task) and SO101 not in names:
        raise ConfigError(f"--scene and --task are for --env {SO101}")
    worlds = []
    for name in names:
        if name != SO101:
            render = (
                None if args.videos or args.skill else False
            )  # a skill may look through `render`
            worlds.append(
                world_of(name, env_config=args.env_config, success=args.success, render=render)
            )
            continue
        for scene in dict.fromkeys(args.scene) or [None]:
            world = world_of(name, scene=scene)
            worlds.append(
                world if scene is None else dataclasses.replace(world, name=f"{SO101}:{scene.stem}")
            )
    return worlds


def entries_of(args: argparse.Namespace, arbiter: Any) -> list[Entry]:
    """Return every contestant in every world.

    Raises ConfigError and UnknownSkill before anything is played.
    """
    from vram_arbiter.runner.goals.catalogue import Catalogue, read_manifests
    from vram_arbiter.runner.sim.benchmark import PolicyContestant, SkillContestant
    from vram_arbiter.runner.sim.policies import policy_of
    from vram_arbiter.runner.sim.tasks import EXPERT, GRAB, TASKS, expert_policy, task_of
    from vram_arbiter.runner.sim.worlds import makers_of
    from vram_arbiter.runner.skills.sidecar_policy import HUNG_WAITING_MIN_S

    if not args.skill and not args.policy:
        raise ConfigError(
            "there are no contestants", hint="--skill RSKILL or --policy random, any number of them"
        )
    if args.real_time and args.parallel > 1:
        raise ConfigError(
            f"--parallel {args.parallel}: episodes at once would slow each other down in real time",
            hint="leave out --parallel or --real-time",
        )
    if args.task is not None and args.task not in TASKS:
        raise ConfigError(f"unknown --task {args.task}", hint=" or ".join(TASKS))
    given_task = TASKS[args.task] if args.task is not None else None
    policies = {name: policy_of(name) for name in dict.fromkeys(args.policy) if name != EXPERT}
    manifests = read_manifests(args.skills or [default_skills()]) if args.skill else []
    refused = unlicensed(manifests, allow_noncommercial=args.allow_noncommercial)
    given = sidecars_given(args.sidecar)
    if args.skill:
        check_sidecars(given, manifests)

    def skilled(make: Callable[[], Skill]) -> SkillContestant:
        return SkillContestant(make())

    entries = []
    for world in worlds_of(args):
        arm, environment = world.arm, world.environment
        makers = makers_of(
            world,
            given,
            arbiter,
            period_s=1.0 / world.control_hz,
            wait_s=0.0 if args.real_time else HUNG_WAITING_MIN_S,
            latency_steps=args.latency_steps,
        )
        catalogue = Catalogue(manifests, makers, refused=refused, body=world.body)
        for name in dict.fromkeys(args.skill):
            _, make, manifest = catalogue.find(name)
            if args.parallel > 1 and remembers(manifest):
                raise ConfigError(
                    f"--parallel {args.parallel}: {name} may keep observations of one episode in"
                    " its sidecar, and episodes at once would mix them",
                    hint="play it without --parallel",
                )
            task = None if arm is None else given_task or task_of(manifest)
            entries.append(Entry(world, name, task, functools.partial(skilled, make)))
        for name in dict.fromkeys(args.policy):
            task = None if arm is None else given_task or GRAB
            if name != EXPERT:
                policy = policies[name]
            elif arm is None or environment is None or task is not GRAB:
                raise ConfigError(f"--policy {EXPERT} grabs in so101, and does nothing else")
            else:
                policy = expert_policy(arm, environment)
            entries.append(Entry(world, name, task, functools.partial(PolicyContestant, policy)))
    _check_names(entries)
    return entries


def remembers(manifest: RSkillManifest) -> bool:
    """Return whether a policy's answer may depend on more than the request: on a history, or, with
    one action a request, on an ensemble of earlier answers."""
    if manifest.kind is not Kind.VLA:
        return False
    return manifest.model_family not in WITHOUT_MEMORY or manifest.n_action_steps == 1


def _check_names(entries: Sequence[Entry]) -> None:
    """Raise ConfigError for cells with the same name: their videos would overwrite each other."""
    from vram_arbiter.runner.sim.benchmark import file_name

    taken: dict[tuple[str, str], Entry] = {}
    for entry in entries:
        other = taken.setdefault((file_name(entry.world.name), file_name(entry.name)), entry)
        if other is not entry:
            raise ConfigError(
                f"{entry.world.name}, {entry.name} and {other.world.name}, {other.name}"
                " would have one name",
                hint="rename one of the files, or run them one after another with an --out each",
            )


def _write(
    args: argparse.Namespace, entries: Sequence[Entry], cells: Sequence[Cell], *, complete: bool
) -> None:
    """After every cell: a run that is killed leaves the cells before."""
    from vram_arbiter.runner.cli.benchmark_report import write_report

    write_report(
        args.out / REPORT,
        [
            (cell, longest_of(entry.world, args))
            for entry, cell in zip(entries, cells, strict=False)
        ],
        seeds=(args.seed, args.seed + args.episodes - 1),
        parallel=args.parallel,
        latency="real time" if args.real_time else args.latency_steps,
        complete=complete,
    )
