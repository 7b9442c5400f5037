"""What each tool does on the wire, and which outcome each answer becomes: real sockets, real
clients.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any, cast

import pytest

from tests.support.waiting import eventually, play
from vram_arbiter.clients.runner import Goal, RunnerClient
from vram_arbiter.clients.sidecar.perception import DetectorClient, SceneVlmClient
from vram_arbiter.reasoner.execution import GOAL_MAX_S, _stands_still, waits_s
from vram_arbiter.reasoner.hints import Hints
from vram_arbiter.reasoner.inbox import Cancel, Danger, Inbox, Said
from vram_arbiter.reasoner.loop import run_episode
from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.perception import LOOKED_AT_MAX_S, LOOKS_MAX, PLACE_MAX_S
from vram_arbiter.reasoner.planner import Episode, Finish
from vram_arbiter.reasoner.tools import Tools
from vram_arbiter.reasoner.watch import watch
from vram_arbiter.schemas.errors import (
    BadState,
    Evicted,
    FrameStale,
    InternalError,
    LeaseRevoking,
    LimitExceeded,
    Loading,
    ModelError,
    NotResident,
    OutOfMemory,
    VramError,
    WaitTimeout,
)
from vram_arbiter.schemas.tools import (
    EmitPrompt,
    ExecuteRskill,
    LifecycleTransition,
    LocateInView,
    QueryScene,
    StopGoal,
    ToolCall,
)
from vram_arbiter.schemas.world import CameraModel

pytestmark = pytest.mark.anyio

GRAB = ExecuteRskill(rskill_id="lab/grab", prompt="grab it", deadline_s=30)
LOOK = LocateInView(query="red cube")
ASK = QueryScene(question="what is held?")


@pytest.mark.parametrize(
    ("ended", "code", "told"),
    [
        ("succeeded", "", ("succeeded", "")),
        ("failed", "oom", ("failed", "oom")),
        ("canceled", "", ("canceled", "")),
        ("deadline", "", ("failed", "deadline")),
    ],
)
async def test_a_goals_end_becomes_an_outcome(
    runner: Any, client: RunnerClient, ended: str, code: str, told: tuple[str, str]
) -> None:
    doing = asyncio.create_task(Tools(client, None, None)(GRAB))
    await runner.accepted.wait()
    await runner.end(ended, code=code)
    outcome = await doing
    assert (outcome.status, outcome.code) == told


async def test_what_follows_a_goal_is_said_while_it_runs(runner: Any, client: RunnerClient) -> None:
    class Said(Hints):
        def __init__(self) -> None:
            self.follow = asyncio.Queue[str]()

        async def follows(self, rskill_id: str) -> None:
            await self.follow.put(rskill_id)

    said = Said()
    drive = GRAB.model_copy(update={"next_rskill_id": "test/next"})
    doing = asyncio.create_task(Tools(client, None, None, hints=said)(drive))
    await runner.accepted.wait()
    follows = await said.follow.get()
    await runner.end("succeeded")
    assert (follows, (await doing).status) == ("test/next", "succeeded")


@pytest.mark.parametrize("heard", [True, False])
async def test_a_goal_nobody_waits_for_any_more_is_cancelled_and_its_end_is_heard(
    runner: Any, client: RunnerClient, heard: bool
) -> None:
    """Regression: a goal went on moving the arm after the reasoner that had sent it was told to
    end, or where its acceptance was not received."""

    runner.deaf |= set() if heard else {"goal"}
    doing = asyncio.create_task(Tools(client, None, None)(GRAB))
    await (runner.accepted if heard else runner.heard).wait()
    doing.cancel()
    with pytest.raises(asyncio.CancelledError):
        await doing
    assert (len(runner.cancelled), runner.goal) == (1, None)


def test_patience_counts_motion_and_not_the_wait_for_the_gpu(a_runner: Any) -> None:
    async def story(patient: ExecuteRskill, feed: Callable[[Any], Any]) -> Any:
        async with a_runner() as runner, RunnerClient(runner.endpoint) as client:
            doing = asyncio.create_task(Tools(client, None, None)(patient))
            await runner.accepted.wait()
            await feed(runner)
            return await doing, runner.cancelled

    patient = ExecuteRskill(rskill_id="lab/grab", patience_s=0.3, progress_tolerance=0.05)

    async def stands_still(runner: Any) -> None:
        await runner.feed(0.2)
        await runner.feed(0.24)  # within the tolerance: no progress

    outcome, cancelled = play(lambda: story(patient, stands_still))
    assert (outcome.status, outcome.code) == ("failed", "no_progress")
    assert len(cancelled) == 1

    async def loads(runner: Any) -> None:
        await runner.feed(0.0, "acquiring")
        # twice the patience: what is tested is that time passes without a cancel
        await asyncio.sleep(0.6)
        await runner.end()

    outcome, cancelled = play(lambda: story(patient, loads))
    assert outcome.status == "succeeded"
    assert cancelled == []


async def test_progress_that_was_told_while_the_reasoner_stood_still_counts() -> None:
    """Regression: the time was up and the feedback there, both at once; the goal was called off for
    no progress.
    """

    loop, goal = asyncio.get_running_loop(), Goal(RunnerClient("ipc:///nobody"), "g")

    def feed(progress: float) -> None:
        goal.fed(
            {
                "push": "feedback",
                "goal_id": "g",
                "progress": progress,
                "state": "running",
                "tick_idx": 0,
                "detail": "",
            }
        )

    patient = ExecuteRskill(rskill_id="lab/grab", patience_s=5.0, progress_tolerance=0.05)
    watching = asyncio.create_task(_stands_still(goal, patient))
    feed(0.2)
    for _ in range(5):  # it has heard of it
        await asyncio.sleep(0)
    # type: ignore[method-assign,misc]  # nothing ran for six seconds
    loop.time = lambda now=loop.time: now() + 6.0
    loop.call_soon_threadsafe(feed, 0.4)
    for _ in range(5):
        await asyncio.sleep(0)
    assert not watching.done()
    goal.ended(
        {
            "push": "result",
            "goal_id": "g",
            "status": "succeeded",
            "success": True,
            "code": "",
            "message": "",
            "data": {},
        }
    )
    found = await watching
    assert found is False


@contextlib.asynccontextmanager
async def looking(
    a_runner: Any, a_sidecar: Any
) -> AsyncIterator[tuple[Any, Any, DetectorClient, Tools]]:
    """A runner with a camera, one sidecar that is both models, its detector's client, and the tools
    over all of them.
    """
    async with (
        a_runner() as runner,
        RunnerClient(runner.endpoint) as client,
        a_sidecar("lab/eye") as sidecar,
        DetectorClient(sidecar.endpoint) as detector,
        SceneVlmClient(sidecar.endpoint) as vlm,
    ):
        yield runner, sidecar, detector, Tools(client, detector, vlm)


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (Evicted("it left"), "evicted"),
        (NotResident("not there"), "evicted"),
        (LeaseRevoking("leaving"), "evicted"),
        (OutOfMemory("full"), "error"),
        (Loading("soon"), "error"),
        (ModelError("broken"), "error"),
        (WaitTimeout("busy"), "error"),
    ],
)
async def test_a_model_that_did_not_look_never_says_that_nothing_is_there(
    a_runner: Any, a_sidecar: Any, error: VramError, status: str
) -> None:
    """The defect of the field: an evicted detector answered `found: false`."""

    async with looking(a_runner, a_sidecar) as (_, sidecar, _, tools):
        sidecar.error = error
        result = [await tools(LOOK), await tools(ASK)]
    for outcome in result:
        assert (outcome.status, outcome.code) == (status, error.code)


async def test_looked_not_seen_answered_and_no_frame_are_four_things(
    a_runner: Any, a_sidecar: Any
) -> None:
    async with looking(a_runner, a_sidecar) as (runner, sidecar, _, tools):
        found = [(await tools(LOOK)).status, (await tools(ASK)).status]
        sidecar.detections = [{"label": "red cube", "score": 0.9, "box": [0, 0, 2, 2]}]
        seen = await tools(LOOK)
        assert "the camera cannot say where it stands" in seen.text
        runner.frame_error = FrameStale("the newest frame is 9 s old")
        found = [*found, seen.status, (await tools(LOOK)).status, (await tools(ASK)).status]
    assert found == ["not_seen", "answered", "error", "no_frame", "no_frame"]


async def test_a_look_tells_all_places_best_first_and_where_the_base_stood(
    a_runner: Any, a_sidecar: Any
) -> None:
    """Boxes that lie on one thing are that one thing."""
    down = CameraModel(
        K=((100.0, 0.0, 50.0), (0.0, 100.0, 50.0), (0.0, 0.0, 1.0)),
        T_base_camera=(
            (1.0, 0.0, 0.0, 0.0),
            (0.0, -1.0, 0.0, 0.0),
            (0.0, 0.0, -1.0, 1.0),
            (0.0, 0.0, 0.0, 1.0),
        ),
        base_pose=(0.4, -0.2, 0.1),
    )

    async with looking(a_runner, a_sidecar) as (runner, sidecar, _, tools):
        runner.camera_model = down.model_dump(mode="json")
        sidecar.detections = [
            {"label": "red cube", "score": 0.6, "box": [18, 38, 22, 42]},
            {"label": "red cube", "score": 0.5, "box": [79, 58, 83, 62]},
            {"label": "red cube", "score": 0.7, "box": [78, 58, 82, 62]},
        ]
        outcome = await tools(LOOK)
    assert outcome.status == "found"
    seen = [(*one["point_base_m"][:2], one["score"]) for one in outcome.data["seen"]]
    assert [pytest.approx(one) for one in seen] == [(0.3, -0.1, 0.7), (-0.3, 0.1, 0.6)]
    assert outcome.data["point_base_m"] == outcome.data["seen"][0]["point_base_m"]
    assert outcome.data["base_pose"] == [0.4, -0.2, 0.1]
    assert "less likely at (-0.300, 0.100" in outcome.text


@pytest.mark.parametrize(
    "wrong",
    [
        {"box": [float("nan"), 0, 2, 2]},
        {"box": [0, 0, float("inf"), 2]},
        {"score": float("nan")},
        {"score": 7.0},
    ],
)
async def test_a_place_that_is_no_number_is_no_place(
    a_runner: Any, a_sidecar: Any, wrong: dict[str, Any]
) -> None:
    """Regression: it was `found` at (nan, nan) m from the base."""

    async with looking(a_runner, a_sidecar) as (_, sidecar, _, tools):
        sidecar.detections = [{"label": "red cube", "score": 0.9, "box": [0, 0, 2, 2]} | wrong]
        outcome = await tools(LOOK)
    assert (outcome.status, outcome.code) == ("error", "model_error")


@pytest.mark.parametrize(
    ("slow", "status", "asked"), [(1, "not_seen", 2), (LOOKS_MAX, "no_frame", LOOKS_MAX)]
)
async def test_a_place_of_long_ago_is_none(
    a_runner: Any,
    a_sidecar: Any,
    monkeypatch: pytest.MonkeyPatch,
    slow: int,
    status: str,
    asked: int,
) -> None:
    """Regression: a detector that waited two minutes for the GPU told where the thing had stood
    when it was asked. Here it is taken away meanwhile; `slow`: answers that take so long."""
    now = [100.0]
    monkeypatch.setattr("vram_arbiter.reasoner.perception.monotonic", lambda: now[0])

    async with looking(a_runner, a_sidecar) as (_, sidecar, detector, tools):
        detect = detector.detect

        async def waits(*arguments: Any, **options: Any) -> Any:
            late = sidecar.asked.count("detect") < slow
            sidecar.detections = [{"label": "red cube", "score": 0.9, "box": [0, 0, 2, 2]}] * late
            now[0] += 2 * PLACE_MAX_S * late
            return await detect(*arguments, **options)

        monkeypatch.setattr(detector, "detect", waits)
        outcome = await tools(LOOK)
        assert sidecar.asked.count("detect") == asked
    assert outcome.status == status


@pytest.mark.parametrize("call", [LOOK, ASK])  # a reward model is asked by the same function
@pytest.mark.parametrize("late", [0, LOOKS_MAX - 1, LOOKS_MAX])
async def test_a_picture_that_waited_for_the_gpu_is_not_looked_at_and_a_new_one_is(
    a_runner: Any, a_sidecar: Any, call: Any, late: int
) -> None:
    """Regression: only the detector's was looked at again, by the time that the answer took."""

    looked = "not_seen" if call is LOOK else "answered"
    async with looking(a_runner, a_sidecar) as (_, sidecar, _, tools):
        sidecar.late = late
        outcome = await tools(call)
        limits = [message["fresh_s"] for message in sidecar.messages if "fresh_s" in message]
        found = outcome.status
    assert (found, len(limits)) == (
        "no_frame" if late == LOOKS_MAX else looked,
        min(late + 1, LOOKS_MAX),
    )
    assert all(0.0 < limit < LOOKED_AT_MAX_S for limit in limits), (
        "what the picture's age left of it"
    )


