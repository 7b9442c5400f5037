"""The goal server over real sockets with the real client: one goal at a time, exactly one result,
whatever happens.
"""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
import zmq.asyncio

from tests.runner.goal_bench import RSKILL, Bench, Told, goal_bench
from tests.support.waiting import eventually
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.goals.catalogue import Catalogue, read_manifests
from vram_arbiter.runner.goals.one_goal import LISTENERS_MAX
from vram_arbiter.runner.goals.server import GoalServer
from vram_arbiter.runner.sim.robot import SimRunner
from vram_arbiter.schemas.errors import (
    AlreadyRunning,
    BadRequest,
    BadState,
    EstopRequested,
    GoalRejected,
    ManifestInvalid,
    UnknownSkill,
)
from vram_arbiter.schemas.goals import GetResult
from vram_arbiter.schemas.manifest import Kind, load_manifest
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry

pytestmark = pytest.mark.anyio


GOAL = {"op": "goal", "id": 1, "goal_id": "g"}


@pytest.fixture
def bench(
    make_runner: Callable[..., SimRunner], env: Any, endpoint: str, navigate_manifest: Path
) -> Callable[..., Any]:
    return lambda: goal_bench(make_runner, env, endpoint, navigate_manifest)


@pytest.fixture
async def b(bench: Callable[..., Any]) -> AsyncIterator[Bench]:
    async with bench() as made:
        yield made


@pytest.fixture
async def client(b: Bench, endpoint: str) -> AsyncIterator[RunnerClient]:
    async with RunnerClient(endpoint) as made:
        yield made


async def test_a_goal_feeds_back_and_ends_with_one_result(b: Bench, client: RunnerClient) -> None:
    goal = await client.send_goal(RSKILL, prompt="end")
    states = [feedback["state"] async for feedback in goal.feedback()]
    result = await goal.result(60)
    assert (result["status"], result["success"], result["code"]) == ("succeeded", True, "")
    assert result["data"]["steps"] == 4
    assert states
    assert b.made[0].story == ["start end", "finish"]
    again = await client.call(GetResult(goal_id=goal.goal_id))
    assert again["status"] == "succeeded"


async def test_the_next_goal_of_the_same_skill_reuses_it(b: Bench, client: RunnerClient) -> None:
    for _ in range(3):
        assert (await (await client.send_goal(RSKILL, prompt="end")).result(60))["success"]
    assert len(b.made) == 1
    assert b.made[0].story == ["start end", "finish"] * 3


async def test_a_second_goal_is_refused_and_the_first_goes_on(client: RunnerClient) -> None:
    first = await client.send_goal(RSKILL, prompt="forever", goal_id="one")
    with pytest.raises(GoalRejected, match="goal one"):
        await client.send_goal(RSKILL, prompt="end")
    assert not first.done
    await first.cancel()
    assert (await first.result(60))["status"] == "canceled"
    assert (await (await client.send_goal(RSKILL, prompt="end")).result(60))["success"]


@pytest.mark.parametrize("by", ["cancel", "estop"])
async def test_a_cancel_or_stop_while_a_goal_finishes_does_not_cost_its_result(
    b: Bench, client: RunnerClient, by: str
) -> None:
    """Regression: one cancellation hit the task that answers for the goal, and every later goal was
    refused."""

    goal = await client.send_goal(RSKILL, prompt="end slowly")
    while not b.made:
        await asyncio.sleep(0)
    await b.made[0].finishing.wait()
    await (goal.cancel() if by == "cancel" else client.estop("smoke"))
    b.made[0].finished.set()
    assert (await goal.result(60))["status"] == "succeeded"  # it was over by then
    assert (await client.state())["goal"] is None
    if by == "cancel":
        again = await client.send_goal(RSKILL, prompt="end")
        assert (await again.result(60))["success"]


@pytest.mark.parametrize("what", ["set", "large number"])
async def test_a_result_that_no_wire_carries_still_reaches_the_client(
    client: RunnerClient, what: str
) -> None:
    """Regression: a skill's own data held values that msgpack does not carry, and the client never
    heard of the end."""

    goal = await client.send_goal(RSKILL, prompt=f"end with a {what}")
    result = await goal.result(60)
    assert result["success"]
    assert "seen" in result["data"]["unsendable"]
    assert (await client.call(GetResult(goal_id=goal.goal_id)))["status"] == "succeeded"


