"""What a look tells beside its answer: its place, unknown words, the picture itself."""

from typing import Any

import pytest

from tests.support.field_server import PNG
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import DetectorClient
from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.tools import Tools
from vram_arbiter.schemas.errors import FrameStale
from vram_arbiter.schemas.tools import LocateInView, Look

pytestmark = pytest.mark.anyio

MODEL = {
    "K": [[100, 0, 2], [0, 100, 2], [0, 0, 1]],
    "T_base_camera": [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]],
    "base_pose": [1.0, 2.0, 0.5],
}


async def test_a_look_says_where_it_was_and_which_words_its_detector_does_not_know(
    a_runner: Any, a_sidecar: Any
) -> None:
    eye = Skill("lab/eye", "detector", "", ("detect",), vocabulary=frozenset({"red", "cube"}))

    async with a_runner() as runner, a_sidecar("lab/eye") as sidecar:
        runner.camera_model, sidecar.detections = MODEL, []
        async with (
            RunnerClient(runner.endpoint) as client,
            DetectorClient(sidecar.endpoint) as detector,
        ):
            tools = Tools(client, detector, None, palette=Palette((eye,)))
            outcome = await tools(LocateInView(query="the pink cube"))
    assert outcome.status == "not_seen"
    assert outcome.data["base_pose"] == [1.0, 2.0, 0.5]
    assert outcome.data["unknown_words"] == ["pink"]
    assert "does not name pink" in outcome.text


async def test_a_picture_for_the_planner_itself(runner: Any, client: RunnerClient) -> None:
    tools = Tools(client, None, None)
    shown = await tools(Look(camera="wrist"))
    runner.frame_error = FrameStale("too old")
    shown, none = [shown, await tools(Look())]
    assert (shown.status, none.status) == ("shown", "no_frame")
    assert shown.picture == PNG
    assert "wrist" in shown.text
    assert none.picture == b""
