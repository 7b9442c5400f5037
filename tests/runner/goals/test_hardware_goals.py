"""Goals on a robot over a real socket: the emergency stop, cancels, pictures.

Control thread and server as `vram-runner deploy` has them.
"""

import asyncio
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.runner.goal_bench import goals_served
from tests.runner.small_robots import FedCamera, Nod, Twin, twin_runner
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.__main__ import main
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.goals.catalogue import Catalogue
from vram_arbiter.runner.protocols import Goal
from vram_arbiter.runner.robots.hardware import HardwareRunner
from vram_arbiter.schemas.errors import (
    EstopRequested,
    FrameStale,
    InternalError,
    LimitExceeded,
    RobotFault,
)
from vram_arbiter.schemas.manifest import Kind, RSkillManifest, load_manifest
from vram_arbiter.schemas.world import WorldState

pytestmark = pytest.mark.anyio

RSKILL = "vram-arbiter/so101-navigate"


class Told(Nod):
    """A nod that hangs in its start or in its step when the prompt says so."""

    def __init__(self, manifest: RSkillManifest) -> None:
        super().__init__(manifest, on_step=self._wait)
        self.go_on = threading.Event()

    async def _start(self, goal: Goal) -> None:
        await super()._start(goal)
        self.prompt = goal.prompt
        if goal.prompt == "hang in the start":
            self.begun.set()
            await asyncio.Event().wait()

    def _wait(self, world: WorldState) -> None:
        if self.prompt == "hang in the step":
            self._loop.call_soon_threadsafe(self.begun.set)
            self.go_on.wait(60)


class Bench:
    def __init__(self, twin: Twin, camera: FedCamera, skill: Told, runner: HardwareRunner) -> None:
        self.twin, self.camera, self.skill, self.runner = twin, camera, skill, runner


@pytest.fixture
def bench(endpoint: str, navigate_manifest: Path) -> Callable[..., Any]:
    """`options` are those of `goals_served`."""

    @asynccontextmanager
    async def serving(**options: Any) -> AsyncIterator[tuple[Bench, RunnerClient]]:
        clock = SystemClock()
        twin, camera = Twin(clock), FedCamera("front", clock)
        skill = Told(load_manifest(navigate_manifest))
        runner = twin_runner(twin, camera, clock=clock, rate_hz=200.0)
        catalogue = Catalogue([skill.manifest], {Kind.ROS_ACTION: lambda manifest: skill})
        async with goals_served(
            endpoint, runner, catalogue, identity={"robot": "bench"}, **options
        ):
            try:
                async with RunnerClient(endpoint) as client:
                    yield Bench(twin, camera, skill, runner), client
            finally:
                skill.go_on.set()
        assert twin.story[-1] == "disconnect"

    return serving


@pytest.fixture
async def serving(bench: Callable[..., Any]) -> AsyncIterator[tuple[Bench, RunnerClient]]:
    async with bench() as made:
        yield made


@pytest.fixture
def made(serving: tuple[Bench, RunnerClient]) -> Bench:
    return serving[0]


@pytest.fixture
def client(serving: tuple[Bench, RunnerClient]) -> RunnerClient:
    return serving[1]


