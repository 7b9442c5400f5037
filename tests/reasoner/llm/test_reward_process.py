"""The reward kind end to end: a real arbiter, the shipped model in its sidecar, the simulator's
runner, and a reasoner whose model asks for progress.
"""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.fakegpu_check import check_log
from tests.support.prepared import Forked, start
from tests.support.wire import WireClient
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import RewardClient
from vram_arbiter.schemas.errors import Evicted

pytestmark = [pytest.mark.anyio, pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(400)]

ROOT = Path(__file__).parents[3]
CONFIGS = ROOT / "configs"
SKILLS = [str(CONFIGS / "rskills/so101-navigate"), str(CONFIGS / "rskills/so101-progress")]
GB = 10**9


def openai(name: str, **arguments: Any) -> Any:
    call = {
        "id": "c",
        "type": "function",
        "function": {"name": name, "arguments": json.dumps(arguments)},
    }
    return {"choices": [{"message": {"role": "assistant", "content": None, "tool_calls": [call]}}]}


@asynccontextmanager
async def program(environ: dict[str, str], name: str, *argv: str) -> AsyncIterator[Forked]:
    process = start(name, argv, environ, cwd=ROOT)
    try:
        yield process
    finally:
        process.terminate()
        printed = await asyncio.to_thread(process.communicate)
        print(*printed)  # shown by pytest where the test fails


async def test_progress_is_asked_for_under_a_lease_and_evicted_like_any_other(
    arbiter_daemon: Any, stand_in: Any, tmp_path: Path
) -> None:
    runtime = arbiter_daemon.runtime
    environ = {**arbiter_daemon.environ, "OMP_NUM_THREADS": "1", "MUJOCO_GL": "egl"}
    result = tmp_path / "result.json"
    stand_in.json(openai("query_task_progress", window_s=5.0))
    stand_in.json(openai("query_task_progress", task="tidy up"))
    stand_in.json(openai("execute_rskill", rskill_id="vram-arbiter/so101-progress"))
    stand_in.json(openai("finish", success=False, reason="it was only a look"))

    async def story() -> None:
        serve = (
            "vram-sidecar",
            "--name",
            "reward",
            "--rskill",
            f"{SKILLS[1]}/rskill.yaml",
            "--device",
            f"fake:{arbiter_daemon.gpu_folder}",
        )
        think = (
            "vram-reasoner",
            "--task",
            "grab the red cube",
            "--planner",
            "openai",
            "--detector",
            "none",
            "--scene-vlm",
            "none",
            "--reward",
            "--result",
            str(result),
        )
        async with (
            program(environ, *serve) as sidecar,
            program(
                environ,
                "vram-runner",
                "sim",
                "--no-arbiter",
                "--seed",
                "1",
                "--skills",
                *SKILLS,
            ),
            RewardClient(f"ipc://{runtime}/reward.sock", connect_timeout_s=120.0) as reward,
            RunnerClient(f"ipc://{runtime}/runner.sock", connect_timeout_s=120.0) as runner,
        ):
            picture = (await runner.frame("wrist", max_age_ms=60_000.0, encoding="png"))["data"]
            llm = {"VRAM_REASONER_LLM_BASE_URL": stand_in.url, "VRAM_REASONER_LLM_MODEL": "m"}
            async with program({**environ, **llm}, *think) as reasoner:
                assert await asyncio.to_thread(reasoner.wait) == 1, (
                    "the planner said that it was no success"
                )

            # resident under a lease of its own, at the inference peak of what it stands for
            identity = await reward.ping(timeout_s=60.0)
            assert (identity["state"], identity["kind"], identity["pid"]) == (
                "resident",
                "reward",
                sidecar.pid,
            )
            with WireClient(arbiter_daemon.endpoint) as arbiter:
                arbiter.hello("vla")
                (lease,) = arbiter.ask("status")["leases"]
                assert (lease["consumer"], lease["pid"], lease["charge_bytes"]) == (
                    "reward",
                    sidecar.pid,
                    3.56 * GB,
                )
                token = identity["token"]  # of the sidecar: `status` shows tokens to holders only
                assert (await reward.score([picture], "grab the red cube", token=token)).progress[
                    0
                ] < 0.5

                # somebody needs the GPU: it leaves, and says *evicted* to whoever still speaks of
                # the old lease
                granted = await asyncio.to_thread(
                    arbiter.acquire, "vla", 6 * GB, wait_timeout_s=60.0
                )
                assert granted["ok"], granted
                push = await asyncio.to_thread(arbiter.push, "granted", 60.0)
                assert (await reward.ping(timeout_s=60.0))["state"] == "parked"
                with pytest.raises(Evicted):
                    await reward.score([picture], "grab the red cube", token=token)
                assert arbiter.ask(
                    "release", lease_id=push["lease"]["lease_id"], token=push["lease"]["token"]
                )["ok"]
            judged = await reward.score([picture], "grab the red cube")  # there is room again
            assert judged.progress[0] < 0.5

    async with asyncio.timeout(350):
        await story()
    steps = json.loads(result.read_text())["steps"]
    assert [(step["call"]["tool"], step["status"], step["code"]) for step in steps] == [
        ("query_task_progress", "answered", ""),
        ("query_task_progress", "error", "bad_request"),
        ("execute_rskill", "refused", "not_permitted"),
    ]
    assert "it is asked through query_task_progress" in steps[2]["text"]
    offered = {tool["function"]["name"] for tool in stand_in.asked[0]["tools"]}
    assert "query_task_progress" in offered
    assert not any("progress" in name for name in offered - {"query_task_progress"})
    told = next(
        json.loads(m["content"]) for m in stand_in.asked[1]["messages"] if m["role"] == "tool"
    )
    assert told["source"] == "reward_model"
    assert told["data"]["progress"][-1] < 0.5, "nothing has been grabbed"
    assert told["data"]["success"][-1] < 0.5
    report = check_log((arbiter_daemon.gpu_folder / "log.jsonl").read_text())
    assert (report.problems, report.oom_events) == ([], 0)
