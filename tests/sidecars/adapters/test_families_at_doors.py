"""Every policy family behind the doors of other projects' robots."""

import asyncio
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.sidecars.adapters.families import (
    NAMES,
    SEED,
    begin,
    history,
    load_policy,
    observations,
    swept,
)
from tests.sidecars.adapters.policies import DIM, SIDE_PX, STATE, TASK
from tests.support.waiting import play
from vram_arbiter.clients.net.server import RouterServer
from vram_arbiter.clients.sidecar import npy
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.doors.lerobot_messages import instructions_of, observation_of
from vram_arbiter.sidecars.doors.robot import Robot
from vram_arbiter.sidecars.weights import Weights
from vram_arbiter.sidecars.wires import parse

pytestmark = [pytest.mark.heavy, pytest.mark.usefixtures("small_networks")]


@pytest.mark.parametrize("name", swept(name for name in NAMES if name != "lingbot_va"))
def test_a_family_is_served_at_lerobots_door(
    checkpoint: Callable[[str], Weights], name: str, short_folder: Path
) -> None:
    """As lerobot's robots write their observations, with the history that the policy sees. At
    lerobot's own server, diffusion fails at the first observation."""
    import numpy as np
    import torch
    from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation

    adapter = load_policy(name, checkpoint(name))
    length, _ = begin(adapter)
    steps, joints = observations(4), [f"joint_{number}.pos" for number in range(DIM)]
    prefix = "observation.images."
    cameras = [one for one in adapter._config.input_features if one in steps[0] and one != STATE]
    features: dict[str, Any] = {STATE: {"dtype": "float32", "shape": (DIM,), "names": joints}}
    renamed = {prefix + one.rpartition(".")[2]: one for one in cameras}
    features |= {one: {"dtype": "image", "shape": (SIDE_PX, SIDE_PX, 3)} for one in renamed}
    config = RemotePolicyConfig("act", "test/model", features, 50, rename_map=renamed)
    asked = instructions_of(pickle.dumps(config))

    def answered(call: EndpointCall) -> Any:
        torch.manual_seed(SEED)
        return adapter.run(call)

    async def story() -> None:
        async def handle(peer: Any, message: Message) -> None:
            reply: Message = {"ok": True}
            if message["endpoint"] == "get_action":
                call = parse(message, adapter.ops)
                assert isinstance(call, EndpointCall)
                reply = npy.pack(answered(call))
            await server.send(peer, reply | {"re": message["id"]})

        endpoint = f"ipc://{short_folder}/s"
        async with (
            RouterServer(endpoint, lambda error: {"error": str(error)}) as server,
            PolicyClient(endpoint) as client,
        ):
            serving = asyncio.create_task(server.serve(handle))
            robot = Robot(asked, client)
            for number, step in enumerate(steps):
                state = dict(zip(joints, map(float, step[STATE]), strict=True))
                pictures = {asked.cameras[one]: step[one] for one in cameras}
                raw = {**state, **pictures, "task": TASK}
                timed = TimedObservation(
                    timestamp=0.0, timestep=number, observation=raw, must_go=True
                )
                robot.offer(observation_of(pickle.dumps(timed), asked))
                _, rows = await robot.act()
                data = {"observation": history(steps, number, length)}
                whole = EndpointCall(
                    endpoint="get_action", data=data, afresh=True, whole_chunk=True
                )
                np.testing.assert_array_equal(rows, answered(whole)["action"][:50])
            serving.cancel()

    play(story)
