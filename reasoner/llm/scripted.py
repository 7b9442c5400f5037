"""A planner without a language model: find the object, navigate to it, grab it, ask for success.

Written as a generator, so that the script reads top-down: it yields a tool call and receives its
outcome. It does not mention VRAM: the arbiter decides which model is resident.
"""

import json
import re
from collections.abc import Generator

from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.planner import Episode, Finish, Outcome, says_yes
from vram_arbiter.reasoner.search_map import Places, Point
from vram_arbiter.schemas.errors import BadRequest, UnknownSkill
from vram_arbiter.schemas.tools import ExecuteRskill, LocateInView, QueryScene, ToolCall, Wait

ATTEMPTS_MAX = 3
LOOKS_MAX = 3  # repeats of a locate that gave no answer about the scene
PLACES_MAX = 3  # to stand before in one attempt
TURNS_RAD = (0.35, -0.70, 0.35)  # look left, look right, back to the middle
NAVIGATE_DEADLINE_S = 60.0
GRAB_DEADLINE_S = 120.0  # counts from acceptance: waiting for the GPU and loading are in it
GRASP_CAMERA = "wrist"  # looks at the fingers: what they hold cannot hide behind the arm

NO_ANSWER = "the scene VLM gave no answer"

_HOLDS = re.compile(
    r"(?<!\bnot )(?<!n't )\bhold(?:s|ing)?\s+(?!nothing\b|anything\b|no\b)", re.IGNORECASE
)
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
        self._script = _script(
            object_of(task),
            palette.first("navigate").id,
            palette.first("grasp").id,
            place=_optional(palette, "place"),
            can_query=palette.can_query,
        )
        self._decided_after = -1  # steps: a decision that was thrown away is given again
        self._decision: ToolCall | Finish = Finish(False, "nothing was decided")

    async def decide(self, episode: Episode) -> ToolCall | Finish:
        if episode.running is not None:
            return Wait(rationale="the script goes on when the goal has ended")
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


def _optional(palette: Palette, action: str) -> str | None:
    try:
        return palette.first(action).id
    except UnknownSkill:
        return None


def _script(thing: str, navigate: str, grab: str, *, place: str | None, can_query: bool) -> Script:
    if can_query:
        yield QueryScene(
            question="What is the gripper holding?",
            camera=GRASP_CAMERA,
            rationale="know the hand before moving",
        )
    reason = ""
    for attempt in range(1, ATTEMPTS_MAX + 1):
        if attempt > 1:
            yield _turn(navigate, 0.0, "fold the arm, which hides the table after a grab")
        places = Places()
        lost = yield from _find(thing, navigate, places)
        if lost:
            return Finish(False, lost)
        stuck = yield from _approach(thing, navigate, places)
        if stuck:
            reason = stuck
            continue
        outcome = yield ExecuteRskill(
            rskill_id=grab,
            prompt=f"grab the {thing}",
            deadline_s=GRAB_DEADLINE_S,
            rationale=f"attempt {attempt} of {ATTEMPTS_MAX}",
        )
        if outcome.status != "succeeded":
            reason = f"the grab failed: {outcome.text}"
            continue
        if not can_query:
            return Finish(True, "the grab ended; there is no scene VLM to confirm it")
        held, answer = yield from _confirm(thing)
        if held:
            return Finish(True, f"the scene VLM confirms: {answer}")
        reason = f"not grasped after attempt {attempt}: {answer}"
        if place is not None and attempt < ATTEMPTS_MAX and _HOLDS.search(answer):
            yield ExecuteRskill(
                rskill_id=place,
                deadline_s=NAVIGATE_DEADLINE_S,
                rationale="a held thing would be looked at, and dropped before the next grasp",
            )
    return Finish(False, reason)


def _find(thing: str, navigate: str, places: Places) -> Generator[ToolCall, Outcome, str]:
    """Look; where a detector that really looked does not see it, turn and look again.

    Returns: why no place is known; empty: one is.
    """
    for turn in (*TURNS_RAD, None):
        looked = yield from _locate(thing, places)
        if looked.status == "found":
            return ""
        if looked.status != "not_seen":
            return f"could not look for the {thing}: {looked.text}"
        if turn is not None:
            yield _turn(navigate, turn, f"the {thing} is not in view: look around")
    return f"the {thing} was not seen"


def _approach(thing: str, navigate: str, places: Places) -> Generator[ToolCall, Outcome, str]:
    """Stand before the likeliest place, at most `PLACES_MAX` places in all.

    Looks from there may favor another place: then it goes there. Returns: why it does not stand
    there; empty: it does.
    """
    place = places.best()
    why = f"stand in front of the {thing}"
    for _ in range(PLACES_MAX):
        assert place is not None, "only called when something was found"
        arrived = yield _drive(navigate, places.from_base(place), why)
        if arrived.status != "succeeded":
            return f"could not drive to the {thing}: {arrived.text}"
        looked = yield from _locate(thing, places)
        if looked.status != "found":
            return ""  # what was seen from afar has to do
        best = places.best()
        if best is place or best is None or not places.joined:
            yield _drive(
                navigate,
                places.from_base(best or place),
                "correct what the view from afar got wrong",
            )
            return ""
        place, why = best, f"both views together say that the {thing} is here"
    return ""


def _locate(thing: str, places: Places) -> Generator[ToolCall, Outcome, Outcome]:
    """Note possible places and return the last outcome.

    Only `not_seen` says something about the scene, everything else is tried again.
    """
    outcome = Outcome("error", "never looked")
    for _ in range(LOOKS_MAX):
        outcome = yield LocateInView(query=thing, rationale=f"where is the {thing}?")
        if outcome.status == "found":
            places.add(outcome.data)
        if outcome.status in ("found", "not_seen"):
            break
    return outcome


def _confirm(thing: str) -> Generator[ToolCall, Outcome, tuple[bool, str]]:
    """Return whether the scene VLM confirms that the named thing is held, and its answer.

    A yes that names something else, or nothing, is not enough.
    """
    answer = yield from _ask(f"Has the robot gripper grasped the {thing}?")
    if answer is not None and says_yes(answer) and thing not in answer.lower():
        answer = yield from _ask("What is the gripper holding?")
        return answer is not None and thing in answer.lower(), answer or NO_ANSWER
    return answer is not None and says_yes(answer), answer or NO_ANSWER


def _ask(question: str) -> Generator[ToolCall, Outcome, str | None]:
    for _ in range(LOOKS_MAX):
        outcome = yield QueryScene(question=question, camera=GRASP_CAMERA)
        if outcome.status == "answered":
            return outcome.text
    return None


def _turn(navigate: str, angle_rad: float, why: str) -> ExecuteRskill:
    params = json.dumps({"turn_rad": angle_rad})
    return ExecuteRskill(
        rskill_id=navigate, deadline_s=NAVIGATE_DEADLINE_S, rationale=why, goal_params_json=params
    )


def _drive(navigate: str, point: Point, why: str) -> ExecuteRskill:
    target = {"target_point": {"x": point.x, "y": point.y, "z": point.z}}
    return ExecuteRskill(
        rskill_id=navigate,
        deadline_s=NAVIGATE_DEADLINE_S,
        rationale=why,
        goal_params_json=json.dumps(target),
    )
