"""A goal of the runner with a real policy behind the wire, against lerobot's own loop.

The reference is `select_action` at every control step over the observations that the runner's
world had.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.runner.small_robots import robot_of
from tests.sidecars.adapters import policies
from tests.sidecars.adapters.families import SEED, lerobots_own, manifest_text, swept
from tests.sidecars.adapters.policies import DIM, FRONT, SIDE_PX, STATE, TASK, WRIST
from vram_arbiter.runner.protocols import Act, Done, Goal
from vram_arbiter.runner.skills.sidecar_policy import SidecarPolicy
from vram_arbiter.runner.skills.wiring import wire_up
from vram_arbiter.schemas.manifest import parse_manifest
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.schemas.world import FrameEncoding, JointState, SensorFrame, WorldState
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.weights import Weights

pytestmark = pytest.mark.heavy

JOINTS = tuple(f"joint{place}" for place in range(DIM))
CAMERAS = {FRONT: "front", WRIST: "wrist"}


class Served:
    """A policy's adapter in place of a client: what it is asked goes to the adapter at once."""

    connected = True
    endpoint = "here"

    def __init__(self, adapter: Any) -> None:
        self.adapter = adapter

    async def load(self, **_: Any) -> dict[str, Any]:
        return {"lease_id": None, "token": None}

    async def reset(self, *_: Any, **__: Any) -> Any:
        return self.adapter.run(EndpointCall(endpoint="reset"))

    async def get_action(self, observation: Any, *, whole_chunk: bool, **_: Any) -> Any:
        data = {"observation": observation}
        return self.adapter.run(
            EndpointCall(endpoint="get_action", data=data, whole_chunk=whole_chunk)
        )

    async def unload(self) -> None: ...

    async def close(self) -> None: ...


@pytest.mark.parametrize("name", swept(["act", "diffusion", "vqbet", "multi_task_dit", "tdmpc"]))
def test_a_goal_plays_what_lerobots_loop_plays(
    tmp_path: Path, run_async: Callable[[Any], Any], name: str
) -> None:
    """Regression: without a word in the manifest a history was one observation a chunk (diffusion
    was off by 1.8), and whole chunks were played where lerobot plays a part."""
    import numpy as np
    import torch

    folder = tmp_path / f"clip {name}"
    folder.mkdir()
    with policies.small_networks():
        policies.SAVERS[name](folder)
        weights = Weights(str(folder), local=True)
        keys = [policies.ONLY_CAMERA] if name == "tdmpc" else list(CAMERAS)
        sensors = "".join(f"  - {{modality: rgb, vla_feature_key: {key}}}\n" for key in keys)
        text = manifest_text(name).replace("chunk_size: 1", "chunk_size: 2")
        text += "action_contract: {dim: 6, joint_units: radians}\nstate_contract: {dim: 6}\n"
        text += "policy_extras: {rollout_steps: 11, stop_when_still: false}\n"
        manifest = parse_manifest(text + f"sensors_required:\n{sensors}")
        adapter: Any = make_adapter(manifest, weights)
        adapter.prepare()
        adapter.load("cpu")
        adapter.place("cpu")
        wiring = wire_up(manifest, robot_of(*JOINTS), None)
        client: Any = Served(adapter)
        skill = SidecarPolicy(manifest, wiring, client, None, period_s=1 / 30, wait_s=60.0)
        random = np.random.default_rng(1)
        seen: list[dict[str, Any]] = []
        rows: list[Any] = []

        def world() -> WorldState:
            state = random.normal(size=DIM).astype(np.float32)
            step: dict[str, Any] = {STATE: state, "task": TASK}
            frames = {}
            for key in keys:
                camera = key.rpartition(".")[2]
                picture = random.integers(0, 255, (SIDE_PX, SIDE_PX, 3), np.uint8)
                step[key] = picture
                frames[camera] = SensorFrame(
                    sensor_id=camera, stamp_monotonic_ns=1, stamp_wall_ns=1,
                    encoding=FrameEncoding.RGB8, width=SIDE_PX, height=SIDE_PX,
                    data=picture.tobytes(),
                )  # fmt: skip
            seen.append(step)
            position = tuple(float(value) for value in state)
            joints = JointState(name=JOINTS, position=position, stamp_ns=1)
            return WorldState(stamp_ns=1, joint_state=joints, image_frames=frames)

        async def play() -> None:
            await skill.start(Goal("g1", "test/model", prompt=TASK, deadline_s=60.0))
            torch.manual_seed(SEED)
            await asyncio.to_thread(skill.step, world())  # at the start pose
            seen.clear()
            while not isinstance(done := await asyncio.to_thread(skill.step, world()), Done):
                assert isinstance(done, Act), "the world waits"
                rows.append(done.action.rows[0])
            await skill.finish()

        run_async(play())
        expected = lerobots_own(weights, seen[: len(rows)])
    assert len(rows) == 11
    np.testing.assert_allclose(np.array(rows, np.float32), expected, rtol=1e-6)