async def test_a_model_whose_licence_is_barred_is_neither_asked_nor_loaded(
    a_runner: Any, a_sidecar: Any
) -> None:
    """Regression: it was not asked, but `lifecycle_transition` put it on the GPU."""
    palette = Palette((Skill("lab/eye", "vlm", "", ("query",), barred="its licence"),))

    async with (
        a_runner() as runner,
        RunnerClient(runner.endpoint) as client,
        a_sidecar("lab/eye") as sidecar,
        SceneVlmClient(sidecar.endpoint) as vlm,
    ):
        tools = Tools(client, None, vlm, palette=palette, components={"eye": vlm})
        load = LifecycleTransition(node="eye", transition="activate")
        outcomes = [await tools(ASK), await tools(load)]
        asked = set(sidecar.asked)
    for outcome in outcomes:
        assert (outcome.status, outcome.code) == ("refused", "not_permitted")
    assert asked == {"ping"}


async def test_nothing_is_loaded_or_unloaded_beside_a_goal(a_runner: Any, a_sidecar: Any) -> None:
    """The defect of the field: a language model could activate the detector in the middle of a
    grab.
    """

    async with (
        a_runner() as runner,
        RunnerClient(runner.endpoint) as client,
        RunnerClient(runner.endpoint) as other,
        a_sidecar("lab/eye") as sidecar,
        DetectorClient(sidecar.endpoint) as detector,
    ):
        tools = Tools(client, detector, None, components={"detector": detector})
        await other.send_goal("lab/grab")  # somebody else's goal counts as well
        calls = [
            LifecycleTransition.model_validate({"node": "detector", "transition": transition})
            for transition in ("activate", "deactivate", "cleanup", "configure")
        ]
        beside = [(await tools(call)).status for call in calls]
        asked = [op for op in sidecar.asked if op != "ping"]
        await runner.end()
        after = [(await tools(call)).status for call in calls]
        assert asked == []
        asked = [op for op in sidecar.asked if op != "ping"]
    assert beside == ["refused", "refused", "refused", "done"]
    assert after == ["done"] * 4
    assert asked == ["load", "unload", "unload"]


