"""`vram-reasoner serve` as a process: tasks from its socket in sequence, until a signal."""

import asyncio
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.llm_apis import OpenAi
from vram_arbiter.reasoner.__main__ import speak
from vram_arbiter.reasoner.options import parser
from vram_arbiter.reasoner.server import send
from vram_arbiter.schemas.errors import BadState, ReasonerUnreachable
from vram_arbiter.schemas.reasoner import HistoryLine

pytest.importorskip("httpx", reason="needs the reasoner extra")


def test_tasks_in_sequence(
    tmp_path: Path, a_runner: Any, stand_in: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    endpoint, history = f"ipc://{tmp_path}/reasoner.sock", tmp_path / "history.jsonl"
    stand_in.json(OpenAi.says(("finish", '{"success": true, "reason": "here already"}')))
    stand_in.hangs()

    async def told(request: dict[str, Any]) -> Any:
        return await send(endpoint, request, timeout_s=60.0)

    async def said(*argv: str) -> None:
        """As the command line says it."""
        arguments = parser("").parse_args([*argv, "--listen", endpoint])
        await speak(arguments, argv[0].removeprefix("--"))

    async def up() -> None:
        while True:
            try:
                await send(endpoint, {"op": "ping"}, timeout_s=1.0)
                return
            except ReasonerUnreachable:
                await asyncio.sleep(0.05)

    async def state_of(number: int, state: str) -> Any:
        while (task := (await told({"op": "tasks"}))["tasks"][number - 1])["state"] != state:
            await asyncio.sleep(0.02)
        return task

    async def story() -> int | None:
        argv = ["serve", "--planner", "openai", "--detector", "none", "--scene-vlm", "none"]
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "vram_arbiter.reasoner",
            *argv,
            "--history",
            str(history),
            env=os.environ
            | {
                "VRAM_ARBITER_RUNTIME": str(tmp_path),
                "VRAM_REASONER_LLM_BASE_URL": stand_in.url,
                "VRAM_REASONER_LLM_MODEL": "m",
            },
        )
        try:
            await up()
            reply = await told({"op": "submit", "text": "drive home"})
            assert (reply["task"], reply["ahead"]) == (1, 0)
            assert (await state_of(1, "success"))["reason"] == "here already"
            await told({"op": "submit", "text": "drive away"})
            await state_of(2, "running")
            for text in ("left", "right"):
                await said("--submit", text)
            assert capsys.readouterr().out == "task 3, 1 before it\ntask 4, 2 before it\n"
            await said("--cancel", "not that way", "--number", "3")
            await said("--tasks")
            listed = [json.loads(line)["state"] for line in capsys.readouterr().out.splitlines()]
            assert listed == ["success", "running", "canceled", "queued"]
            assert (await told({"op": "state"}))["queued"] == 1
            assert (await told({"op": "result", "task": 1}))["result"]["llm"]["requests"] == 1
            with pytest.raises(BadState, match="is not over: running"):
                await told({"op": "result", "task": 2})
            while len(stand_in.asked) < 2:  # the second task's episode runs
                await asyncio.sleep(0.02)
            process.send_signal(signal.SIGTERM)
            return await process.wait()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()

    async def bounded() -> int | None:
        async with a_runner(), asyncio.timeout(120):
            return await story()

    assert asyncio.run(bounded()) == 0
    lines = [HistoryLine.model_validate_json(line) for line in history.read_text().splitlines()]
    ended = {line.task["task"]: (line.task["state"], line.result["reason"]) for line in lines}
    assert ended == {
        1: ("success", "here already"),
        2: ("canceled", "canceled: by SIGTERM"),
        3: ("canceled", "canceled: not that way"),
        4: ("canceled", "canceled: by SIGTERM"),
    }
