"""Tools that look: a camera's present picture, and what a detector, a scene VLM or a reward model
says about it.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import TypedDict

from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.perception import DetectorClient, RewardClient, SceneVlmClient
from vram_arbiter.reasoner.history import Past, Taken
from vram_arbiter.reasoner.outcomes import of_detections, of_judgement
from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.planner import Outcome
from vram_arbiter.schemas.defaults import IMAGE_MESSAGE_MAX_BYTES
from vram_arbiter.schemas.errors import FrameStale, LimitExceeded, NotPermitted
from vram_arbiter.schemas.goals import FrameReply
from vram_arbiter.schemas.tools import LocateInView, Look, QueryScene, QueryTaskProgress

FRAME_MAX_AGE_MS = 1000.0
# a picture's age when a model begins to look at it; one that waited for the GPU is too old
LOOKED_AT_MAX_S = 5.0
PLACE_MAX_S = 10.0  # a later answer says where something stood: an arm would reach for that
LOOKS_MAX = 3  # with a new picture each, for one answer: behind the first wait the model is there
IDENTITY_S = 10.0  # for a perception sidecar to say which model it serves


@dataclass(frozen=True, slots=True)
class Judge:
    """A reward model, its picture history, and the default task.

    It only gives its opinion: goals do not depend on it.
    """

    reward: RewardClient
    past: Past
    task: str


@dataclass(frozen=True, slots=True)
class Perception:
    """`locate`, `query`, `show` and `progress`. Raises NotPermitted for a model that is not there,
    or that the palette bars."""

    runner: RunnerClient
    detector: DetectorClient | None
    scene_vlm: SceneVlmClient | None
    judge: Judge | None
    palette: Palette | None

    async def locate(self, call: LocateInView) -> Outcome:
        detector = _provided(self.detector, "detector")
        frame, detections = await self._ask(
            detector,
            lambda: self._frame(call.camera),
            lambda frame: detector.detect(
                frame["data"], call.query, fresh_s=_good_for_s(frame["age_ms"])
            ),
            answer_max_s=PLACE_MAX_S,
        )
        unknown = self._unknown_words(detector, call.query)
        return of_detections(call.query, frame, detections, unknown)

    def _unknown_words(self, detector: DetectorClient, query: str) -> list[str]:
        """Return the words that the manifest of the served detector does not name."""
        served = detector.identity["rskill"] if detector.identity else ""
        skills = self.palette.skills if self.palette is not None else ()
        return [
            word for skill in skills if skill.id == served for word in skill.unknown_words(query)
        ]

    async def query(self, call: QueryScene) -> Outcome:
        vlm = _provided(self.scene_vlm, "scene VLM")
        clip, answer = await self._ask(
            vlm,
            lambda: self._clip(call),
            lambda clip: vlm.query(
                **_pictures(clip),
                question=call.question,
                fresh_s=_good_for_s(clip[-1]["age_ms"]),
            ),
        )
        about = {"camera": clip[-1]["camera"], "question": call.question}
        return Outcome("answered", answer, data=about)

    async def _clip(self, call: QueryScene) -> list[FrameReply]:
        """Return the present picture, or the clip that the call asks for, oldest first.

        Raises FrameStale where the camera gives no new picture for each, LimitExceeded for more
        bytes than a request may have.
        """
        if call.frames == 1:
            return [await self._frame(call.camera)]
        apart_s = call.seconds / (call.frames - 1)
        clip: list[FrameReply] = []
        begun_s = monotonic()
        for number in range(call.frames):
            await asyncio.sleep(begun_s + number * apart_s - monotonic())
            # pictures of a clip are looked at together, and PNG would be too many bytes
            frame = await self.runner.frame(
                call.camera, max_age_ms=min(FRAME_MAX_AGE_MS, apart_s * 1e3), encoding="jpeg"
            )
            if clip and frame["stamp_monotonic_ns"] <= clip[-1]["stamp_monotonic_ns"]:
                raise FrameStale(
                    f"camera {frame['camera']} gives no new picture every {apart_s:g} s",
                    hint="ask for fewer frames, or for more seconds",
                )
            clip.append(frame)
            if sum(len(one["data"]) for one in clip) > IMAGE_MESSAGE_MAX_BYTES:
                raise LimitExceeded(
                    f"{len(clip)} pictures have more than {IMAGE_MESSAGE_MAX_BYTES} bytes",
                    hint="ask for fewer frames",
                )
        return clip

    async def show(self, call: Look) -> Outcome:
        frame = await self.runner.frame(call.camera, max_age_ms=FRAME_MAX_AGE_MS, encoding="jpeg")
        age_s = frame["age_ms"] / 1e3
        text = f"{frame['camera']}, {frame['width']} × {frame['height']}, {age_s:.1f} s old"
        return Outcome("shown", text, data={"camera": frame["camera"]}, picture=frame["data"])

    async def progress(self, call: QueryTaskProgress) -> Outcome:
        """Judge by what the camera showed within the window, up to now: no picture now is no
        evidence.
        """
        judge = _provided(self.judge, "reward model")
        reward, task = judge.reward, call.task or judge.task

        async def shown_now() -> list[Taken]:
            newest = await judge.past.look()
            return judge.past.since(newest.at_s - call.window_s)

        shown, judged = await self._ask(
            reward,
            shown_now,
            lambda shown: reward.score(
                [taken.image for taken in shown], task, fresh_s=_good_for_s(shown[-1].age_s * 1e3)
            ),
        )
        return of_judgement(task, shown, judged)

    async def _frame(self, camera: str) -> FrameReply:
        return await self.runner.frame(camera, max_age_ms=FRAME_MAX_AGE_MS, encoding="png")

    async def _ask[P, A](
        self,
        sidecar: SidecarClient,
        take: Callable[[], Awaitable[P]],
        ask: Callable[[P], Awaitable[A]],
        *,
        answer_max_s: float = math.inf,
    ) -> tuple[P, A]:
        """Look with a sidecar that the palette permits, also after it: it may have been replaced
        meanwhile."""
        await need_permitted(sidecar, self.palette)
        found = await _look(take, ask, answer_max_s)
        await need_permitted(sidecar, self.palette)
        return found


def _provided[T](given: T | None, what: str) -> T:
    if given is None:
        raise NotPermitted(f"no {what} is provided")
    return given


async def need_permitted(sidecar: SidecarClient, palette: Palette | None) -> None:
    """Raise NotPermitted where the palette bars the served model.

    Asked until the sidecar has answered.
    """
    if palette is None:
        return
    identity = sidecar.identity or await sidecar.ping(timeout_s=IDENTITY_S)
    if (error := palette.permits(str(identity.get("rskill", "")))) is not None:
        raise error


class _Shown(TypedDict, total=False):
    """A picture, or a video with its rate, as `SceneVlmClient.query` takes them."""

    image_png: bytes
    video: Sequence[bytes]
    fps: float


def _pictures(clip: Sequence[FrameReply]) -> _Shown:
    """Return one picture as such, several as a video with its rate."""
    images = [frame["data"] for frame in clip]
    if len(images) == 1:
        return {"image_png": images[0]}
    first, last = clip[0]["stamp_monotonic_ns"], clip[-1]["stamp_monotonic_ns"]
    return {"video": images, "fps": (len(images) - 1) * 1e9 / (last - first)}


async def _look[P, A](
    take: Callable[[], Awaitable[P]],
    ask: Callable[[P], Awaitable[A]],
    answer_max_s: float,
) -> tuple[P, A]:
    """Return a picture and a model's answer about it.

    A picture that grew too old before the model looked, or whose answer took longer than
    `answer_max_s`, is replaced by a new one, `LOOKS_MAX` in all; then FrameStale. Raises what
    `take` and `ask` raise.
    """
    for _ in range(LOOKS_MAX):
        taken = await take()
        asked_s = monotonic()
        try:
            answer = await ask(taken)
        except FrameStale as error:
            stale = error
            continue
        if (took_s := monotonic() - asked_s) <= answer_max_s:
            return taken, answer
        stale = FrameStale(
            f"the answer took {took_s:.0f} s, which is more than {answer_max_s:g} s:"
            " it is not about now",
            hint="look again, or use a faster model",
        )
    raise stale


def _good_for_s(age_ms: float) -> float:
    """Return how much longer a picture may wait to be looked at."""
    return max(0.0, LOOKED_AT_MAX_S - age_ms / 1e3)
