"""A policy skill at a policy server of openpi."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

pytest.importorskip("openpi_client", reason="the dependency group `stock` is not installed")

from tests.runner.skills.policy_bench import MANIFEST, Arbiter, Bench
from tests.support.openpi_server import OpenpiServer
from vram_arbiter.clients.sidecar.openpi import Template
from vram_arbiter.runner.protocols import Goal
from vram_arbiter.runner.skills.makers import client_of
from vram_arbiter.runner.skills.wiring import Rollout
from vram_arbiter.schemas.errors import (
    BadRequest,
    ConfigError,
    ManifestInvalid,
    ModelError,
    SidecarUnavailable,
    UnknownOp,
)
from vram_arbiter.schemas.manifest import ManifestError, parse_manifest

pytestmark = [pytest.mark.anyio, pytest.mark.heavy]  # arrays: numpy

WANTED = """{observation/joint_position: "observation.state[:1]",
  observation/gripper_position: "observation.state[1:]",
  observation/image: observation.images.front, images: {high: observation.images.front chw},
  prompt: task}"""
OPENPI = MANIFEST.replace(
    "policy_extras: {", f"policy_extras: {{adapter: openpi, openpi_observation: {WANTED}, "
)
GOAL = Goal("g1", "test/arm-grab", prompt="grab the red cube", deadline_s=20.0)


def chunk(_: Any) -> dict[str, Any]:
    import numpy as np

    return {"actions": np.full((3, 2), 0.25)}


@asynccontextmanager
async def at_server(infer: Any = chunk) -> AsyncIterator[Any]:
    server = OpenpiServer(infer)
    async with server.served() as url:
        bench = Bench(parse_manifest(OPENPI), url, Arbiter())
        try:
            yield bench, server
        finally:
            server.held.set()
            await bench.skill.finish()
            await bench.skill.release()


async def test_a_goal_is_played_by_a_stock_server() -> None:
    """It sees the observation under the names that the manifest gives, in its own arrays."""
    import numpy as np

    async with at_server() as (bench, server):
        await bench.skill.start(GOAL)
        rows, _ = await bench.play()
        assert bench.arbiter.asked == [], "its lease is that of `vramctl run`"
        port = int(bench.client.endpoint.rpartition(":")[2])
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        assert await reader.readline() == b"HTTP/1.1 200 OK\r\n", "as upstream's"
        writer.close()
    assert rows == [(0.25, 0.25)] * 7
    assert len(server.connections) == 1
    seen = server.heard[0]
    assert seen.keys() == {
        "observation/joint_position", "observation/gripper_position", "observation/image",
        "images", "prompt",
    }  # fmt: skip
    assert seen["prompt"] == GOAL.prompt
    np.testing.assert_array_equal(seen["observation/joint_position"], np.float32([0.0]))
    np.testing.assert_array_equal(seen["observation/gripper_position"], np.float32([0.5]))
    picture = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    np.testing.assert_array_equal(seen["observation/image"], picture)
    np.testing.assert_array_equal(seen["images"]["high"], picture.transpose(2, 0, 1))


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        ({"action": 1}, "no 'actions'"),
        ({"actions": "forward"}, "no numbers"),
        ({"actions": [[0.0, 1.0, 2.0]]}, r"actions of shape \(1, 3\)"),
        ({"actions": [[float("nan"), 0.0]]}, "not finite"),
        ({"actions": [[0.0, 0.0]] * 1001}, "1001 actions|which the limit|is not read"),
    ],
)
async def test_what_is_not_a_chunk_never_reaches_the_arm(answer: Any, told: str) -> None:
    async with at_server(lambda _: dict(answer)) as (bench, _):
        await bench.skill.start(GOAL)
        with pytest.raises(ModelError, match=told):
            await bench.play()
        assert bench.played == []


async def test_an_error_of_the_server_is_a_typed_one_and_the_next_goal_begins_anew() -> None:
    def broken(_: Any) -> Any:
        raise KeyError("observation/exterior_image_1_left")

    async with at_server(broken) as (bench, server):
        await bench.skill.start(GOAL)
        with pytest.raises(ModelError, match="KeyError: 'observation/exterior_image_1_left'"):
            await bench.play()
        await bench.skill.finish()
        await server.connections[0].wait_closed()
        server.infer = chunk
        await bench.skill.start(GOAL)
        rows, _ = await bench.play()
        assert rows == [(0.25, 0.25)] * 7


async def test_a_server_that_is_away_is_a_typed_error() -> None:
    async with at_server() as (bench, server):
        await bench.skill.start(GOAL)
        await server.connections[0].close()
        with pytest.raises(SidecarUnavailable, match="lost"):
            await bench.play()
        await bench.skill.finish()
    with pytest.raises(SidecarUnavailable, match=r"no sidecar answers at ws://127\.0\.0\.1:"):
        await client_of(Rollout.model_validate({"adapter": "openpi"}), bench.client.endpoint).load()


async def test_an_answer_that_comes_late_or_unasked_is_not_taken_for_another_ones() -> None:
    """Old actions would be played as those after the newest observation."""
    from openpi_client import msgpack_numpy

    observation = {"observation.state": [0.0, 0.0], "observation.images.front": None, "task": "x"}
    async with at_server() as (_, server), server.served() as url:
        rollout = {"adapter": "openpi", "openpi_observation": {"prompt": "task"}}
        client = client_of(Rollout.model_validate(rollout), url)
        async with client:
            server.held.clear()
            asking = asyncio.create_task(client.get_action(observation))
            while not server.heard:
                await asyncio.sleep(0)
            asking.cancel()
            await asyncio.gather(asking, return_exceptions=True)
            assert not client.connected
            server.held.set()
            server.infer = lambda _: {"actions": [[1.0, 1.0]]}
            assert await client.get_action(observation) == {"action": [[1.0, 1.0]]}
            await server.connections[-1].send(msgpack_numpy.packb(chunk(None)))
            await server.connections[-1].wait_closed()
            assert not client.connected
            with pytest.raises(UnknownOp):
                await client.shutdown()


def test_a_manifest_says_what_the_server_sees() -> None:
    for wanted, told in (
        ("{}", "is required with adapter: openpi"),
        ("{prompt: instruction}", "'instruction' is not task"),
        ("{x: observation.images.wrist}", "shows observation.images.wrist; there is"),
    ):
        with pytest.raises((ManifestError, ManifestInvalid), match=told):
            Bench(parse_manifest(OPENPI.replace(WANTED, wanted)), "ws://127.0.0.1:1", None)
    with pytest.raises(BadRequest, match=r"has no observation\.state"):
        Template({"x": "observation.state"}).filled({"task": "grab"})


@pytest.mark.parametrize("endpoint", ["ipc:///run/grab.sock", "ws://10.0.0.1:8000", "8000"])
def test_only_a_websocket_of_this_machine_is_spoken_to(endpoint: str) -> None:
    with pytest.raises(ConfigError, match=f"not at {endpoint}"):
        client_of(Rollout.model_validate({"adapter": "openpi"}), endpoint)
