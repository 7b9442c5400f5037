"""The loop never waits for its planner: results, cancels, words and dangers pass it by.

Every wait here is for an event.
"""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from tests.support.waiting import play
from vram_arbiter.reasoner import loop as looping
from vram_arbiter.reasoner.inbox import WORDS_MAX, Cancel, Danger, Inbox, Said
from vram_arbiter.reasoner.loop import LOOKS_IN_A_ROW_MAX, REFUSALS_MAX, Result, run_episode
from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.planner import Episode, Finish, Outcome
from vram_arbiter.schemas.errors import LlmError
from vram_arbiter.schemas.tools import (
    ExecuteRskill,
    LocateInView,
    QueryScene,
    StopGoal,
    ToolCall,
    WaitOn,
)

pytestmark = pytest.mark.anyio

PALETTE = Palette(
    (Skill("lab/grab", "vla", "grab", ("grasp",)), Skill("lab/eye", "vlm", "look", ("query",)))
)
GRAB = ExecuteRskill(rskill_id="lab/grab")
NEVER = asyncio.Event


class Planner:
    """Decides by a function of the episode; a function that returns None hangs for ever."""

    def __init__(self, decide: Callable[[Episode], ToolCall | Finish | None]) -> None:
        self._decide = decide
        self.asked: list[Episode] = []
        self.hanging = asyncio.Event()
        self.dropped = 0

    async def decide(self, episode: Episode) -> ToolCall | Finish:
        self.asked.append(
            Episode(episode.task, [*episode.steps], [*episode.notes], episode.running)
        )
        decision = self._decide(episode)
        if decision is not None:
            return decision
        self.hanging.set()
        try:
            await NEVER().wait()
        except asyncio.CancelledError:
            self.dropped += 1
            self.hanging.clear()
            raise
        raise AssertionError("never set")


class Robot:
    """One goal that ends when told, and says when it was cancelled."""

    def __init__(self) -> None:
        self.begun = asyncio.Event()
        self.end = asyncio.Event()
        self.cancelled = False

    async def __call__(self, call: ToolCall) -> Outcome:
        self.begun.set()
        try:
            await self.end.wait()
        except asyncio.CancelledError:
            self.cancelled = True
            raise
        return Outcome("succeeded", "there")


async def test_a_cancel_passes_a_planner_that_hangs() -> None:
    planner, inbox = Planner(lambda episode: None), Inbox()
    episode = asyncio.create_task(run_episode("x", planner, PALETTE, Robot(), inbox=inbox))
    await planner.hanging.wait()
    inbox.put(Cancel("enough"))
    result = await episode
    await asyncio.sleep(0)
    assert planner.dropped == 1
    assert result["reason"] == "canceled: enough"


async def test_a_danger_ends_the_goal_and_the_episode_while_the_planner_hangs() -> None:
    robot, inbox = Robot(), Inbox()
    planner = Planner(lambda episode: None if episode.running else GRAB)
    episode = asyncio.create_task(run_episode("x", planner, PALETTE, robot, inbox=inbox))
    await robot.begun.wait()
    inbox.put(Said("careful"))
    await planner.hanging.wait()
    inbox.put(Danger("emergency stop: by hand", stop=True))
    result = await episode
    assert (result["reason"], result["stopped"]) == ("stopped: emergency stop: by hand", True)
    assert robot.cancelled
    assert result["steps"][0]["status"] == "canceled"


async def test_a_result_passes_a_planner_that_hangs_and_makes_it_think_again() -> None:
    robot, inbox = Robot(), Inbox()

    def decide(episode: Episode) -> ToolCall | Finish | None:
        if episode.running:
            return None
        return Finish(True, "seen the result") if episode.steps else GRAB

    planner = Planner(decide)
    episode = asyncio.create_task(run_episode("x", planner, PALETTE, robot, inbox=inbox))
    await robot.begun.wait()
    inbox.put(Said("how is it going?"))
    await planner.hanging.wait()
    robot.end.set()
    result = await episode
    assert result["status"] == "success"
    assert planner.dropped == 1
    assert not robot.cancelled
    assert [step.outcome.status for step in planner.asked[-1].steps] == ["succeeded"]
    assert planner.asked[1].running == GRAB
    assert result["notes"] == [{"source": "operator", "text": "how is it going?", "after": 0}]


@pytest.mark.parametrize(
    ("message", "source"),
    [(Said("leave it"), "operator"), (Danger("the front camera is stale", stop=False), "safety")],
)
async def test_news_reach_a_thinking_planner_by_asking_it_again(
    message: Said | Danger, source: str
) -> None:
    inbox = Inbox()
    planner = Planner(
        lambda episode: Finish(False, episode.notes[0].source) if episode.notes else None
    )
    episode = asyncio.create_task(run_episode("x", planner, PALETTE, Robot(), inbox=inbox))
    await planner.hanging.wait()
    inbox.put(message)
    result = await episode
    assert result["reason"] == source
    assert (len(planner.asked), planner.dropped) == (2, 1)


async def test_a_long_talk_is_forgotten_from_its_beginning() -> None:
    robot, inbox = Robot(), Inbox()

    def decide(episode: Episode) -> ToolCall | Finish:
        if episode.running:
            return WaitOn()
        return Finish(True, "done") if episode.steps else GRAB

    planner = Planner(decide)
    episode = asyncio.create_task(run_episode("x", planner, PALETTE, robot, inbox=inbox))
    await robot.begun.wait()
    for number in range(looping.NOTES_MAX + 9):
        asked = len(planner.asked)
        inbox.put(Said(str(number)))
        while len(planner.asked) == asked:
            await asyncio.sleep(0)
    robot.end.set()
    result = await episode
    assert [note["text"] for note in result["notes"]] == [
        str(n) for n in range(9, looping.NOTES_MAX + 9)
    ]