async def test_no_goal_is_accepted_once_the_control_loop_has_ended(
    b: Bench, client: RunnerClient
) -> None:
    """Regression: only a signal counted as stopping, so a goal was accepted and would have loaded
    its model."""

    goal = await client.send_goal(RSKILL, prompt="end, and leave slowly")
    assert (await goal.result(60))["success"]
    b.runner.request_stop()
    await b.made[0].finishing.wait()
    with pytest.raises(GoalRejected, match="stopping"):
        await client.send_goal(RSKILL, prompt="end")
    b.made[0].finished.set()


async def test_a_skill_that_could_not_undo_a_failed_start_can_be_started_again(
    client: RunnerClient,
) -> None:
    """Regression: such a skill stayed `starting` and was refused for ever."""

    goal = await client.send_goal(RSKILL, prompt="unavailable for ever")
    assert (await goal.result(60))["status"] == "failed"
    assert (await (await client.send_goal(RSKILL, prompt="end")).result(60))["success"]


async def test_a_skill_that_breaks_while_it_finishes_still_gives_a_result(
    client: RunnerClient,
) -> None:
    """Regression: a skill that failed in `finish` lost the result, and every later goal was
    refused."""

    goal = await client.send_goal(RSKILL, prompt="end badly")
    assert (await goal.result(60))["success"]
    assert (await (await client.send_goal(RSKILL, prompt="end")).result(60))["success"]


@pytest.mark.parametrize("prompt", ["forever", "hang"])
async def test_cancel_takes_the_arm_back(b: Bench, client: RunnerClient, prompt: str) -> None:
    goal = await client.send_goal(RSKILL, prompt=prompt)
    await eventually(lambda: b.made and b.made[0].begun.is_set())
    await goal.cancel()
    result = await goal.result(60)
    assert (result["status"], result["success"]) == ("canceled", False)
    assert b.made[0].story[-1] == "finish"
    steps = b.made[0].steps
    if prompt == "forever":  # it had the arm
        assert result["data"]["ticks"] == steps
        assert result["data"]["withheld"] == 0
    else:
        assert set(result["data"]) == {"elapsed_s"}
    await goal.cancel()  # late and harmless
    await client.state()
    assert b.made[0].steps == steps


async def test_cancel_right_behind_the_goal_still_gives_a_result(b: Bench, endpoint: str) -> None:
    with zmq.asyncio.Context.instance().socket(zmq.DEALER) as socket:
        socket.connect(endpoint)
        await socket.send(msgpack.packb({**GOAL, "rskill_id": RSKILL, "prompt": "hang"}))
        await socket.send(msgpack.packb({"op": "cancel", "id": 2, "goal_id": "g"}))
        results = []
        while not results:
            message = msgpack.unpackb(await socket.recv())
            results += [message] if message.get("push") == "result" else []
        assert results[0]["status"] == "canceled"


@pytest.mark.parametrize("prompt", ["forever", "hang"])
async def test_a_deadline_is_no_success(b: Bench, client: RunnerClient, prompt: str) -> None:
    goal = await client.send_goal(RSKILL, prompt=prompt, deadline_s=0.3)
    result = await goal.result(60)
    assert (result["status"], result["success"]) == ("deadline", False)
    assert b.made[0].story[-1] == "finish"


async def test_a_goal_that_ends_before_its_model_is_there_says_how_far_that_was(
    client: RunnerClient,
) -> None:
    """Regression: the result said `canceled on request` or `not done within 20 s`, whether the
    robot had moved or its model was still on its way.
    """

    goal = await client.send_goal(RSKILL, prompt="hang")
    async for feedback in goal.feedback():
        if feedback["detail"]:
            break
    assert (feedback["state"], feedback["detail"]) == ("starting", "loading: 1 GiB of 4 GiB")
    await goal.cancel()
    told = (await goal.result(60))["message"]
    assert told == "canceled on request; its model was loading: 1 GiB of 4 GiB"
    goal = await client.send_goal(RSKILL, prompt="forever", deadline_s=0.3)
    assert (await goal.result(60))["message"] == "not done within 0.3 s"


