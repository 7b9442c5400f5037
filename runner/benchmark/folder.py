"""Folder of a run (`--out`): the flags that its results follow from, and a result a seed.

A run that ended anyhow goes on with the same command. Must not know who plays.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

from vram_arbiter.clients.cli.files import replace
from vram_arbiter.clients.results import commit, committed
from vram_arbiter.runner.benchmark.entries import VIDEOS, Entry
from vram_arbiter.runner.benchmark.outcomes import Cell, SeedOutcome
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.plain import JsonMap, JsonObject

RUN = "run.json"
RESULTS = "results"
ANOTHER = "name another --out, or remove that folder"
NUMBERS = ("task", "seed", "episodes", "max_steps", "latency_steps", "real_time")
"""Flags that results follow from, as they are."""

Tell = Callable[[SeedOutcome], None]
"""Called with each outcome once it is committed."""


def flags_of(args: argparse.Namespace, entries: Sequence[Entry]) -> JsonObject:
    """Return the flags that results follow from, with what the files are that they name."""
    revisions = {entry.name: entry.revision for entry in entries}
    return {
        "--skill": {name: revisions[name] for name in args.skill},
        "--policy": {name: _digest(Path(name.partition(":")[2])) for name in args.policy},
        "--scene": {str(scene): _digest(scene) for scene in args.scene},
        "--record": args.record and str(args.record),
    } | {f"--{name.replace('_', '-')}": getattr(args, name) for name in NUMBERS}


def claim(out: Path, flags: JsonMap) -> None:
    """Let the folder be that of a run with these flags, or find that it is.

    Raises ConfigError where it is of other flags, or cannot be written.
    """
    path, differing = out / RUN, list[str]()
    try:
        if any((out / RESULTS).glob("*/*.json")):
            earlier = json.loads(path.read_text(encoding="utf-8"))
            differing = [
                f"{name} {json.dumps(earlier[name])}, not {json.dumps(value)}"
                for name, value in flags.items()
                if earlier[name] != value
            ]
        else:
            replace(path, json.dumps(flags, indent=1) + "\n")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is not of a run: {error}", hint=ANOTHER) from error
    if differing:
        raise ConfigError(f"{out} has results of another run: {'; '.join(differing)}", hint=ANOTHER)


def take_up(out: Path, cell: Cell, seeds: Iterable[int]) -> list[int]:
    """Return the seeds that are left to play. Results without a verdict are removed."""
    read(out, cell)
    for played in cell.episodes:
        if played.success is None:
            (results(out, cell) / f"{played.seed:05d}.json").unlink()
    judged = {played.seed for played in cell.episodes if played.success is not None}
    return [seed for seed in seeds if seed not in judged]


def results(out: Path, cell: Cell) -> Path:
    """Return the folder of a cell's results."""
    return out / RESULTS / cell.name


def keep(folder: Path, played: SeedOutcome) -> None:
    """Commit an outcome, unless its seed has one. Raises ConfigError."""
    try:
        commit(folder, played.seed, asdict(played))
    except OSError as error:
        raise ConfigError(f"{folder} cannot be written: {error}") from error


def read(out: Path, cell: Cell) -> None:
    """Give a cell its results, in the order of seeds. Raises ConfigError."""
    folder = results(out, cell)
    try:
        cell.episodes = [SeedOutcome(**told) for told in committed(folder).values()]
    except TypeError as error:
        raise ConfigError(f"{folder} has results of another version: {error}") from None


def tidy(out: Path) -> None:
    """Remove the videos of episodes that did not end."""
    for path in (out / VIDEOS).glob(".*.mp4"):
        path.unlink(missing_ok=True)


def _digest(path: Path) -> str | None:
    """Return what a file is told by; None without one."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else None