async def test_whoever_speaks_all_the_time_does_not_keep_the_planner_from_deciding() -> None:
    inbox = Inbox()
    released = asyncio.Event()

    class Slow(Planner):
        async def decide(self, episode: Episode) -> ToolCall | Finish:
            self.asked.append(episode)
            if len(self.asked) > looping.SUPERSEDED_MAX:
                released.set()
                await asyncio.sleep(0)
                return Finish(True, "decided")
            inbox.put(Said("more"))
            await NEVER().wait()
            raise AssertionError("never set")

    planner = Slow(lambda episode: None)
    episode = asyncio.create_task(run_episode("x", planner, PALETTE, Robot(), inbox=inbox))
    await released.wait()
    inbox.put(Said("and more"))
    assert (await episode)["status"] == "success"
    assert len(planner.asked) == looping.SUPERSEDED_MAX + 1


@pytest.mark.parametrize(
    ("decision", "status", "reason"),
    [
        (StopGoal(), "canceled", "after the goal"),
        (WaitOn(), "succeeded", "after the goal"),
        (LocateInView(query="cube"), "succeeded", "after the goal"),
        (ExecuteRskill(rskill_id="lab/grab", prompt="another"), "succeeded", "after the goal"),
        (Finish(False, "no more"), "canceled", "no more"),
        (LlmError("the model is away"), "succeeded", "after the goal"),
    ],
)
async def test_beside_a_goal_it_goes_on_unless_the_planner_clearly_stops_it(
    decision: ToolCall | Finish | LlmError, status: str, reason: str
) -> None:
    robot, inbox, consulted = Robot(), Inbox(), asyncio.Event()

    def decide(episode: Episode) -> ToolCall | Finish:
        if episode.running:
            consulted.set()
            if isinstance(decision, LlmError):
                raise decision
            return decision
        return Finish(True, "after the goal") if episode.steps else GRAB

    episode = asyncio.create_task(run_episode("x", Planner(decide), PALETTE, robot, inbox=inbox))
    await robot.begun.wait()
    inbox.put(Said("?"))
    await consulted.wait()
    for _ in range(5):  # what the decision does is done within a few turns of the loop
        await asyncio.sleep(0)
    robot.end.set()
    result = await episode
    assert [step["status"] for step in result["steps"]] == [status]
    assert result["reason"] == reason


async def test_a_planner_that_never_decides_is_given_up() -> None:
    result = await run_episode(
        "x", Planner(lambda episode: None), PALETTE, Robot(), think_max_s=0.05
    )
    assert result["reason"] == "the planner failed: no decision within 0.05 s"


async def test_an_emergency_stop_is_not_discussed_with_the_planner() -> None:
    async def stopped(call: ToolCall) -> Outcome:
        return Outcome("failed", "the stop is latched", "estop_requested")

    planner = Planner(lambda episode: GRAB)
    result = await run_episode("x", planner, PALETTE, stopped)
    assert (result["reason"], result["stopped"]) == ("stopped: the stop is latched", True)
    assert len(planner.asked) == 1


async def test_an_episode_that_is_cancelled_takes_its_goal_with_it() -> None:
    robot = Robot()
    episode = asyncio.create_task(run_episode("x", Planner(lambda episode: GRAB), PALETTE, robot))
    await robot.begun.wait()
    episode.cancel()
    with pytest.raises(asyncio.CancelledError):
        await episode
    assert robot.cancelled


def test_refusals_looks_and_steps_have_limits() -> None:
    answers: list[Outcome] = []

    async def see(call: ToolCall) -> Outcome:
        answers.append(Outcome("answered", "Yes."))
        return answers[-1]

    async def story(decide: Callable[[Episode], ToolCall | Finish], **limits: Any) -> Result:
        return await run_episode("x", Planner(decide), PALETTE, see, **limits)

    stubborn = play(lambda: story(lambda episode: ExecuteRskill(rskill_id="lab/eye")))
    assert [step["status"] for step in stubborn["steps"]] == ["refused"] * REFUSALS_MAX
    assert "cannot be executed" in stubborn["reason"]
    curious = play(lambda: story(lambda episode: QueryScene(question=f"and {len(episode.steps)}?")))
    assert len(answers) == LOOKS_IN_A_ROW_MAX
    assert curious["steps"][-1]["code"] == "limit_exceeded"
    short = play(
        lambda: story(
            lambda episode: QueryScene(question=f"and {len(episode.steps)}?"), steps_max=3
        )
    )
    assert short["reason"] == "gave up after 3 steps"


def test_a_defect_in_a_tool_is_not_swallowed() -> None:
    async def broken(call: ToolCall) -> Outcome:
        raise ZeroDivisionError("oops")

    with pytest.raises(ZeroDivisionError):
        play(lambda: run_episode("x", Planner(lambda episode: GRAB), PALETTE, broken))


def test_words_are_bounded_and_a_cancel_is_never_dropped() -> None:
    inbox = Inbox()
    inbox.put(Cancel("now"))
    for number in range(WORDS_MAX + 5):
        inbox.put(Said(str(number)))
    taken = inbox.take()
    assert taken[0] == Cancel("now")
    assert [item.text for item in taken[1:] if isinstance(item, Said)] == [
        str(n) for n in range(5, WORDS_MAX + 5)
    ]
    assert inbox.take() == []
