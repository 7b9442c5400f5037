"""How often the scripted planner fetches the named thing where it is hidden, has a double of its
color, or falls: 100 episodes each in a room without physics, with the errors of a real detector.

The figures are of these seeds. They say how the planner decides, not how a robot grasps.
"""

import asyncio
import dataclasses
import math
import random
from collections import Counter
from collections.abc import Callable

import pytest

from vram_arbiter.reasoner.llm.scripted import ScriptedPlanner
from vram_arbiter.reasoner.loop import run_episode
from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.planner import Outcome
from vram_arbiter.schemas.tools import ExecuteRskill, LocateInView, QueryScene, ToolCall

pytestmark = pytest.mark.nightly  # two seconds of CPU

SEEDS = range(100)
POSE_SCHEMA = {"type": "object", "properties": {"target_point": {}, "pose": {}, "turn_rad": {}}}
NAVIGATE = Skill(
    "lab/navigate", "ros_action", "drive", ("navigate",), goal_params_schema=POSE_SCHEMA
)
GRAB = Skill("lab/grab", "vla", "grab", ("pick", "grasp"))
PLACE = Skill("lab/put-down", "ros_action", "put down", ("place",))
DETECTOR = Skill("lab/detector", "detector", "see", ("detect",))
PALETTE = Palette((NAVIGATE, GRAB, PLACE, DETECTOR))

FRONT_M = 0.33  # from the base to the place that the arm reaches
REACH_M = 0.05  # a thing farther from that place is missed
VIEW_RAD, VIEW_M = 0.6, 1.6  # half of the camera's opening, and how far it tells things apart
WIDTH_M = 0.05  # of a thing, which hides what is behind it
THRESHOLD = 0.3  # of the detector's score
MISSED = 0.1  # share of grabs that close beside the thing
FALL_M = 0.2  # how far a thing rolls

type Point = tuple[float, float]


@dataclasses.dataclass
class Thing:
    """`score`: the mean of what the detector gives it when it is asked for the target."""

    name: str
    at: Point
    score: float


class Room:
    """Things on a plane, a base that drives, a hand, a detector that errs and a scene VLM that does
    not. `falls` moves the target once, after so many calls.
    """

    def __init__(self, seed: int, things: list[Thing], falls: int = 0) -> None:
        self.random = random.Random(seed)
        self.things = {thing.name: thing for thing in things}
        self.target = things[0].name
        self.base = (0.0, 0.0, 0.0)
        self.turned = 0.0
        self.held = ""
        self.falls = falls

    async def __call__(self, call: ToolCall) -> Outcome:
        self.falls -= 1
        if self.falls == 0:
            self._fall()
        match call:
            case LocateInView(query=name):
                return self._look(name)
            case QueryScene(question=question):
                return self._say(question)
            case ExecuteRskill(rskill_id=GRAB.id):
                return self._grab()
            case ExecuteRskill(rskill_id=PLACE.id):
                self.things[self.held].at, self.held = self._before(FRONT_M), ""
            case ExecuteRskill():
                self._drive(call)
        return Outcome("succeeded", "")

    def _before(self, ahead: float, left: float = 0.0) -> Point:
        x, y, yaw = self.base
        return (
            x + ahead * math.cos(yaw) - left * math.sin(yaw),
            y + ahead * math.sin(yaw) + left * math.cos(yaw),
        )

    def _from_base(self, at: Point) -> Point:
        x, y, yaw = self.base
        dx, dy = at[0] - x, at[1] - y
        return (dx * math.cos(yaw) + dy * math.sin(yaw), dy * math.cos(yaw) - dx * math.sin(yaw))

    def _fall(self) -> None:
        """The target falls, out of the hand as well, and rolls."""
        if self.held == self.target:
            self.held = ""
        thing, way = self.things[self.target], self.random.uniform(0.0, math.tau)
        x, y = thing.at
        thing.at = (x + FALL_M * math.cos(way), y + FALL_M * math.sin(way))

    def _look(self, name: str) -> Outcome:
        """Score what is in view and not hidden; places err by a fiftieth of their distance."""
        seen = []
        for thing in self.things.values():
            ahead, left = self._from_base(thing.at)
            distance = math.hypot(ahead, left)
            angle = math.atan2(left, ahead) - self.turned
            if thing.name == self.held or abs(angle) > VIEW_RAD or distance > VIEW_M:
                continue
            if self._hidden(thing, distance):
                continue
            mean = thing.score if name == self.target else 0.9 if name == thing.name else 0.2
            score = min(0.99, self.random.gauss(mean, 0.1))
            if score >= THRESHOLD:
                error = self.random.gauss(0.0, distance / 50)
                seen.append((score, [ahead + error, left + error, 0.0]))
        data: dict[str, object] = {"base_pose": list(self.base)}
        if not seen:
            return Outcome("not_seen", "", data=data)
        seen.sort(reverse=True)
        data["point_base_m"] = seen[0][1]
        data["seen"] = [{"point_base_m": point, "score": score} for score, point in seen]
        return Outcome("found", "there", data=data)

    def _hidden(self, thing: Thing, distance: float) -> bool:
        ahead, left = self._from_base(thing.at)
        for other in self.things.values():
            x, y = self._from_base(other.at)
            nearer = math.hypot(x, y) < distance - WIDTH_M
            apart = abs(math.atan2(y, x) - math.atan2(left, ahead)) * math.hypot(x, y)
            if other.name not in (thing.name, self.held) and nearer and apart < WIDTH_M:
                return True
        return False

    def _say(self, question: str) -> Outcome:
        holds = f"the gripper holds the {self.held}." if self.held else "the gripper is empty."
        if question.startswith("What"):
            return Outcome("answered", holds.capitalize())
        yes = bool(self.held) if "anything" in question else self.held == self.target
        return Outcome("answered", f"{'Yes' if yes else 'No'}, {holds}")

    def _grab(self) -> Outcome:
        place = self._before(FRONT_M)
        near = min(self.things.values(), key=lambda thing: math.dist(thing.at, place))
        if math.dist(near.at, place) <= REACH_M and self.random.random() >= MISSED:
            self.held = near.name
        return Outcome("succeeded", "")

    def _drive(self, call: ExecuteRskill) -> None:
        """Drive straight to a point, or to a pose; the arm's turn lasts until the next drive."""
        params = call.goal_params
        if "turn_rad" in params:
            self.turned = params["turn_rad"] and self.turned + params["turn_rad"]
            return
        self.turned = 0.0
        if "pose" in params:
            stand = params["pose"]["pose"]
            yaw = 2 * math.atan2(stand["orientation"]["z"], stand["orientation"]["w"])
            self.base = (stand["position"]["x"], stand["position"]["y"], yaw)
            return
        ahead, left = params["target_point"]["x"], params["target_point"]["y"]
        yaw = self.base[2] + math.atan2(left, ahead)
        x, y = self._before(ahead, left)
        error = self.random.gauss(0.0, 0.01)
        self.base = (
            x - (FRONT_M + error) * math.cos(yaw),
            y - (FRONT_M + error) * math.sin(yaw),
            yaw,
        )


