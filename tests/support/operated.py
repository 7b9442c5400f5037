"""`vram-runner sim --teleop` with a leader arm that is led by script: it takes a goal over, and
grabs.

`python -m tests.support.operated OUT` films it, with tests/runner/robots/plugin on PYTHONPATH.
"""

import asyncio
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.__main__ import parse
from vram_arbiter.runner.robots.so101 import lerobot_units_of, so101
from vram_arbiter.runner.sim.config import ARM_JOINTS
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.expert import GrabExpert
from vram_arbiter.schemas.goals import ResultPush

STEP_S = 0.3  # from pose to pose of the script, which takes 1/30 s: people are slower
ALIGNS = 10  # steps for which the leader waits in its first pose until the arm is there
GRAB_S = 120.0
LIFTED_M = 0.06
FILE = """\
robot_id: operated
hal: {{adapter: so101_mujoco}}
teleop: {{adapter: "lerobot:track", transport: {transport}}}
"""
STAY = {
    "joint_names": ["wrist_roll"],
    "points": [{"positions": [0], "time_from_start": {"sec": 50}}],
}


def poses(seed: int, base_pose: tuple[float, float, float]) -> Iterator[dict[str, float]]:
    """Yield a scripted grab of the seed's target from a pose of the base, in lerobot's units."""
    units = lerobot_units_of(so101(simulated=True))
    assert units is not None
    with SimEnv() as env:
        env.reset(seed)
        env.place(base_pose)
        expert = GrabExpert(env, env.target)
        while not expert.done:
            angles = expert.act()
            yield units.named(dict(zip(ARM_JOINTS, angles, strict=True)))
            env.step(angles)


async def operate(
    client: RunnerClient, seed: int, track: Path
) -> tuple[ResultPush, dict[str, Any]]:
    """Drive to the target, take over a goal that stays there, and grab. Return that goal's result
    and the ground truth at its end.
    """
    truth = await client.ground_truth()
    target = truth["target"]
    point = dict(zip("xyz", truth["objects"][target]["xyz_base"], strict=True))
    drive = await client.send_goal(
        "vram-arbiter/so101-navigate", goal_params={"target_point": point}
    )
    assert (await drive.result())["success"]
    stands = (await client.ground_truth())["base_pose"]
    first, *others = poses(seed, tuple(stands))
    led = [*[first] * ALIGNS, *others]
    track.write_text(json.dumps(led), encoding="utf-8")
    goal = await client.send_goal("vram-arbiter/so101-move", goal_params={"trajectory": STAY})
    while (await client.state())["phase"] != "running":
        await asyncio.sleep(0.01)
    await client.take_over("take")
    async with asyncio.timeout(GRAB_S):
        while (await client.ground_truth())["objects"][target]["lift_m"] < LIFTED_M:
            await asyncio.sleep(0.05)
    truth = await client.ground_truth()
    await client.take_over("end")
    return await goal.result(), truth


async def play_program(folder: Path, *flags: str) -> tuple[ResultPush, dict[str, Any]]:
    """Run the program with files and socket in a folder; as `operate`."""
    track, file, endpoint = folder / "track.json", folder / "robot.yaml", f"ipc://{folder}/r.sock"
    transport = {"path": str(track), "joints": list(ARM_JOINTS), "step_s": STEP_S}
    file.write_text(FILE.format(transport=json.dumps(transport)), encoding="utf-8")
    argv = ["sim", "--no-arbiter", "--seed", "0", "--teleop", str(file), *flags]
    args = parse([*argv, "--endpoint", endpoint])
    running = asyncio.create_task(args.run(args))
    async with RunnerClient(endpoint) as client:
        ended = await operate(client, 0, track)
        await client.shutdown()
    assert await running == 0
    return ended


if __name__ == "__main__":
    out = Path(sys.argv[1]).resolve()
    out.mkdir(parents=True, exist_ok=True)
    print(asyncio.run(play_program(out, "--video", str(out / "episode.mp4"))))
