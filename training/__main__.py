"""Command line: `python -m training record KIND …` and `python -m training MODEL …`, in a clone."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from training import (
    detector,
    policy,
    progress,
    record_counter,
    record_grabs,
    record_progress,
    record_scenes,
    scene_vlm,
)
from training.common import BadInput, Recipe, Trainer, write_card
from vram_arbiter.schemas.plain import JsonObject

RECORDERS: Final = {
    "scenes": (record_scenes.record, "labeled frames, for detector and scene VLM"),
    "counter": (record_counter.record, "labeled frames of the Panda's wrist, for its scene VLM"),
    "grabs": (record_grabs.record, "demonstrations of the scripted expert, for the policy"),
    "progress": (record_progress.record, "grabs, two in five miss, for the progress model"),
}
TRAINERS: Final = {
    "detector": detector.TRAINER,
    "scene-vlm": scene_vlm.TRAINER,
    "policy": policy.TRAINER,
    "progress": progress.TRAINER,
}


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; a trainer's options are the numbers of its recipe."""
    parser = argparse.ArgumentParser(
        prog="python -m training", description="How the shipped models were made."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    record = commands.add_parser("record", help="record training data in the simulator")
    kinds = record.add_subparsers(dest="kind", required=True, metavar="KIND")
    for name, (recorder, text) in RECORDERS.items():
        kind = kinds.add_parser(name, help=text)
        kind.set_defaults(recorder=recorder)
        kind.add_argument("--count", type=int, required=True, help="frames, or tries")
        kind.add_argument("--seed", type=int, default=0, help="another seed, other scenes")
        kind.add_argument("--out", type=Path, required=True, help="folder for the data")
    kind = kinds.choices["grabs"]
    kind.add_argument("--policy", type=Path, help="checkpoint that drives while the expert labels")
    for name, trainer in TRAINERS.items():
        add = commands.add_parser(name, help=f"train {trainer.model}").add_argument
        add("--data", type=Path, nargs="+", required=True, help="folders of `record`")
        add("--out", type=Path, required=True, help="folder for the checkpoint")
        add("--start-from", type=Path, help="checkpoint of this trainer to continue")
        add("--smoke", action="store_true", help="toy sizes, seconds: checks that all code runs")
        for field, value in numbers(trainer.recipe).items():
            add(f"--{field.replace('_', '-')}", type=type(value), help=f"default {value}")
    return parser


def numbers(recipe: Recipe) -> dict[str, int | float]:
    """Return the numeric parameters of a recipe."""
    values = {field.name: getattr(recipe, field.name) for field in dataclasses.fields(recipe)}
    return {name: value for name, value in values.items() if isinstance(value, int | float)}


def train(trainer: Trainer, args: argparse.Namespace) -> JsonObject:
    """Train a model and write its card. Returns the figures; raises BadInput."""
    plan = trainer.smoke if args.smoke else trainer.recipe
    given = {name: getattr(args, name) for name in numbers(plan)}
    recipe = dataclasses.replace(plan, **{k: v for k, v in given.items() if v is not None})
    args.out.mkdir(parents=True, exist_ok=True)
    report = trainer.train(recipe, args.data, args.out, args.start_from)
    return write_card(args.out, trainer, recipe, report)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command: figures to stdout as JSON. Returns 2 for data or options that do not fit."""
    args = make_parser().parse_args(argv)
    began = time.monotonic()
    try:
        if args.command == "record":
            if args.count < 1:
                raise BadInput(f"--count must be above 0, got {args.count}")
            more = {"policy": args.policy} if "policy" in args else {}
            figures = args.recorder(args.out, args.count, args.seed, **more)
        else:
            figures = train(TRAINERS[args.command], args)
    except BadInput as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    seconds = round(time.monotonic() - began, 1)
    print(json.dumps({"out": str(args.out), **figures, "seconds": seconds}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
