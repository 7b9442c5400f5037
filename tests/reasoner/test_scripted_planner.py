"""The script's decisions, driven by hand: no sockets, no clock."""

import asyncio
import dataclasses
import math
from collections.abc import Callable
from typing import Any

import pytest

from vram_arbiter.reasoner.llm.scripted import PLACES_MAX, ScriptedPlanner, object_of
from vram_arbiter.reasoner.loop import REPEATS_MAX, Result, run_episode
from vram_arbiter.reasoner.palette import OPERATOR, Palette, Skill
from vram_arbiter.reasoner.planner import Episode, Finish, Outcome, Seen, Sight
from vram_arbiter.reasoner.search_map import VIEWPOINTS_M
from vram_arbiter.schemas.errors import BadRequest, LlmError, UnknownSkill
from vram_arbiter.schemas.tools import ExecuteRskill, LocateInView, QueryScene, ToolCall

NAVIGATE = Skill("lab/navigate", "ros_action", "drive", ("navigate",))
GRAB = Skill("lab/grab", "vla", "grab", ("pick", "grasp"))
DETECTOR = Skill("lab/detector", "detector", "see", ("detect",))
PALETTE = Palette((NAVIGATE, GRAB, DETECTOR))

FOUND = Outcome("found", "there", data={"point_base_m": [0.4, 0.1, 0.2]})
DONE = Outcome("succeeded", "")
EMPTY = Outcome("answered", "The gripper is empty.")
YES = Outcome("answered", "Yes, the gripper holds the red cube.")
NO = Outcome("answered", "No, the gripper is empty.")


type World = Callable[[ToolCall, int], Outcome]
type Told = Outcome | Callable[[Any, int], Outcome]


def saying(look: Told = FOUND, answer: Told = YES, grab: Told = DONE) -> World:
    """Return a world that says this of each look, question and grab, and does all else."""

    def told(call: ToolCall, before: int) -> Outcome:
        match call:
            case LocateInView():
                says = look
            case QueryScene():
                says = answer
            case ExecuteRskill(rskill_id=GRAB.id):
                says = grab
            case _:
                says = DONE
        return says if isinstance(says, Outcome) else says(call, before)

    return told


def run_script(
    world: World, palette: Palette = PALETTE, hand: str | None = None, sight: Sight | None = None
) -> tuple[Result, list[ToolCall]]:
    """Run the script against a world that answers (call, how many calls of this tool came
    before). The hand is empty at first; with `hand` the world says what is in it.
    """
    calls: list[ToolCall] = []

    async def dispatch(call: ToolCall) -> Outcome:
        before = sum(other.tool == call.tool for other in calls)
        calls.append(call)
        return EMPTY if len(calls) == 1 and hand is None else world(call, before)

    async def look_at() -> Sight | None:
        return sight

    planner = ScriptedPlanner("grab the red cube", palette)
    episode = run_episode("grab the red cube", planner, palette, dispatch, look_at=look_at)
    return asyncio.run(episode), calls


def test_finds_drives_corrects_grabs_and_asks() -> None:
    result, calls = run_script(saying())
    assert [call.tool for call in calls] == [
        "query_scene",
        "locate_in_view",
        "execute_rskill",
        "locate_in_view",
        "execute_rskill",
        "execute_rskill",
        "query_scene",
    ]
    drive, correct, grab = (call for call in calls if isinstance(call, ExecuteRskill))
    assert drive.rskill_id == correct.rskill_id == NAVIGATE.id
    assert drive.next_rskill_id == correct.next_rskill_id == GRAB.id
    assert drive.goal_params == {"target_point": {"x": 0.4, "y": 0.1, "z": 0.2}}
    assert (grab.rskill_id, grab.prompt) == (GRAB.id, "grab the red cube")
    assert result["status"] == "success"
    assert result["attempts"] == 1
    assert result["vlm_confirmed"]


CAMERAS = dataclasses.replace(PALETTE, cameras=("front", "rear"))


def cameras_of(calls: list[ToolCall]) -> list[str]:
    return [call.camera for call in calls if isinstance(call, LocateInView)]


