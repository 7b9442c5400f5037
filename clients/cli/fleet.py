"""`vramctl fleet`: the boxes of a Ray cluster in one view, and where a model would be placed."""

import argparse
import contextlib
import json
import os
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Final

from vram_arbiter.clients.cli import text
from vram_arbiter.clients.cli.arguments import add_json, at_least, name, size
from vram_arbiter.clients.cli.replies import NO, OK
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.runtime.printable import makes_printable, printable
from vram_arbiter.schemas.sizes import format_bytes

if TYPE_CHECKING:
    from vram_arbiter.clients.ray import Fleet

DESCRIPTIONS = {
    "fleet": "See the boxes of a Ray cluster, each with its own arbiter, and where a model would "
    "be placed. A box whose agent or arbiter does not answer is unknown. Needs the extra `ray`."
}
ACTIONS: Final = {
    "status": "Show each box: bytes free, evictable and in its budget, models, and waiters. Exits "
    "1 if one is unknown.",
    "top": "Show the same again and again, until Ctrl-C.",
    "why": "Explain on each box why CONSUMER is not running. Exits 1 if no box knows it.",
    "place": "Show in which order boxes would be tried for a model, each with its reason. Exits 1 "
    "if none may be.",
}
ADDRESS: Final = "RAY_ADDRESS"
CLEAR: Final = "\x1b[H\x1b[2J"
UNKNOWN: Final = "unknown"
WARM: Final = "{model} is {reason} there, and another copy fits: {free} free"
REASONS: Final = {
    "resident": WARM,
    "parked": WARM,
    "free": "it fits: {free} free",
    "evictable": "it fits after evictions: {free} free, {evictable} evictable",
    "busy": "it has to wait: {free} free, {evictable} evictable",
    "unknown": "never placed there: its arbiter or its reading is missing or old",
    "too_small": "its budget is {budget}",
}
"""By the code of `placement.Reason`."""


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    commands = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    made = {
        action: commands.add_parser(action, help=told, description=told)
        for action, told in ACTIONS.items()
    }
    for one in made.values():
        one.add_argument(
            "--ray",
            metavar="ADDRESS",
            default=os.environ.get(ADDRESS, "auto"),
            help=f"of the Ray cluster (environment: {ADDRESS}; default: the one of this machine)",
        )
    for action in ("status", "why", "place"):
        add_json(made[action])
    made["top"].add_argument(
        "--every", type=at_least(0.5), default=2.0, metavar="S", help="seconds (default: 2)"
    )
    made["why"].add_argument("consumer", metavar="CONSUMER", type=name)
    made["place"].add_argument("--vram", type=size, required=True, metavar="SIZE")
    made["place"].add_argument("--model", type=name, required=True)


def run(args: argparse.Namespace) -> int:
    from vram_arbiter.clients.ray.fleet import connected

    with connected(args.ray) as fleet:
        return _ACTIONS[args.action](fleet, args)


def _named(fleet: "Fleet", key: str, answers: Mapping[str, object]) -> list[Message]:
    """Return the answers with their boxes, in the order of names; None: unknown."""
    names = fleet.boxes()
    boxes = [
        {"node": node, "box": names.get(node, node), key: answer}
        for node, answer in answers.items()
    ]
    return sorted(boxes, key=lambda one: (one["box"], one["node"]))


# -- status
def _status(fleet: "Fleet", args: argparse.Namespace) -> int:
    boxes = _boxes(fleet)
    _show(args, {"boxes": boxes}, _status_lines(boxes))
    return OK if all(one["view"] for one in boxes) else NO


def _top(fleet: "Fleet", args: argparse.Namespace) -> int:
    ever = threading.Event()
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            lines = _status_lines(_boxes(fleet))
            print(CLEAR * sys.stdout.isatty() + "\n".join(lines), flush=True)
            ever.wait(args.every)
    return OK


def _boxes(fleet: "Fleet") -> list[Message]:
    boxes = _named(fleet, "view", fleet.views())
    for one in boxes:
        if one["view"] is not None:
            one["view"] = asdict(one["view"])
            del one["view"]["at"]  # on a clock that only this process has
    return boxes


def _status_lines(boxes: Sequence[JsonMap]) -> list[str]:
    columns = ("BOX", "GPU", "FREE", "EVICTABLE", "BUDGET", "WAITING", "MODELS")
    rows = [row for one in boxes for row in _rows(one["box"], one["view"])]
    unknown = sum(one["view"] is None for one in boxes)
    return [f"boxes: {len(boxes)}, {unknown} {UNKNOWN}", "", *text.table(columns, rows)]


def _rows(box: str, view: JsonMap | None) -> Iterator[tuple[str, ...]]:
    """Yield a row for each GPU; what is of the box stands in the first."""
    if view is None:
        yield (box, "", UNKNOWN, "", "", "", "")
        return
    models = ", ".join(f"{model} ({state})" for model, state in sorted(view["resident"].items()))
    of_box = (str(view["waiting"]), models)
    for index, gpu in enumerate(view["gpus"]):
        free = UNKNOWN if gpu["free_bytes"] is None else format_bytes(gpu["free_bytes"])
        sizes = (format_bytes(gpu["evictable_bytes"]), format_bytes(gpu["budget_bytes"]))
        yield ("" if index else box, str(index), free, *sizes, *of_box)
        of_box = ("", "")


# -- why
def _why(fleet: "Fleet", args: argparse.Namespace) -> int:
    boxes = _named(fleet, "why", fleet.why(args.consumer))
    known = [one for one in boxes if one["why"] and one["why"]["leases"]]
    lines: list[str] = []
    for one in known:
        lines += [
            f"{printable(one['box'])}:",
            *(f"  {line}" for line in text.why_lines(one["why"])),
        ]
    lines += [f"{printable(one['box'])}: {UNKNOWN}" for one in boxes if one["why"] is None]
    if not known:
        lines.append(f"no box that answers knows {printable(args.consumer)}")
    _show(args, {"boxes": boxes}, lines)
    return OK if known else NO


# -- place
def _place(fleet: "Fleet", args: argparse.Namespace) -> int:
    ranked = fleet.order(args.vram, args.model)
    order = [asdict(one) for one in ranked]
    _show(args, {"order": order}, _place_lines(order, args.model))
    return OK if any(one.usable for one in ranked) else NO


@makes_printable
def _place_lines(order: Sequence[JsonMap], model: str) -> list[str]:
    lines = []
    for number, one in enumerate(order, 1):
        sizes = {
            part: format_bytes(one[f"{part}_bytes"] or 0)
            for part in ("free", "evictable", "budget")
        }
        told = REASONS[one["reason"]].format(model=model, reason=one["reason"], **sizes)
        queue = f", {text.plural(one['waiting'], 'waiter')}" if one["waiting"] else ""
        lines.append(f"{number}. {one['box']}: {told}{queue}")
    return lines


def _show(args: argparse.Namespace, reply: JsonMap, lines: Sequence[str]) -> None:
    print(json.dumps(reply, indent=2) if args.as_json else "\n".join(lines))


_ACTIONS: Final = {"status": _status, "top": _top, "why": _why, "place": _place}
