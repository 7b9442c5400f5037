"""`vram-runner deploy` as a process:

MuJoCo's twin, a camera that plays a file, goals over a socket, signals, the emergency stop.
"""

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support import prepared
from tests.support.paths import ROOT
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.cli.deploy import claim
from vram_arbiter.schemas.config.robot import HalConfig, RobotEnvironment
from vram_arbiter.schemas.errors import AlreadyRunning, EstopRequested, InternalError
from vram_arbiter.schemas.goals import PingRunner

pytestmark = [pytest.mark.anyio, pytest.mark.heavy, pytest.mark.e2e]

RSKILL = "vram-arbiter/so101-navigate"
FPS, WIDTH, HEIGHT = 30, 64, 48
TASK = f"task: {{id: nod, instruction: nod, max_steps: 400}}\nvla: {{id: {RSKILL}}}\n"

Start = Callable[..., prepared.Forked]


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One second of red pictures."""
    import cv2
    import numpy as np

    path = tmp_path_factory.mktemp("video") / "red.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for _ in range(FPS):
        writer.write(np.full((HEIGHT, WIDTH, 3), (0, 0, 250), dtype=np.uint8))
    writer.release()
    return path


@pytest.fixture
def deploy(tmp_path: Path, video: Path, programs: list[prepared.Forked]) -> Start:
    def begin(
        *flags: str,
        more: str = "",
        loop: bool = True,
        fps: int = FPS,
        steps: str = "",
        cameras: str = "front",
    ) -> prepared.Forked:
        config = tmp_path / "robot.yaml"
        config.write_text(
            "robot_id: bench\nembodiment_tags: [so101_follower, mobile_base]\nhal: {adapter:"
            " so101_mujoco}\n"
            f"sensors:\n  - {{sensor_id: front, max_age_ms: 2000, backend_params: {{path: {video}, "
            f"loop: {str(loop).lower()}, fps: {fps}}}}}\n" + more
        )
        environ = os.environ | {
            "VRAM_ARBITER_RUNTIME": str(tmp_path),
            "OMP_NUM_THREADS": "1",
            "NOD_STEPS": steps,
            "NOD_CAMERAS": cameras,
        }
        skills = str(ROOT / "configs/rskills/so101-navigate")
        argv = ["deploy", "--config", str(config), "--skills", skills, "--no-arbiter", *flags]
        process = prepared.start("deploy-nod", argv, environ, cwd=tmp_path)
        programs.append(process)
        return process

    return begin


@contextlib.asynccontextmanager
async def client_of(tmp_path: Path) -> AsyncIterator[RunnerClient]:
    async with (
        asyncio.timeout(120),
        RunnerClient(f"ipc://{tmp_path}/runner.sock", connect_timeout_s=60.0) as client,
    ):
        yield client


async def goal_under_way(client: RunnerClient, ticks: int = 5) -> Any:
    """A goal that has moved the arm for so many ticks."""
    goal = await client.send_goal(RSKILL, prompt="nod")
    async for feedback in goal.feedback():
        if feedback["tick_idx"] >= ticks:
            return goal
    raise AssertionError(await goal.result(1))


async def all_fresh(client: RunnerClient) -> None:
    """Until nothing is stale: on a busy machine it may be for some ticks."""
    while set((await client.state())["world"]["diagnostics"].values()) != {"ok"}:
        await asyncio.sleep(0.05)


async def stopped(client: RunnerClient, reason: str) -> None:
    """Until the motors have been told.

    A loop that stands still for a second is told of as one that hangs, and obeys when it goes on.
    """
    await client.call(PingRunner())  # it may have to come up first
    while True:
        try:
            await client.estop(reason)
            return
        except InternalError as error:
            if "has not obeyed" not in error.message:
                raise


async def test_a_signal_cancels_the_goal_and_ends_in_order(deploy: Start, tmp_path: Path) -> None:
    """SIGINT is that of test_program.py."""
    process = deploy()

    async with client_of(tmp_path) as client:
        assert (await client.call(PingRunner()))["robot"] == "bench"
        picture = await client.frame(max_age_ms=5000, encoding="png")
        assert (picture["camera"], picture["width"], picture["height"]) == ("front", WIDTH, HEIGHT)
        goal = await goal_under_way(client)
        assert set((await client.state())["world"]["diagnostics"]) == {"front", "joint_state"}
        await all_fresh(client)
        process.send_signal(signal.SIGTERM)
        assert (await goal.result(60))["status"] == "canceled"

    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "so101 is disconnected" in err
    result = json.loads(out)
    assert result["n_ticks"] > 5
    assert result["success"] is None
    assert result["metadata"]["robot"] == "bench"


@pytest.mark.parametrize(
    ("more", "steps", "code", "success", "said"),
    [
        (TASK, "20", 0, True, "task done"),
        (TASK.replace("400", "10"), "", 1, False, "not done within 10 ticks"),
        (TASK + "max_ticks: 30\n", "", 1, False, ""),
        ("max_ticks: 30\n", "", 0, None, ""),
    ],
    ids=["done", "limited task", "limited run with a task", "limited run"],
)
def test_the_end_of_a_files_task_or_ticks_ends_the_program(
    deploy: Start, more: str, steps: str, code: int, success: bool | None, said: str
) -> None:
    process = deploy(more=more, steps=steps)
    out, err = process.communicate(timeout=120)
    assert process.returncode == code, err
    result = json.loads(out)
    assert result["success"] is success
    assert result["n_ticks"] == 30 or "max_ticks" not in more
    assert result["p99_tick_ms"] > 0
    assert said in err


async def test_a_camera_file_that_ends_withholds_and_fails_the_goal(
    deploy: Start, tmp_path: Path
) -> None:
    deploy(loop=False, fps=10)  # three seconds: long enough for the runner to have seen it

    async with client_of(tmp_path) as client:
        goal = await client.send_goal(RSKILL, prompt="nod")
        result = await goal.result(60)
        assert (result["status"], result["code"]) == ("failed", "frame_stale")
        assert result["data"]["withheld"] > 0
        assert (await client.state())["world"]["diagnostics"]["front"] == "error"


async def test_the_emergency_stop_of_a_real_process(deploy: Start, tmp_path: Path) -> None:
    process = deploy()

    async with client_of(tmp_path) as client:
        goal = await goal_under_way(client)
        words = ("estop", "--reason", "test", "--endpoint", client.endpoint)
        argv = [sys.executable, "-m", "vram_arbiter.runner", *words]
        said, complaint = b"", b"has not obeyed"
        # within a second, which a busy machine may need for less
        while b"has not obeyed" in complaint:
            program = await asyncio.create_subprocess_exec(
                *argv, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
            said, complaint = await program.communicate()
        assert program.returncode == 0, complaint
        assert b"emergency stop: test; the servos hold the present pose" in said
        assert (await goal.result(60))["code"] == "estop_requested"
        with pytest.raises(EstopRequested):
            await client.send_goal(RSKILL)
        process.send_signal(signal.SIGTERM)

    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "emergency stop: test" in json.loads(out)["metadata"]["estop"]


async def test_after_an_emergency_stop_a_task_is_not_restarted_and_the_robot_stays_connected(
    deploy: Start, tmp_path: Path
) -> None:
    process = deploy(more=TASK)

    async with client_of(tmp_path) as client:
        await client.ping(timeout_s=60)
        while (await client.state())["goal"] is None:
            pass
        await stopped(client, "test")
        while (await client.state())["goal"] is not None:
            pass
        ticks = (await client.state())["ticks"]
        while (state := await client.state())["ticks"] < ticks + 10:
            pass
        assert "emergency stop: test" in state["estop"]
        process.send_signal(signal.SIGTERM)

    out, err = process.communicate(timeout=60)
    assert process.returncode == 2, err  # systemd's RestartPreventExitStatus
    assert json.loads(out)["success"] is False


async def test_a_stopped_robot_does_not_move_again_because_its_runner_was_killed_and_restarted(
    deploy: Start, tmp_path: Path
) -> None:
    """Regression: the latch was kept in memory only, and systemd restarts a killed runner."""
    mark = tmp_path / "robot-bench.estop"
    first = deploy()

    async with client_of(tmp_path) as client:
        await stopped(client, "a hand is in the way")

    assert "a hand is in the way" in mark.read_text()
    first.kill()  # as the kernel does when memory is short; systemd starts it again
    first.communicate(timeout=60)
    second = deploy()
    _, err = second.communicate(timeout=60)
    assert second.returncode == 2, err  # systemd's RestartPreventExitStatus
    assert "a hand is in the way" in err
    assert f"delete {mark}" in err
    mark.unlink()
    third = deploy()

    async with client_of(tmp_path) as client:
        await stopped(client, "again")
        third.send_signal(signal.SIGTERM)

    third.communicate(timeout=60)
    assert not mark.exists()  # a person ended it


async def test_a_port_has_one_runner_whatever_its_robots_are_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two files of one arm, copied and renamed, would both drive its motors."""
    monkeypatch.setenv("VRAM_ARBITER_RUNTIME", str(tmp_path))
    bus, link = tmp_path / "ttyACM0", tmp_path / "by-id"
    bus.touch()
    link.symlink_to(bus)

    def robot(robot_id: str, port: Path) -> RobotEnvironment:
        return RobotEnvironment(
            robot_id=robot_id,
            hal=HalConfig(adapter="lerobot:so101_follower", transport={"port": str(port)}),
        )

    async with contextlib.AsyncExitStack() as stack:
        claim(robot("left", bus), stack)
        with pytest.raises(AlreadyRunning, match=rf"pid {os.getpid()}\) already uses port .*by-id"):
            claim(robot("right", link), stack)
        claim(robot("other", tmp_path / "ttyACM1"), stack)


async def test_a_robot_has_one_runner(deploy: Start, tmp_path: Path) -> None:
    first = deploy()

    async with client_of(tmp_path) as client:
        await client.ping(timeout_s=60)
        second = deploy("--endpoint", f"ipc://{tmp_path}/second.sock")
        _, err = await asyncio.to_thread(second.communicate, timeout=60)
        assert second.returncode == 1
        assert f"(pid {first.pid}) already uses robot bench" in err


def test_a_signal_while_it_waits_for_a_camera_ends_it_at_once(
    deploy: Start, tmp_path: Path
) -> None:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as listening:  # accepts, and never says a word
        port = listening.getsockname()[1]
        more = (
            f"  - {{sensor_id: silent, backend_params: {{url: 'rtsp://127.0.0.1:{port}/', "
            "timeout_s: 60}}\n"
        )
        process = deploy(more=more)
        listening.settimeout(60)
        connection, _ = listening.accept()  # it waits for a picture now
        with connection:
            process.send_signal(signal.SIGTERM)
            _, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "stopped before anything moved" in err
