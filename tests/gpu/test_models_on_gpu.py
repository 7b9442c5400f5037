"""The shipped detector, policy and scene VLM on 8 GiB of a GPU, each with the bytes of the model
that it stands for, on pictures of the simulated table."""

import asyncio
import json
import math
import random

import pytest

from tests.gpu.conftest import PATIENCE_S, Machine, back
from tests.support.paths import CONFIGS
from tests.support.process import vramctl

pytest.importorskip("mujoco")
from tests.support.tabletop import photo
from vram_arbiter.clients.sidecar.perception import Detection, DetectorClient, SceneVlmClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.tasks import stand_before

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.nightly]

GB = 10**9
SIDECAR = ("-m", "vram_arbiter.sidecars")
SEED = 900  # a scene that no training saw


async def detect(endpoint: str, image: bytes, name: str) -> Detection:
    async with DetectorClient(endpoint, timeout_s=PATIENCE_S) as detector:
        return (await detector.detect(image, name))[0]


async def query(endpoint: str, image: bytes, question: str) -> str:
    async with SceneVlmClient(endpoint, timeout_s=PATIENCE_S) as vlm:
        return await vlm.query(image, question)


async def actions(endpoint: str, env: SimEnv, name: str) -> list[list[float]]:
    import numpy as np

    observation = {
        "observation.state": np.array(list(env.joint_state().values()), np.float32),
        "observation.images.front": env.render("front"),
        "observation.images.wrist": env.render("wrist"),
        "task": f"grab the {name}",
    }
    async with PolicyClient(endpoint, timeout_s=PATIENCE_S) as policy:
        chunk: list[list[float]] = (await policy.get_action(observation))["action"].tolist()
    return chunk


def test_the_detectors_bytes_return_and_the_policy_loads(small_machine: Machine) -> None:
    """Detector and policy do not fit beside each other; the scene VLM loads beside the policy, and
    sees that the gripper is empty."""
    machine, names = small_machine, ("detector", "grab", "scene-vlm")
    before = machine.used()
    detector, grab, vlm = (
        machine.serve(name, SIDECAR, CONFIGS / f"rskills/so101-{name}/rskill.yaml")
        for name in names
    )
    at = {name: f"ipc://{machine.arbiter.runtime}/{name}.sock" for name in names}
    with SimEnv() as env:
        env.reset(SEED)
        target = env.layout.objects[0].name
        truth = env.seen_objects("front")[target].box
        found = asyncio.run(detect(at["detector"], photo(env, "front"), target))
        assert found.centre == pytest.approx(
            ((truth[0] + truth[2]) / 2, (truth[1] + truth[3]) / 2), abs=8
        )
        left = detector.pid
        assert left is not None
        assert machine.bytes_of(left) > 4 * GB

        stand_before(env, target, random.Random(SEED))
        chunk = asyncio.run(actions(at["grab"], env, target))
        assert {len(row) for row in chunk} == {6}
        assert all(math.isfinite(value) for row in chunk for value in row)
        assert detector.pid is None
        assert machine.bytes_of(left) == 0
        assert verdicts(machine) == ["verified"]

        question = f"Has the robot gripper grasped the {target}?"
        assert asyncio.run(query(at["scene-vlm"], photo(env, "wrist"), question)).startswith("No")
    assert grab.pid is not None, "the scene VLM is beside the policy"
    for model in (grab, vlm):
        model.result(model.send("unload"))
    assert back(machine, before)


def verdicts(machine: Machine) -> list[str]:
    said = vramctl("history", "--kind", "verified", "--json", environ=machine.environ)
    return [event["verdict"] for event in json.loads(said.stdout)["events"]]