async def test_an_unknown_component_and_a_prompt(runner: Any, client: RunnerClient) -> None:
    tools = Tools(client, None, None)
    calls = [
        LifecycleTransition(node="kernel", transition="deactivate"),
        EmitPrompt(target_topic="/operator", text="help"),
        LOOK,
        ASK,
    ]
    found = [(await tools(call)).status for call in calls]
    assert found == ["refused", "done", "refused", "refused"]


async def test_an_emergency_stop_and_a_runner_that_is_gone_reach_the_inbox(a_runner: Any) -> None:
    inbox = Inbox()
    async with a_runner() as runner, RunnerClient(runner.endpoint) as client:
        watching = asyncio.create_task(watch(client, inbox, period_s=0.01, answer_s=60.0))
        await client.state()
        assert inbox.take() == []
        runner.diagnostics = {"front": "stale", "joint_state": "ok"}
        await inbox.wait()
        assert inbox.take() == [Danger("not to be trusted now, too old: front", stop=False)]
        runner.estop = "somebody pressed it"
        await inbox.wait()
        await watching
        stopped = inbox.take()
    async with RunnerClient(runner.endpoint, connect_timeout_s=0.1) as client:
        await watch(client, inbox, period_s=0.01, answer_s=0.1)
    stopped, gone = stopped + inbox.take()
    assert stopped == Danger("emergency stop: somebody pressed it", stop=True)
    assert gone.stop
    assert "gone" in gone.text