@pytest.mark.parametrize(
    ("prompt", "code"),
    [("evicted", "evicted"), ("unavailable", "sidecar_unavailable"), ("defect", "internal")],
)
async def test_failures_are_typed(
    client: RunnerClient, prompt: str, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: the metric of failed goals did not say why they failed."""
    counted: list[tuple[str | None, str | None]] = []

    def count(name: str, labels: dict[str, str] | None = None, times: int = 1) -> None:
        if name == telemetry.METRIC_GOALS and labels is not None:
            told = labels.get(telemetry.ATTR_OUTCOME), labels.get(telemetry.ATTR_ERROR_TYPE)
            counted.append(told)

    monkeypatch.setattr(meters, "count", count)

    result = await (await client.send_goal(RSKILL, prompt=prompt)).result(60)
    assert (result["status"], result["success"], result["code"]) == ("failed", False, code)
    assert result["message"]
    assert (await (await client.send_goal(RSKILL, prompt="end")).result(60))["success"]
    assert counted[0] == ("failed", code)


async def test_a_client_that_vanished_finds_its_result(client: RunnerClient, endpoint: str) -> None:
    async with RunnerClient(endpoint) as gone:
        await gone.send_goal(RSKILL, prompt="end", goal_id="mine")
    while True:
        try:
            result = await client.call(GetResult(goal_id="mine"))
            break
        except BadState:  # still running
            await asyncio.sleep(0.02)
    assert result["status"] == "succeeded"
    with pytest.raises(GoalRejected, match="has ended"):
        await client.send_goal(RSKILL, prompt="end", goal_id="mine")


async def test_the_same_goal_sent_again_is_the_same_goal(
    b: Bench, client: RunnerClient, endpoint: str
) -> None:
    goal = await client.send_goal(RSKILL, prompt="forever", goal_id="same")
    async with RunnerClient(endpoint) as other:
        again = await other.send_goal(RSKILL, prompt="forever", goal_id="same")
        await again.cancel()
        assert (await again.result(60))["status"] == "canceled"
    assert (await goal.result(60))["status"] == "canceled"
    assert b.made[0].story == ["start forever", "finish"]


async def test_a_goal_of_another_session_moves_nothing(b: Bench, client: RunnerClient) -> None:
    """Regression: a runner that was started again executed the motion of a task that had begun
    with the runner before it.
    """

    session = (await client.skills())["session"]
    assert (await client.state())["session"] == session
    with pytest.raises(GoalRejected, match=f"session other .* session {session}"):
        await client.send_goal(RSKILL, prompt="end", session="other")
    assert b.made == []
    goal = await client.send_goal(RSKILL, prompt="end", session=session)
    assert (await goal.result(60))["success"]


async def test_a_goal_sent_from_ever_new_connections_is_told_on_the_newest(
    b: Bench, client: RunnerClient, endpoint: str
) -> None:
    goal = await client.send_goal(RSKILL, prompt="forever", goal_id="same")
    async with AsyncExitStack() as stack:
        for _ in range(LISTENERS_MAX):
            newest = await stack.enter_async_context(RunnerClient(endpoint))
            again = await newest.send_goal(RSKILL, prompt="forever", goal_id="same")
        assert len(b.server._goals._running.peers) == LISTENERS_MAX
        await again.cancel()
        assert (await again.result(60))["status"] == "canceled"
    assert (await client.call(GetResult(goal_id=goal.goal_id)))["status"] == "canceled"


async def test_reads(client: RunnerClient, bench: Any) -> None:
    assert (await client.ping(timeout_s=60))["goal_id"] is None
    assert (await client.ground_truth())["target"] == "red cube"
    installed = await client.skills()
    assert installed["body"] is None, "this bench takes any skill"
    skills = installed["skills"]
    assert [(skill["name"], skill["kind"]) for skill in skills] == [(RSKILL, "ros_action")]
    state = await client.state()
    assert state["phase"] == "idle"
    assert state["world"]["base_pose"]["frame_id"] == "map"
    with pytest.raises(BadRequest, match="no camera 'rear'"):
        await client.frame("rear")


@pytest.mark.parametrize(
    ("message", "code"),
    [
        (b"\xc1\xc1", "bad_frame"),
        ([1, 2], "bad_frame"),
        ({"op": "dance", "id": 1}, "unknown_op"),
        ({"id": 1}, "unknown_op"),
        (GOAL, "bad_request"),
        ({**GOAL, "rskill_id": "x", "deadline_s": -1}, "bad_request"),
        ({**GOAL, "rskill_id": "a/b"}, "unknown_skill"),
        ({"op": "ping", "id": 1, "extra": 1}, "bad_request"),
        ({"op": "ping", "id": "one"}, "bad_request"),
        ({"op": "ping"}, "bad_request"),  # whom would an answer be told?
        ({"op": "cancel", "id": 1, "goal_id": "none"}, "bad_request"),
        ({"op": "result", "id": 1, "goal_id": "none"}, "bad_request"),
    ],
)
async def test_bad_input_gets_an_answer_and_harms_nothing(
    client: RunnerClient, endpoint: str, message: Any, code: str
) -> None:
    with zmq.asyncio.Context.instance().socket(zmq.DEALER) as socket:
        socket.connect(endpoint)
        await socket.send(message if isinstance(message, bytes) else msgpack.packb(message))
        reply = msgpack.unpackb(await socket.recv())
        assert reply["error"]["code"] == code
        assert reply["error"]["message"]
    assert (await client.ping(timeout_s=60))["ok"]


async def test_shutdown_answers_cancels_and_ends(b: Bench, client: RunnerClient) -> None:
    goal = await client.send_goal(RSKILL, prompt="forever")
    await client.shutdown()
    assert (await goal.result(60))["status"] == "canceled"
    assert b.made[0].story == ["start forever", "finish", "release"]


async def test_a_second_runner_on_the_same_socket_is_refused(bench: Any, endpoint: str) -> None:
    async with bench() as b, RunnerClient(endpoint) as client:
        control = b.server._control
        second = GoalServer(endpoint, control, b.server._catalogue, SystemClock())
        with pytest.raises(AlreadyRunning):
            await second.serve()
        assert (await client.ping(timeout_s=60))["ok"]


def test_only_skills_that_move_something_can_be_executed(navigate_manifest: Path) -> None:
    manifest = load_manifest(navigate_manifest)
    with pytest.raises(UnknownSkill, match="choose from"):
        Catalogue([manifest], {Kind.ROS_ACTION: Told}).find("no/such")
    with pytest.raises(UnknownSkill, match=r"installed as 0\.1\.0"):
        Catalogue([manifest], {Kind.ROS_ACTION: Told}).find(RSKILL, "9.9.9")
    detector = manifest.model_copy(update={"kind": Kind.DETECTOR})
    with pytest.raises(UnknownSkill, match="is a detector"):
        Catalogue([detector], {Kind.DETECTOR: Told}).find(RSKILL)


def test_manifests_are_read_from_folders_and_checked(
    tmp_path: Path, navigate_manifest: Path
) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one/rskill.yaml").write_text(navigate_manifest.read_text())
    assert [manifest.name for manifest in read_manifests([tmp_path])] == [RSKILL]
    with pytest.raises(ManifestInvalid, match="installed twice"):
        read_manifests([tmp_path, navigate_manifest])
    (tmp_path / "one/rskill.yaml").write_text("name: x\n")
    with pytest.raises(ManifestInvalid, match="rskill"):
        read_manifests([tmp_path])
    (tmp_path / "one/empty").mkdir()
    with pytest.raises(ManifestInvalid, match="no skill"):
        read_manifests([tmp_path / "one" / "empty"])


@pytest.mark.parametrize("prompt", ["forever", "hang"])
async def test_the_emergency_stop_of_a_simulator_ends_its_goal_too(
    b: Bench, client: RunnerClient, prompt: str
) -> None:
    goal = await client.send_goal(RSKILL, prompt=prompt)
    while not b.made:
        await client.ping(timeout_s=60)
    await b.made[0].begun.wait()
    assert "emergency stop: smoke" in (await client.estop("smoke")).message
    result = await goal.result(60)
    assert (result["status"], result["code"]) == ("failed", "estop_requested")
    assert b.made[0].story == [f"start {prompt}", "finish"]
    with pytest.raises(EstopRequested, match="smoke"):
        await client.send_goal(RSKILL, prompt="end")


async def test_a_goal_runs_when_it_has_the_arm_and_not_before(
    b: Bench, client: RunnerClient
) -> None:
    """Regression: until the control thread took it up, a goal was fed back with the progress of the
    goal before: ended, all of it done.
    """

    first = await client.send_goal(RSKILL, prompt="end")
    assert (await first.result(60))["success"]
    assert b.runner.progress.state == "ended"
    busy, go_on = threading.Event(), threading.Event()

    def hold_up() -> None:
        busy.set()
        go_on.wait(60)

    b.runner.mailbox.post(hold_up)
    await asyncio.to_thread(busy.wait, 60)
    second = await client.send_goal(RSKILL, prompt="wait")
    feedback = aiter(second.feedback())
    while (told := await anext(feedback))["state"] != "starting":
        assert told["state"] == "acquiring"
    told = await anext(feedback)  # said again, since nothing changes
    assert (told["state"], told["progress"]) == ("starting", 0.0)
    assert (await client.state())["phase"] == "starting"
    go_on.set()
    while (told := await anext(feedback))["state"] == "starting":
        assert told["progress"] == 0.0
    assert told["state"] == "running"
    await second.cancel()
    assert (await second.result(60))["status"] == "canceled"


async def test_an_answer_does_not_repeat_a_mebibyte_of_mistakes(client: RunnerClient) -> None:
    for wrong in ({"op": "x" * 1_000_000}, {"op": "state", "k" * 1_000_000: 0}):
        reply = await client._rpc.exchange(wrong, 60)
        assert reply["ok"] is False
        assert len(str(reply)) < 1000
