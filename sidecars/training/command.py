"""Command line of a training program: data in, checkpoint out, figures on stdout."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vram_arbiter.sidecars.training.common import BadDataset

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from vram_arbiter.schemas.plain import JsonObject

type Run[R] = Callable[[R, Path, Path, Path | None], JsonObject]
"""Recipe, data, checkpoint to write, checkpoint to continue → figures."""


def run_command[R: DataclassInstance](
    argv: Sequence[str] | None,
    prog: str,
    description: str | None,
    recipes: tuple[R, R],
    limits: Mapping[str, tuple[str, str, type]],
    run: Run[R],
) -> int:
    """Run the command line; return 2 for a folder that is not a data set.

    Args:
        recipes: the full run's and that of `--smoke`.
        limits: flag → field of the recipe, help and type; not given, the recipe's holds.
    """
    parser = argparse.ArgumentParser(prog=prog, description=description)
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder with labels.jsonl and images")
    add("--out", type=Path, required=True, help="folder for the checkpoint")
    add("--start-from", type=Path, help="checkpoint of this script to continue")
    for flag, (field, text, kind) in limits.items():
        add(flag, dest=field, type=kind, help=text)
    add("--smoke", action="store_true", help="toy size, a few seconds: checks that all code runs")
    full, smoke = recipes
    for field in ("seed", "threads"):
        add(f"--{field}", type=int, default=getattr(full, field))
    args = parser.parse_args(argv)
    chosen = ("seed", "threads", *(field for field, _, _ in limits.values()))
    given = {name: value for name in chosen if (value := getattr(args, name)) is not None}
    recipe = dataclasses.replace(smoke if args.smoke else full, **given)
    try:
        figures = run(recipe, args.data, args.out, args.start_from)
    except BadDataset as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(json.dumps(figures, indent=2))
    return 0
