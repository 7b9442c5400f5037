"""`query_task_progress`: what it looks at, what each answer becomes, and that an opinion neither
begins nor ends anything.
"""

import asyncio
from typing import Any

import pytest

from tests.support.waiting import play
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import RewardClient
from vram_arbiter.reasoner.history import KEPT_MAX, SHOWN_MAX, Past, Taken, spread
from vram_arbiter.reasoner.loop import run_episode
from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.perception import Judge
from vram_arbiter.reasoner.planner import Episode, Finish
from vram_arbiter.reasoner.tools import Tools
from vram_arbiter.schemas.errors import (
    BadRequest,
    Evicted,
    FrameStale,
    ModelError,
    NotPermitted,
    OutOfMemory,
    VramError,
)
from vram_arbiter.schemas.goals import FrameReply
from vram_arbiter.schemas.tools import (
    PROGRESS_WINDOW_MAX_S,
    ExecuteRskill,
    QueryTaskProgress,
    ToolCall,
)

pytestmark = pytest.mark.anyio

ASK = QueryTaskProgress()
TASK = "grab the red cube"


# -- the pictures
class Camera:
    """Gives what the test says, or raises it."""

    def __init__(self) -> None:
        self.next: FrameReply | VramError = FrameStale("nothing yet")
        self.looks = 0
        self.looked = asyncio.Event()

    def shows(self, image: bytes, age_ms: float = 0.0) -> None:
        self.next = FrameReply(
            camera="wrist",
            encoding="png",
            data=image,
            width=1,
            height=1,
            stamp_monotonic_ns=1,
            age_ms=age_ms,
        )

    async def __call__(self) -> FrameReply:
        self.looks += 1
        self.looked.set()
        if isinstance(self.next, VramError):
            raise self.next
        return self.next


def test_the_window_is_what_was_taken_in_it() -> None:
    past = Past(Camera())
    for second in range(100):
        past.add(Taken(float(second), b"%d" % second))
    past.add(Taken(50.0, b"late"))
    past.add(Taken(99.0, b"the same again"))
    assert [taken.image for taken in past.since(96.5)] == [b"97", b"98", b"99"]
    assert past.since(0.0)[0].at_s == 99.0 - PROGRESS_WINDOW_MAX_S, "older ones are forgotten"
    thinned = past.since(0.0)
    assert len(thinned) == SHOWN_MAX
    assert thinned[-1].image == b"99", "the newest is always shown"
    for hundredth in range(2 * KEPT_MAX):
        past.add(Taken(200.0 + hundredth / 100, b""))
    assert past.since(200.0)[0].at_s == pytest.approx(200.0 + KEPT_MAX / 100), (
        "never more than so many are kept"
    )


@pytest.mark.parametrize("count", range(20))
def test_thinning_keeps_order_and_both_ends(count: int) -> None:
    items = list(range(count))
    for most in (2, 3, 8):
        found = spread(items, most)
        assert found == sorted(set(found))
        assert len(found) == min(count, most)
        assert [*found[:1], *found[-1:]] == [*items[:1], *items[-1:]]


async def test_a_camera_that_shows_nothing_leaves_a_gap_and_is_looked_at_again() -> None:
    camera = Camera()
    past = Past(camera, rate_hz=1000.0)
    looking = asyncio.create_task(past.run())
    for error in (FrameStale("too old"), BadRequest("there is no camera"), ModelError("?")):
        camera.next = error
        camera.looked.clear()
        await camera.looked.wait()
        assert past.since(0.0) == []
    camera.shows(b"x", age_ms=250.0)
    looks = camera.looks
    while camera.looks < looks + 2:
        camera.looked.clear()
        await camera.looked.wait()
    (*_, newest) = past.since(0.0)
    assert newest.image == b"x"
    looking.cancel()
    await asyncio.gather(looking, return_exceptions=True)


# -- the tool
PALETTE = Palette((Skill("lab/grab", "vla", "", ("grasp",)),), can_judge=True)


def ask_tool(
    a_runner: Any,
    a_sidecar: Any,
    call: ToolCall = ASK,
    *,
    frame_error: VramError | None = None,
    **says: Any,
) -> Any:
    """The outcome, and what the sidecar was asked. `says`: fields of the sidecar."""

    async def story() -> Any:
        async with (
            a_runner() as runner,
            a_sidecar("lab/reward") as sidecar,
            RunnerClient(runner.endpoint) as eyes,
            RewardClient(sidecar.endpoint) as reward,
        ):
            runner.frame_error = frame_error
            vars(sidecar).update(says)
            past = Past(lambda: eyes.frame("wrist", max_age_ms=1000.0, encoding="png"))
            if frame_error is None:
                await past.look()
            judge = Judge(reward, past, TASK)
            tools = Tools(RunnerClient(runner.endpoint), None, None, judge=judge, palette=PALETTE)
            outcome = await tools(call)
            return outcome, [message for message in sidecar.messages if message["op"] == "score"]

    return play(story)


def test_an_opinion_is_said_with_what_it_is_worth(a_runner: Any, a_sidecar: Any) -> None:
    outcome, asked = ask_tool(a_runner, a_sidecar)
    assert outcome.status == "answered"
    assert "progress 0.70, 0.20" in outcome.text
    assert "it looks done (0.90, done from 0.50 on). An opinion about" in outcome.text
    assert (outcome.data["progress"], outcome.data["task"]) == ([0.2, 0.7], TASK)
    assert asked[0]["task"] == TASK, "without words of its own the call is about the present task"
    assert 1 <= len(asked[0]["images"]) <= SHOWN_MAX