def test_it_looks_first_where_a_continuous_detector_sees_the_thing() -> None:
    seen = (Seen("blue ball", 0.99, "front", 0.1), Seen("Red cube", 0.8, "rear", 0.4))
    result, calls = run_script(saying(), CAMERAS, sight=Sight(seen))
    assert result["status"] == "success"
    assert cameras_of(calls) == ["rear", "rear"]
    unsure = (Seen("red cube", 0.3, "front", 0.2), *seen)
    assert cameras_of(run_script(saying(), CAMERAS, sight=Sight(unsure))[1])[0] == "rear"


def test_what_gives_no_place_there_is_looked_for_by_the_default_camera() -> None:
    def only_in_front(call: Any, before: int) -> Outcome:
        return FOUND if not call.camera else Outcome("not_seen", "", data={"base_pose": [0, 0, 0]})

    sight = Sight((Seen("red cube", 0.8, "rear", 0.4),))
    result, calls = run_script(saying(only_in_front), CAMERAS, sight=sight)
    assert result["status"] == "success"
    assert cameras_of(calls) == ["rear", "", "rear", ""]
    turns = [call for call in calls if "turn_rad" in call.model_dump_json()]
    assert turns == [], "it is in view"


@pytest.mark.parametrize("sight", [None, Sight(()), Sight((), blind=("rear",))])
def test_without_a_fresh_detection_it_looks_as_ever(sight: Sight | None) -> None:
    assert cameras_of(run_script(saying(), CAMERAS, sight=sight)[1]) == ["", ""]


def test_retries_at_most_three_times() -> None:
    result, calls = run_script(saying(answer=NO))
    assert result["status"] == "failure"
    assert result["attempts"] == 3
    assert not result["vlm_confirmed"]
    assert sum(isinstance(call, ExecuteRskill) and call.rskill_id == GRAB.id for call in calls) == 3
    assert "not grasped after attempt 3" in result["reason"]


def test_looks_around_when_not_seen_and_gives_up_without_grabbing() -> None:
    result, calls = run_script(saying(Outcome("not_seen", ""), NO))
    turns = [call.goal_params["turn_rad"] for call in calls if isinstance(call, ExecuteRskill)]
    assert turns == [0.35, -0.70, 0.35]
    assert result["attempts"] == 0
    assert result["reason"] == "the red cube was not seen"


def test_evicted_is_not_absent() -> None:
    """The defect of the field: an evicted detector that answers as if the object were not there
    makes the robot turn away.
    """
    evicted = Outcome("evicted", "not resident", "evicted")
    result, calls = run_script(saying(lambda _, before: evicted if before == 0 else FOUND))
    assert [call.tool for call in calls][1:4] == [
        "locate_in_view",
        "locate_in_view",
        "execute_rskill",
    ]
    assert "target_point" in calls[3].model_dump_json()
    assert result["status"] == "success"


def test_a_detector_that_cannot_look_makes_nobody_turn_away() -> None:
    result, calls = run_script(saying(Outcome("error", "CUDA out of memory", "oom")))
    assert not any(isinstance(call, ExecuteRskill) for call in calls)
    assert result["reason"] == "could not look for the red cube: CUDA out of memory"


def test_a_failed_drive_or_grab_is_a_retry_with_its_reason() -> None:
    failed = Outcome("failed", "CUDA out of memory (simulated)", "oom")
    result, calls = run_script(saying(answer=NO, grab=failed))
    assert result["status"] == "failure"
    assert result["attempts"] == 3
    assert "out of memory" in result["reason"]
    asked = [call for call in calls if isinstance(call, QueryScene)]
    assert len(asked) == 4, "a grab that failed may hold the thing all the same"


def test_a_grab_that_says_it_failed_and_holds_the_thing_is_a_success() -> None:
    """Regression: a grab that ran into its deadline with the cube in the hand was repeated, and
    the next one dropped it.
    """

    result, _ = run_script(saying(grab=Outcome("failed", "the time is over", "deadline")))
    assert (result["status"], result["attempts"]) == ("success", 1)
    assert result["vlm_confirmed"]


