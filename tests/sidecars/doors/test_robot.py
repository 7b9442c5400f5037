"""The queue and the history of one robot at lerobot's door, against lerobot's own server and a
small real sidecar."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from tests.runner.skills.policy_bench import Sidecar
from tests.support.waiting import play
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.errors import FrameStale, ModelError
from vram_arbiter.sidecars.doors.lerobot_messages import STATE, Instructions, Observation
from vram_arbiter.sidecars.doors.robot import Robot

pytestmark = pytest.mark.heavy

ASKED = Instructions("skill", ("a", "b"), {}, 2)


def seen(timestep: int, position: float = 0.0, must_go: bool = False) -> Observation:
    import numpy as np

    state = np.array([position, 0.0], np.float32)
    return Observation(float(timestep), timestep, must_go, {STATE: state, "task": "grab"})


def at_sidecar(folder: Path, story: Callable[[Robot, Sidecar], Awaitable[None]]) -> None:
    async def played() -> None:
        sidecar, endpoint = Sidecar(), f"ipc://{folder}/s"
        async with sidecar.served(endpoint), PolicyClient(endpoint) as client:
            await story(Robot(ASKED, client), sidecar)

    play(played)


async def waits(robot: Robot) -> bool:
    return await robot.arrival(0)


def test_observations_are_chosen_as_by_lerobots_server(
    short_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which of several observations is worth an inference, after each inference."""
    monkeypatch.chdir(tmp_path)  # lerobot's logger writes where it runs
    from lerobot.async_inference.configs import PolicyServerConfig
    from lerobot.async_inference.helpers import TimedObservation
    from lerobot.async_inference.policy_server import PolicyServer

    theirs = PolicyServer(PolicyServerConfig())
    theirs.lerobot_features = {STATE: {"dtype": "float32", "shape": (2,), "names": ["a", "b"]}}
    steps = [
        seen(0, 0.0, must_go=True), seen(0, 0.5), seen(0, 5.0), seen(1, 0.5), seen(1, 1.5),
        seen(1, 4.0), seen(1, 9.0, must_go=True), seen(2, 9.99), seen(3, 10.01), seen(1, 20.0),
    ]  # fmt: skip

    async def story(robot: Robot, sidecar: Sidecar) -> None:
        for one in steps:
            raw = {"a": float(one.values[STATE][0]), "b": 0.0}
            timed = TimedObservation(
                timestamp=one.timestamp, timestep=one.timestep, observation=raw, must_go=one.must_go
            )
            robot.offer(one)
            assert await waits(robot) == theirs._enqueue_observation(timed), one
            if await waits(robot):
                looked_at, rows = await robot.act()
                assert looked_at is one
                assert len(rows) == ASKED.actions_max
                theirs.last_processed_obs = theirs.observation_queue.get_nowait()
                theirs._predicted_timesteps.add(one.timestep)

    at_sidecar(short_folder, story)


def test_a_newer_observation_takes_the_place_of_one_that_waits(short_folder: Path) -> None:
    async def story(robot: Robot, sidecar: Sidecar) -> None:
        first, similar = seen(0, must_go=True), seen(0, 0.1)
        robot.offer(first)
        robot.offer(similar)
        assert (await robot.act())[0] is similar
        assert not await waits(robot)

    at_sidecar(short_folder, story)


def test_after_a_failure_the_next_observation_is_looked_at(short_folder: Path) -> None:
    """The robot marks no other as `must_go` until it has had actions: it would stand still."""

    async def story(robot: Robot, sidecar: Sidecar) -> None:
        for error in (FrameStale("it waited"), ModelError("it fails")):
            robot.offer(seen(0, must_go=True))
            sidecar.error = error
            with pytest.raises(type(error)):
                await robot.act()
            sidecar.error = None
            robot.offer(seen(0))
            assert (await robot.act())[0].must_go is False

    at_sidecar(short_folder, story)


def test_a_policy_with_a_history_gets_the_control_steps_that_were_sent(short_folder: Path) -> None:
    """In the place of a step that the robot did not send stands the next one."""

    async def story(robot: Robot, sidecar: Sidecar) -> None:
        robot.offer(seen(0, 0.0, must_go=True))
        sidecar.answer = {"n_obs_steps": 3}
        await robot.act()
        for number in (4, 5, 7):
            robot.offer(seen(number, float(number), must_go=True))
        await robot.act()
        robot.offer(seen(8, 8.0, must_go=True))
        await robot.act()
        states = [observation[STATE] for observation in sidecar.observations]
        assert [float(state[0]) for state in states[:1]] == [0.0]
        assert [[float(step[0]) for step in state] for state in states[1:]] == [
            [5.0, 7.0, 7.0],
            [7.0, 7.0, 8.0],
        ]
        assert all(call["afresh"] for call in sidecar.requests)

    at_sidecar(short_folder, story)


def test_an_observation_is_offered_with_its_age(short_folder: Path) -> None:
    async def story(robot: Robot, sidecar: Sidecar) -> None:
        robot.offer(seen(0, must_go=True))
        began = asyncio.get_running_loop().time()
        while asyncio.get_running_loop().time() < began + 0.1:
            await asyncio.sleep(0)
        await robot.act()
        assert sidecar.requests[-1]["fresh_s"] <= 4.9

    at_sidecar(short_folder, story)