def test_what_the_model_does_not_say_is_not_said(a_runner: Any, a_sidecar: Any) -> None:
    less = {"progress": [0.4], "success": [], "success_threshold": 0.5}
    other = QueryTaskProgress(task="open the drawer")
    outcome, asked = ask_tool(a_runner, a_sidecar, other, judgement=less)
    assert asked[0]["task"] == "open the drawer"
    assert outcome.text.startswith("'open the drawer': progress 0.40. An opinion")


@pytest.mark.parametrize(
    ("error", "status", "code"),
    [
        (Evicted("made to leave"), "evicted", "evicted"),
        (OutOfMemory("full"), "error", "oom"),
        (BadRequest("task: names nothing"), "error", "bad_request"),
    ],
)
def test_no_answer_is_never_no_progress(
    a_runner: Any, a_sidecar: Any, error: VramError, status: str, code: str
) -> None:
    outcome, _ = ask_tool(a_runner, a_sidecar, error=error)
    assert (outcome.status, outcome.code) == (status, code)
    assert "progress" not in outcome.data


@pytest.mark.parametrize(
    "judgement",
    [
        {},
        {"progress": [], "success": [], "success_threshold": 0.5},
        {"progress": [1.5], "success": [], "success_threshold": 0.5},
        {"progress": [0.5], "success": [float("nan")], "success_threshold": 0.5},
        {"progress": "half", "success": [], "success_threshold": 0.5},
        {"progress": [0.1, 0.2, 0.9], "success": [], "success_threshold": 0.5},
        {"progress": [0.5], "success": [0.9, 0.9], "success_threshold": 0.5},
        {"progress": [0.5], "success": [0.9], "success_threshold": float("nan")},
        {"progress": [0.5], "success": [0.9], "success_threshold": -1.0},
    ],
)
def test_a_strange_answer_is_an_error(
    a_runner: Any, a_sidecar: Any, judgement: dict[str, Any]
) -> None:
    """Regression: a reward model's opinion about three pictures was reported for two."""
    outcome, _ = ask_tool(a_runner, a_sidecar, judgement=judgement)
    assert (outcome.status, outcome.code) == ("error", "model_error")


def test_without_a_fresh_picture_nothing_is_judged(a_runner: Any, a_sidecar: Any) -> None:
    dark = FrameStale("the camera is dark")
    outcome, asked = ask_tool(a_runner, a_sidecar, frame_error=dark)
    assert (outcome.status, outcome.code, asked) == ("no_frame", "frame_stale", [])


def test_its_flag_is_its_own() -> None:
    """Whatever else is provided, and beside no goal."""
    without = Palette((), can_locate=True, can_query=True)
    alone = Palette((), can_locate=False, can_query=False, can_judge=True)
    assert isinstance(without.check(ASK), NotPermitted)
    assert alone.check(ASK) is None
    assert {function["function"]["name"] for function in alone.functions()} == {
        "query_task_progress"
    }
    assert "query_task_progress" not in {
        function["function"]["name"] for function in without.functions()
    }
    assert isinstance(alone.check(ASK, goal_runs=True), NotPermitted)


class Believes:
    """A planner that asks for progress, then grabs, then asks again and again, whatever it
    hears.
    """

    def __init__(self) -> None:
        self.calls: list[ToolCall] = [ASK, ExecuteRskill(rskill_id="lab/grab", prompt=TASK), ASK]

    async def decide(self, episode: Episode) -> ToolCall | Finish:
        done = len(episode.steps)
        return (
            self.calls[done]
            if done < len(self.calls)
            else Finish(False, "the planner decides, nobody else")
        )


async def test_an_opinion_begins_and_ends_nothing(a_runner: Any, a_sidecar: Any) -> None:
    """It says *done* before, while and after a goal runs: the goal runs to its own end, and the
    episode to the planner's.
    """

    async with (
        a_runner() as runner,
        a_sidecar("lab/reward") as sidecar,
        RunnerClient(runner.endpoint) as client,
        RunnerClient(runner.endpoint) as eyes,
        RewardClient(sidecar.endpoint) as reward,
    ):
        sidecar.judgement = {"progress": [1.0], "success": [1.0], "success_threshold": 0.5}
        past = Past(lambda: eyes.frame("wrist", encoding="png"), rate_hz=1000.0)
        looking = asyncio.create_task(past.run())
        tools = Tools(client, None, None, judge=Judge(reward, past, TASK), palette=PALETTE)
        episode = asyncio.create_task(run_episode(TASK, Believes(), PALETTE, tools))
        await runner.accepted.wait()
        scored = sidecar.asked.count("score")
        await runner.feed(0.1)
        assert not episode.done()
        assert sidecar.asked.count("score") == scored == 1, (
            "nobody asks by himself while a goal runs"
        )
        assert runner.cancelled == []
        await runner.end("failed", code="limit_exceeded", message="not grasped")
        looking.cancel()
        result, cancelled = await episode, runner.cancelled
    assert [step["status"] for step in result["steps"]] == ["answered", "failed", "answered"]
    assert (result["status"], result["reason"]) == ("failure", "the planner decides, nobody else")
    assert result["vlm_confirmed"] is False, "an opinion about progress confirms nothing"
    assert cancelled == []
