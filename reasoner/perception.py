"""Tools that look: a camera's present picture, and what a detector, a scene VLM or a reward model
says about it.
"""

import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from time import monotonic

from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.perception import DetectorClient, RewardClient, SceneVlmClient
from vram_arbiter.reasoner.history import Past, Taken
from vram_arbiter.reasoner.outcomes import of_detections, of_judgement
from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.planner import Outcome
from vram_arbiter.schemas.errors import FrameStale
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


class Perception:
    """`locate`, `query`, `show` and `progress`; a model that is not there refuses."""

    def __init__(
        self,
        runner: RunnerClient,
        detector: DetectorClient | None,
        scene_vlm: SceneVlmClient | None,
        judge: Judge | None,
        palette: Palette | None,
    ) -> None:
        self._runner = runner
        self._detector = detector
        self._scene_vlm = scene_vlm
        self._judge = judge
        self._palette = palette

    async def locate(self, call: LocateInView) -> Outcome:
        if self._detector is None:
            return Outcome("refused", "no detector is provided", "not_permitted")
        if (refusal := await not_permitted(self._detector, self._palette)) is not None:
            return refusal
        detector = self._detector
        frame, detections = await _look(
            lambda: self._frame(call.camera),
            lambda frame: detector.detect(
                frame["data"], call.query, fresh_s=_good_for_s(frame["age_ms"])
            ),
            answer_max_s=PLACE_MAX_S,
        )
        if (refusal := await not_permitted(self._detector, self._palette)) is not None:
            return refusal  # it was replaced meanwhile
        unknown = self._unknown_words(detector, call.query)
        return of_detections(call.query, frame, detections, unknown)

    def _unknown_words(self, detector: DetectorClient, query: str) -> list[str]:
        """Return the words that the manifest of the served detector does not name."""
        served = str(detector.identity.get("rskill", "")) if detector.identity else ""
        skills = self._palette.skills if self._palette is not None else ()
        known = next((skill for skill in skills if skill.id == served), None)
        return [] if known is None else known.unknown_words(query)

    async def query(self, call: QueryScene) -> Outcome:
        if self._scene_vlm is None:
            return Outcome("refused", "no scene VLM is provided", "not_permitted")
        if (refusal := await not_permitted(self._scene_vlm, self._palette)) is not None:
            return refusal
        vlm = self._scene_vlm
        frame, answer = await _look(
            lambda: self._frame(call.camera),
            lambda frame: vlm.query(
                frame["data"], call.question, fresh_s=_good_for_s(frame["age_ms"])
            ),
        )
        if (refusal := await not_permitted(self._scene_vlm, self._palette)) is not None:
            return refusal
        return Outcome(
            "answered", answer, data={"camera": frame["camera"], "question": call.question}
        )

    async def show(self, call: Look) -> Outcome:
        frame = await self._runner.frame(call.camera, max_age_ms=FRAME_MAX_AGE_MS, encoding="jpeg")
        age_s = frame["age_ms"] / 1e3
        text = f"{frame['camera']}, {frame['width']} × {frame['height']}, {age_s:.1f} s old"
        return Outcome("shown", text, data={"camera": frame["camera"]}, picture=frame["data"])

    async def progress(self, call: QueryTaskProgress) -> Outcome:
        """Judge by what the camera showed within the window, up to now: no picture now is no
        evidence.
        """
        if self._judge is None:
            return Outcome("refused", "no reward model is provided", "not_permitted")
        reward, past = self._judge.reward, self._judge.past
        if (refusal := await not_permitted(reward, self._palette)) is not None:
            return refusal
        task = call.task or self._judge.task

        async def shown_now() -> list[Taken]:
            newest = await past.look()
            return past.since(newest.at_s - call.window_s)

        shown, judged = await _look(
            shown_now,
            lambda shown: reward.score(
                [taken.image for taken in shown], task, fresh_s=_good_for_s(shown[-1].age_s * 1e3)
            ),
        )
        if (refusal := await not_permitted(reward, self._palette)) is not None:
            return refusal
        return of_judgement(task, shown, judged)

    async def _frame(self, camera: str) -> FrameReply:
        return await self._runner.frame(camera, max_age_ms=FRAME_MAX_AGE_MS, encoding="png")


async def not_permitted(sidecar: SidecarClient, palette: Palette | None) -> Outcome | None:
    """Return why the palette bars the served model, if it does.

    Asked until the sidecar has answered.
    """
    if palette is None:
        return None
    identity = sidecar.identity or await sidecar.ping(timeout_s=IDENTITY_S)
    error = palette.permits(str(identity.get("rskill", "")))
    return None if error is None else Outcome("refused", str(error), error.code)


async def _look[P, A](
    take: Callable[[], Awaitable[P]],
    ask: Callable[[P], Awaitable[A]],
    *,
    answer_max_s: float = math.inf,
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
