"""`vram-runner goal|state|frame|reset|mark` against a runner that serves in the same loop."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2", reason="needs the runner extra")

from tests.runner.goal_bench import goals_served
from tests.runner.small_robots import Nod
from tests.support.waiting import eventually
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.__main__ import parse
from vram_arbiter.runner.goals.catalogue import Catalogue
from vram_arbiter.runner.protocols import Hold
from vram_arbiter.schemas.errors import BadState, ConfigError, RunnerUnreachable, UnknownSkill
from vram_arbiter.schemas.manifest import Kind, RSkillManifest, load_manifest

pytestmark = pytest.mark.anyio

RSKILL = "vram-arbiter/so101-navigate"
Serving = Callable[[], Any]


@pytest.fixture
def serving(
    make_runner: Callable[..., Any], endpoint: str, navigate_manifest: Path
) -> Callable[[], Any]:
    def make(manifest: RSkillManifest) -> Nod:
        skill = Nod(manifest, steps=3)
        if len(made) == 1:
            skill._step = lambda world: Hold("it never ends")  # type: ignore[method-assign]
        made.append(skill)
        return skill

    made: list[Nod] = []

    @asynccontextmanager
    async def serve() -> AsyncIterator[Any]:
        runner = make_runner(rate_hz=200.0, cameras=("front",), seed=4)
        catalogue = Catalogue([load_manifest(navigate_manifest)], {Kind.ROS_ACTION: make})
        reset = runner.robot.begin_episode
        async with goals_served(endpoint, runner, catalogue, reset=reset):
            yield runner

    return serve


async def test_a_session_by_commands_alone(
    serving: Serving,
    endpoint: str,
    env: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("vram_arbiter.clients.runner.WAIT_QUIETLY_S", 0.01)

    async def command(*argv: str) -> int:
        args = parse([*argv, "--endpoint", endpoint])
        return int(await args.run(args))

    early = asyncio.create_task(command("state", "--json"))  # the runner is still starting
    await eventually(lambda: "waiting for a runner at" in caplog.text)
    async with serving():
        assert await early == 0
        state = json.loads(capsys.readouterr().out)
        assert (state["cameras"], state["goal"]) == (["front"], None)
        assert await command("state") == 0
        assert "cameras   front" in capsys.readouterr().out

        assert await command("goal", RSKILL, "nod", "--params", '{"times": 3}') == 0
        said = capsys.readouterr()
        result = json.loads(said.out)
        assert (result["status"], result["data"]["nods"]) == ("succeeded", 3)
        with pytest.raises(UnknownSkill):
            await command("goal", "vram-arbiter/none")

        picture = tmp_path / "front.png"
        assert await command("frame", "--out", str(picture), "--max-age-ms", "60000") == 0
        assert picture.read_bytes().startswith(b"\x89PNG")
        with pytest.raises(ConfigError, match=r"ends in \.jpg or \.png"):
            await command("frame", "--out", str(tmp_path / "front.gif"))

        assert await command("reset", "--seed", "7") == 0
        assert await command("reset") == 0
        assert env.resets == [4, 7, 7]
        with pytest.raises(BadState, match="records nothing"):
            await command("mark", "success")


async def test_the_scene_of_a_goal_is_not_reset(serving: Serving, endpoint: str, env: Any) -> None:
    async with serving(), RunnerClient(endpoint) as client:
        assert (await (await client.send_goal(RSKILL)).result(60))["success"]
        goal = await client.send_goal(RSKILL, max_ticks=100_000)
        with pytest.raises(BadState, match="is running"):
            await client.reset(3)
        await goal.cancel()
        assert (await goal.result(60))["status"] == "canceled"
        assert env.resets == [4]


def test_a_runner_that_never_comes_is_unreachable(
    endpoint: str, run_async: Callable[[Any], Any]
) -> None:
    args = parse(["state", "--endpoint", endpoint, "--wait", "0.1"])
    with pytest.raises(RunnerUnreachable):
        run_async(args.run(args))
