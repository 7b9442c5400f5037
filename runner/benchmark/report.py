"""What comes of a benchmark: its report as JSON and as a page, and its table."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence

from vram_arbiter.clients.cli import text
from vram_arbiter.clients.cli.files import replace
from vram_arbiter.runner.benchmark.outcomes import Cell
from vram_arbiter.runner.benchmark.page import page, words
from vram_arbiter.schemas.errors import ConfigError

REPORT = "benchmark.json"
PAGE = "report.html"
MAX_STEPS = 600  # of an episode, 20 s, where --max-steps does not say
COLUMNS = ("world", "contestant", "success", "95 % interval", "steps", "errors")


def write_report(args: argparse.Namespace, cells: Sequence[Cell], *, complete: bool) -> None:
    """Write the cells whole or not at all, after every cell. Raises ConfigError."""
    last = args.seed + args.episodes - 1
    about = {
        "complete": complete,
        "seeds": (args.seed, last),
        "max_steps": args.max_steps,
        "latency": "real time" if args.real_time else args.latency_steps,
    }
    told = [
        {**cell.summary(), "episodes": [dataclasses.asdict(played) for played in cell.episodes]}
        for cell in cells
    ]
    report = {"format": "vram-benchmark/3", **about, "cells": told}
    try:
        replace(args.out / REPORT, json.dumps(report, indent=1) + "\n")
        replace(args.out / PAGE, page(about | {"seeds": f"{args.seed} to {last}"}, cells))
    except OSError as error:
        raise ConfigError(f"{args.out} cannot be written: {error}") from error


def table(cells: Sequence[Cell]) -> str:
    """Format the cells as a table."""
    return "\n".join(text.table(COLUMNS, [words(cell) for cell in cells]))
