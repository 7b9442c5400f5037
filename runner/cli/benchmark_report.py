"""What comes of a benchmark: its report as JSON, and its table."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.plain import JsonMap

if TYPE_CHECKING:
    from vram_arbiter.runner.sim.benchmark import Cell

REPORT = "benchmark.json"
MAX_STEPS = 600  # of an episode, 20 s, where --max-steps does not say
COLUMNS = ("world", "contestant", "success", "95 % interval", "steps", "errors")


def write_report(args: argparse.Namespace, cells: Sequence[Cell], *, complete: bool) -> None:
    """Write the cells whole or not at all, after every cell: a run that is killed leaves the cells
    before. Raises ConfigError.
    """
    target: Path = args.out / REPORT
    report = {
        "format": "vram-benchmark/2",
        "complete": complete,
        "seeds": (args.seed, args.seed + args.episodes - 1),
        "max_steps": args.max_steps,
        "latency": "real time" if args.real_time else args.latency_steps,
        "cells": [
            {
                **cell.summary(),
                "episodes": [dataclasses.asdict(played) for played in cell.episodes],
            }
            for cell in cells
        ],
    }
    beside = target.with_suffix(".new")
    try:
        beside.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        os.replace(beside, target)
    except OSError as error:
        raise ConfigError(f"{target} cannot be written: {error}") from error


def table(rows: Sequence[JsonMap]) -> str:
    """Format the cells as a table."""
    lines = [COLUMNS, *(_row(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(COLUMNS))]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def _row(row: JsonMap) -> tuple[str, ...]:
    interval = row["interval_95"]
    rate = row["success_rate"]
    task = f" ({row['task']})" if row["task"] else ""
    return (
        row["world"] + task,
        row["contestant"],
        "no verdict" if rate is None else f"{row['successes']}/{row['judged']} = {rate:.0%}",
        "" if interval is None else f"{interval[0]:.0%} to {interval[1]:.0%}",
        "" if row["mean_steps"] is None else f"{row['mean_steps']:.1f}",
        f"{row['errors']}" + ("" if row["complete"] else f"; not complete: {row['why']}"),
    )
