"""A `ros_action` in deploy that this runner plays itself: the real program on the kinematic twin,
through its gate.
"""

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest

from tests.support.paths import ROOT
from tests.support.prepared import start
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.schemas.errors import UnknownSkill

pytestmark = [pytest.mark.heavy, pytest.mark.e2e]

SKILL = "vram-arbiter/so101-move"


def points(*positions: tuple[float, float], every_s: int = 1) -> dict[str, Any]:
    return {
        "trajectory": {
            "joint_names": ["shoulder_pan", "wrist_flex"],
            "points": [
                {"positions": list(position), "time_from_start": {"sec": every_s * (number + 1)}}
                for number, position in enumerate(positions)
            ],
        }
    }


def test_the_arm_goes_where_the_trajectory_says(tmp_path: Path) -> None:
    config = tmp_path / "robot.yaml"
    config.write_text(
        "robot_id: bench\nhal: {adapter: so101_kinematic}\nsafety: {max_joint_speed_factor: 0.5}\n"
    )
    environ = os.environ | {"VRAM_ARBITER_RUNTIME": str(tmp_path), "OMP_NUM_THREADS": "1"}
    words = [
        "deploy",
        "--config",
        str(config),
        "--no-arbiter",
        "--skills",
        str(ROOT / "configs/rskills/so101-move"),
        str(ROOT / "configs/rskills/so101-navigate"),
    ]
    process = start("vram-runner", words, environ, cwd=ROOT)

    async def story() -> None:
        async with RunnerClient(f"ipc://{tmp_path}/runner.sock", connect_timeout_s=120.0) as client:
            goal = await client.send_goal(SKILL, goal_params=points((0.5, 1.0), (-0.4, 1.2)))
            result = await goal.result(120)
            assert (result["status"], result["code"]) == ("succeeded", ""), result
            joints = (await client.state())["world"]["joint_state"]
            angles = dict(zip(joints["name"], joints["position"], strict=True))
            assert angles["shoulder_pan"] == pytest.approx(-0.4, abs=0.06)
            assert angles["wrist_flex"] == pytest.approx(1.2, abs=0.06)
            assert angles["elbow_flex"] == pytest.approx(1.05, abs=0.02), (
                "joints that are not named stay"
            )

            # half of the servos' speed is this robot's limit: said before anything moves
            result = await (
                await client.send_goal(
                    SKILL, goal_params=points((0.0, 1.0), (1.9, 1.0), (-0.9, 1.0))
                )
            ).result(120)
            assert (result["status"], result["code"]) == ("failed", "bad_request")
            assert (
                "points[2]: shoulder_pan would have to make 2.80 rad/s; at most 2.35"
                in result["message"]
            )
            result = await (await client.send_goal(SKILL)).result(120)
            assert "an empty one moves nothing" in result["message"]
            joints = (await client.state())["world"]["joint_state"]
            assert dict(zip(joints["name"], joints["position"], strict=True))[
                "shoulder_pan"
            ] == pytest.approx(-0.4, abs=0.06)
            with pytest.raises(UnknownSkill, match="made for mobile_base"):
                await client.send_goal("vram-arbiter/so101-navigate", goal_params={"turn_rad": 1.0})
            await client.shutdown()

    async def bounded() -> None:
        async with asyncio.timeout(240):
            await story()

    try:
        asyncio.run(bounded())
        assert process.wait(60) == 0
    finally:
        if process.poll() is None:
            process.kill()
        _, said = process.communicate()
        print(said)