class Persistent:
    """Grabs whatever became of the last attempt. `asked` counts the decisions."""

    def __init__(self) -> None:
        self.asked = 0

    async def decide(self, episode: Episode) -> ToolCall | Finish:
        self.asked += 1
        return GRAB


async def test_a_runner_that_hangs_up_ends_the_episode_at_once(a_runner: Any) -> None:
    """Regression: the episode ended after three unanswered states of 11 s each; meanwhile the
    planner was asked on and two motions were tried.
    """

    inbox, planner = Inbox(), Persistent()
    palette = Palette((Skill("lab/grab", "vla", "", ("grasp",)),))
    async with contextlib.AsyncExitStack() as stack:
        async with a_runner() as runner:
            client, watching = [
                await stack.enter_async_context(
                    RunnerClient(runner.endpoint, connect_timeout_s=3600.0)
                )
                for _ in range(2)
            ]
            await watching.state()
            beside = asyncio.create_task(watch(watching, inbox, period_s=3600.0))
            stack.callback(beside.cancel)
            episode = asyncio.create_task(
                run_episode("x", planner, palette, Tools(client, None, None), inbox=inbox)
            )
            await runner.accepted.wait()
        result = await episode
        asked, steps, reason, stopped = (
            planner.asked,
            result["steps"],
            result["reason"],
            result["stopped"],
        )
    assert stopped
    assert reason == "stopped: the runner is gone: it hung up"
    assert asked <= 2, "asked once more at most, in the moment of the hang-up"
    assert len(steps) == 1, "no further motion was tried"


