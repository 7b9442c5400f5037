"""A planner without a language model: find the object, navigate to it, grab it, ask for success.

Written as a generator, so that the script reads top-down: it yields a tool call and receives its
outcome. It does not mention VRAM: the arbiter decides which model is resident.
"""

import json
import math
import re
from collections.abc import Generator
from dataclasses import dataclass, field

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

type Steps[T] = Generator[ToolCall, Outcome, T]
"""Calls, each of which gets its outcome, and what came of them."""


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
        script = _Script.of(object_of(task), palette)
        self._script, self._search = script.run(), script.search
        self._decided_after = -1  # steps: a decision that was thrown away is given again
        self._decision: ToolCall | Finish = Finish(False, "nothing was decided")

    async def decide(self, episode: Episode) -> ToolCall | Finish:
        if episode.running is not None:
            return WaitOn(rationale="the script goes on when the goal has ended")
        if len(episode.steps) == self._decided_after:
            return self._decision
        self._search.seen = () if episode.sight is None else episode.sight.seen
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
class _Script:
    """The script for one thing, with the skills and tools that it has."""

    thing: str
    navigate: str
    grab: str
    place: str | None
    takes_pose: bool
    """Whether navigation drives to a pose, and not only to what was seen."""
    can_query: bool
    can_say: bool
    grasp_camera: str
    search: Search = field(default_factory=Search)

    @classmethod
    def of(cls, thing: str, palette: Palette) -> "_Script":
        """Raises UnknownSkill when navigation or a grasp is missing."""
        navigate = palette.first("navigate")
        schema = navigate.goal_params_schema or {}
        try:
            place = palette.first("place").id
        except UnknownSkill:
            place = None
        return cls(
            thing,
            navigate.id,
            palette.first("grasp").id,
            place,
            "pose" in (schema.get("properties") or {}),
            palette.can_query,
            OPERATOR in palette.topics,
            GRASP_CAMERA if GRASP_CAMERA in (palette.cameras or (GRASP_CAMERA,)) else "",
        )

    def run(self) -> Steps[Finish]:
        """Fetch the thing: the calls of an episode, and its end."""
        reason = ""
        ended = (yield from self._empty_hand()) if self.can_query else None
        if ended is not None:
            return ended
        folded = True
        # of the attempt before, if it grasped what was called something else
        known: list[Place] = []
        for attempt in range(1, ATTEMPTS_MAX + 1):
            if not folded:
                yield self._fold()
            folded = False
            places = Places(known, self.search.doubted)
            known = []
            lost = yield from self._find(places)
            if lost:
                return Finish(False, lost)
            stuck = yield from self._approach(places)
            if stuck:
                reason = stuck
                continue
            outcome = yield ExecuteRskill(
                rskill_id=self.grab,
                prompt=f"grab the {self.thing}",
                deadline_s=GRAB_DEADLINE_S,
                rationale=f"attempt {attempt} of {ATTEMPTS_MAX}",
            )
            failed = "" if outcome.status == "succeeded" else f"the grab failed: {outcome.text}"
            if outcome.status not in MOVED or (failed and not self.can_query):
                reason = failed
                continue
            if not self.can_query:
                return Finish(True, "the grab ended; there is no scene VLM to confirm it")
            held, answer = yield from self._confirm()
            if held:
                return Finish(True, f"the scene VLM confirms: {answer}")
            told = f"{failed}; {answer}" if failed else answer
            reason = f"not grasped after attempt {attempt}: {told}"
            if not _HOLDS.search(answer):
                continue
            place = places.best()
            assert place is not None, "it stood before one"
            if places.doubts(place) and (yield from self._holds_anything(answer)):
                seen = f"the detector sees the {self.thing} there, before the first grasp and after"
                return Finish(True, f"{seen} it; the scene VLM calls it something else: {answer}")
            if self.place is not None and attempt < ATTEMPTS_MAX:
                if _NAMED.search(answer):
                    self.search.doubted.append(place)
                    known = places.known if places.joined else []
                why = "a held thing would be looked at, and dropped before the next grasp"
                folded = (yield from self._put_down(answer, why)).status == "succeeded"
        return Finish(False, reason)

    def _holds_anything(self, answer: str) -> Steps[bool]:
        """Return whether the scene VLM says a second time that the gripper holds something."""
        return says_yes((yield from self._ask(ANYTHING, f"make sure: {answer}")))

    def _empty_hand(self) -> Steps[Finish | None]:
        """Ask what the gripper holds before anything moves.

        Returns the end where the named thing is held already, or where another one cannot be put
        down. Two answers have to agree: one that is wrong would move the arm, or end the task.
        """
        answer = yield from self._ask(HOLDING, "know the hand before moving")
        if self.thing in answer.lower():
            held, confirmed = yield from self._confirm()
            return Finish(True, f"it is held already: {confirmed}") if held else None
        if not _HOLDS.search(answer):
            return None
        if not (yield from self._holds_anything(answer)):
            return None
        if self.place is None:
            return Finish(False, f"{answer} No installed skill can put it down")
        why = f"{answer} The gripper has to be empty for a grasp"
        outcome = yield from self._put_down(answer, why)
        if outcome.status != "succeeded":
            return Finish(False, f"{answer} It could not be put down: {outcome.text}")
        return None

    def _find(self, places: Places) -> Steps[str]:
        """Look; where a detector that really looked does not see it, turn and look again, and then
        drive to where nothing was looked at from yet.

        Returns: why no place is known; empty: one is.
        """
        for turn in (*TURNS_RAD, None):
            looked = yield from self._locate(places)
            if looked.status == "not_seen" and places.known:
                return ""  # from another place
            if looked.status != "not_seen":
                return self._unanswered(looked)
            if unknown := looked.data.get("unknown_words"):
                words = ", ".join(unknown)
                return f"the {self.thing} was not seen, and the detector does not know {words}"
            if turn is not None:
                yield self._turn(turn, f"the {self.thing} is not in view: look around")
        while self.takes_pose and (pose := self.search.next()) is not None:
            arrived = yield self._stand(pose, f"look for the {self.thing} from another place")
            if arrived.status != "succeeded":
                continue  # something stands there: the next place
            looked = yield from self._locate(places)
            if looked.status != "not_seen":
                return self._unanswered(looked)
        return f"the {self.thing} was not seen"

    def _unanswered(self, looked: Outcome) -> str:
        """Return why a look gave no place; empty: it gave one."""
        seen = looked.status == "found"
        return "" if seen else f"could not look for the {self.thing}: {looked.text}"

    def _approach(self, places: Places) -> Steps[str]:
        """Stand before the likeliest place, at most `PLACES_MAX` places in all.

        Looks from there may favor another place: then it goes there. Returns: why it does not stand
        there; empty: it does.
        """
        place = places.best()
        why = f"stand in front of the {self.thing}"
        for _ in range(PLACES_MAX):
            assert place is not None, "only called when something was found"
            arrived = yield self._drive(places.from_base(place), why)
            if arrived.status != "succeeded":
                return f"could not drive to the {self.thing}: {arrived.text}"
            looked = yield from self._locate(places)
            if looked.status != "found":
                return ""  # what was seen from afar has to do
            best = places.best()
            if best is place or best is None or not places.joined:
                why = "correct what the view from afar got wrong"
                yield self._drive(places.from_base(best or place), why)
                return ""
            place, why = best, f"both views together say that the {self.thing} is here"
        return ""

    def _locate(self, places: Places) -> Steps[Outcome]:
        """Note possible places and return the last outcome.

        Only `not_seen` says something about the scene, everything else is tried again. A word that
        the detector's manifest does not name is said once, before the robot drives. A camera whose
        continuous detector sees the thing now is looked through first; if it gives no place, the
        default one is asked.
        """
        outcome = Outcome("error", "never looked")
        watched = self.search.camera_of(self.thing)
        for camera in ([watched] if watched else []) + [""] * LOOKS_MAX:
            outcome = yield LocateInView(
                query=self.thing, camera=camera, rationale=f"where is the {self.thing}?"
            )
            looked = outcome.status == "found" or "base_pose" in outcome.data
            added = looked and places.add(outcome.data, self.search.others.values())
            if outcome.status == "found" and not added:
                outcome = Outcome("not_seen", "what is seen was put down here", data=outcome.data)
            if outcome.status == "found" or (outcome.status == "not_seen" and not camera):
                unknown = outcome.data.get("unknown_words")
                if unknown and self.can_say and not self.search.began:
                    text = f"the detector's manifest does not name {', '.join(unknown)}: it may"
                    yield EmitPrompt(target_topic=OPERATOR, text=f"{text} take another thing")
                self.search.looked(outcome.data.get("base_pose"))
                break
        return outcome

    def _confirm(self) -> Steps[tuple[bool, str]]:
        """Return whether the scene VLM confirms that the named thing is held, and its answer.

        A yes that names something else, or nothing, is not enough; nor is a no that names it.
        """
        answer = yield from self._ask(f"Has the robot gripper grasped the {self.thing}?")
        if says_yes(answer) == (self.thing in answer.lower()):
            return says_yes(answer), answer or NO_ANSWER
        answer = yield from self._ask(HOLDING)
        denied = "hold" in answer.lower() and not _HOLDS.search(answer)
        return self.thing in answer.lower() and not denied, answer or NO_ANSWER

    def _ask(self, question: str, why: str = "") -> Steps[str]:
        """Return the scene VLM's answer; empty: it gave none."""
        for _ in range(LOOKS_MAX):
            outcome = yield QueryScene(question=question, camera=self.grasp_camera, rationale=why)
            if outcome.status == "answered":
                return outcome.text
        return ""

    def _put_down(self, answer: str, why: str) -> Steps[Outcome]:
        """Put down what the scene VLM says is held, fold the arm, and note where the thing stands
        by its own name: a detector may take it for the wanted one.
        """
        assert self.place is not None, "only called where something can be put down"
        outcome = yield ExecuteRskill(
            rskill_id=self.place, deadline_s=NAVIGATE_DEADLINE_S, rationale=why
        )
        if outcome.status != "succeeded":
            return outcome
        yield self._fold()
        named = _NAMED.search(answer)
        if named is not None:
            name = named[1].lower()
            looked = yield LocateInView(query=name, rationale=f"where does the {name} stand now?")
            there = Places()
            if looked.status == "found" and there.add(looked.data) and there.joined:
                # the nearest: it stands before the arm, and another of its kind may be better seen
                self.search.others[name] = min(there.known, key=lambda place: place.seen_from_m)
        return outcome

    def _fold(self) -> ExecuteRskill:
        return self._turn(0.0, "fold the arm, which hides the table after a grab")

    def _turn(self, angle_rad: float, why: str) -> ExecuteRskill:
        return self._go(json.dumps({"turn_rad": angle_rad}), why)

    def _drive(self, point: Point, why: str) -> ExecuteRskill:
        target = dict(zip("xyz", point, strict=True))
        return self._go(json.dumps({"target_point": target}), why)

    def _stand(self, pose: Pose, why: str) -> ExecuteRskill:
        x, y, yaw = pose
        orientation = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
        stand = {"position": {"x": x, "y": y, "z": 0.0}, "orientation": orientation}
        return self._go(json.dumps({"pose": {"header": {"frame_id": "odom"}, "pose": stand}}), why)

    def _go(self, params: str, why: str) -> ExecuteRskill:
        return ExecuteRskill(
            rskill_id=self.navigate,
            next_rskill_id=self.grab,
            deadline_s=NAVIGATE_DEADLINE_S,
            rationale=why,
            goal_params_json=params,
        )
