"""Folder of a run (`--out`): the flags that its results follow from, and a result a seed.

A run that ended anyhow goes on with the same command. Must not know who plays.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from vram_arbiter.clients.results import commit, committed
from vram_arbiter.runner.benchmark.entries import VIDEOS, Entry
from vram_arbiter.runner.benchmark.outcomes import Cell, SeedOutcome
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.plain import JsonMap, JsonObject

RUN = "run.json"
RESULTS = "results"


def flags_of(args: argparse.Namespace, entries: Sequence[Entry]) -> JsonObject:
    """Return the flags that results follow from, with what the files are that they name."""
    revisions = {entry.name: entry.revision for entry in entries}
    return {
        "--skill": {name: revisions[name] for name in args.skill},
        "--policy": {name: _digest(Path(name.partition(":")[2])) for name in args.policy},
        "--scene": {str(scene): _digest(scene) for scene in args.scene},
        "--task": args.task,
        "--seed": args.seed,
        "--episodes": args.episodes,
        "--max-steps": args.max_steps,
        "--latency-steps": args.latency_steps,
        "--real-time": args.real_time,
        "--record": args.record and str(args.record),
    }


def claim(out: Path, flags: JsonMap) -> None:
    """Let the folder be that of a run with these flags, or find that it is.

    Raises ConfigError where it is of other flags, or cannot be written.
    """
    path = out / RUN
    beside = path.with_suffix(f".{os.getpid()}")
    try:
        beside.write_text(json.dumps(flags, indent=1) + "\n", encoding="utf-8")
        try:
            if not any((out / RESULTS).glob("*/*.json")):
                path.unlink(missing_ok=True)  # nothing follows from its flags
            os.link(beside, path)
        except FileExistsError:
            _compare(path, flags)
        finally:
            beside.unlink()
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from error


def take_up(out: Path, cell: Cell) -> Path:
    """Give a cell what was played before, and return the folder of its results.

    Results without a verdict are removed: their seeds are played again.
    """
    folder = out / RESULTS / cell.name
    read(folder, cell)
    for played in cell.episodes:
        if played.success is None:
            (folder / f"{played.seed:05d}.json").unlink()
    cell.episodes = [played for played in cell.episodes if played.success is not None]
    return folder


def keep(folder: Path, played: SeedOutcome) -> None:
    """Commit an outcome, unless its seed has one. Raises ConfigError."""
    try:
        commit(folder, played.seed, asdict(played))
    except OSError as error:
        raise ConfigError(f"{folder} cannot be written: {error}") from error


def read(folder: Path, cell: Cell) -> None:
    """Give a cell the results of its folder, in the order of seeds. Raises ConfigError."""
    try:
        cell.episodes = [SeedOutcome(**told) for told in committed(folder).values()]
    except TypeError as error:
        raise ConfigError(f"{folder} has results of another version: {error}") from None


def tidy(out: Path) -> None:
    """Remove the videos of episodes that did not end."""
    for path in (out / VIDEOS).glob(".*.mp4"):
        path.unlink(missing_ok=True)


def _compare(path: Path, flags: JsonMap) -> None:
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        differing = [name for name in flags if earlier.get(name) != flags[name]]
    except (ValueError, AttributeError) as error:
        raise ConfigError(f"{path} does not describe a run: {error}") from None
    if differing:
        told = "; ".join(
            f"{name} {_said(earlier, name)}, not {_said(flags, name)}" for name in differing
        )
        raise ConfigError(
            f"{path.parent} has results of another run: {told}",
            hint="name another --out, or remove that folder",
        )


def _said(flags: JsonMap, name: str) -> str:
    return json.dumps(flags.get(name))


def _digest(path: Path) -> str | None:
    """Return what a file is told by; None without one."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else None