@pytest.mark.parametrize(
    ("answer", "holding", "status", "attempts"),
    [
        ("Maybe.", "Maybe.", "failure", 3),
        ("Yes, the gripper holds the red ball.", "The gripper holds the red ball.", "failure", 3),
        ("Yes, the gripper holds the red ball.", "A red cube.", "success", 1),
        ("No, the gripper holds the red cube.", "The gripper holds the red cube.", "success", 1),
        ("No, the gripper holds the red cube.", "The gripper is empty.", "failure", 3),
        (
            "No, the gripper holds the red cube.",
            "The gripper is not holding the red cube.",
            "failure",
            3,
        ),
    ],
)
def test_an_answer_that_contradicts_itself_is_asked_after(
    answer: str, holding: str, status: str, attempts: int
) -> None:
    """Regression: "No, the gripper holds the red cube." was a no."""

    def told(call: QueryScene, _: int) -> Outcome:
        asks = call.question == "What is the gripper holding?"
        return Outcome("answered", holding if asks else answer)

    result, _ = run_script(saying(answer=told))
    assert (result["status"], result["attempts"]) == (status, attempts)
    if answer.startswith("Yes") and status == "success":
        assert result["vlm_confirmed"]


def test_task_and_skills_are_checked_before_anything_moves() -> None:
    assert object_of("Pick up the blue ball.") == "blue ball"
    with pytest.raises(BadRequest, match="cannot do"):
        object_of("sing a song")
    with pytest.raises(UnknownSkill, match="can grasp"):
        ScriptedPlanner("grab the red cube", Palette((NAVIGATE,)))


def test_a_planner_that_repeats_itself_or_fails_ends_the_episode() -> None:
    class Parrot:
        async def decide(self, episode: Episode) -> ToolCall | Finish:
            return QueryScene(question="Is it there?")

    class Mute:
        async def decide(self, episode: Episode) -> ToolCall | Finish:
            raise LlmError("no answer")

    async def dispatch(call: ToolCall) -> Outcome:
        return NO

    repeated = asyncio.run(run_episode("x", Parrot(), PALETTE, dispatch))
    assert repeated["status"] == "failure"
    assert len(repeated["steps"]) == REPEATS_MAX
    assert "no answer" in asyncio.run(run_episode("x", Mute(), PALETTE, dispatch))["reason"]


def sees(base_pose: list[float] | None, *things: tuple[float, float, float]) -> Outcome:
    """What `locate_in_view` says of things at (x, y) from the base, with their scores, best
    first.
    """
    seen = [
        {"point_base_m": [x, y, 0.2], "score": score, "box": [0, 0, 9, 9]} for x, y, score in things
    ]
    data = {"point_base_m": seen[0]["point_base_m"], "seen": seen}
    return Outcome(
        "found", "there", data=data if base_pose is None else data | {"base_pose": base_pose}
    )


def looks_of(*looks: Outcome) -> World:
    return saying(lambda _, before: looks[min(before, len(looks) - 1)])


def drives(calls: list[ToolCall]) -> list[tuple[float, float]]:
    points = [
        call.goal_params["target_point"]
        for call in calls
        if isinstance(call, ExecuteRskill) and call.rskill_id == NAVIGATE.id
    ]
    return [(round(point["x"], 3), round(point["y"], 3)) for point in points]


def test_a_look_from_near_at_another_thing_is_no_correction() -> None:
    """Regression: from near a ball got a little more than the cube before which the robot stood,
    and it drove 23 cm away to the ball.
    """
    far = sees([0.0, 0.0, 0.0], (0.7, -0.3, 0.62))
    near = sees([0.375, -0.3, 0.0], (0.285, 0.23, 0.63), (0.33, 0.01, 0.60))
    result, calls = run_script(looks_of(far, near))
    assert drives(calls) == [(0.7, -0.3), (0.33, 0.01)]
    assert (result["status"], result["attempts"]) == ("success", 1)


def test_two_looks_that_speak_for_another_place_make_it_that_ones_turn() -> None:
    far = sees([0.0, 0.0, 0.0], (0.7, -0.3, 0.5), (0.7, 0.0, 0.45))
    near = sees([0.375, -0.3, 0.0], (0.325, 0.3, 0.8))
    there = sees([0.375, 0.0, 0.0], (0.32, 0.0, 0.9))
    _, calls = run_script(looks_of(far, near, there))
    assert drives(calls) == [(0.7, -0.3), (0.325, 0.3), (0.32, 0.0)]


