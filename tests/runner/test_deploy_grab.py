"""The grab policy on a deployed robot: its own sidecar, a real arbiter, MuJoCo's twin, two cameras. The goal is a use of the lease."""

import asyncio
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from arbiter.testing.process import ArbiterProcess
from clients.aio import ArbiterClient
from clients.runner import RunnerClient

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(240)]

ROOT = Path(__file__).parents[2]
GRAB = "vram-arbiter/so101-grab"
SKILL = ROOT / "configs/rskills/so101-grab/rskill.yaml"


class Programs:
    """Policy sidecar and `vram-runner deploy` in the daemon's runtime folder."""

    def __init__(self, arbiter: ArbiterProcess) -> None:
        config = arbiter.runtime / "robot.yaml"
        cameras = "".join(
            f"  - {{sensor_id: {name}, max_age_ms: 2000, backend_params: {{path: {path}, loop: true}}}}\n"
            for name, path in _videos(arbiter.runtime).items()
        )
        config.write_text(f"robot_id: bench\nhal: {{adapter: so101_mujoco}}\nsensors:\n{cameras}")
        self.log = arbiter.runtime / "programs.log"
        environ = arbiter.environ | {"OMP_NUM_THREADS": "1"}
        sidecar = ["sidecars", "--name", "grab", "--rskill", str(SKILL), "--device", f"fake:{arbiter.card}"]
        runner = ["runner", "deploy", "--config", str(config), "--skills", str(SKILL)]
        with self.log.open("ab") as log:
            self.sidecar, self.runner = (
                subprocess.Popen([sys.executable, "-m", *argv], cwd=ROOT, env=environ, stdout=log, stderr=log)
                for argv in (sidecar, runner)
            )

    def close(self) -> None:
        for process in (self.runner, self.sidecar):
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(20)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


def _videos(folder: Path) -> dict[str, Path]:
    """A second of what both cameras see when the base stands before the object, arm at rest: the policy knows such pictures."""
    import cv2

    from runner.sim.dataset import stand_before
    from runner.sim.env import SimEnv

    paths = {}
    with SimEnv() as env:
        env.reset(3)
        stand_before(env, env.target, random.Random(3), error_m=0.0)
        for name in ("front", "wrist"):
            picture = env.render(name)[:, :, ::-1]
            paths[name] = folder / f"{name}.avi"
            height, width = picture.shape[:2]
            writer = cv2.VideoWriter(str(paths[name]), cv2.VideoWriter.fourcc(*"MJPG"), 30, (width, height))
            assert writer.isOpened()
            for _ in range(30):
                writer.write(picture)
            writer.release()
    return paths


@pytest.fixture
def programs(arbiter_daemon: ArbiterProcess) -> Iterator[Programs]:
    if not (ROOT / "configs/models/so101-grab/model.safetensors").exists():
        pytest.skip("the grab checkpoint is not in this tree")
    started = Programs(arbiter_daemon)
    yield started
    started.close()


def uses(status: dict[str, Any]) -> list[int]:
    return [lease["uses"] for lease in status["leases"] if lease["consumer"] == "grab"]


async def scenario(arbiter: ArbiterProcess, programs: Programs) -> None:
    async with (
        RunnerClient(f"ipc://{arbiter.runtime}/runner.sock", connect_timeout_s=60.0) as runner,
        ArbiterClient(arbiter.endpoint, name="watcher") as watcher,
    ):
        assert (await runner.call("ping"))["arbiter"] is True
        begun = await runner.state()
        goal = await runner.send_goal(GRAB, prompt="grab the red cube")
        async for feedback in goal.feedback():
            if feedback["state"] == "running":
                break
        assert [count >= 1 for count in uses(await watcher.status())] == [True]
        lift = begun["world"]["joint_state"]["name"].index("shoulder_lift")
        here = begun["world"]["joint_state"]["position"][lift]
        while abs((await runner.state())["world"]["joint_state"]["position"][lift] - here) < 0.5:
            assert not goal.done, await goal.result(1)
        programs.runner.send_signal(signal.SIGTERM)
        assert (await goal.result(60))["status"] == "canceled"
        assert await asyncio.to_thread(programs.runner.wait, 60) == 0
        async with asyncio.timeout(60):
            while any(uses(await watcher.status())):
                await watcher.ping()


def test_the_policy_moves_the_arm_and_a_signal_ends_its_use(
    arbiter_daemon: ArbiterProcess, programs: Programs
) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(200):
            await scenario(arbiter_daemon, programs)

    try:
        asyncio.run(bounded())
    except (AssertionError, TimeoutError):
        print(programs.log.read_text(errors="replace")[-4000:])
        raise
