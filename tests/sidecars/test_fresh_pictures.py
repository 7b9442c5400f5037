"""What a model looks at is of now: a picture that waited for the GPU is not looked at. A real
sidecar beside a real daemon, asked by the reasoner's tools."""

import asyncio
import time

import pytest

from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import SceneVlmClient
from vram_arbiter.reasoner.perception import LOOKED_AT_MAX_S
from vram_arbiter.reasoner.tools import Tools
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.tools import QueryScene

from .conftest import PNG, until

pytestmark = pytest.mark.e2e


class Camera:
    """A runner that gives pictures only, numbered from 1 on. `age_ms` is what it says of each."""

    def __init__(self, endpoint: str) -> None:
        self.taken = 0
        self._server = RouterServer(endpoint, lambda error: {"ok": False, "error": error.to_wire()})

    async def serve(self) -> None:
        async with self._server:
            await self._server.serve(self._handle)

    async def _handle(self, peer: Peer, message: Message) -> None:
        reply: Message = {"re": message["id"], "ok": True}
        if message["op"] == "frame":
            self.taken += 1
            reply |= {"camera": "wrist", "encoding": "png", "data": PNG + b"%d" % self.taken,
            "width": 4, "height": 4,
                      "stamp_monotonic_ns": 1, "age_ms": 0.0}  # fmt: skip
        await self._server.send(peer, reply)


def test_an_answer_is_not_about_a_picture_from_before_a_long_load(box) -> None:
    """Regression: the scene model waited for the GPU and loaded for minutes, and then told of the
    picture it had been sent before."""
    sidecar = box.start("vlm")
    (sidecar.folder / "slow_load").touch()

    async def story() -> tuple[str, str]:
        camera = Camera(f"ipc://{box.runtime}/runner.sock")
        serving = asyncio.create_task(camera.serve())
        async with (
            RunnerClient(f"ipc://{box.runtime}/runner.sock") as runner,
            SceneVlmClient(f"ipc://{box.runtime}/vlm.sock") as vlm,
        ):
            asking = asyncio.create_task(
                Tools(runner, None, vlm)(QueryScene(question="which picture?"))
            )
            await asyncio.to_thread(until, lambda: sidecar.state() == "loading")
            since_s = time.monotonic()
            await asyncio.to_thread(until, lambda: time.monotonic() > since_s + LOOKED_AT_MAX_S)
            (sidecar.folder / "slow_load").unlink()
            outcome = await asking
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        return outcome.status, outcome.text

    assert asyncio.run(story()) == ("answered", "2")


def test_a_request_says_how_long_its_picture_is_good_for(box) -> None:
    sidecar = box.start("vlm")
    (sidecar.folder / "slow_load").touch()
    asked = sidecar.client.send("detect", image=PNG, query="red cube", fresh_s=0.05)
    patient = sidecar.client.send("detect", image=PNG, query="red cube", fresh_s=3600.0)
    sent_s = time.monotonic()
    until(lambda: time.monotonic() > sent_s + 0.05 and sidecar.state() == "loading")
    (sidecar.folder / "slow_load").unlink()
    refused = sidecar.client.reply(asked, 60.0)
    assert (refused["ok"], refused["code"]) == (False, "frame_stale")
    assert sidecar.client.reply(patient, 60.0)["ok"]
    assert sidecar.state() == "resident", "what came too late for one is there for the next"
    assert sidecar.detect()["ok"], "who says nothing is answered, as the field's clients are"
