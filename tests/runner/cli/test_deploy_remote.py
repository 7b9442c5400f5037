"""`vram-runner deploy` with a policy of a GPU server: the robot has no arbiter of its own, the goal
is a use of the server's, and a lost tunnel ends the goal."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.runner.grab_programs import GRAB, SKILL
from tests.runner.skills.policy_bench import Leased
from tests.support import prepared
from tests.support.guests import USER
from tests.support.process import Make
from tests.support.remote import Remote, wait_for_line
from tests.support.waiting import play
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.runner import Goal, RunnerClient

pytestmark = [pytest.mark.nightly, pytest.mark.heavy, pytest.mark.e2e]

JOINTS, ROWS = 6, 12


def video(folder: Path) -> Path:
    """A second of black pictures."""
    import cv2
    import numpy as np

    path = folder / "black.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (640, 480))
    for _ in range(30):
        writer.write(np.zeros((480, 640, 3), dtype=np.uint8))
    writer.release()
    return path


@contextmanager
def deployed(remote: Remote, folder: Path) -> Iterator[prepared.Forked]:
    camera = f"max_age_ms: 2000, backend_params: {{path: {video(folder)}, loop: true}}"
    config = folder / "robot.yaml"
    config.write_text(
        "robot_id: bench\nhal: {adapter: so101_mujoco}\nsensors:\n"
        f"  - {{sensor_id: front, {camera}}}\n  - {{sensor_id: wrist, {camera}}}\n"
        f"sidecars: {{grab: ssh://{remote.host}/grab}}\n"
    )
    words = ["deploy", "--config", str(config), "--skills", str(SKILL), "--no-arbiter"]
    environ = remote.environ | {"OMP_NUM_THREADS": "1"}
    runner = prepared.start("vram-runner", words, environ, cwd=folder)
    try:
        yield runner
    finally:
        runner.terminate()
        print(runner.communicate())


async def running(runner: RunnerClient) -> Goal:
    """A goal that moves the arm."""
    goal = await runner.send_goal(GRAB, prompt="grab the red cube", deadline_s=100.0)
    async for feedback in goal.feedback():
        if feedback["state"] == "running":
            return goal
    raise AssertionError(await goal.result(1))


def test_a_goal_ends_with_its_tunnel_and_the_next_is_a_new_use(
    make_arbiter: Make, tmp_path: Path
) -> None:
    import numpy as np

    sidecar = Leased()
    sidecar.action = np.zeros((ROWS, JOINTS), dtype=np.float32)

    async def story(remote: Remote) -> None:
        async with (
            AsyncClient("grab", endpoint=remote.arbiter.endpoint) as server,
            server.lease(vram="1GiB", model="pi0", unload=lambda: None) as sidecar.lease,
            sidecar.served(f"ipc://{remote.sidecar}"),
        ):
            remote.sidecar.chmod(0o666)

            async def uses() -> int:
                return sum(lease.uses for lease in (await server.status()).leases)

            await sidecar.lease.ready()
            keeper = await asyncio.to_thread(remote.up, "grab")
            with deployed(remote, tmp_path):
                endpoint = f"ipc://{remote.robot}/runner.sock"
                async with RunnerClient(endpoint, connect_timeout_s=60.0) as runner:
                    goal = await running(runner)
                    assert await uses() == 1
                    remote.sshd.kill(USER)
                    result: Any = await goal.result(60)
                    assert (result["status"], "lost" in result["message"]) == ("failed", True)
                    assert await uses() == 0
                    await asyncio.to_thread(wait_for_line, keeper, "is up")
                    goal = await running(runner)
                    assert await uses() == 1, "a new use"
                    await goal.cancel()
                    await goal.result(60)

    with Remote(make_arbiter, tmp_path) as remote:
        play(lambda: story(remote), 200.0)