def outcomes(room_of: Callable[[int], Room]) -> Counter[str]:
    """Count episodes by their end. Beside the planner's own word the hand is looked at: `wrong` is
    a success without the target in it.
    """
    ends: Counter[str] = Counter()
    for seed in SEEDS:
        room = room_of(seed)
        task = f"grab the {room.target}"
        result = asyncio.run(run_episode(task, ScriptedPlanner(task, PALETTE), PALETTE, room))
        if result["status"] != "success":
            ends["failed"] += 1
        else:
            ends["fetched" if room.held == room.target else "wrong"] += 1
    return ends


def spot(rng: random.Random, near: float = 0.7, far: float = 1.2) -> Point:
    distance, angle = rng.uniform(near, far), rng.uniform(-0.4, 0.4)
    return (distance * math.cos(angle), distance * math.sin(angle))


def hidden_room(seed: int) -> Room:
    rng = random.Random(seed)
    x, y = spot(rng)
    return Room(
        seed,
        [
            Thing("red cube", (x, y), 0.75),
            Thing("blue box", (0.75 * x, 0.75 * y), 0.2),
            Thing("green ball", spot(rng), 0.25),
        ],
    )


def room_with_a_double(seed: int) -> Room:
    rng = random.Random(seed)
    cube, ball = spot(rng), spot(rng)
    while math.dist(cube, ball) < 2 * WIDTH_M:
        ball = spot(rng)
    return Room(seed, [Thing("red cube", cube, 0.65), Thing("red ball", ball, 0.55)])


def room_with_a_fall(seed: int) -> Room:
    rng = random.Random(seed)
    things = [Thing("red cube", spot(rng), 0.75), Thing("blue ball", spot(rng), 0.25)]
    return Room(seed, things, falls=rng.randint(2, 8))


def test_a_thing_behind_another_one() -> None:
    """Fetched in 88 of 100 episodes, mostly after another thing was grasped and put down (in 67).
    10 give up after three grasps. In 2 the wrong thing is called a success: the detector sees the
    target there before and after the grasp, and is believed over the scene VLM, which calls it
    something else.
    """
    ends = outcomes(hidden_room)
    assert ends["fetched"] >= 88
    assert ends["wrong"] <= 2


def test_two_things_of_one_color() -> None:
    """Fetched in 99 of 100 episodes, though the detector gives the double nearly the same score: in
    26 it is grasped, named by the scene VLM, and put down.
    """
    ends = outcomes(room_with_a_double)
    assert ends["fetched"] >= 99
    assert ends["wrong"] == 0


def test_a_thing_that_falls_during_the_task() -> None:
    """Fetched in 96 of 100 episodes; in 3 it is not found again."""
    ends = outcomes(room_with_a_fall)
    assert ends["fetched"] >= 96
    assert ends["wrong"] == 0
