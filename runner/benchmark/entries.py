"""What a benchmark plays: every contestant in every world, by the flags of its command line."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vram_arbiter.runner.benchmark.outcomes import Cell
from vram_arbiter.runner.cli.common import (
    check_sidecars,
    default_skills,
    sidecars_given,
    unlicensed,
)
from vram_arbiter.schemas.errors import ConfigError

if TYPE_CHECKING:
    from vram_arbiter.runner.benchmark.player import Player, Told
    from vram_arbiter.runner.protocols import Skill
    from vram_arbiter.runner.sim.arm_env import ArmEnvironment
    from vram_arbiter.runner.sim.tasks import Task

SO101 = "so101"
VIDEOS = "videos"
"""Folder of the videos below `--out`."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One cell to be played: a contestant in a world, made when its turn comes."""

    world: ArmEnvironment
    world_name: str
    name: str
    revision: str
    task: Task
    skill: Callable[[], Skill]

    def cell(self) -> Cell:
        return Cell(self.world_name, self.name, self.task.name, self.revision)


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
            key, make, manifest = catalogue.find(name)
            task = given_task or task_of(manifest)
            entries.append(Entry(world, world_name, name, key.revision, task, make))
        for name, begin in policies.items():
            policy = functools.partial(PolicySkill, name, begin, world)
            entries.append(Entry(world, world_name, name, "", given_task or GRAB, policy))
    _check_names(entries)
    return entries


def _check_names(entries: Sequence[Entry]) -> None:
    """Raise ConfigError for cells with the same name: their files would be the same."""
    taken: dict[str, Entry] = {}
    for entry in entries:
        other = taken.setdefault(entry.cell().name, entry)
        if other is not entry:
            raise ConfigError(
                f"{entry.world_name}, {entry.name} and {other.world_name}, {other.name}"
                " would have one name",
                hint="rename one of the files, or run them one after another with an --out each",
            )


def player_of(entry: Entry, args: argparse.Namespace) -> Player:
    """Return the player of an entry's world, task and skill."""
    from vram_arbiter.runner.benchmark.player import Player
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
    return Player(
        runner,
        entry.skill(),
        world=entry.world_name,
        told=told,
        videos=args.out / VIDEOS if args.videos else None,
        episode_s=args.episode_seconds,
    )
