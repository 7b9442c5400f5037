"""Frames over the goal socket: the right camera, encoding and stamp, and a refusal instead of an
old picture.
"""

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import pytest

from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.goals import frames
from vram_arbiter.runner.sensors.pictures import encode
from vram_arbiter.schemas.errors import BadRequest, FrameStale
from vram_arbiter.schemas.world import CameraModel

pytestmark = [pytest.mark.anyio, pytest.mark.heavy]  # pictures: numpy, OpenCV

Make = Callable[..., Any]


async def test_the_first_camera_is_the_default(make_runner: Make) -> None:
    import cv2
    import numpy as np

    runner = make_runner(rate_hz=200.0, cameras=("front", "wrist"))
    async with ControlThread(runner) as control:
        for camera, encoding, magic in (("", "png", b"\x89PNG"), ("wrist", "jpeg", b"\xff\xd8")):
            reply = await frames.fetch(control, SystemClock(), camera, 60_000.0, encoding)
            assert reply["camera"] == (camera or "front")
            assert reply["data"].startswith(magic)
            picture = cv2.imdecode(np.frombuffer(reply["data"], dtype=np.uint8), cv2.IMREAD_COLOR)
            assert picture.shape == (24, 32, 3) == (reply["height"], reply["width"], 3)
            assert 0 <= reply["age_ms"] <= 60_000
            CameraModel.model_validate(reply["camera_model"])
        with pytest.raises(BadRequest, match="front, wrist"):
            await frames.fetch(control, SystemClock(), "rear", 500.0, "png")


def test_png_is_lossless_and_in_rgb_order() -> None:
    import cv2
    import numpy as np

    picture = np.random.default_rng(1).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    decoded = cv2.imdecode(np.frombuffer(encode(picture, "png"), dtype=np.uint8), cv2.IMREAD_COLOR)
    assert (decoded[..., ::-1] == picture).all()


async def test_a_control_loop_that_hangs_gives_no_picture(
    make_runner: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, "FIRST_FRAME_GRACE_S", 0.05)
    hung, released = threading.Event(), threading.Event()

    def hang() -> None:
        hung.set()
        released.wait(60)

    runner = make_runner(rate_hz=200.0, cameras=("front",))
    async with ControlThread(runner) as control:
        hanging = asyncio.create_task(control.call(hang))
        await asyncio.to_thread(hung.wait, 60)
        try:
            with pytest.raises(FrameStale, match="has given no frame"):
                await frames.fetch(control, SystemClock(), "front", 20.0, "png")
        finally:
            released.set()
            await hanging


async def test_an_old_picture_is_never_served(make_runner: Make, clock: Any) -> None:
    class Late(SystemClock):
        def now_ns(self) -> int:
            return super().now_ns() + 70 * 10**9

    runner = make_runner(rate_hz=200.0, cameras=("front",))
    async with ControlThread(runner) as control:
        with pytest.raises(FrameStale, match="60000 ms are accepted"):
            await frames.fetch(control, Late(), "front", 60_000.0, "png")
