"""`vram-reasoner` for one task and as a service, with a language model's server that hangs: nothing
waits for the model."""

import asyncio
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.sidecars.gateway.conftest import GatewayProcess
from tests.sidecars.gateway.conftest import stand_in as stand_in_server
from tests.support.llm_apis import Anthropic, OpenAi
from tests.support.process import ArbiterProcess
from vram_arbiter.reasoner.__main__ import _one_task, _serve, speak
from vram_arbiter.reasoner.options import parser
from vram_arbiter.reasoner.server import send
from vram_arbiter.schemas.errors import BadState, ReasonerUnreachable
from vram_arbiter.schemas.reasoner import HistoryLine

pytest.importorskip("httpx", reason="needs the reasoner extra")

pytestmark = pytest.mark.anyio

GO = {
    "name": "lab/go",
    "version": "1.0.0",
    "license": "mit",
    "kind": "ros_action",
    "embodiment_tags": ["any"],
    "chunk_size": 1,
    "latency_budget": {"per_chunk_ms": 1},
    "description": "drive",
    "actions": ["navigate"],
    "actuators_required": [{"kind": "body_twist", "control_mode_semantics": {"mode": "absolute"}}],
    "ros_integration": {
        "package": "p",
        "interface_type": "T",
        "interface_name": "/t",
        "default_goal_json": "{}",
    },
}


