"""Breadth-first search over the orders in which the actions of a world may happen.

`Search.run` explores one scenario: each state is known by its fingerprint, and how it is reached by
its first, shortest story. It ends with everything explored, at a limit, or at the first action that
raises. Whether each waiter can be served is told by the same graph: from every state a path of
`SERVE` actions leads to one in which no client waits, or the state itself comes there by hand
(`serve`).
"""

import gc
import random
import time
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from tests.explore.cloning import Freezer, Parts, thaw
from tests.explore.fingerprint import fingerprint
from tests.explore.world import Action, Scenario, World

SERVE: Final = (
    *("send", "hear", "connect", "die", "return", "read"),
    *("load", "ready", "end", "free", "leave", "tick", "sleep"),
)
"""What happens where nothing fails and no client wants anything new, the first that can."""
SERVE_STEPS_MAX = 400
SERVE_SHARE = 0.1
"""Of the time of a search that is cut: for serving those that wait at its edge."""
COLLECT_EVERY = 20
"""States between two collections of garbage: worlds hold circles, and memory that was used just now
is fast."""


@dataclass(slots=True)
class Report:
    """One search. `merged`: transitions to known states. `depth`: of the last layer that was met.
    `served`: states at the edge, by hand. `unproven`: states that may lead to no service, by want
    of time."""

    scenario: str
    states: int = 0
    transitions: int = 0
    merged: int = 0
    depth: int = 0
    complete: bool = False
    served: int = 0
    unproven: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    verbs: dict[str, int] = field(default_factory=dict)
    story: list[Action] = field(default_factory=list)
    error: str = ""

    def __str__(self) -> str:
        count = max(1, self.transitions)
        told = (
            f"{self.scenario:13}{self.states:10,} states{self.transitions:11,} transitions, "
            f"{self.merged / count:.0%} merged; depth {self.depth} "
            f"({'complete' if self.complete else 'cut'}), {self.unproven:,} unproven, "
            f"{count / self.wall_s:,.0f}/s, {count / self.cpu_s:,.0f} per s of CPU"
        )
        if not self.error:
            return told
        steps = "".join(f"\n{n:4}. {verb} {who}" for n, (verb, who) in enumerate(self.story, 1))
        again = f"play(SCENARIOS[{self.scenario!r}], {self.story!r})"
        return f"{told}{steps}\n      {self.error}\n{again}"


def play(scenario: Scenario, story: Iterable[Action]) -> World:
    """Return the world after a story. Raises what the last action raises."""
    world = World(scenario)
    for action in story:
        assert action in world.actions(), f"{action} cannot happen; {world.actions()} can"
        world.act(action)
    return world


def serve(world: World) -> bool:
    """Let happen what serves those that wait. Return whether none waits any more."""
    for step in range(1, SERVE_STEPS_MAX):
        if not _waits(world):
            return True
        verbs = SERVE if step % 15 else SERVE[::-1]  # so that time passes in any case
        able = {verb: (verb, whose) for verb, whose in world.actions()}
        world.act(next(able[verb] for verb in verbs if verb in able))
    return False


def _waits(world: World) -> bool:
    return any(client.is_waiting() for client in world.clients.values())


