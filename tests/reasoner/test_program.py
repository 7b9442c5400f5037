"""`vram-reasoner` as a process: how it ends, what it refuses, how a running one is spoken to."""

import asyncio
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.anyio

UNKNOWN_BODY = [
    "--runner",
    "ipc:///proc/none/runner.sock",
    "--detector",
    "none",
    "--scene-vlm",
    "none",
]


def reasoner(runtime: Path, *arguments: str, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "vram_arbiter.reasoner", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={k: v for k, v in os.environ.items() if not k.startswith("VRAM_")}
        | {"VRAM_ARBITER_RUNTIME": str(runtime), **environ},
    )


def test_usage(tmp_path: Path) -> None:
    ended = reasoner(tmp_path, "--task", "x", "--say", "y")
    assert ended.returncode == 2
    ended = reasoner(tmp_path, "--say", "hello")
    assert ended.returncode == 3
    assert "no reasoner answers" in ended.stderr
    ended = reasoner(
        tmp_path, "--task", "grab the cube", "--playbook", "/nonexistent/rskill.yaml", *UNKNOWN_BODY
    )
    assert ended.returncode == 2
    assert "cannot be read" in ended.stderr
    assert "Traceback" not in ended.stderr
    written(tmp_path)
    ended = reasoner(
        tmp_path,
        "--task",
        "grab the cube",
        "--playbook",
        str(tmp_path / "rskill.yaml"),
        *UNKNOWN_BODY,
    )
    assert ended.returncode == 2
    assert "a playbook is read by a language model (--planner openai or anthropic)" in ended.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--task", " "], "the task is empty"),
        (["serve", "--result", "r.json"], "serve writes --history FILE"),
        (
            ["--task", "grab it", "--result", "/proc/none/result.json"],
            "--result /proc/none/result.json cannot be written",
        ),
        (
            ["--task", "grab it", "--planner", "openai"],
            "VRAM_REASONER_LLM_BASE_URL and VRAM_REASONER_LLM_MODEL not set",
        ),
        (
            ["--task", "grab it", "--look"],
            "--look is for a language model (--planner openai or anthropic",
        ),
        (["--task", "grab it", "--runner", "runner.sock"], "'runner.sock' is not an endpoint"),
        (["--task", "grab it", "--listen", "tcp://127.0.0.1:7"], "any user of the machine"),
        (["--say", "x", "--listen", "reasoner.sock"], "'reasoner.sock' is not an endpoint"),
    ],
)
def test_what_is_wrong_from_the_start_is_said_at_the_start(
    tmp_path: Path, arguments: list[str], said: str
) -> None:
    """Before the runner is waited for, and before an episode whose result could not be written."""
    there = ["--listen", f"ipc://{tmp_path}/reasoner.sock", *UNKNOWN_BODY]
    ended = reasoner(tmp_path, *there, *arguments)
    assert ended.returncode == 2
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1, ended.stderr


def written(folder: Path) -> None:
    (folder / "rskill.yaml").write_text(
        'name: acme/search\nversion: "0.1.0"\nlicense: mit\nrole: s2\nkind:'
        " playbook\nembodiment_tags: [any]\nchunk_size: 1\n"
        "latency_budget: {per_chunk_ms: 5000}\ndescription: x\nactions: [plan]\n"
        "playbook: {trigger: t, body_uri: ./P.md, composes_tools: [execute_rskill],"
        " done_predicate: d, max_steps: 4}\n"
    )
    (folder / "P.md").write_text("Turn left first.")


async def test_a_running_episode_is_cancelled_from_outside(tmp_path: Path, a_runner: Any) -> None:
    """The runner knows one skill; the language model's server takes the connection and never
    answers.
    """
    pytest.importorskip("httpx", reason="needs the reasoner extra")
    manifest = {
        "name": "lab/go",
        "version": "1.0.0",
        "license": "mit",
        "kind": "ros_action",
        "embodiment_tags": ["any"],
        "chunk_size": 1,
        "latency_budget": {"per_chunk_ms": 1},
        "description": "drive",
        "actions": ["navigate"],
        "actuators_required": [
            {"kind": "body_twist", "control_mode_semantics": {"mode": "absolute"}}
        ],
        "ros_integration": {
            "package": "p",
            "interface_type": "T",
            "interface_name": "/t",
            "default_goal_json": "{}",
        },
    }

    asked_for: list[bytes] = []

    asked = asyncio.Event()
    written(tmp_path)

    async def silent(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked_for.append(await reader.readuntil(b"\r\n\r\n"))
        length = next(
            line
            for line in asked_for[0].lower().split(b"\r\n")
            if line.startswith(b"content-length")
        )
        asked_for.append(await reader.readexactly(int(length.split(b":")[1])))
        asked.set()
        await reader.read()  # until the client hangs up
        writer.close()

    server = await asyncio.start_server(silent, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    environ = os.environ | {
        "VRAM_ARBITER_RUNTIME": str(tmp_path),
        "VRAM_REASONER_LLM_BASE_URL": f"http://127.0.0.1:{port}",
        "VRAM_REASONER_LLM_MODEL": "m",
    }
    async with a_runner() as runner, asyncio.timeout(200):
        runner.skills = [manifest]
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "vram_arbiter.reasoner",
            "--task",
            "drive home",
            "--planner",
            "anthropic",
            "--detector",
            "none",
            "--scene-vlm",
            "none",
            "--playbook",
            str(tmp_path / "rskill.yaml"),
            "--result",
            str(tmp_path / "result.json"),
            env=environ,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            await asked.wait()
            told = await asyncio.to_thread(reasoner, tmp_path, "--cancel", "lunch")
            assert told.returncode == 0, told.stderr
            _, err = await process.communicate()
        finally:
            if process.returncode is None:
                process.kill()
        server.close()
        code, err = process.returncode, err.decode()
    assert code == 1, err
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["reason"] == "canceled: lunch"
    body = json.loads(asked_for[1])
    assert "Turn left first." in body["system"]
    assert [tool["name"] for tool in body["tools"]] == ["execute_rskill__lab__go", "finish"]
    assert "Traceback" not in err


def test_a_task_that_is_no_text_and_a_result_that_has_no_place_are_said_before_anything_moves(
    tmp_path: Path,
) -> None:
    """Regression: an undecodable byte, or a task of many pages, ended in a traceback; a result file
    that could not be written in one behind the episode.
    """
    for task in ("grab the \udcff cube", "grab the " + "very " * 2000 + "red cube"):
        ended = reasoner(tmp_path, "--task", task, *UNKNOWN_BODY)
        assert (ended.returncode, "Traceback" in ended.stderr) == (2, False), ended.stderr
        assert ended.stderr.startswith("vram-reasoner: the task ")
    (tmp_path / "file").touch()
    for place in (tmp_path / "file" / "r.json", tmp_path):
        ended = reasoner(tmp_path, "--task", "grab the cube", "--result", str(place), *UNKNOWN_BODY)
        assert (ended.returncode, "Traceback" in ended.stderr) == (2, False), ended.stderr
        assert f"--result {place} cannot be written" in ended.stderr