async def diagnosed(client: RunnerClient, as_what: str) -> None:
    """Until the joints and the camera are called this.

    What is fresh is stale for some ticks wherever the machine stood still.
    """
    while (await client.state())["world"]["diagnostics"] != {
        "front": as_what,
        "joint_state": as_what,
    }:
        await asyncio.sleep(0.05)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command waits as long as the tests do: whether the motors are told is what counts here,
    not how soon.
    """
    monkeypatch.setattr("vram_arbiter.runner.cli.estop.ANSWER_S", 60.0)


@pytest.mark.parametrize("prompt", ["nod", "hang in the start"])
async def test_the_stop_fails_the_goal_and_refuses_new_ones(
    made: Bench, client: RunnerClient, prompt: str
) -> None:
    goal = await client.send_goal(RSKILL, prompt=prompt)
    await made.skill.begun.wait()
    reply = await client.estop("a hand is in the way")
    assert "a hand is in the way; all joints stand still" in reply.message
    assert made.twin.story == ["connect", "halt"]
    sent = len(made.twin.applied)
    result = await goal.result(60)
    assert (result["status"], result["success"], result["code"]) == (
        "failed",
        False,
        "estop_requested",
    )
    with pytest.raises(EstopRequested, match="a hand is in the way"):
        await client.send_goal(RSKILL, prompt="nod")
    state = await client.state()
    assert "a hand is in the way" in state["estop"]
    await diagnosed(client, "ok")  # it can still be looked at
    again = await client.estop("once more")
    assert "a hand is in the way" in again.message
    assert len(made.twin.applied) == sent


async def test_a_stop_that_the_loop_does_not_obey_is_said_and_still_latched(bench: Any) -> None:
    async with bench(estop_s=0.5) as (made, client):
        await client.send_goal(RSKILL, prompt="hang in the step")
        await made.skill.begun.wait()
        with pytest.raises(InternalError, match="cut the robot's power"):
            await client.estop("it hangs")
        with pytest.raises(EstopRequested):
            await client.send_goal(RSKILL)
        made.skill.go_on.set()
        while "stand still" not in (await client.state())["estop"]:
            await asyncio.sleep(0.01)
        assert made.twin.applied == []  # what the step came back with was not sent


async def test_what_was_fresh_is_stale_while_the_loop_hangs(
    made: Bench, client: RunnerClient
) -> None:
    """Regression: `state` showed the last world state, which was fresh when it was made."""

    await client.send_goal(RSKILL, prompt="hang in the step")
    await made.skill.begun.wait()
    await diagnosed(client, "stale")
    made.skill.go_on.set()
    await diagnosed(client, "ok")


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize(
    "cause", [RobotFault("motor 2 does not answer"), TypeError("a driver's defect")]
)
async def test_a_stop_that_did_not_reach_the_motors_is_no_success_and_is_tried_again(
    made: Bench,
    client: RunnerClient,
    endpoint: str,
    capfd: pytest.CaptureFixture[str],
    cause: Exception,
) -> None:
    """Regression: the runner counted the attempt as the stop: a lost packet left the motors running
    and the command exited 0."""

    made.twin.halt_breaks = cause
    goal = await client.send_goal(RSKILL, prompt="nod")
    await made.skill.begun.wait()
    argv = ["estop", "--reason", "smoke", "--endpoint", endpoint]
    assert await asyncio.to_thread(main, argv) == 1
    assert "cut the robot's power" in capfd.readouterr().err
    assert (await goal.result(60))["code"] == "estop_requested"
    assert "halt" not in made.twin.story
    made.twin.halt_breaks = None  # the bus is back: nobody has to ask again
    while "halt" not in made.twin.story:
        await client.state()
    assert await asyncio.to_thread(main, argv) == 0
    said = capfd.readouterr().out
    assert "emergency stop: smoke; all joints stand still" in said
    assert made.twin.story.count("halt") == 1


async def test_a_flood_of_requests_for_pictures_does_not_keep_the_stop_from_being_read(
    bench: Any,
) -> None:
    """Regression: requests that waited for a hanging control loop held all slots, so a stop was not
    read."""

    async with bench(estop_s=0.5) as (made, client):
        await client.send_goal(RSKILL, prompt="hang in the step")
        await made.skill.begun.wait()
        flood = [asyncio.create_task(client.frame("front", max_age_ms=60_000)) for _ in range(100)]
        await asyncio.wait(flood, return_when=asyncio.FIRST_COMPLETED)
        with pytest.raises(InternalError, match="cut the robot's power"):
            await client.estop("it hangs")
        assert made.runner.estop is not None
        made.skill.go_on.set()
        answers = await asyncio.gather(*flood, return_exceptions=True)
        assert any(isinstance(answer, LimitExceeded) for answer in answers)
        assert made.twin.applied == []


@pytest.mark.parametrize("reason", ["x" * 10_000, "smoke \udcff", "\x1b[2J\n\u202e", ""])
async def test_a_stop_is_not_refused_for_its_words(
    made: Bench, client: RunnerClient, reason: str
) -> None:
    """Regression: a reason of more than 500 characters made the runner refuse the stop."""

    assert "stand still" in (await client.estop(reason)).message
    assert made.runner.estop is not None
    assert made.twin.story == ["connect", "halt"]


async def test_whoever_names_no_endpoint_stops_the_system_service_too(
    made: Bench,
    client: RunnerClient,
    bench: Any,
    endpoint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: Any,
) -> None:
    """Regression: a login shell has another runtime folder, so `vram-runner estop` did not find the
    system service."""
    monkeypatch.setenv("VRAM_ARBITER_RUNTIME", str(tmp_path / "of-this-login"))
    monkeypatch.setattr(
        "vram_arbiter.runner.cli.estop.SYSTEM_RUNTIME",
        endpoint.removeprefix("ipc://").rpartition("/")[0],
    )

    assert await asyncio.to_thread(main, ["estop", "--reason", "smoke"]) == 0
    assert made.twin.story == ["connect", "halt"]
    (tmp_path / "of-this-login").mkdir()
    # a socket without a server: it may be the one of the robot that moves
    (tmp_path / "of-this-login" / "runner.sock").touch()
    assert await asyncio.to_thread(main, ["estop"]) == 1
    said = capfd.readouterr()
    assert said.out.count("bench: emergency stop: smoke") == 2
    assert "cut its power" in said.err


async def test_a_wrong_runtime_folder_does_not_keep_the_system_service_from_being_stopped(
    made: Bench, client: RunnerClient, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: the path was checked before anything was stopped."""
    monkeypatch.setenv("VRAM_ARBITER_RUNTIME", "not/absolute")
    monkeypatch.setattr(
        "vram_arbiter.runner.cli.estop.SYSTEM_RUNTIME",
        endpoint.removeprefix("ipc://").rpartition("/")[0],
    )

    assert await asyncio.to_thread(main, ["estop", "--reason", "smoke"]) == 0
    assert made.twin.story == ["connect", "halt"]


