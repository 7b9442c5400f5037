"""The runner's client against a stand-in runner on `clients.net.server`, in the same loop."""

import asyncio
import tempfile
from collections.abc import AsyncIterator
from typing import Any

import pytest
from pydantic import TypeAdapter

from tests.support.serving import answering
from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES
from vram_arbiter.schemas.errors import (
    BadFrame,
    BadRequest,
    BadState,
    FrameStale,
    GoalRejected,
    MessageTooLarge,
    RunnerUnreachable,
    UnknownSkill,
    VramError,
)
from vram_arbiter.schemas.goals import RunnerRequest

pytestmark = pytest.mark.anyio


class FakeRunner:
    """Accepts one goal at a time; the test says when feedback and result go out."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self.sender: Peer | None = None
        self.result: dict[str, Any] | None = None
        self.seen: list[dict[str, Any]] = []
        self.server = RouterServer(
            endpoint,
            lambda error: {"ok": False, "error": error.to_wire()},
            message_max_bytes=MESSAGE_MAX_BYTES,
        )

    async def handle(self, peer: Peer, message: dict[str, Any]) -> None:
        TypeAdapter(RunnerRequest).validate_python(message)
        self.seen.append(message)
        try:
            reply = {"ok": True, **self.answer(peer, message)}
        except VramError as error:
            reply = {"ok": False, "error": error.to_wire()}
        await self.server.send(peer, {"re": message["id"], **reply})

    def answer(self, peer: Peer, message: dict[str, Any]) -> dict[str, Any]:
        match message["op"]:
            case "goal":
                if self.sender is not None:
                    raise GoalRejected("one goal at a time")
                if message["rskill_id"] == "none":
                    raise UnknownSkill("no such skill")
                self.sender = peer
            case "result":
                if self.result is None:
                    raise (
                        BadState("it is running")
                        if self.sender
                        else BadRequest("there is no such goal")
                    )
                return self.result
            case "frame":
                if message["camera"] == "blind":
                    raise FrameStale("the newest frame is 2 s old", details={"age_ms": 2000})
                return {"camera": "front", "data": b"x", "age_ms": 1.0}
        return {}

    async def push(self, kind: str, goal_id: str, **fields: Any) -> None:
        assert self.sender is not None
        await self.server.send(self.sender, {"push": kind, "goal_id": goal_id, **fields})


RESULT = {"status": "succeeded", "success": True, "code": "", "message": "", "data": {"steps": 3}}


@pytest.fixture
async def fake() -> AsyncIterator[FakeRunner]:
    with tempfile.TemporaryDirectory(prefix="rc") as folder:
        runner = FakeRunner(f"ipc://{folder}/r.sock")
        async with answering(runner.server, runner.handle):
            yield runner


@pytest.fixture
async def client(fake: FakeRunner) -> AsyncIterator[RunnerClient]:
    async with RunnerClient(fake.endpoint) as client:
        yield client


@pytest.mark.parametrize(
    ("params", "kind"),
    [
        ({"points": [{"positions": [0.1] * 14}] * 1000}, MessageTooLarge),
        ({"points": [0.1] * 2000}, BadFrame),
        ({"text": "x" * (MESSAGE_MAX_BYTES - 1000), "more": "x" * 2000}, MessageTooLarge),
    ],
    ids=["values", "items", "bytes"],
)
async def test_a_goal_that_is_too_long_is_refused_at_once(
    client: RunnerClient, params: dict[str, Any], kind: type[VramError]
) -> None:
    """Regression: the refusal had no id, so the client waited 10 s for a reply to its own."""
    with pytest.raises(kind):
        await client.send_goal("ns/grab", goal_params=params)
    await client.send_goal("ns/grab")


async def test_goal_feedback_result(fake: FakeRunner, client: RunnerClient) -> None:
    goal = await client.send_goal("ns/grab", prompt="grab the red cube", deadline_s=5.0)
    assert fake.seen[-1]["prompt"] == "grab the red cube"
    for tick in range(3):
        await fake.push(
            "feedback", goal.goal_id, progress=tick / 3, state="running", tick_idx=tick, detail=""
        )
    await fake.push("result", goal.goal_id, **RESULT)
    assert [item["tick_idx"] async for item in goal.feedback()] == [0, 1, 2]
    assert (await goal.result())["data"] == {"steps": 3}
    assert goal.done
    assert [item async for item in goal.feedback()] == []


async def test_typed_refusals(fake: FakeRunner, client: RunnerClient) -> None:
    with pytest.raises(UnknownSkill):
        await client.send_goal("none")
    await client.send_goal("ns/grab", goal_id="g")
    with pytest.raises(GoalRejected):
        await client.send_goal("ns/grab")
    with pytest.raises(GoalRejected):
        await client.send_goal("ns/grab", goal_id="g")
    with pytest.raises(FrameStale) as stale:
        await client.frame("blind")
    assert stale.value.details["age_ms"] == 2000
    assert (await client.frame())["camera"] == "front"


async def test_cancel_and_a_result_that_is_late(fake: FakeRunner, client: RunnerClient) -> None:
    goal = await client.send_goal("ns/grab")
    with pytest.raises(TimeoutError):
        await goal.result(timeout_s=0.05)
    await goal.cancel()
    assert fake.seen[-1]["op"] == "cancel"
    await fake.push("result", goal.goal_id, **RESULT | {"status": "canceled", "success": False})
    assert (await goal.result())["status"] == "canceled"


async def test_a_result_whose_push_was_missed_is_fetched(
    fake: FakeRunner, client: RunnerClient
) -> None:
    goal = await client.send_goal("ns/grab")
    fake.result = {"goal_id": goal.goal_id, **RESULT}
    assert (await goal.result(timeout_s=10.0))["success"]


async def test_a_goal_that_a_restarted_runner_forgot(
    fake: FakeRunner, client: RunnerClient
) -> None:
    goal = await client.send_goal("ns/grab")
    fake.sender = None
    with pytest.raises(BadRequest):
        await goal.result(timeout_s=10.0)


async def test_a_runner_that_goes_away(client: RunnerClient, fake: FakeRunner) -> None:
    """Regression: a goal's client tried to reach the dead runner for the time that one may take to
    start, 11 s for the result and as long again for the cancellation.
    """
    client._connect_timeout_s = 3600.0
    await client.ping()
    goal = await client.send_goal("ns/grab")
    waiting = asyncio.create_task(goal.result())
    await fake.server.__aexit__()
    with pytest.raises(RunnerUnreachable):
        await waiting
    with pytest.raises(RunnerUnreachable):
        await goal.cancel()


async def test_no_runner(tmp_path: Any) -> None:
    async with RunnerClient(f"ipc://{tmp_path}/none.sock", connect_timeout_s=0.1) as client:
        with pytest.raises(RunnerUnreachable, match="vram-runner"):
            await client.state()