def test_places_that_outdo_each_other_do_not_make_it_drive_for_ever() -> None:
    looks = [sees([0.0, 0.0, 0.0], (0.5 + 0.2 * n, 0.0, 0.5 + 0.1 * n)) for n in range(9)]
    result, calls = run_script(looks_of(*looks))
    assert len(drives(calls)) == PLACES_MAX
    assert result["attempts"] == 1


PLACE = Skill("lab/put-down", "ros_action", "put down", ("place",))


def grabs_and_places(answer: Outcome) -> list[str]:
    """Which arm skills follow each other when the scene VLM always says this."""

    _, calls = run_script(saying(answer=answer), Palette((NAVIGATE, GRAB, PLACE, DETECTOR)))
    return [
        call.rskill_id
        for call in calls
        if isinstance(call, ExecuteRskill) and call.rskill_id != NAVIGATE.id
    ]


def test_what_the_hand_holds_is_put_down_before_it_looks_again() -> None:
    """Regression: it looked with the thing in the hand, found that, drove to where it seemed to
    stand and dropped it into the way of the next grasp.
    """
    holds = Outcome("answered", "No, the gripper holds the red ball.")
    assert grabs_and_places(holds) == [GRAB.id, PLACE.id, GRAB.id, PLACE.id, GRAB.id]


@pytest.mark.parametrize(
    "answer",
    [
        NO,
        Outcome("answered", "No, it is not holding anything."),
        Outcome("answered", "No, the gripper is not holding the red cube."),
        Outcome("answered", "No. It doesn't hold the red cube."),
        Outcome("error", "CUDA out of memory", "oom"),
    ],
)
def test_a_hand_of_which_nobody_says_that_it_holds_something_puts_nothing_down(
    answer: Outcome,
) -> None:
    """It would press on what it has missed, which stands there."""
    assert grabs_and_places(answer) == [GRAB.id] * 3


# -- what it hears before it begins
def hears(*answers: str, palette: Palette = PALETTE) -> tuple[Result, list[ToolCall]]:
    """Run the script in a world whose scene VLM gives these answers, the last one from then on."""

    def told(_: QueryScene, before: int) -> Outcome:
        return Outcome("answered", answers[min(before, len(answers) - 1)])

    return run_script(saying(answer=told), palette, hand=answers[0])


def test_a_target_that_is_held_already_is_confirmed_and_nothing_moves() -> None:
    """Regression: it drove to the table and grabbed what it had in its hand."""
    held = "The gripper holds the red cube."
    result, calls = hears(held, f"Yes, {held}")
    assert (result["status"], result["attempts"], result["vlm_confirmed"]) == ("success", 0, True)
    assert [call.tool for call in calls] == ["query_scene", "query_scene"]
    _, calls = hears(held, "No, the gripper is empty.")
    assert any(isinstance(call, ExecuteRskill) for call in calls), "one wrong answer ends no task"


WITH_PLACE = Palette((NAVIGATE, GRAB, PLACE))


def test_another_thing_in_the_hand_is_put_down_first() -> None:
    """Regression: a second task drove off with the first one's object, and dropped it on the way
    to the grasp.
    """
    held = "The gripper holds the blue ball."
    result, calls = hears(held, f"Yes, {held}", YES.text, palette=WITH_PLACE)
    moved = [call.rskill_id for call in calls if isinstance(call, ExecuteRskill)]
    assert moved[0] == PLACE.id
    assert moved.count(PLACE.id) == 1
    assert result["status"] == "success"
    _, calls = hears(held, "No, the gripper is empty.", YES.text, palette=WITH_PLACE)
    assert PLACE.id not in [c.rskill_id for c in calls if isinstance(c, ExecuteRskill)]
    result, calls = hears(held, f"Yes, {held}")
    assert "No installed skill can put it down" in result["reason"]
    assert not any(isinstance(call, ExecuteRskill) for call in calls)


def test_what_was_put_down_is_not_taken_for_the_target() -> None:
    """Regression: in the demo's world of seed 3 the second task took the red ball, which it had
    just put down, for the red cube, and grabbed it three times.
    """
    here = [0.4, 0.2, 0.0]

    def world(call: ToolCall, before: int) -> Outcome:
        match call:
            case LocateInView(query="red ball"):
                return sees(here, (0.33, 0.0, 0.73), (0.7, 0.4, 0.8))
            case LocateInView():
                return sees(here, (0.33, 0.0, 0.43), *([(0.34, -0.3, 0.4)] if before > 2 else []))
            case QueryScene(question="What is the gripper holding?"):
                return Outcome("answered", "The gripper holds the red ball.")
            case QueryScene():
                return YES
            case _:
                return DONE

    result, calls = run_script(world, WITH_PLACE, hand="red ball")
    assert result["status"] == "success"
    assert drives([c for c in calls if "target_point" in c.model_dump_json()])[0] == (0.34, -0.3)


