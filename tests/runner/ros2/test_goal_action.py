"""A runner's goals as a ROS 2 action: an independent participant, with types and codec of Cyclone
DDS alone, sends goals, hears feedback and status, cancels, and asks for results.
"""

import asyncio
import uuid
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.runner.goal_bench import RSKILL, Bench, goal_bench
from tests.support.dds import NETWORK
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.ros2 import action_server
from vram_arbiter.runner.ros2.action_server import ActionServer
from vram_arbiter.runner.ros2.goal_action import INTERFACE, RunnerGoals

pytestmark = [pytest.mark.anyio, pytest.mark.heavy]
pytest.importorskip("cyclonedds")

from cyclonedds.idl.types import float32, float64, uint32  # noqa: E402

from tests.runner.ros2 import independent  # noqa: E402
from tests.runner.ros2.independent import UUID_, struct  # noqa: E402

DOMAIN = 81
PREFIX = "openral_msgs.action.dds_.ExecuteRskill_"


Goal_ = struct(
    PREFIX + "Goal_",
    rskill_id=str,
    revision=str,
    prompt=str,
    prompt_metadata_json=str,
    goal_params_json=str,
    deadline_s=float64,
)
Result_ = struct(PREFIX + "Result_", success=bool, failure_reason=str, trace_id=str)
Feedback_ = struct(
    PREFIX + "Feedback_", progress=float32, state=str, chunk_index=uint32, chunks_total=uint32
)


class Commander(independent.Commander):
    def __init__(self, name: str) -> None:
        super().__init__(DOMAIN, name, PREFIX, Goal_, Result_, Feedback_)

    async def goal(
        self, prompt: str, *, rskill: str = RSKILL, params: str = "", metadata: str = ""
    ) -> UUID_ | None:
        """Send a goal; None: it was rejected."""
        return await self.send(rskill, "", prompt, metadata, params, 0.0)


NO_ID = UUID_(bytes(16))
Serving = Callable[[], Any]


@pytest.fixture
def served_action(
    make_runner: Any,
    env: Any,
    endpoint: str,
    navigate_manifest: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Serving:
    monkeypatch.setenv("CYCLONEDDS_URI", NETWORK)
    name = f"/n{uuid.uuid4().hex}/execute_rskill"

    @asynccontextmanager
    async def both() -> AsyncIterator[tuple[Bench, Commander]]:
        async with (
            goal_bench(make_runner, env, endpoint, navigate_manifest) as bench,
            RunnerClient(endpoint) as client,
            ActionServer(INTERFACE, name, DOMAIN, RunnerGoals(client).accept),
        ):
            yield bench, Commander(name)

    return both


async def test_goals_are_served_with_feedback_status_and_result(served_action: Serving) -> None:
    async with served_action() as (bench, commander):
        goal_id = await commander.goal("end", params='{"deep": {"er": [1]}}')
        assert goal_id is not None
        told = await commander.ended(goal_id)
        assert (told.status, told.result.success, told.result.failure_reason) == (4, True, "")
        assert len(told.result.trace_id) == 32
        await commander.status(goal_id, 4)

        failing = await commander.goal("defect")
        assert failing is not None
        told = await commander.ended(failing)
        assert (told.status, told.result.success) == (6, False)
        assert "oops" in told.result.failure_reason

        assert await commander.goal("end", rskill="a/unknown") is None
        assert await commander.goal("end", params="[1]") is None
        assert await commander.goal("end", params="{") is None
        assert (await commander.ended(UUID_(uuid.uuid4().bytes))).status == 0
        assert bench.made[0].story.count("finish") == 2


async def test_a_goal_joins_the_callers_trace(served_action: Serving) -> None:
    """What is no traceparent is no reason to refuse a goal: it begins a trace of its own."""
    trace = "0af7651916cd43dd8448eb211c80319c"
    sent = f'{{"traceparent": "00-{trace}-b7ad6b7169203331-01"}}'
    async with served_action() as (bench, commander):
        for metadata, joins in ((sent, True), ('{"traceparent": "00-x"}', False), ("[", False)):
            goal_id = await commander.goal("end", metadata=metadata)
            assert goal_id is not None
            told = (await commander.ended(goal_id)).result.trace_id
            assert (told == trace, len(told)) == (joins, 32)
            assert bench.made[0].traceparents[-1].split("-")[1] == told


async def test_a_goal_is_canceled_alone_with_all_others_and_when_the_server_ends(
    served_action: Serving,
) -> None:
    async with served_action() as (bench, commander):
        first = await commander.goal("forever")
        assert first is not None
        assert (await commander.heard(first)).state in ("loading", "warming", "executing")
        assert await commander.goal("end") is None, "the runner has one goal at a time"
        unknown = await commander.canceled(UUID_(uuid.uuid4().bytes))
        assert (unknown.return_code, unknown.goals_canceling) == (2, [])
        told = await commander.canceled(first)
        assert (told.return_code, [g.goal_id for g in told.goals_canceling]) == (0, [first])
        assert (await commander.ended(first)).status == 5
        assert (await commander.canceled(first)).return_code == 3

        second = await commander.goal("forever")
        assert second is not None
        told = await commander.canceled(NO_ID)
        assert [goal.goal_id for goal in told.goals_canceling] == [second]
        assert (await commander.ended(second)).status == 5

        third = await commander.goal("forever")
        assert third is not None
        await bench.made[0].begun.wait()
        asked = asyncio.create_task(commander.ended(third))
        await commander.status(third, 2)
    told = await asked
    assert told.status == 5, "whoever leaves does not leave a robot that moves"
    assert bench.made[0].story.count("finish") == 3


async def test_goals_that_ended_are_forgotten_in_the_end(
    served_action: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(action_server, "GOALS_KEPT", 2)

    async with served_action() as (_, commander):
        first = await commander.goal("end")
        assert first is not None
        await commander.ended(first)
        for _ in range(2):
            goal_id = await commander.goal("end")
            assert goal_id is not None
            assert (await commander.ended(goal_id)).status == 4
        assert (await commander.ended(first)).status == 0


async def test_every_endpoint_tells_the_hash_of_its_type(served_action: Serving) -> None:
    """REP 2011; of a service its request's and its reply's, as rmw_cyclonedds tells them."""
    async with served_action() as (_, commander):
        told = await commander.type_hashes(8)
    short = {topic.rpartition("/")[2]: text for topic, text in told.items()}
    assert sorted(short) == [
        "cancel_goalReply", "cancel_goalRequest", "feedback", "get_resultReply",
        "get_resultRequest", "send_goalReply", "send_goalRequest", "status",
    ]  # fmt: skip
    request = "3d3c84653c1f96918086887e1dcb236faec88b81a5b14fd4cf4840065bcdf8af"
    assert short["cancel_goalRequest"] == f"typehash=RIHS01_{request};".encode()
    status = "6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e"
    assert short["status"] == f"typehash=RIHS01_{status};".encode()


async def test_a_node_is_told_with_its_endpoints(served_action: Serving) -> None:
    """As `ros2 node list` and `ros2 node info` find it."""
    async with served_action() as (_, commander):
        await commander.type_hashes(8)  # all are discovered
        assert await commander.nodes() == {"/vram_runner_execute_rskill": (3, 5, True)}
