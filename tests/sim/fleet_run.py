"""A fleet on paper: `python -m tests.sim.fleet_run --boxes 1000` places models by `placement.rank`
on boxes that exist only here, and prints what becomes of it.

Boxes have one GPU with leases of fifty models; a placed model stays HOLD_S on average. Who places
sees the boxes as they were up to `stale_s` ago. A placement that finds its GPU full waits there.
Each row compares the order's first box with two random choices among equals, with an order that
puts boxes with the model first although no copy fits beside it, and with one that asks for room
alone.
"""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Final

from vram_arbiter.clients.ray.placement import Ranked, Reason, Room, View, rank
from vram_arbiter.schemas.defaults import GIB

MODELS: Final = 50
HOLD_S: Final = 60.0
BOARDS: Final = 4
type Choose = Callable[[Mapping[str, View | None], int, str, float, Random], str | None]


@dataclass(slots=True)
class Box:
    """A GPU: leases as (end, model, bytes), and placements that wait for room."""

    name: str
    size_bytes: int
    leases: list[tuple[float, str, int]] = field(default_factory=list)
    waiting: list[tuple[float, str, int]] = field(default_factory=list)

    @property
    def free_bytes(self) -> int:
        return self.size_bytes - sum(size for _, _, size in self.leases)

    def advance(self, now: float) -> None:
        """End leases, and let those in that have waited longest."""
        for lease in sorted(self.leases):
            if lease[0] <= now:
                self.leases.remove(lease)
                while self.waiting and self.waiting[0][2] <= self.free_bytes:
                    hold_s, model, size = self.waiting.pop(0)
                    self.leases.append((lease[0] + hold_s, model, size))

    def place(self, now: float, hold_s: float, model: str, size: int) -> bool:
        """Return whether it waits."""
        if waits := bool(self.waiting) or size > self.free_bytes:
            self.waiting.append((hold_s, model, size))
        else:
            self.leases.append((now + hold_s, model, size))
        return waits

    def view(self, at: float) -> View:
        resident = dict.fromkeys((model for _, model, _ in self.leases), "held")
        room = Room(self.free_bytes, self.size_bytes)
        return View(self.name, (room,), resident, len(self.waiting), at)


@dataclass(frozen=True, slots=True)
class Story:
    """A load. `placements` and `per_s`: for each box. `hot`: share of them that ask for one model.
    `dead`: of BOARDS, each with its share of the boxes, which are unknown then. `herd`: all
    placements come at one moment."""

    name: str
    placements: float = 2.0
    per_s: float = 0.05
    hot: float = 0.0
    stale_s: float = 1.0
    dead: int = 0
    herd: bool = False


STORIES: Final = (
    Story("asked", stale_s=0.5),
    Story("boards", stale_s=1.0),
    Story("dead board", stale_s=1.0, dead=1),
    Story("stale views", stale_s=2.9),
    Story("hot model", hot=0.5),
    Story("herd", placements=0.2, herd=True),
    Story("hot herd", placements=0.2, herd=True, hot=1.0),
)
"""`asked`: a driver asks 1,000 agents within half a second (measured: 0.5 ms each). `boards`:
agents would push their views to BOARDS actors each second."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """`most`: placements on one box within one view; `waited`: share that found no room; `warm`:
    share on a box with the model; `unplaced`: placements for which no box was usable."""

    most: int
    waited: float
    warm: float
    unplaced: int


def two_choices(
    views: Mapping[str, View | None], need: int, model: str, now: float, rng: Random
) -> str | None:
    best = rank(views, need, model, now, rng)[0]
    return best.node if best.usable else None


def first(
    views: Mapping[str, View | None], need: int, model: str, now: float, rng: Random
) -> str | None:
    """The same order, without a choice: ties go to the emptiest box, then to its name."""
    ranked = [one for one in rank(views, need, model, now, rng) if one.usable]
    return min(ranked, key=_strict).node if ranked else None


def model_first(
    views: Mapping[str, View | None], need: int, model: str, now: float, rng: Random
) -> str | None:
    """Two choices among the boxes that have the model, with or without room beside it."""
    warm = {node: view for node, view in views.items() if view and model in view.resident}
    return (
        two_choices(warm, need, model, now, rng)
        if warm
        else two_choices(views, need, model, now, rng)
    )


def room_alone(
    views: Mapping[str, View | None], need: int, model: str, now: float, rng: Random
) -> str | None:
    """Two choices among the boxes with room, whatever models they have."""
    return two_choices(views, need, "", now, rng)


def _strict(one: Ranked) -> tuple[int, int, int, str]:
    return list(Reason).index(one.reason), one.waiting, -(one.free_bytes or 0), one.node


def play_story(story: Story, choose: Choose, boxes: int, seed: int) -> Outcome:
    rng = Random(seed)
    fleet = {
        f"{number:04d}": Box(f"{number:04d}", rng.choice((8, 12, 16, 24)) * GIB)
        for number in range(boxes)
    }
    now = 0.0
    for box in fleet.values():  # half full, as it would be met
        while box.free_bytes > box.size_bytes // 2:
            box.place(now, rng.expovariate(1 / HOLD_S), f"m{rng.randrange(MODELS)}", 2 * GIB)
    views: dict[str, View | None] = {}
    seen_s = -story.stale_s
    within, most, waited, warm, unplaced = Counter[str](), 0, 0, 0, 0
    placements = round(story.placements * boxes)
    for _ in range(placements):
        if not views or now - seen_s >= story.stale_s:
            seen_s, within = now, Counter()
            for number, (name, box) in enumerate(fleet.items()):
                box.advance(now)
                views[name] = None if number % BOARDS < story.dead else box.view(now)
        model = "m0" if rng.random() < story.hot else f"m{rng.randrange(MODELS)}"
        need = rng.choice((2, 3, 5)) * GIB
        node = choose(views, need, model, now, rng)
        if node is None:
            unplaced += 1
            continue
        within[node] += 1
        most = max(most, within[node])
        fleet[node].advance(now)
        warm += any(held == model for _, held, _ in fleet[node].leases)
        waited += fleet[node].place(now, rng.expovariate(1 / HOLD_S), model, need)
        now += 0.0 if story.herd else rng.expovariate(story.per_s * boxes)
    return Outcome(most, waited / placements, warm / placements, unplaced)


POLICIES: Final[Mapping[str, Choose]] = {
    "first": first,
    "two choices": two_choices,
    "model first": model_first,
    "room alone": room_alone,
}


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.sim.fleet_run", description=__doc__)
    parser.add_argument("--boxes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    print(f"{'story':18}{'policy':14}{'most on a box':>14}{'waited':>9}{'warm':>8}{'s':>7}")
    for story in STORIES:
        for name, choose in POLICIES.items():
            begun = time.perf_counter()
            told = play_story(story, choose, args.boxes, args.seed)
            took = time.perf_counter() - begun
            figures = f"{told.most:14}{told.waited:9.1%}{told.warm:8.1%}{took:7.1f}"
            print(f"{story.name:18}{name:14}{figures}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
