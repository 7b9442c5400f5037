"""The reasoner's process with the simulator's runner and a language model's server that hangs:
nothing waits for the model.
"""

import asyncio
import json
import os
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.prepared import Forked, start
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.reasoner.server import send
from vram_arbiter.schemas.goals import GetResult

pytestmark = [pytest.mark.anyio, pytest.mark.heavy, pytest.mark.e2e]

ROOT = Path(__file__).parents[3]
TURN = "execute_rskill__vram-arbiter__so101-navigate"


def openai(name: str, **arguments: Any) -> Any:
    call = {
        "id": "c",
        "type": "function",
        "function": {"name": name, "arguments": json.dumps(arguments)},
    }
    return {"choices": [{"message": {"role": "assistant", "content": None, "tool_calls": [call]}}]}


def anthropic(name: str, **arguments: Any) -> Any:
    call = {"type": "tool_use", "id": "toolu_1", "name": name, "input": arguments}
    return {"type": "message", "role": "assistant", "content": [call], "stop_reason": "tool_use"}


class Programs:
    def __init__(self, folder: Path, llm: str) -> None:
        self.folder = folder
        self.environ = os.environ | {
            "VRAM_ARBITER_RUNTIME": str(folder),
            "OMP_NUM_THREADS": "1",
            "MUJOCO_GL": "egl",
            "VRAM_REASONER_LLM_BASE_URL": llm,
            "VRAM_REASONER_LLM_MODEL": "m",
        }

    @asynccontextmanager
    async def run(self, program: str, *argv: str) -> AsyncIterator[Forked]:
        process = start(program, argv, self.environ, cwd=ROOT)
        try:
            yield process
        finally:
            process.kill()
            await asyncio.to_thread(process.wait)

    def runner(self) -> Any:
        skill = str(ROOT / "configs/rskills/so101-navigate")
        return self.run("vram-runner", "sim", "--skills", skill, "--no-arbiter", "--seed", "1")

    def reasoner(self, planner: str) -> Any:
        return self.run(
            "vram-reasoner",
            "--task",
            "turn round",
            "--planner",
            planner,
            "--detector",
            "none",
            "--scene-vlm",
            "none",
            "--result",
            str(self.folder / "result.json"),
        )

    def result(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.folder / "result.json").read_text())
        return found


async def comes_true(condition: Callable[[], Any]) -> Any:
    """The condition's value once it is true; the test's own time limit bounds it."""
    while True:
        value = condition()
        if asyncio.iscoroutine(value):
            value = await value
        if value:
            return value
        await asyncio.sleep(0.02)


async def test_results_signals_and_an_emergency_stop_pass_a_model_that_hangs(
    tmp_path: Path, stand_in: Any
) -> None:
    pytest.importorskip("mujoco", reason="needs the full install")
    programs = Programs(tmp_path, stand_in.url)

    async def story() -> None:
        async with (
            programs.runner(),
            RunnerClient(f"ipc://{tmp_path}/runner.sock", connect_timeout_s=120.0) as client,
        ):

            async def goal() -> Any:
                return (await client.state())["goal"]

            # an operator speaks while a goal runs; the model is asked and hangs; the goal's result
            # passes it by
            stand_in.json(openai(TURN, goal_params={"turn_rad": 6.2}))
            stand_in.hangs()
            stand_in.json(openai("finish", success=True, reason="turned"))
            async with programs.reasoner("openai") as reasoner:
                await comes_true(goal)
                await send(
                    f"ipc://{tmp_path}/reasoner.sock",
                    {"op": "say", "text": "slowly"},
                    timeout_s=60.0,
                )
                assert await asyncio.to_thread(reasoner.wait) == 0
            result = programs.result()
            assert [step["status"] for step in result["steps"]] == ["succeeded"]
            assert result["reason"] == "turned"
            assert len(stand_in.asked) == 3
            assert "operator: slowly" in json.dumps(stand_in.asked[1]["messages"])

            # a signal ends the reasoner, and its goal with it; the result tells of both
            stand_in.json(anthropic(TURN, goal_params={"turn_rad": 6.2}))
            async with programs.reasoner("anthropic") as reasoner:
                running = await comes_true(goal)
                reasoner.send_signal(signal.SIGTERM)
                assert await asyncio.to_thread(reasoner.wait) == 1
            result = programs.result()
            assert result["reason"] == "canceled: by SIGTERM"
            assert [step["status"] for step in result["steps"]] == ["canceled"]
            assert (await client.call(GetResult(goal_id=running)))["status"] == "canceled"
            assert await goal() is None

            # an emergency stop ends an episode whose model hangs
            asked = len(stand_in.asked)
            stand_in.hangs()
            async with programs.reasoner("anthropic") as reasoner:
                await comes_true(lambda: len(stand_in.asked) > asked)
                await client.estop("a hand in the way")
                assert await asyncio.to_thread(reasoner.wait) == 1
            assert programs.result()["reason"].startswith("stopped: emergency stop")

    async with asyncio.timeout(280):
        await story()
