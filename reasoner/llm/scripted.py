"""A planner without a language model: find the object, navigate to it, grab it, ask for success.

Written as a generator, so that the script reads top-down: it yields a tool call and receives its
outcome. It does not mention VRAM: the arbiter decides which model is resident.
"""

import json
import math
import re
from collections.abc import Generator
from dataclasses import dataclass

from vram_arbiter.reasoner.palette import OPERATOR, Palette
from vram_arbiter.reasoner.planner import Episode, Finish, Outcome, says_yes
from vram_arbiter.reasoner.search_map import Place, Places, Point, Pose, Search
from vram_arbiter.schemas.errors import BadRequest, UnknownSkill
from vram_arbiter.schemas.tools import (
    EmitPrompt,
    ExecuteRskill,
    LocateInView,
    QueryScene,
    ToolCall,
    WaitOn,
)

ATTEMPTS_MAX = 3
LOOKS_MAX = 3  # repeats of a locate that gave no answer about the scene
PLACES_MAX = 3  # to stand before in one attempt
TURNS_RAD = (0.35, -0.70, 0.35)  # look left, look right, back to the middle
NAVIGATE_DEADLINE_S = 60.0
GRAB_DEADLINE_S = 120.0  # counts from acceptance: waiting for the GPU and loading are in it
GRASP_CAMERA = "wrist"  # looks at the fingers: what they hold cannot hide behind the arm

HOLDING = "What is the gripper holding?"
ANYTHING = "Is the gripper holding anything?"
NO_ANSWER = "the scene VLM gave no answer"
# outcomes of a grab that moved the arm: something may be held, whatever the skill says of itself
MOVED = frozenset({"succeeded", "failed", "canceled"})

_HOLDS = re.compile(
    r"(?<!\bnot )(?<!n't )\bhold(?:s|ing)?\s+(?!nothing\b|anything\b|no\b)", re.IGNORECASE
)
_NAMED = re.compile(r"\bhold(?:s|ing)?\s+(?:the|an?)\s+([^.,;]+)", re.IGNORECASE)
_TASK = re.compile(
    r"\s*(?:grab|grasp|pick up|pick|fetch|take|lift)\s+(?:the\s+|a\s+|an\s+)?(.+?)\s*\.?\s*",
    re.IGNORECASE,
)

Script = Generator[ToolCall, Outcome, Finish]


def object_of(task: str) -> str:
    """`grab the red cube` → `red cube`. Raises BadRequest for a task that the script cannot do."""
    match = _TASK.fullmatch(task)
    if match is None:
        raise BadRequest(
            f"the scripted planner cannot do {task!r}",
            hint='say, for example, "grab the red cube", or use a language model',
        )
    return match[1].lower()


class ScriptedPlanner:
    """`Planner` by script.

    The constructor raises BadRequest or UnknownSkill for an impossible task.
    """

    def __init__(self, task: str, palette: Palette) -> None:
        self._script = _script(object_of(task), _Robot.of(palette))
        self._decided_after = -1  # steps: a decision that was thrown away is given again
        self._decision: ToolCall | Finish = Finish(False, "nothing was decided")

    async def decide(self, episode: Episode) -> ToolCall | Finish:
        if episode.running is not None:
            return WaitOn(rationale="the script goes on when the goal has ended")
        if len(episode.steps) == self._decided_after:
            return self._decision
        try:
            self._decision = (
                self._script.send(episode.steps[-1].outcome)
                if episode.steps
                else next(self._script)
            )
        except StopIteration as stop:
            self._decision = stop.value
        self._decided_after = len(episode.steps)
        return self._decision


@dataclass(frozen=True, slots=True)
class _Robot:
    """Skills and tools that the script has."""

    navigate: str
    grab: str
    place: str | None
    takes_pose: bool
    """Whether navigation drives to a pose, and not only to what was seen."""
    can_query: bool
    can_say: bool
    grasp_camera: str

    @classmethod
    def of(cls, palette: Palette) -> "_Robot":
        """Raises UnknownSkill when navigation or a grasp is missing."""
        navigate = palette.first("navigate")
        schema = navigate.goal_params_schema or {}
        try:
            place = palette.first("place").id
        except UnknownSkill:
            place = None
        return cls(
            navigate.id,
            palette.first("grasp").id,
            place,
            "pose" in (schema.get("properties") or {}),
            palette.can_query,
            OPERATOR in palette.topics,
            GRASP_CAMERA if GRASP_CAMERA in (palette.cameras or (GRASP_CAMERA,)) else "",
        )


