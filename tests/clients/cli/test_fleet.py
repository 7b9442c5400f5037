"""What `vramctl fleet` says of boxes that answer and of one that does not, on a fleet of paper."""

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from random import Random
from typing import Any

import pytest

from vram_arbiter.clients.cli import fleet as command
from vram_arbiter.clients.cli.main import command_parser
from vram_arbiter.clients.ray.placement import Ranked, Room, View, rank
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.plain import Message

VIEWS: Mapping[str, View | None] = {
    "node-b": View("b", (Room(6 * GIB, 8 * GIB, 2 * GIB), Room(None, GIB)), {"pi0": "held"}, 1),
    "node-a": View("a", (Room(GIB, 4 * GIB, GIB),), {}, 0),
    "node-c": None,
}
WHY: Message = {"consumer": "grab", "leases": [{"lease_id": "L1-1", "state": "held", "text": "ok"}]}


class PaperFleet:
    """Answers as `Fleet` does, of VIEWS."""

    def boxes(self) -> dict[str, str]:
        return {"node-a": "a", "node-b": "b", "node-c": "c"}

    def views(self) -> dict[str, View | None]:
        return dict(VIEWS)

    def why(self, consumer: str) -> dict[str, Message | None]:
        known = (
            {**WHY, "footprint": None}
            if consumer == "grab"
            else {"consumer": consumer, "leases": []}
        )
        return {"node-a": {"consumer": consumer, "leases": []}, "node-b": known, "node-c": None}

    def order(self, need_bytes: int, model: str) -> list[Ranked]:
        ranked = rank(VIEWS, need_bytes, model, 0.0, Random(0))
        return [replace(one, box=self.boxes()[one.node]) for one in ranked]


Run = Callable[..., tuple[int, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """`run(*words)` returns the exit code and what was printed."""

    def run(*words: str) -> tuple[int, str]:
        args: argparse.Namespace = command_parser("fleet").parse_args(words)
        fleet: Any = PaperFleet()
        code = command._ACTIONS[args.action](fleet, args)
        return code, capsys.readouterr().out

    return run


def test_status_has_a_row_for_each_gpu_and_names_what_is_unknown(run: Run) -> None:
    assert run("status") == (1, """\
boxes: 3, 1 unknown

BOX  GPU  FREE     EVICTABLE  BUDGET  WAITING  MODELS
a    0    1 GiB    1 GiB      4 GiB         0
b    0    6 GiB    2 GiB      8 GiB         1  pi0 (held)
     1    unknown  0 B        1 GiB
c         unknown
""")  # fmt: skip
    boxes = json.loads(run("status", "--json")[1])["boxes"]
    assert [(one["box"], one["node"]) for one in boxes] == [
        ("a", "node-a"), ("b", "node-b"), ("c", "node-c"),
    ]  # fmt: skip
    assert boxes[2]["view"] is None
    assert "at" not in boxes[0]["view"]


def test_place_explains_its_order(run: Run) -> None:
    code, told = run("place", "--vram", "5GiB", "--model", "pi0")
    assert code == 0
    assert (
        told
        == """\
1. b: pi0 is resident there, and another copy fits: 6 GiB free, 1 waiter
2. c: never placed there: its arbiter or its reading is missing or old
3. a: its budget is 4 GiB
"""
    )
    (first, *_) = json.loads(run("place", "--vram", "5GiB", "--model", "pi0", "--json")[1])["order"]
    assert (first["reason"], first["free_bytes"]) == ("resident", 6 * GIB)
    assert run("place", "--vram", "20GiB", "--model", "pi0")[0] == 1


def test_why_names_the_boxes_that_know_a_consumer(run: Run) -> None:
    assert run("why", "grab") == (0, "b:\n  ok\n    lease     L1-1, held\nc: unknown\n")
    assert run("why", "nobody") == (1, "c: unknown\nno box that answers knows nobody\n")
