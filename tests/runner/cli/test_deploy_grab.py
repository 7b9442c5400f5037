"""The grab policy on a deployed robot: its own sidecar, a real arbiter, MuJoCo's twin, two cameras.

The goal is a use of the lease.
"""

import asyncio
import random
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.runner.grab_programs import GOAL_S, GRAB, SKILL, GrabPrograms, need_checkpoint
from tests.support.process import ArbiterProcess
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.schemas.goals import PingRunner
from vram_arbiter.schemas.wire.replies import StatusReply

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(340)]


def deployed(arbiter: ArbiterProcess) -> GrabPrograms:
    """Policy sidecar and `vram-runner deploy` on a file with the twin and two cameras."""
    config = arbiter.runtime / "robot.yaml"
    cameras = "".join(
        f"  - {{sensor_id: {name}, max_age_ms: 2000, backend_params: {{path: {path}, loop: "
        "true}}\n"
        for name, path in _videos(arbiter.runtime).items()
    )
    config.write_text(f"robot_id: bench\nhal: {{adapter: so101_mujoco}}\nsensors:\n{cameras}")
    return GrabPrograms(arbiter, "deploy", "--config", str(config), "--skills", str(SKILL))


def _videos(folder: Path) -> dict[str, Path]:
    """A second of what both cameras see when the base stands before the object, arm at rest: the
    policy knows such pictures.
    """
    import cv2

    from vram_arbiter.runner.sim.env import SimEnv
    from vram_arbiter.runner.sim.tasks import stand_before

    paths = {}
    with SimEnv() as env:
        env.reset(3)
        stand_before(env, env.target, random.Random(3), error_m=0.0)
        for name in ("front", "wrist"):
            picture = env.render(name)[:, :, ::-1]
            paths[name] = folder / f"{name}.avi"
            height, width = picture.shape[:2]
            writer = cv2.VideoWriter(
                str(paths[name]), cv2.VideoWriter.fourcc(*"MJPG"), 30, (width, height)
            )
            assert writer.isOpened()
            for _ in range(30):
                writer.write(picture)
            writer.release()
    return paths


@pytest.fixture
def programs(arbiter_daemon: ArbiterProcess) -> Iterator[GrabPrograms]:
    need_checkpoint()
    started = deployed(arbiter_daemon)
    yield started
    started.close()


def uses_of_grab(status: StatusReply) -> list[int]:
    return [lease.uses for lease in status.leases if lease.consumer == "grab"]


async def interrupted_grab(arbiter: ArbiterProcess, programs: GrabPrograms) -> None:
    async with (
        RunnerClient(f"ipc://{arbiter.runtime}/runner.sock", connect_timeout_s=60.0) as runner,
        AsyncClient("watcher", endpoint=arbiter.endpoint) as watcher,
    ):
        assert (await runner.call(PingRunner()))["arbiter"] is True
        begun = await runner.state()
        goal = await runner.send_goal(GRAB, prompt="grab the red cube", deadline_s=GOAL_S)
        async for feedback in goal.feedback():
            if feedback["state"] == "running":
                break
        assert [count >= 1 for count in uses_of_grab(await watcher.status())] == [True]
        lift = begun["world"]["joint_state"]["name"].index("shoulder_lift")
        here = begun["world"]["joint_state"]["position"][lift]
        while abs((await runner.state())["world"]["joint_state"]["position"][lift] - here) < 0.5:
            assert not goal.done, await goal.result(1)
        programs.runner.send_signal(signal.SIGTERM)
        assert (await goal.result(60))["status"] == "canceled"
        assert await asyncio.to_thread(programs.runner.wait, 60) == 0
        async with asyncio.timeout(60):
            while any(uses_of_grab(await watcher.status())):
                await watcher.ping(timeout_s=60)


def test_the_policy_moves_the_arm_and_a_signal_ends_its_use(
    arbiter_daemon: ArbiterProcess, programs: GrabPrograms
) -> None:
    programs.play(interrupted_grab(arbiter_daemon, programs))