class Table:
    """Things that stand still, a detector's scores for them, and a hand that puts its thing back.

    `scores`: name asked for → (x, y, score) in the odometry's frame. `says`: what the scene VLM
    calls the thing that was grasped at a place. The base stays at the origin.
    """

    def __init__(
        self, scores: dict[str, list[tuple[float, float, float]]], says: dict[float, str]
    ) -> None:
        self.scores, self.says = scores, says
        self.before = self.held = 0.0
        """y of the place that it stands before, and of the one whose thing it holds; 0: none."""

    def __call__(self, call: ToolCall, _: int) -> Outcome:
        match call:
            case LocateInView(query=name):
                seen = self.scores.get(name, [])
                nothing = Outcome("not_seen", "", data={"base_pose": [0.0, 0.0, 0.0]})
                return sees([0.0, 0.0, 0.0], *seen) if seen else nothing
            case QueryScene(question=question):
                holds = f"the gripper holds the {self.says[self.held]}." if self.held else ""
                if question.startswith("What"):
                    return Outcome("answered", holds or "The gripper is empty.")
                return Outcome("answered", f"Yes, {holds}" if holds else NO.text)
            case ExecuteRskill(rskill_id=GRAB.id):
                self.held = self.before
            case ExecuteRskill(rskill_id=PLACE.id):
                self.held = 0.0
            case ExecuteRskill() if "target_point" in call.goal_params:
                self.before = call.goal_params["target_point"]["y"]
        return DONE


def grasped_at(calls: list[ToolCall]) -> list[float]:
    """y of the place before which it stood at each grab."""
    at, before = [], 0.0
    for call in calls:
        if isinstance(call, ExecuteRskill) and "target_point" in call.goal_params:
            before = call.goal_params["target_point"]["y"]
        elif isinstance(call, ExecuteRskill) and call.rskill_id == GRAB.id:
            at.append(before)
    return at


def test_a_wrong_name_that_the_detector_denies_does_not_lose_the_target() -> None:
    """Regression: in the demo's world of seed 35 the robot held the green cube, which the scene
    VLM took for a green cylinder; there was none. It put the cube down and grabbed it again until
    the attempts were used up, with what it was sent for in the hand each time.
    """
    for cylinder in ([], [(0.32, 0.1, 0.4)]):
        table = Table(
            {"red cube": [(0.33, 0.1, 0.7)], "red cylinder": cylinder}, {0.1: "red cylinder"}
        )
        result, _ = run_script(table, WITH_PLACE)
        assert (result["status"], result["attempts"]) == ("success", 2)
        assert "the detector sees the red cube there" in result["reason"]
        assert "red cylinder" in result["reason"], "the scene VLM's word is not concealed"


def test_a_doubted_thing_that_is_not_held_the_next_time_is_no_success() -> None:
    class Slips(Table):
        def __call__(self, call: ToolCall, before: int) -> Outcome:
            outcome = super().__call__(call, before)
            if isinstance(call, QueryScene) and "anything" in call.question:
                return NO
            return outcome

    table = Slips({"red cube": [(0.33, 0.1, 0.7)]}, {0.1: "red cylinder"})
    assert run_script(table, WITH_PLACE)[0]["status"] == "failure"


def test_a_thing_without_a_name_is_not_doubted() -> None:
    """There is no second opinion then: nothing says that it is the wanted thing."""

    def world(call: ToolCall, _: int) -> Outcome:
        if isinstance(call, QueryScene):
            return Outcome("answered", "Yes, the gripper is holding something.")
        return sees([0.0, 0.0, 0.0], (0.33, 0.1, 0.7)) if isinstance(call, LocateInView) else DONE

    result, _ = run_script(world, WITH_PLACE)
    assert (result["status"], result["attempts"]) == ("failure", 3)