def test_a_stop_does_not_wait_for_the_imports_of_other_commands(endpoint: str) -> None:
    code = (
        "import sys; from vram_arbiter.runner.__main__ import main; "
        "code = main(['estop', '--endpoint', sys.argv[1]]); "
        "print(code, sorted({'vram_arbiter.runner.cli.deploy', 'vram_arbiter.runner.cli.sim',"
        " 'pydantic', 'numpy', 'zmq', 'msgpack'} & set(sys.modules)))"
    )
    argv = [sys.executable, "-c", code, endpoint]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "1 []"


def test_a_stop_that_nobody_hears_is_an_error(
    endpoint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["estop", "--endpoint", endpoint]) == 1
    assert "cut its power" in capsys.readouterr().err


async def test_a_canceled_goal_leaves_the_arm_where_it_was_sent(
    made: Bench, client: RunnerClient
) -> None:
    goal = await client.send_goal(RSKILL, prompt="nod")
    await made.skill.begun.wait()
    await goal.cancel()
    assert (await goal.result(60))["status"] == "canceled"
    sent = len(made.twin.applied)
    ticks = (await client.state())["ticks"]
    while (await client.state())["ticks"] < ticks + 5:
        pass
    assert len(made.twin.applied) == sent
    assert (await client.state())["estop"] is None


@pytest.mark.heavy
async def test_pictures_go_out_in_their_colours_and_a_dead_camera_gives_none(
    made: Bench, client: RunnerClient
) -> None:
    import cv2
    import numpy as np

    reply = await client.frame("front", max_age_ms=60_000, encoding="png")
    picture = cv2.imdecode(np.frombuffer(reply["data"], dtype=np.uint8), cv2.IMREAD_COLOR)
    assert picture.tolist() == [[[255, 0, 0], [0, 0, 255]]]
    made.camera.stop()
    with pytest.raises(FrameStale, match="stopped"):
        await client.frame("front", max_age_ms=60_000)
