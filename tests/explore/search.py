"""Breadth-first search over the orders in which the actions of a world may happen.

`Search.run` explores one scenario: each state is known by its fingerprint, and how it is reached by
its first, shortest story. It ends with everything explored, at a limit, or at the first action that
raises. What is alive is then told from the same graph: from every state a path of `BENIGN` actions
leads to one in which no client waits. Where the graph is cut, a client that waits at its edge is
served by hand (`serve`).
"""

import gc
import time
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from tests.explore.cloning import Frozen, freeze, thaw
from tests.explore.fingerprint import fingerprint
from tests.explore.world import Action, Scenario, World

SERVE: Final = (
    *("send", "hear", "connect", "die", "return", "read"),
    *("load", "ready", "end", "free", "leave", "tick", "sleep"),
)
"""What happens where nothing fails and no client wants anything new, the first that can."""
BENIGN = frozenset(SERVE)
COLLECT_EVERY = 4000
"""States between two collections of garbage: worlds hold circles."""
SERVE_STEPS_MAX = 400
SERVE_SHARE = 0.1
"""Of the time of a search that is cut: for serving those that wait at its edge."""


@dataclass(slots=True)
class Failure:
    """What was raised, and the shortest story that leads there."""

    story: list[Action]
    error: str

    def told(self, scenario: str) -> str:
        """Return the story, and the line that plays it again."""
        steps = "\n".join(
            f"  {n:3}. {verb} {whose}" for n, (verb, whose) in enumerate(self.story, 1)
        )
        return f"{steps}\n{self.error}\nplay(SCENARIOS[{scenario!r}], {self.story!r})"


@dataclass(slots=True)
class Report:
    """One search. `merged`: transitions to a state that was known. `depth`: of the last layer that
    is explored whole. `unproven`: states at the edge from which no client was served, by want of
    time."""

    scenario: str
    states: int = 1
    transitions: int = 0
    merged: int = 0
    depth: int = 0
    complete: bool = False
    unproven: int = 0
    served: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    verbs: dict[str, int] = field(default_factory=dict)
    failure: Failure | None = None


def play(scenario: Scenario, story: Iterable[Action]) -> World:
    """Return the world after a story. Raises what the last action raises."""
    world = World(scenario)
    for action in story:
        assert action in world.actions(), f"{action} cannot happen; {world.actions()} can"
        world.act(action)
    return world


def serve(world: World) -> bool:
    """Let happen what serves those that wait. Return whether none waits any more."""
    for step in range(SERVE_STEPS_MAX):
        if not waits(world):
            return True
        verbs = SERVE if (step + 1) % 20 else SERVE[::-1]  # so that time passes in any case
        able = {verb: (verb, whose) for verb, whose in world.actions()}
        world.act(next(able[verb] for verb in verbs if verb in able))
    return False


def waits(world: World) -> bool:
    return any(client.is_waiting() for client in world.clients.values())


class Search:
    """States are numbered in the order in which they are met."""

    def __init__(self, scenario: Scenario) -> None:
        self.report = Report(scenario.name)
        self._scenario = scenario
        self._known: dict[int, int] = {}
        self._parents = array("I")
        self._steps = array("H")  # the action that led here, as a place in `_actions`
        self._actions: dict[Action, int] = {}
        self._served = bytearray()  # 1: no client waits, or some path leads there
        self._edges = array("I")  # benign actions: from, to, from, to, …

    def run(self, seconds: float, states_max: int = 1 << 31) -> Report:
        """Explore until everything is known, for some seconds, or up to a number of states."""
        report, began, cpu = self.report, time.perf_counter(), time.process_time()
        until = began + seconds * (1 - SERVE_SHARE)
        gc.disable()
        try:
            edge = self._explore(until, states_max)
            if report.failure is None:
                self._check_alive(edge, began + seconds)
        finally:
            gc.unfreeze()
            gc.enable()
        report.complete = not edge
        report.states = len(self._parents)
        report.wall_s = time.perf_counter() - began
        report.cpu_s = time.process_time() - cpu
        return report

    def _explore(self, until: float, states_max: int) -> list[tuple[int, Frozen]]:
        """Explore layer by layer. Return the states that are met and not explored."""
        report = self.report
        world = World(self._scenario)
        self._meet(world, 0, ("start", ""))
        layer, following = [(0, freeze(world))], list[tuple[int, Frozen]]()
        while layer:
            for place, (state, frozen) in enumerate(layer):
                if time.perf_counter() > until or len(self._parents) >= states_max:
                    return layer[place:] + following
                if state % COLLECT_EVERY == 0:
                    gc.collect()
                    gc.freeze()  # what waits in the layers is not looked at again
                self._expand(state, frozen, following)
                if report.failure is not None:
                    return layer[place:] + following
            layer, following = following, []
            report.depth += bool(layer)
        return []

    def _expand(self, state: int, frozen: Frozen, following: list[tuple[int, Frozen]]) -> None:
        report, world = self.report, thaw(frozen)
        for number, action in enumerate(world.actions()):
            if number:
                world = thaw(frozen)
            try:
                world.act(action)
            except Exception as error:  # noqa: BLE001 - whatever it is, it is what is looked for
                told = f"{type(error).__name__}: {error}"
                report.failure = Failure([*self.story(state), action], told)
                return
            report.transitions += 1
            report.verbs[action[0]] = report.verbs.get(action[0], 0) + 1
            met, is_new = self._meet(world, state, action)
            if is_new:
                following.append((met, freeze(world)))
            else:
                report.merged += 1
            if action[0] in BENIGN and met != state:
                self._edges.extend((state, met))

    def _meet(self, world: World, parent: int, action: Action) -> tuple[int, bool]:
        """Return the number of a state, and whether it is new."""
        seen = fingerprint(world)
        if (known := self._known.get(seen)) is not None:
            return known, False
        state = self._known[seen] = len(self._parents)
        self._parents.append(parent)
        self._steps.append(self._actions.setdefault(action, len(self._actions)))
        self._served.append(not waits(world))
        return state, True

    def story(self, state: int) -> list[Action]:
        """Return the shortest story that leads to a state."""
        actions, steps = list(self._actions), list[Action]()
        while state:
            steps.append(actions[self._steps[state]])
            state = self._parents[state]
        return steps[::-1]

    # -- liveness
    def _check_alive(self, edge: list[tuple[int, Frozen]], until: float) -> None:
        """Look for a state from which no path serves those that wait."""
        report, served = self.report, self._served
        self._spread()
        for state, frozen in edge:
            if time.perf_counter() > until:
                break
            if served[state]:
                continue
            try:
                served[state] = serve(thaw(frozen))
                error = "" if served[state] else "a client waits for ever"
            except Exception as raised:  # noqa: BLE001 - as above
                error = f"{type(raised).__name__}: {raised}, while those that wait are served"
            if error:
                report.failure = Failure(self.story(state), error)
                return
            report.served += 1
        self._spread()
        report.unproven = served.count(0)
        if report.unproven and not edge:
            report.failure = Failure(self.story(served.index(0)), "no path serves those that wait")

    def _spread(self) -> None:
        """A state is served if one that follows is. Later states mostly follow earlier ones."""
        served, edges = self._served, self._edges
        changed = True
        while changed:
            changed = False
            for place in range(len(edges) - 2, -1, -2):
                if served[edges[place + 1]] and not served[edges[place]]:
                    served[edges[place]] = changed = True