async def test_a_runner_that_was_started_again_ends_the_episode_and_gets_no_goal(
    a_runner: Any,
) -> None:
    """Its robot may stand elsewhere, and its goals are those of another task."""

    inbox = Inbox()
    async with a_runner() as runner, RunnerClient(runner.endpoint) as client:
        await watch(client, inbox, "the session before")
        outcome = await Tools(client, None, None, session="the session before")(GRAB)
        assert runner.goal is None
        danger, more, code = inbox.take()[0].text, inbox.take(), outcome.code
    assert (danger, more, code) == ("the runner was started again", [], "goal_rejected")


async def test_a_goal_without_an_end_is_given_up(runner: Any, client: RunnerClient) -> None:
    outcome = await Tools(client, None, None, goal_grace_s=0.0)(
        ExecuteRskill(rskill_id="lab/grab", deadline_s=0.2)
    )
    cancelled = runner.cancelled
    assert (outcome.status, outcome.code) == ("failed", "wait_timeout")
    assert len(cancelled) == 1


async def test_a_goal_whose_runner_is_gone_is_not_called_cancelled(
    a_runner: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: lost contact and a missing result were one case, reported as canceled."""
    monkeypatch.setattr("vram_arbiter.reasoner.execution.CANCEL_S", 0.3)

    async with contextlib.AsyncExitStack() as stack:
        async with a_runner() as runner:
            client = await stack.enter_async_context(RunnerClient(runner.endpoint))
            doing = asyncio.create_task(Tools(client, None, None)(GRAB))
            await runner.accepted.wait()
            client._timeout_s = client._connect_timeout_s = (
                0.3  # of no use any more: nobody will answer
            )
        outcome = await doing
    assert (outcome.status, outcome.code) == ("failed", "runner_unreachable")
    assert "it may still run" in outcome.text
    assert "no result within" not in outcome.text


class Stopper:
    """Grabs, and stops that when anybody says anything."""

    async def decide(self, episode: Episode) -> ToolCall | Finish:
        return GRAB if episode.running is None else StopGoal()


async def test_a_goal_that_is_cancelled_twice_is_waited_for_all_the_same(
    runner: Any, client: RunnerClient
) -> None:
    """Regression: the second cancel (a person's, behind the planner's) ended the wait for its
    end.
    """

    runner.ends_on_cancel, runner.result_error = False, BadState("it is still running")
    inbox = Inbox()
    palette = Palette((Skill("lab/grab", "vla", "", ("grasp",)),))
    episode = asyncio.create_task(
        run_episode("x", Stopper(), palette, Tools(client, None, None), inbox=inbox)
    )
    await runner.accepted.wait()
    inbox.put(Said("stop it"))
    await eventually(lambda: runner.cancelled)
    inbox.put(Cancel("at once"))
    await asyncio.wait({episode}, timeout=0.3)  # what is tested is that time passes without an end
    waits = not episode.done()
    runner.result_error = None
    await runner.end("canceled")
    result = await episode
    found = (
        ("waited" if waits else "left it running"),
        [step["status"] for step in result["steps"]],
    )
    assert found == ("waited", ["canceled"])


@pytest.mark.parametrize("ended", [InternalError("a defect"), LimitExceeded("too many")])
async def test_a_goal_whose_result_cannot_be_asked_for_is_called_off(
    runner: Any, client: RunnerClient, ended: VramError
) -> None:
    """Regression: the goal went on without anybody who waited for it."""

    runner.result_error = ended
    outcome = await Tools(client, None, None)(GRAB)
    found = outcome.status, outcome.code, len(runner.cancelled)
    assert found == ("failed", ended.code, 1)


def test_a_skill_may_take_as_long_as_its_manifest_says() -> None:
    """Regression: a goal without a deadline of its own was called off after ten minutes, also where
    its manifest allows an hour.
    """
    skills = (
        Skill("lab/dig", "vla", "", ("grasp",), longest_s=3600.0),
        Skill("lab/grab", "vla", "", ("grasp",)),
    )
    palette = Palette(skills)
    assert waits_s(ExecuteRskill(rskill_id="lab/dig"), palette, 60.0) > 3600.0 + 90.0
    assert waits_s(ExecuteRskill(rskill_id="lab/grab"), palette, 60.0) == GOAL_MAX_S
    assert waits_s(ExecuteRskill(rskill_id="lab/dig", deadline_s=5.0), palette, 60.0) == 65.0
    assert waits_s(ExecuteRskill(rskill_id="lab/other"), None, 60.0) == GOAL_MAX_S


def test_nobody_looking_after_the_robot_ends_the_episode() -> None:
    """Regression: an answer that nobody had thought of ended the watch without a word, and an
    emergency stop behind it was not noticed.
    """

    class Strange:
        async def call(self, op: str, **_: Any) -> dict[str, Any]:
            return {"estop": None, "world": {"diagnostics": ["stale"]}}

    inbox = Inbox()
    play(lambda: watch(cast(RunnerClient, Strange()), inbox))
    (danger,) = inbox.take()
    assert isinstance(danger, Danger)
    assert danger.stop
    assert "the robot is not watched" in danger.text