@pytest.fixture(autouse=True)
def environment(tmp_path: Path, stand_in: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VRAM_ARBITER_RUNTIME", str(tmp_path))
    monkeypatch.setenv("VRAM_REASONER_LLM_BASE_URL", stand_in.url)
    monkeypatch.setenv("VRAM_REASONER_LLM_MODEL", "m")


def flags(*argv: str) -> Any:
    return parser("").parse_args(["--detector", "none", "--scene-vlm", "none", *argv])


async def speaks(*argv: str) -> None:
    """Speak to the running reasoner, as the command line does."""
    await speak(flags(*argv), argv[0].removeprefix("--"))


async def comes_true(condition: Callable[[], Any]) -> None:
    while not condition():
        await asyncio.sleep(0.01)


async def test_tasks_in_sequence(
    tmp_path: Path, a_runner: Any, stand_in: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    history = tmp_path / "history.jsonl"
    stand_in.json(OpenAi.says(("finish", '{"success": true, "reason": "here already"}')))
    stand_in.hangs()

    async def told(request: dict[str, Any]) -> Any:
        while True:
            try:
                return await send(f"ipc://{tmp_path}/reasoner.sock", request)
            except ReasonerUnreachable:  # it begins
                await asyncio.sleep(0.01)

    async def state_of(number: int, state: str) -> Any:
        while (task := (await told({"op": "tasks"}))["tasks"][number - 1])["state"] != state:
            await asyncio.sleep(0.01)
        return task

    async with a_runner(), asyncio.timeout(60):
        serving = asyncio.create_task(
            _serve(flags("serve", "--planner", "openai", "--history", str(history)))
        )
        reply = await told({"op": "submit", "text": "drive home"})
        assert (reply["task"], reply["ahead"]) == (1, 0)
        assert (await state_of(1, "success"))["reason"] == "here already"
        await told({"op": "submit", "text": "drive away"})
        await state_of(2, "running")
        for text in ("left", "right"):
            await speaks("--submit", text)
        assert capsys.readouterr().out == "task 3, 1 before it\ntask 4, 2 before it\n"
        await speaks("--cancel", "not that way", "--number", "3")
        await speaks("--tasks")
        listed = [json.loads(line)["state"] for line in capsys.readouterr().out.splitlines()]
        assert listed == ["success", "running", "canceled", "queued"]
        assert (await told({"op": "state"}))["queued"] == 1
        assert (await told({"op": "result", "task": 1}))["result"]["llm"]["requests"] == 1
        with pytest.raises(BadState, match="is not over: running"):
            await told({"op": "result", "task": 2})
        await comes_true(lambda: len(stand_in.asked) == 2)  # the second task's episode runs
        signal.raise_signal(signal.SIGTERM)
        await serving
    lines = [HistoryLine.model_validate_json(line) for line in history.read_text().splitlines()]
    ended = {line.task["task"]: (line.task["state"], line.result["reason"]) for line in lines}
    assert ended == {
        1: ("success", "here already"),
        2: ("canceled", "canceled: by SIGTERM"),
        3: ("canceled", "canceled: not that way"),
        4: ("canceled", "canceled: by SIGTERM"),
    }


@pytest.mark.parametrize(
    ("ended_by", "reason"),
    [
        ("person", "canceled: lunch"),
        ("signal", "canceled: by SIGTERM"),
        ("stop", "stopped: emergency stop: a hand in the way"),
    ],
)
async def test_a_goal_ends_with_its_episode_whatever_the_model_does(
    a_runner: Any, stand_in: Any, ended_by: str, reason: str
) -> None:
    stand_in.json(Anthropic.says(("execute_rskill__lab__go", "{}")))
    stand_in.hangs()
    async with a_runner() as runner, asyncio.timeout(60):
        runner.skills = [GO]
        episode = asyncio.create_task(
            _one_task(flags("--task", "drive home", "--planner", "anthropic"))
        )
        await runner.accepted.wait()
        await speaks("--say", "slowly")
        await comes_true(lambda: len(stand_in.asked) == 2)
        match ended_by:
            case "person":
                await speaks("--cancel", "lunch")
            case "signal":
                signal.raise_signal(signal.SIGTERM)
            case "stop":
                runner.estop = "a hand in the way"
        result = await episode
    assert result["reason"] == reason
    assert [step["status"] for step in result["steps"]] == ["canceled"]
    assert len(runner.cancelled) == 1
    assert "operator: slowly" in Anthropic.told(stand_in.asked[1])


async def test_a_playbook_and_a_reward_model_reach_the_language_model(
    tmp_path: Path, a_runner: Any, a_sidecar: Any, stand_in: Any
) -> None:
    (tmp_path / "P.md").write_text("Turn left first.")
    (tmp_path / "rskill.yaml").write_text(
        'name: acme/search\nversion: "0.1.0"\nlicense: mit\nrole: s2\nkind: playbook\n'
        "embodiment_tags: [any]\nchunk_size: 1\nlatency_budget: {per_chunk_ms: 5000}\n"
        "description: x\nactions: [plan]\nplaybook: {trigger: t, body_uri: ./P.md,"
        " composes_tools: [query_task_progress], done_predicate: d, max_steps: 4}\n"
    )
    stand_in.json(OpenAi.says(("query_task_progress", "{}")))
    stand_in.json(OpenAi.says(("finish", '{"success": false, "reason": "a look"}')))
    async with a_runner(), a_sidecar("lab/judge") as judge, asyncio.timeout(60):
        argv = ["--playbook", str(tmp_path / "rskill.yaml"), "--reward", judge.endpoint]
        result = await _one_task(flags("--task", "drive home", "--planner", "openai", *argv))
    assert (result["steps"][0]["status"], result["reason"]) == ("answered", "a look")
    assert "Turn left first." in OpenAi.system(stand_in.asked[0])
    assert set(OpenAi.offered(stand_in.asked[0])) == {"query_task_progress", "finish"}


@pytest.mark.e2e
async def test_a_planner_whose_model_takes_turns_on_the_gpu_ends_its_task(
    tmp_path: Path, a_runner: Any, arbiter_daemon: ArbiterProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind the gateway the model leaves for another server while a goal runs, and comes back for
    the next decision."""
    servers = {name: stand_in_server(arbiter_daemon, 5) for name in ("llm", "other")}
    config = {"listen": "127.0.0.1:0", "servers": servers}
    gateway = await asyncio.to_thread(GatewayProcess, arbiter_daemon, config, tmp_path)
    monkeypatch.setenv("VRAM_REASONER_LLM_BASE_URL", f"{gateway.url}/v1")
    monkeypatch.setenv("VRAM_REASONER_LLM_MODEL", "llm")
    try:
        async with a_runner() as runner, asyncio.timeout(60):
            runner.skills, runner.result_error = [GO], BadState("it runs")
            task = asyncio.create_task(
                _one_task(flags("--task", "drive home", "--planner", "openai"))
            )
            await runner.accepted.wait()
            await asyncio.to_thread(gateway.client.get, "/upstream/other/x")
            assert set(gateway.running()) == {"other"}
            await runner.end()
            result = await task
            assert (result["status"], result["reason"]) == ("success", "here")
            assert [step["status"] for step in result["steps"]] == ["succeeded"]
            assert gateway.running()["llm"]["switches"] == 2
    finally:
        await asyncio.to_thread(gateway.close)