def test_a_name_that_the_detector_confirms_rules_the_place_out() -> None:
    """What the scene VLM calls a ball, and the detector too, is no cube, whatever the detector
    gives it as one: the next place is the better one.
    """
    scores = {"red cube": [(0.33, 0.1, 0.6), (0.33, -0.1, 0.5)], "red ball": [(0.33, 0.11, 0.8)]}
    table = Table(scores, {0.1: "red ball", -0.1: "red cube"})
    result, calls = run_script(table, WITH_PLACE)
    assert grasped_at(calls) == [0.1, -0.1]
    assert (result["status"], result["attempts"]) == ("success", 2)
    scores["red cube"].pop()
    result, calls = run_script(Table(scores, {0.1: "red ball"}), WITH_PLACE)
    assert grasped_at(calls) == [0.1], "what is ruled out is not grabbed again"
    assert "was not seen" in result["reason"]


def test_a_name_that_the_detector_half_confirms_rules_the_place_out() -> None:
    """Regression: the scene VLM said rightly that the hand held the cylinder, which the detector
    scored 0.56 as a cylinder and 0.60 as a cube: it was taken for the cube.
    """
    scores = {"red cube": [(0.33, 0.1, 0.6)], "red cylinder": [(0.33, 0.1, 0.56)]}
    result, calls = run_script(Table(scores, {0.1: "red cylinder"}), WITH_PLACE)
    assert result["status"] == "failure"
    assert grasped_at(calls) == [0.1]


def test_a_place_that_was_seen_from_afar_is_not_forgotten() -> None:
    """Regression: with another thing in the hand it looked anew from where it stood, and the
    target, which the first look had shown, was beyond the picture's edge.
    """

    class Near(Table):
        def __call__(self, call: ToolCall, before: int) -> Outcome:
            if self.before == 0.1:  # stands before the wrong one
                self.scores["red cube"] = self.scores["red cube"][:1]
            return super().__call__(call, before)

    scores = {"red cube": [(0.33, 0.1, 0.6), (0.33, -0.4, 0.5)], "red ball": [(0.33, 0.1, 0.8)]}
    table = Near(scores, {0.1: "red ball", -0.4: "red cube"})
    result, calls = run_script(table, WITH_PLACE)
    assert grasped_at(calls) == [0.1, -0.4]
    assert (result["status"], result["attempts"]) == ("success", 2)


def test_without_odometry_nothing_is_doubted_or_remembered() -> None:
    """Places of two looks cannot be compared then: each attempt begins anew."""

    def world(call: ToolCall, before: int) -> Outcome:
        match call:
            case LocateInView():  # from near the arm hides it
                there = sees(None, (0.4, 0.1, 0.6), (0.4, -0.1, 0.5))
                return Outcome("not_seen", "") if before % 3 == 1 else there
            case QueryScene():
                return Outcome("answered", "Yes, the gripper holds the red ball.")
            case _:
                return DONE

    result, calls = run_script(world, WITH_PLACE)
    assert (result["status"], result["attempts"]) == ("failure", 3)
    assert grasped_at(calls) == [0.1] * 3


def test_a_doubted_place_comes_after_the_others() -> None:
    """The detector may be wrong as well: in the demo's seed 57 it preferred an orange ball to the
    orange cube, by either name, and the ball that was grasped again counted as the cube."""
    scores = {"red cube": [(0.33, 0.1, 0.64), (0.33, -0.1, 0.42)], "red ball": [(0.33, 0.1, 0.45)]}
    for other, places, attempts in (
        ("red cube", [0.1, -0.1], 2),
        ("red cone", [0.1, -0.1, 0.1], 3),
    ):
        result, calls = run_script(Table(scores, {0.1: "red ball", -0.1: other}), WITH_PLACE)
        assert grasped_at(calls) == places
        assert (result["status"], result["attempts"]) == ("success", attempts)


def test_the_arm_is_folded_before_it_looks_at_what_it_put_down() -> None:
    """A skill that puts down need not fold the arm, which stands between camera and table."""
    table = Table({"red cube": [(0.33, 0.1, 0.7)]}, {0.1: "red cylinder"})
    _, calls = run_script(table, WITH_PLACE)
    (at,) = (n for n, c in enumerate(calls) if getattr(c, "rskill_id", "") == PLACE.id)
    fold, look, search = calls[at + 1 : at + 4]
    assert isinstance(fold, ExecuteRskill)
    assert fold.goal_params == {"turn_rad": 0.0}
    assert isinstance(look, LocateInView)
    assert look.query == "red cylinder"
    assert isinstance(search, LocateInView), "folded once"


