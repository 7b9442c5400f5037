"""Clients of the perception sidecars: open-vocabulary detector, scene VLM, reward model. They know
images as PNG bytes only."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.sidecar import PICTURES_MAX

MAX_SIDE = 1024


@dataclass(frozen=True, slots=True)
class Detection:
    """`box` is x0, y0, x1, y1 in pixels of the image that was sent; `score` is 0..1."""

    label: str
    score: float
    box: tuple[float, float, float, float]

    @property
    def centre(self) -> tuple[float, float]:
        return (self.box[0] + self.box[2]) / 2, (self.box[1] + self.box[3]) / 2


class DetectorClient(SidecarClient):
    """`await detector.detect(png, "red cube")`."""

    async def detect(
        self,
        image_png: bytes,
        query: str,
        *,
        max_side: int = MAX_SIDE,
        score_threshold: float | None = None,
        token: Sequence[int] | None = None,
        timeout_s: float | None = None,
        fresh_s: float | None = None,
    ) -> list[Detection]:
        """Everything that matches, best first. An empty list means: the detector looked and found
        nothing.

        Raises Evicted, NotResident, WaitTimeout, OutOfMemory, ModelError, SidecarUnavailable, and
        FrameStale when it could not look within `fresh_s` (seconds from now): it did not look.
        """
        fields = {
            "image": image_png,
            "query": query,
            "max_side": max_side,
            "score_threshold": score_threshold,
        }
        reply = await self.call("detect", fields, token=token, timeout_s=timeout_s, fresh_s=fresh_s)
        try:
            found = [_detection(entry) for entry in reply["detections"]]
        except (KeyError, TypeError, ValueError) as error:
            raise ModelError(f"the detector's answer has a wrong shape: {error!r}") from error
        return sorted(found, key=lambda detection: -detection.score)


class SceneVlmClient(SidecarClient):
    """`await vlm.query(png, "Is the red cube held?")`, or
    `await vlm.query(images=[before, after], question="Has the cube moved?")`."""

    async def query(
        self,
        image_png: bytes | None = None,
        question: str = "",
        *,
        images: Sequence[bytes] = (),
        video: Sequence[bytes] = (),
        fps: float | None = None,
        max_side: int = MAX_SIDE,
        max_new_tokens: int = 256,
        token: Sequence[int] | None = None,
        timeout_s: float | None = None,
        fresh_s: float | None = None,
    ) -> str:
        """Ask about a picture, further `images`, and a `video`: frames of one camera, oldest first,
        `fps` of them a second.

        Returns: the model's answer, as it wrote it, without its thoughts.

        Raises: as `DetectorClient.detect`; LimitExceeded for too many tokens, and where the model
        thought for all of `max_new_tokens`.
        """
        given = {"image": image_png, "images": list(images), "video": list(video), "fps": fps}
        fields = {name: value for name, value in given.items() if value} | {
            "question": question,
            "max_side": max_side,
            "max_new_tokens": max_new_tokens,
        }
        reply = await self.call("query", fields, token=token, timeout_s=timeout_s, fresh_s=fresh_s)
        answer = reply.get("answer") if isinstance(reply, dict) else None
        if not isinstance(answer, str):
            raise ModelError("the scene VLM's reply has no answer")
        return answer


@dataclass(frozen=True, slots=True)
class Judgement:
    """Of each picture, oldest first, or of the newest alone: `progress` 0..1, `success`
    (probability; empty: not said). Advice, no proof."""

    progress: tuple[float, ...]
    success: tuple[float, ...]
    success_threshold: float


class RewardClient(SidecarClient):
    """`await reward.score([png, png], "grab the red cube")`."""

    async def score(
        self,
        images_png: Sequence[bytes],
        task: str,
        *,
        token: Sequence[int] | None = None,
        timeout_s: float | None = None,
        fresh_s: float | None = None,
    ) -> Judgement:
        """How far along the task one camera's pictures show the robot to be; the newest
        `PICTURES_MAX` are sent. Raises as `DetectorClient.detect`."""
        fields = {"images": list(images_png)[-PICTURES_MAX:], "task": task}
        reply = await self.call("score", fields, token=token, timeout_s=timeout_s, fresh_s=fresh_s)
        try:
            sent = reply.get("n", len(fields["images"]))  # a server of the field takes fewer
            found = Judgement(
                tuple(float(value) for value in reply["progress"]),
                tuple(float(value) for value in reply["success"]),
                float(reply["success_threshold"]),
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ModelError(f"the reward model's answer has a wrong shape: {error!r}") from error
        values = (*found.progress, *found.success, found.success_threshold)
        if not found.progress or not all(0.0 <= value <= 1.0 for value in values):
            raise ModelError("the reward model's answer is not in 0..1")
        if len(found.progress) not in (1, sent) or len(found.success) not in (
            0,
            len(found.progress),
        ):
            raise ModelError(
                f"the reward model judged {len(found.progress)} and {len(found.success)} of {sent} "
                "pictures"
            )
        return found


def _detection(entry: dict[str, object]) -> Detection:
    box = entry["box"]
    if not isinstance(box, list) or len(box) != 4:
        raise ValueError(f"a box has four numbers, not {box!r}")
    x0, y0, x1, y1 = (float(side) for side in box)
    score = float(str(entry["score"]))
    if not all(map(math.isfinite, (x0, y0, x1, y1))) or not 0.0 <= score <= 1.0:
        raise ValueError(f"a box is finite and a score in 0..1, not {box!r}, {score!r}")
    return Detection(str(entry["label"]), score, (x0, y0, x1, y1))
