"""`vram-runner benchmark`: success rates of skills and policies over worlds and seeds.

Composes the parts, writes the report and prints the table.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import dataclasses
import functools
import json
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
    positive,
    positive_int,
    sidecars_given,
    unlicensed,
    warm_up,
)
from vram_arbiter.runner.sim.config import CONTROL_HZ
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.printable import printable_lines

if TYPE_CHECKING:
    from vram_arbiter.runner.protocols import Skill
    from vram_arbiter.runner.sim.benchmark import Benchmark, Cell, CellSummary, Contestant, Told
    from vram_arbiter.runner.sim.tasks import Task
    from vram_arbiter.runner.sim.worlds import World

log = logging.getLogger("runner")

REPORT = "benchmark.json"
COLUMNS = ("world", "contestant", "success", "95 % interval", "steps", "reward", "errors")


def add_parser(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner benchmark`."""
    bench = commands.add_parser(
        "benchmark", help="success rates of skills and policies, with videos"
    )
    bench.add_argument(
        "--env",
        action="append",
        default=[],
        help="so101 (default) or gym:ID; may be given several times",
    )
    bench.add_argument(
        "--scene",
        type=Path,
        action="append",
        default=[],
        help="scene file of so101; may be given several times",
    )
    bench.add_argument(
        "--env-config", type=Path, help="how the gymnasium environment is to be read"
    )
    bench.add_argument(
        "--success", metavar="RULE", help="of a gymnasium environment: info:KEY or return:NUMBER"
    )
    bench.add_argument(
        "--task", help="in so101: grab or navigate; by default what the skill's actions say"
    )
    bench.add_argument(
        "--skill",
        action="append",
        default=[],
        help="an installed skill; may be given several times",
    )
    bench.add_argument(
        "--policy", action="append", default=[],
        help="random, scripted:MODULE, scripted:FILE.py or, for grabs in so101, expert; repeatable",
    )  # fmt: skip
    bench.add_argument("--episodes", type=positive_int, default=10, help="seeds a cell; default 10")
    bench.add_argument("--seed", type=int, default=0, help="the first one")
    bench.add_argument(
        "--max-steps",
        type=positive_int,
        default=600,
        help="of an episode; default 600, 20 s of the SO-101",
    )
    bench.add_argument(
        "--episode-seconds",
        type=positive,
        default=600.0,
        help="of an episode, on the wall; default 600",
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
    bench.add_argument("--no-arbiter", action="store_true", help="run without arbiter and leases")
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
        entries = entries_of(args, arbiter)
        check_output("--out", args.out / REPORT)
        if args.videos:
            check_output("--out", args.out / "videos" / "any")
        need("a benchmark", "numpy", "cv2", extra="runner")  # behind what is wrong with the flags
        await asyncio.to_thread(warm_up)
        stopping = asyncio.Event()
        install_signals(stopping)
        cells: list[Cell] = []
        for entry in entries:
            if stopping.is_set():
                break
            cells.append(await _play(entry, args, stopping))
            _write(args, cells, complete=False)
    complete = len(cells) == len(entries) and all(cell.complete for cell in cells)
    _write(args, cells, complete=complete)
    print(printable_lines(table([cell.summary() for cell in cells])))
    print(f"{args.out / REPORT}")
    return 0 if complete and not any(cell.errors for cell in cells) else 1


async def _play(entry: Entry, args: argparse.Namespace, stopping: asyncio.Event) -> Cell:
    bench = _benchmark(entry, args)
    watching = asyncio.create_task(_stop_with(stopping, bench))
    try:
        return await bench.run(entry.contestant(), range(args.seed, args.seed + args.episodes))
    finally:
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)


async def _stop_with(stopping: asyncio.Event, bench: Benchmark) -> None:
    await stopping.wait()
    bench.stop()


def _benchmark(entry: Entry, args: argparse.Namespace) -> Benchmark:
    from vram_arbiter.runner.sim.benchmark import Benchmark
    from vram_arbiter.runner.sim.robot import sim_runner

    world, task, arm = entry.world, entry.task, entry.world.arm

    def told() -> Told:
        return ("", {}) if arm is None or task is None else task.told(arm)

    if arm is not None and task is not None and world.environment is not None:
        prepare = task.prepare
        world.environment.about(
            prepare=None if prepare is None else lambda seed: prepare(arm, seed),
            judge=lambda: task.judge(arm),
            steady=task.steady,
        )
    runner = sim_runner(
        world.make,
        cameras=world.cameras,
        rate_hz=0,
        max_steps=args.max_steps,
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
    from vram_arbiter.runner.skills.sidecar_policy import LOCKSTEP_WAIT_S

    if not args.skill and not args.policy:
        raise ConfigError(
            "there are no contestants", hint="--skill RSKILL or --policy random, any number of them"
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
        makers = makers_of(world, given, arbiter, period_s=1.0 / CONTROL_HZ, wait_s=LOCKSTEP_WAIT_S)
        catalogue = Catalogue(manifests, makers, refused=refused, body=world.body)
        for name in dict.fromkeys(args.skill):
            _, make, manifest = catalogue.find(name)
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


# -- what comes of it
def _write(args: argparse.Namespace, cells: Sequence[Cell], *, complete: bool) -> None:
    """After every cell, whole or not at all: a run that is killed leaves the cells before."""
    report = {
        "format": "vram-benchmark/1",
        "complete": complete,
        "seeds": [args.seed, args.seed + args.episodes - 1],
        "max_steps": args.max_steps,
        "cells": [
            cell.summary() | {"episodes": [dataclasses.asdict(played) for played in cell.episodes]}
            for cell in cells
        ],
    }
    target = args.out / REPORT
    beside = target.with_suffix(".new")
    try:
        beside.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        os.replace(beside, target)
    except OSError as error:
        raise ConfigError(f"{target} cannot be written: {error}") from error


def table(rows: Sequence[CellSummary]) -> str:
    """Format the cells as a table."""
    lines = [COLUMNS, *(_row(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(COLUMNS))]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def _row(row: CellSummary) -> tuple[str, ...]:
    interval = row["interval_95"]
    rate = row["success_rate"]
    task = f" ({row['task']})" if row["task"] else ""
    return (
        row["world"] + task,
        row["contestant"],
        "not judged" if rate is None else f"{row['successes']}/{row['judged']} = {rate:.0%}",
        "" if interval is None else f"{interval[0]:.0%} to {interval[1]:.0%}",
        "" if row["mean_steps"] is None else f"{row['mean_steps']:.1f}",
        "" if row["mean_reward"] is None else f"{row['mean_reward']:.2f}",
        f"{row['errors']}" + ("" if row["complete"] else f"; not complete: {row['why']}"),
    )