class Search:
    """States are numbered in the order in which they are met."""

    def __init__(self, scenario: Scenario) -> None:
        self.report = Report(scenario.name)
        self._world = World(scenario)
        self._freezer = Freezer()
        self._known: dict[int, int] = {}
        self._parents, self._steps = array("I"), array("H")
        self._actions: dict[Action, int] = {}  # by which number they are steps
        self._served = bytearray()  # 1: no client waits, or some path leads there
        self._edges = array("I")  # of SERVE actions: from, to, from, to, …

    def run(self, seconds: float, states_max: int = 1 << 31) -> Report:
        """Explore until everything is known, for some seconds, or up to a number of states."""
        report, began, cpu = self.report, time.perf_counter(), time.process_time()
        gc.disable()
        try:
            edge = self._explore(began + seconds * (1 - SERVE_SHARE), states_max)
            if not report.error:
                self._check_served(edge, began + seconds)
        finally:
            gc.unfreeze()
            gc.enable()
        report.complete, report.states = not edge, len(self._parents)
        report.wall_s, report.cpu_s = time.perf_counter() - began, time.process_time() - cpu
        return report

    def _explore(self, until: float, states_max: int) -> list[tuple[int, Parts]]:
        """Explore layer by layer. Return the states that are met and not explored."""
        report, world = self.report, self._world
        self._meet(world, 0, ("start", ""))
        layer, following = [(0, self._freezer.freeze(world, {}))], list[tuple[int, Parts]]()
        while layer:
            for place, (state, frozen) in enumerate(layer):
                if time.perf_counter() > until or len(self._parents) >= states_max or report.error:
                    return layer[place:] + following
                if state % COLLECT_EVERY == 0:
                    gc.collect()
                    gc.freeze()  # what waits in the layers is not looked at again
                self._expand(state, frozen, following)
            layer, following = following, []
            report.depth += bool(layer)
        return []

    def _expand(self, state: int, frozen: Parts, following: list[tuple[int, Parts]]) -> None:
        report, freezer, world = self.report, self._freezer, self._world
        for action in thaw(frozen, world).actions():
            thaw(frozen, world)
            try:
                world.act(action)
            except Exception as error:  # noqa: BLE001 - whatever it is, it is what is looked for
                self._fail([*self.story(state), action], f"{type(error).__name__}: {error}")
                return
            report.transitions += 1
            report.verbs[action[0]] = report.verbs.get(action[0], 0) + 1
            met, is_new = self._meet(world, state, action)
            if is_new:
                following.append((met, freezer.freeze(world, frozen)))
            else:
                report.merged += 1
            if action[0] in SERVE and met != state:
                self._edges.extend((state, met))

    def _meet(self, world: World, parent: int, action: Action) -> tuple[int, bool]:
        """Return the number of a state, and whether it is new."""
        seen = fingerprint(world)
        if (known := self._known.get(seen)) is not None:
            return known, False
        state = self._known[seen] = len(self._parents)
        self._parents.append(parent)
        self._steps.append(self._actions.setdefault(action, len(self._actions)))
        self._served.append(not _waits(world))
        return state, True

    def story(self, state: int) -> list[Action]:
        """Return the shortest story that leads to a state."""
        actions, steps = list(self._actions), list[Action]()
        while state:
            steps.append(actions[self._steps[state]])
            state = self._parents[state]
        return steps[::-1]

    def _fail(self, story: list[Action], error: str) -> None:
        self.report.story, self.report.error = story, error

    # -- liveness
    def _check_served(self, edge: list[tuple[int, Parts]], until: float) -> None:
        """Look for a state from which those that wait cannot be served. Where the graph has no path
        they are served by hand: at its edge, and where all of it is known, since of two deadlines
        it may know the one alone that comes again and again (`fingerprint`)."""
        report, served, frozen = self.report, self._served, dict(edge)
        self._spread()
        at_edge = random.Random(0).sample(list(frozen), len(frozen))
        for state in at_edge or range(len(served)):
            if time.perf_counter() > until:
                break
            if served[state]:
                continue
            try:
                served[state] = serve(self._again(state, frozen))
                error = "" if served[state] else "a client waits for ever"
            except Exception as raised:  # noqa: BLE001 - as above
                error = f"{type(raised).__name__}: {raised}, while those that wait are served"
            if error:
                self._fail(self.story(state), error)
                return
            report.served += 1
        self._spread()
        report.unproven = served.count(0)

    def _again(self, state: int, frozen: Mapping[int, Parts]) -> World:
        if state in frozen:
            return thaw(frozen[state], self._world)
        return play(self._world.scenario, self.story(state))

    def _spread(self) -> None:
        """A state is served if one that follows is. Later states mostly follow earlier ones."""
        served, edges, changed = self._served, self._edges, True
        while changed:
            changed = False
            for place in range(len(edges) - 2, -1, -2):
                if served[edges[place + 1]] and not served[edges[place]]:
                    served[edges[place]] = changed = True
