"""What a look tells beside its answer: its place, unknown words, the picture itself."""

from typing import Any

import pytest

from tests.support.field_server import PNG
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import DetectorClient, SceneVlmClient
from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.tools import Tools
from vram_arbiter.schemas.errors import FrameStale
from vram_arbiter.schemas.tools import LocateInView, Look, QueryScene

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


async def test_a_clip_is_a_video_of_new_pictures(
    runner: Any, client: RunnerClient, a_sidecar: Any
) -> None:
    """Its rate is that of the pictures' stamps, not what was asked for."""
    runner.stamp_step_ns = 200_000_000
    async with a_sidecar("lab/vlm") as sidecar, SceneVlmClient(sidecar.endpoint) as vlm:
        tools = Tools(client, None, vlm)
        ask = QueryScene(question="Does it move?", camera="wrist", frames=3, seconds=0.02)
        outcome = await tools(ask)
        assert (outcome.status, outcome.data["camera"]) == ("answered", "wrist")
        (asked,) = [message for message in sidecar.messages if message["op"] == "query"]
        assert (asked["video"], asked["fps"]) == ([PNG] * 3, 5.0)
        assert "image" not in asked
        assert 0 < asked["fresh_s"] <= 5.0
        wanted = [(frame.max_age_ms, frame.encoding, frame.camera) for frame in runner.frames]
        assert wanted == [(10.0, "jpeg", "wrist")] * 3


@pytest.mark.parametrize(
    ("fault", "status", "said"),
    [
        ({"stamp_step_ns": 0}, "no_frame", "no new picture every 0.01 s"),
        ({"frame_error": FrameStale("too old")}, "no_frame", "too old"),
        ({"frame_data": b"x" * 9 * 2**20}, "error", "2 pictures have more than 16777216 bytes"),
    ],
)
async def test_a_clip_of_old_or_too_large_pictures_is_not_sent(
    runner: Any, client: RunnerClient, a_sidecar: Any, fault: Any, status: str, said: str
) -> None:
    vars(runner).update(fault)
    async with a_sidecar("lab/vlm") as sidecar, SceneVlmClient(sidecar.endpoint) as vlm:
        outcome = await Tools(client, None, vlm)(
            QueryScene(question="Does it move?", frames=3, seconds=0.02)
        )
        assert outcome.status == status
        assert said in outcome.text
        assert "query" not in sidecar.asked
