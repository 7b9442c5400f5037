"""Breadth-first search over the orders in which the actions of a world may happen.

`Search.run` explores one scenario: each state is known by its fingerprint, and how it is reached by
its first, shortest story. It ends with everything explored, at a limit, or at the first action that
raises. Whether each waiter can be served is told by the same graph: from every state a path of
`SERVE` actions leads to one in which no client waits, or the state itself comes there by hand
(`serve`).
"""

import random
import time
from array import array
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from tests.explore.cloning import Freezer, Frozen, thaw
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


@dataclass(slots=True)
class Report:
    """One search. `depth`: of the last state that was met. `served`: states by hand. `unproven`:
    states that may lead to no service, by want of time."""

    scenario: str
    states: int = 0
    transitions: int = 0
    depth: int = 0
    complete: bool = False
    served: int = 0
    unproven: int = 0
    cpu_s: float = 0.0
    verbs: dict[str, int] = field(default_factory=dict)
    story: list[Action] = field(default_factory=list)
    error: str = ""

    def __str__(self) -> str:
        told = (
            f"{self.scenario:13}{self.states:10,} states{self.transitions:11,} transitions; "
            f"depth {self.depth} ({'complete' if self.complete else 'cut'}), "
            f"{self.unproven:,} unproven, {self.transitions / self.cpu_s:,.0f} per s of CPU"
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


def serve(world: World) -> str:
    """Let happen what serves those that wait. Return what went wrong; "": none waits any more."""
    for step in range(1, SERVE_STEPS_MAX):
        if not world.waits():
            return ""
        verbs = SERVE if step % 15 else SERVE[::-1]  # so that time passes in any case
        able = {verb: (verb, whose) for verb, whose in world.actions()}
        if error := _error_of(world, next(able[verb] for verb in verbs if verb in able)):
            return f"{error}, while those that wait are served"
    return "a client waits for ever"


def _error_of(world: World, action: Action) -> str:
    """Let an action happen. Return what it raises; "": nothing."""
    try:
        world.act(action)
    except Exception as error:  # noqa: BLE001 - whatever it is, it is what is looked for
        return f"{type(error).__name__}: {error}"
    return ""


class Search:
    """States are numbered in the order in which they are met."""

    def __init__(self, scenario: Scenario) -> None:
        self.report = Report(scenario.name)
        self._scenario, self._freezer = scenario, Freezer()
        self._known: dict[int, int] = {}
        self._parents, self._steps = array("I"), list[Action]()
        self._actions: dict[Action, Action] = {}  # one object for those that are equal
        self._edge = deque[tuple[int, Frozen]]()  # states that are met and not explored
        self._served = bytearray()  # 1: no client waits, or some path leads there
        self._paths = array("I")  # of SERVE actions: from, to, from, to, …
        self._meet(World(scenario), 0, ("start", ""))

    def run(self, seconds: float, states_max: int = 1 << 31) -> Report:
        """Explore until everything is known, for some seconds, or up to a number of states."""
        report, began, cpu = self.report, time.perf_counter(), time.process_time()
        until = began + seconds * (1 - SERVE_SHARE)
        while self._edge and time.perf_counter() < until and not report.error:
            if len(self._parents) >= states_max:
                break
            self._expand(*self._edge.popleft())
        report.complete = not self._edge
        if not report.error:
            self._check_served(began + seconds)
        report.states, report.depth = len(self._parents), len(self.story(len(self._parents) - 1))
        report.cpu_s = time.process_time() - cpu
        return report

    def _expand(self, state: int, frozen: Frozen) -> None:
        report, world = self.report, thaw(frozen)
        for n, action in enumerate(world.actions()):
            world = thaw(frozen) if n else world
            if error := _error_of(world, action):
                self._fail(error, [*self.story(state), action])
                return
            report.transitions += 1
            report.verbs[action[0]] = report.verbs.get(action[0], 0) + 1
            met = self._meet(world, state, action)
            if action[0] in SERVE and met != state:
                self._paths.extend((state, met))

    def _meet(self, world: World, parent: int, action: Action) -> int:
        """Return the number of a state."""
        state = self._known.setdefault(fingerprint(world), len(self._parents))
        if state == len(self._parents):
            self._parents.append(parent)
            self._steps.append(self._actions.setdefault(action, action))
            self._served.append(not world.waits())
            self._edge.append((state, self._freezer.freeze(world)))
        return state

    def story(self, state: int) -> list[Action]:
        """Return the shortest story that leads to a state."""
        steps = list[Action]()
        while state:
            steps.append(self._steps[state])
            state = self._parents[state]
        return steps[::-1]

    def _fail(self, error: str, story: list[Action]) -> None:
        self.report.error, self.report.story = error, story

    # -- liveness
    def _check_served(self, until: float) -> None:
        """Look for a state from which those that wait cannot be served. Where the graph has no path
        they are served by hand: at its edge, and where all of it is known, since of two deadlines
        it may know the one alone that comes again and again (`fingerprint`)."""
        report, served, edge = self.report, self._served, dict(self._edge)
        self._spread()
        at_edge = random.Random(0).sample(list(edge), len(edge))
        for state in at_edge or range(len(served)):
            if time.perf_counter() > until:
                break
            if not served[state]:
                frozen = edge.get(state)
                world = thaw(frozen) if frozen else play(self._scenario, self.story(state))
                if error := serve(world):
                    self._fail(error, self.story(state))
                    return
                served[state] = 1
                report.served += 1
        self._spread()
        report.unproven = served.count(0)

    def _spread(self) -> None:
        """A state is served if one that follows is. Later states mostly follow earlier ones."""
        served, paths, changed = self._served, self._paths, True
        while changed:
            changed = False
            for place in range(len(paths) - 2, -1, -2):
                if served[paths[place + 1]] and not served[paths[place]]:
                    served[paths[place]] = changed = True