def _script(thing: str, robot: _Robot) -> Script:
    reason = ""
    search = Search()
    ended = (yield from _empty_hand(thing, robot, search)) if robot.can_query else None
    if ended is not None:
        return ended
    folded = True
    known: list[Place] = []  # of the attempt before, if it grasped what was called something else
    for attempt in range(1, ATTEMPTS_MAX + 1):
        if not folded:
            yield _fold(robot)
        folded = False
        places = Places(known, search.doubted)
        known = []
        lost = yield from _find(thing, robot, places, search)
        if lost:
            return Finish(False, lost)
        stuck = yield from _approach(thing, robot, places, search)
        if stuck:
            reason = stuck
            continue
        outcome = yield ExecuteRskill(
            rskill_id=robot.grab,
            prompt=f"grab the {thing}",
            deadline_s=GRAB_DEADLINE_S,
            rationale=f"attempt {attempt} of {ATTEMPTS_MAX}",
        )
        failed = "" if outcome.status == "succeeded" else f"the grab failed: {outcome.text}"
        if outcome.status not in MOVED or (failed and not robot.can_query):
            reason = failed
            continue
        if not robot.can_query:
            return Finish(True, "the grab ended; there is no scene VLM to confirm it")
        held, answer = yield from _confirm(thing, robot)
        if held:
            return Finish(True, f"the scene VLM confirms: {answer}")
        reason = f"not grasped after attempt {attempt}: {failed + '; ' if failed else ''}{answer}"
        if not _HOLDS.search(answer):
            continue
        place = places.best()
        assert place is not None, "it stood before one"
        if places.doubts(place) and (yield from _holds_anything(robot, answer)):
            seen = f"the detector sees the {thing} there, before the first grasp and after it"
            return Finish(True, f"{seen}; the scene VLM calls it something else: {answer}")
        if robot.place is not None and attempt < ATTEMPTS_MAX:
            if _NAMED.search(answer):
                search.doubted.append(place)
                known = places.known if places.joined else []
            why = "a held thing would be looked at, and dropped before the next grasp"
            folded = (yield from _put_down(robot, answer, why, search)).status == "succeeded"
    return Finish(False, reason)


def _holds_anything(robot: _Robot, answer: str) -> Generator[ToolCall, Outcome, bool]:
    """Return whether the scene VLM says a second time that the gripper holds something."""
    return says_yes((yield from _ask(robot, ANYTHING, f"make sure: {answer}")) or "")


def _empty_hand(
    thing: str, robot: _Robot, search: Search
) -> Generator[ToolCall, Outcome, Finish | None]:
    """Ask what the gripper holds before anything moves.

    Returns the end where the named thing is held already, or where another one cannot be put down.
    Two answers have to agree: one that is wrong would move the arm, or end the task.
    """
    answer = (yield from _ask(robot, HOLDING, "know the hand before moving")) or ""
    if thing in answer.lower():
        held, confirmed = yield from _confirm(thing, robot)
        return Finish(True, f"it is held already: {confirmed}") if held else None
    if not _HOLDS.search(answer):
        return None
    if not (yield from _holds_anything(robot, answer)):
        return None
    if robot.place is None:
        return Finish(False, f"{answer} No installed skill can put it down")
    why = f"{answer} The gripper has to be empty for a grasp"
    outcome = yield from _put_down(robot, answer, why, search)
    if outcome.status != "succeeded":
        return Finish(False, f"{answer} It could not be put down: {outcome.text}")
    return None


def _find(
    thing: str, robot: _Robot, places: Places, search: Search
) -> Generator[ToolCall, Outcome, str]:
    """Look; where a detector that really looked does not see it, turn and look again, and then
    drive to where nothing was looked at from yet.

    Returns: why no place is known; empty: one is.
    """
    for turn in (*TURNS_RAD, None):
        looked = yield from _locate(thing, robot, places, search)
        if looked.status == "not_seen" and places.known:
            return ""  # from another place
        if looked.status != "not_seen":
            return _unanswered(thing, looked)
        if unknown := looked.data.get("unknown_words"):
            return f"the {thing} was not seen, and the detector does not know {', '.join(unknown)}"
        if turn is not None:
            yield _turn(robot, turn, f"the {thing} is not in view: look around")
    while robot.takes_pose and (pose := search.next()) is not None:
        arrived = yield _stand(robot, pose, f"look for the {thing} from another place")
        if arrived.status != "succeeded":
            continue  # something stands there: the next place
        looked = yield from _locate(thing, robot, places, search)
        if looked.status != "not_seen":
            return _unanswered(thing, looked)
    return f"the {thing} was not seen"


def _unanswered(thing: str, looked: Outcome) -> str:
    """Return why a look gave no place; empty: it gave one."""
    return "" if looked.status == "found" else f"could not look for the {thing}: {looked.text}"