def test_a_robot_without_a_wrist_camera_is_asked_about_with_its_default_one() -> None:
    held = "The gripper holds the red cube."
    for cameras, asked in ((("front", "wrist"), "wrist"), (("front",), ""), ((), "wrist")):
        _, calls = hears(
            held, f"Yes, {held}", palette=dataclasses.replace(PALETTE, cameras=cameras)
        )
        assert [call.camera for call in calls if isinstance(call, QueryScene)] == [asked] * 2


# -- a wider search
POSED = {"type": "object", "properties": {"pose": {}, "turn_rad": {}, "target_point": {}}}
DRIVING = Palette((dataclasses.replace(NAVIGATE, goal_params_schema=POSED), GRAB))


def poses(calls: list[ToolCall]) -> list[tuple[float, float]]:
    """Where it drove in the odometry's frame."""
    stands = [c.goal_params.get("pose") for c in calls if isinstance(c, ExecuteRskill)]
    at = [stand["pose"]["position"] for stand in stands if stand]
    return [(round(position["x"], 2), round(position["y"], 2)) for position in at]


def unseen_until(looks: int, *, blocked: int = 0) -> World:
    """The thing is seen after so many looks; so many drives to a pose are blocked."""
    where = [1.0, 2.0, math.pi / 2]
    drives = 0

    def world(call: ToolCall, before: int) -> Outcome:
        nonlocal drives
        match call:
            case LocateInView():
                if before >= looks:
                    return sees(where, (0.4, 0.1, 0.9))
                return Outcome("not_seen", "", data={"base_pose": list(where)})
            case ExecuteRskill() if "pose" in call.goal_params:
                drives += 1
                if drives <= blocked:
                    return Outcome("failed", "the base stays where it is", "goal_rejected")
                pose = call.goal_params["pose"]["pose"]
                where[:2] = [pose["position"]["x"], pose["position"]["y"]]
                return DONE
            case QueryScene():
                return YES
            case _:
                return DONE

    return world


def test_beyond_its_view_it_drives_to_where_it_has_not_looked_from() -> None:
    """Regression: after two looks to the sides it gave up, also with room to drive."""
    result, calls = run_script(unseen_until(5), DRIVING)
    # it looks along y: back is smaller y, left is smaller x
    assert poses(calls) == [(1.0, 1.65), (0.55, 1.65)]
    assert result["status"] == "success"


def test_a_place_that_cannot_be_reached_is_left_out_of_the_search() -> None:
    result, calls = run_script(unseen_until(4, blocked=1), DRIVING)
    assert poses(calls)[:2] == [(1.0, 1.65), (0.55, 1.65)]
    assert result["status"] == "success"


def test_a_search_has_an_end() -> None:
    result, calls = run_script(unseen_until(999), DRIVING)
    assert result["reason"] == "the red cube was not seen"
    assert len(poses(calls)) == len(set(poses(calls))) == len(VIEWPOINTS_M)
    _, calls = run_script(unseen_until(999), PALETTE)
    assert poses(calls) == [], "navigation that takes no pose"


# -- words that the detector does not know
def test_an_unknown_word_is_said_before_the_robot_drives() -> None:
    """Regression: for a thing that its detector has no word for it looked around the whole table
    and did not say so.
    """
    unknown = {"unknown_words": ["cube"]}
    said = dataclasses.replace(PALETTE, topics=frozenset({OPERATOR}))

    nothing = Outcome("not_seen", "", data=unknown)
    result, calls = run_script(saying(nothing, DONE), said)
    assert "does not know cube" in result["reason"]
    assert [call.tool for call in calls] == ["query_scene", "locate_in_view", "emit_prompt"]
    something = Outcome("found", "", data=dict(FOUND.data) | unknown)
    result, calls = run_script(saying(something), said)
    tools = [call.tool for call in calls]
    assert tools.count("emit_prompt") == 1
    assert tools.index("emit_prompt") < tools.index("execute_rskill")
    assert result["status"] == "success"
