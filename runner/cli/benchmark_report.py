"""What comes of a benchmark: the report's file, and the table for people."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from vram_arbiter.runner.sim.benchmark import Cell, CellSummary
from vram_arbiter.schemas.errors import ConfigError

COLUMNS = ("world", "contestant", "success", "95 % interval", "steps", "reward", "errors")


def write_report(
    target: Path,
    cells: Sequence[tuple[Cell, int]],
    *,
    seeds: tuple[int, int],
    parallel: int,
    latency: int | Literal["real time"] | None,
    complete: bool,
) -> None:
    """Write the cells, each with its `max_steps`, whole or not at all. Raises ConfigError.

    `latency`: control steps that an answer took; None: until the actions before it were played.
    """
    report = {
        "format": "vram-benchmark/1",
        "complete": complete,
        "seeds": seeds,
        "parallel": parallel,
        "latency": latency,
        "cells": [
            {
                **cell.summary(),
                "max_steps": max_steps,
                "episodes": [dataclasses.asdict(played) for played in cell.episodes],
            }
            for cell, max_steps in cells
        ],
    }
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