def _approach(
    thing: str, robot: _Robot, places: Places, search: Search
) -> Generator[ToolCall, Outcome, str]:
    """Stand before the likeliest place, at most `PLACES_MAX` places in all.

    Looks from there may favor another place: then it goes there. Returns: why it does not stand
    there; empty: it does.
    """
    place = places.best()
    why = f"stand in front of the {thing}"
    for _ in range(PLACES_MAX):
        assert place is not None, "only called when something was found"
        arrived = yield _drive(robot, places.from_base(place), why)
        if arrived.status != "succeeded":
            return f"could not drive to the {thing}: {arrived.text}"
        looked = yield from _locate(thing, robot, places, search)
        if looked.status != "found":
            return ""  # what was seen from afar has to do
        best = places.best()
        if best is place or best is None or not places.joined:
            yield _drive(
                robot,
                places.from_base(best or place),
                "correct what the view from afar got wrong",
            )
            return ""
        place, why = best, f"both views together say that the {thing} is here"
    return ""


def _locate(
    thing: str, robot: _Robot, places: Places, search: Search
) -> Generator[ToolCall, Outcome, Outcome]:
    """Note possible places and return the last outcome.

    Only `not_seen` says something about the scene, everything else is tried again. A word that the
    detector's manifest does not name is said once, before the robot drives.
    """
    outcome = Outcome("error", "never looked")
    for _ in range(LOOKS_MAX):
        outcome = yield LocateInView(query=thing, rationale=f"where is the {thing}?")
        looked = outcome.status == "found" or "base_pose" in outcome.data
        added = looked and places.add(outcome.data, search.others.values())
        if outcome.status == "found" and not added:
            outcome = Outcome("not_seen", "what is seen was put down here", data=outcome.data)
        if outcome.status in ("found", "not_seen"):
            unknown = outcome.data.get("unknown_words")
            if unknown and robot.can_say and not search.began:
                text = f"the detector's manifest does not name {', '.join(unknown)}"
                yield EmitPrompt(target_topic=OPERATOR, text=f"{text}: it may take another thing")
            search.looked(outcome.data.get("base_pose"))
            break
    return outcome


def _confirm(thing: str, robot: _Robot) -> Generator[ToolCall, Outcome, tuple[bool, str]]:
    """Return whether the scene VLM confirms that the named thing is held, and its answer.

    A yes that names something else, or nothing, is not enough; nor is a no that names the thing.
    """
    answer = (yield from _ask(robot, f"Has the robot gripper grasped the {thing}?")) or ""
    if says_yes(answer) == (thing in answer.lower()):
        return says_yes(answer), answer or NO_ANSWER
    answer = (yield from _ask(robot, HOLDING)) or ""
    denied = "hold" in answer.lower() and not _HOLDS.search(answer)
    return thing in answer.lower() and not denied, answer or NO_ANSWER


def _ask(robot: _Robot, question: str, why: str = "") -> Generator[ToolCall, Outcome, str | None]:
    for _ in range(LOOKS_MAX):
        outcome = yield QueryScene(question=question, camera=robot.grasp_camera, rationale=why)
        if outcome.status == "answered":
            return outcome.text
    return None


def _put_down(
    robot: _Robot, answer: str, why: str, search: Search
) -> Generator[ToolCall, Outcome, Outcome]:
    """Put down what the scene VLM says is held, fold the arm, and note where the thing stands by
    its own name: a detector may take it for the wanted one.
    """
    assert robot.place is not None, "only called where something can be put down"
    outcome = yield ExecuteRskill(
        rskill_id=robot.place, deadline_s=NAVIGATE_DEADLINE_S, rationale=why
    )
    if outcome.status != "succeeded":
        return outcome
    yield _fold(robot)
    named = _NAMED.search(answer)
    if named is not None:
        name = named[1].lower()
        looked = yield LocateInView(query=name, rationale=f"where does the {name} stand now?")
        there = Places()
        if looked.status == "found" and there.add(looked.data) and there.joined:
            # the nearest: it stands before the arm, and another one of its kind may be better seen
            search.others[name] = min(there.known, key=lambda place: place.seen_from_m)
    return outcome


def _fold(robot: _Robot) -> ExecuteRskill:
    return _turn(robot, 0.0, "fold the arm, which hides the table after a grab")


def _turn(robot: _Robot, angle_rad: float, why: str) -> ExecuteRskill:
    return _go(robot, json.dumps({"turn_rad": angle_rad}), why)


def _drive(robot: _Robot, point: Point, why: str) -> ExecuteRskill:
    target = {"target_point": {"x": point.x, "y": point.y, "z": point.z}}
    return _go(robot, json.dumps(target), why)


def _stand(robot: _Robot, pose: Pose, why: str) -> ExecuteRskill:
    x, y, yaw = pose
    orientation = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    stand = {"position": {"x": x, "y": y, "z": 0.0}, "orientation": orientation}
    return _go(robot, json.dumps({"pose": {"header": {"frame_id": "odom"}, "pose": stand}}), why)


def _go(robot: _Robot, params: str, why: str) -> ExecuteRskill:
    return ExecuteRskill(
        rskill_id=robot.navigate,
        next_rskill_id=robot.grab,
        deadline_s=NAVIGATE_DEADLINE_S,
        rationale=why,
        goal_params_json=params,
    )
