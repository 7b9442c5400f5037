"""Implementation of the tools: one request to the runner or a sidecar, one typed outcome.

The difference between *not seen*, *evicted*, *no frame* and *error* is kept: only a detector that
really looked may say that something is not there. A goal does not outlive its waiter: when the wait
is canceled, or the goal makes no progress for as long as the call allows, it is canceled at the
runner. Nothing here names bytes, leases or victims: loading and unloading are between the sidecars
and the arbiter.
"""

import asyncio
import logging
import math
import uuid
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Any, Protocol, TypedDict

from vram_arbiter.clients.runner import Goal, RunnerClient
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.perception import (
    Detection,
    DetectorClient,
    Judgement,
    RewardClient,
    SceneVlmClient,
)
from vram_arbiter.reasoner.hints import Hints
from vram_arbiter.reasoner.history import Past, Taken
from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.planner import Outcome
from vram_arbiter.reasoner.search_map import SAME_M
from vram_arbiter.schemas.errors import (
    BadRequest,
    BadState,
    Evicted,
    FrameStale,
    GoalRejected,
    LeaseRevoking,
    NotResident,
    RunnerUnreachable,
    VramError,
)
from vram_arbiter.schemas.goals import FrameReply, ResultPush
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.tools import (
    EmitPrompt,
    ExecuteRskill,
    LifecycleTransition,
    LocateInView,
    Look,
    QueryScene,
    QueryTaskProgress,
    ToolCall,
)
from vram_arbiter.schemas.world import CameraModel

log = logging.getLogger(__name__)

FRAME_MAX_AGE_MS = 1000.0
# a picture's age when a model begins to look at it; one that waited for the GPU is too old
LOOKED_AT_MAX_S = 5.0
PLACE_MAX_S = 10.0  # a later answer says where something stood: an arm would reach for that
LOOKS_MAX = 3  # with a new picture each, for one answer: behind the first wait the model is there
GOAL_GRACE_S = (
    60.0  # beyond the goal's own deadline: loading the skill's model is not part of the motion
)
GOAL_MAX_S = 600.0  # when the manifest sets the deadline, and sets none that is longer
START_S = 90.0  # what the runner adds to a manifest's time of motion, to get there
# for feedback that came while this process was stopped; without it a live goal would be canceled
HEARD_LATE_S = 0.5
CANCEL_S = 10.0  # for a canceled goal to end: it gives the robot back and finishes its use
ASK_AGAIN_S = 0.2  # whether a goal has ended whose result has no listener
IDENTITY_S = 10.0  # for a perception sidecar to say which model it serves
PROGRESS_TOLERANCE = 0.0
THINGS_MAX = 8  # reported per look, best first
# waiting for the GPU is not a lack of progress
BEFORE_MOTION = frozenset({"acquiring", "starting"})


class Dispatcher(Protocol):
    async def __call__(self, call: ToolCall) -> Outcome: ...


@dataclass(frozen=True, slots=True)
class Judge:
    """A reward model, its picture history, and the default task.

    It only gives its opinion: goals do not depend on it.
    """

    reward: RewardClient
    past: Past
    task: str


class Tools:
    """Dispatch to a runner, a detector, a scene VLM and a reward model, started on demand.

    `components` are the sidecars by name that `lifecycle_transition` may load and unload, if the
    palette allows it.
    """

    def __init__(
        self,
        runner: RunnerClient,
        detector: DetectorClient | None,
        scene_vlm: SceneVlmClient | None,
        *,
        judge: Judge | None = None,
        palette: Palette | None = None,
        components: Mapping[str, SidecarClient] | None = None,
        hints: Hints | None = None,
        goal_grace_s: float = GOAL_GRACE_S,
    ) -> None:
        self._runner = runner
        self._detector = detector
        self._scene_vlm = scene_vlm
        self._judge = judge
        self._palette = palette
        self._components = dict(components or {})
        self._hints = hints
        self._goal_grace_s = goal_grace_s

    async def __call__(self, call: ToolCall) -> Outcome:
        """Execute a call. Never raises for errors of the other side; they are part of the
        outcome.
        """
        try:
            match call:
                case LocateInView():
                    return await self._locate(call)
                case QueryScene():
                    return await self._query(call)
                case Look():
                    return await self._show(call)
                case QueryTaskProgress():
                    return await self._progress(call)
                case ExecuteRskill():
                    return await self._execute(call)
                case LifecycleTransition():
                    return await self._transition(call)
                case EmitPrompt():
                    log.warning("to %s: %s", call.target_topic, call.text)
                    return Outcome("done", f"said to {call.target_topic}")
                case _:
                    return Outcome("refused", f"{call.tool} is not provided here", "not_permitted")
        except VramError as error:
            return _failed(error)

    async def _locate(self, call: LocateInView) -> Outcome:
        if self._detector is None:
            return Outcome("refused", "no detector is provided", "not_permitted")
        if (refusal := await self._not_permitted(self._detector)) is not None:
            return refusal
        detector = self._detector
        frame, detections = await _look(
            lambda: self._frame(call.camera),
            lambda frame: detector.detect(
                frame["data"], call.query, fresh_s=_good_for_s(frame["age_ms"])
            ),
            answer_max_s=PLACE_MAX_S,
        )
        if (refusal := await self._not_permitted(self._detector)) is not None:
            return refusal  # it was replaced meanwhile
        where: JsonObject = {"camera": frame["camera"]}
        if (pose := frame.get("camera_model", {}).get("base_pose")) is not None:
            where["base_pose"] = list(pose)
        unnamed = ""
        if unknown := self._unknown_words(self._detector, call.query):
            where["unknown_words"] = unknown
            unnamed = f"; the detector's manifest does not name {', '.join(unknown)}"
        if not detections:
            return Outcome(
                "not_seen", f"{call.query} is not in view of {frame['camera']}{unnamed}", data=where
            )
        best, *others = sorted(detections, key=lambda detection: -detection.score)
        data: JsonObject = where | {
            "box": list(best.box),
            "score": best.score,
            "label": best.label,
        }
        point = point_on_plane(frame, best.box)
        if point is None:
            return Outcome(
                "error",
                f"{call.query} is seen, but the camera cannot say where it stands",
                "frame_stale",
                data,
            )
        data["point_base_m"] = point
        data["seen"] = seen = _things(frame, [best, *others])
        places = [
            "({:.3f}, {:.3f}, {:.3f}) m from the base, score {:.2f}".format(
                *one["point_base_m"], one["score"]
            )
            for one in seen
        ]
        also = f"; less likely at {', or at '.join(places[1:])}" if len(places) > 1 else ""
        return Outcome("found", f"{call.query} at {places[0]}{also}{unnamed}", data=data)

    def _unknown_words(self, detector: DetectorClient, query: str) -> list[str]:
        """Return the words that the manifest of the served detector does not name."""
        served = str(detector.identity.get("rskill", "")) if detector.identity else ""
        skills = self._palette.skills if self._palette is not None else ()
        known = next((skill for skill in skills if skill.id == served), None)
        return [] if known is None else known.unknown_words(query)

    async def _query(self, call: QueryScene) -> Outcome:
        if self._scene_vlm is None:
            return Outcome("refused", "no scene VLM is provided", "not_permitted")
        if (refusal := await self._not_permitted(self._scene_vlm)) is not None:
            return refusal
        vlm = self._scene_vlm
        frame, answer = await _look(
            lambda: self._frame(call.camera),
            lambda frame: vlm.query(
                frame["data"], call.question, fresh_s=_good_for_s(frame["age_ms"])
            ),
        )
        if (refusal := await self._not_permitted(self._scene_vlm)) is not None:
            return refusal
        return Outcome(
            "answered", answer, data={"camera": frame["camera"], "question": call.question}
        )

    async def _show(self, call: Look) -> Outcome:
        frame = await self._runner.frame(call.camera, max_age_ms=FRAME_MAX_AGE_MS, encoding="jpeg")
        age_s = frame["age_ms"] / 1e3
        text = f"{frame['camera']}, {frame['width']} × {frame['height']}, {age_s:.1f} s old"
        return Outcome("shown", text, data={"camera": frame["camera"]}, picture=frame["data"])

    async def _progress(self, call: QueryTaskProgress) -> Outcome:
        """Judge by what the camera showed within the window, up to now: no picture now is no
        evidence.
        """
        if self._judge is None:
            return Outcome("refused", "no reward model is provided", "not_permitted")
        reward, past = self._judge.reward, self._judge.past
        if (refusal := await self._not_permitted(reward)) is not None:
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
        if (refusal := await self._not_permitted(reward)) is not None:
            return refusal
        return _opinion(task, shown, judged)

    async def _execute(self, call: ExecuteRskill) -> Outcome:
        goal = await self._send(call)
        limit_s = waits_s(call, self._palette, self._goal_grace_s)
        patience = (
            asyncio.create_task(_stands_still(goal, call)) if call.patience_s is not None else None
        )
        waiting = asyncio.create_task(goal.result(timeout_s=limit_s))
        hint = (
            asyncio.create_task(self._hints.follows(call.next_rskill_id))
            if call.next_rskill_id and self._hints is not None
            else None
        )
        try:
            either: set[asyncio.Task[Any]] = {waiting} if patience is None else {waiting, patience}
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if not waiting.done() and patience is not None and patience.result():
                result = await _called_off(goal)
                if result is None or not result["success"]:
                    return Outcome(
                        "failed",
                        f"no progress for {call.patience_s:g} s; {_how_it_went(result)}",
                        "no_progress",
                    )
                return _ended(result)
            return _ended(await waiting)
        except TimeoutError:
            how = _how_it_went(await _called_off(goal))
            return Outcome("failed", f"no result within {limit_s:.0f} s; {how}", "wait_timeout")
        except BadRequest:
            raise  # the runner knows no such goal (any more)
        except VramError as error:  # it is gone, or cannot say how the goal goes
            how = _how_it_went(await _called_off(goal))
            return Outcome("failed", f"{error.message}; {how}", error.code)
        except asyncio.CancelledError:
            await _called_off(goal)
            raise
        finally:
            for task in (waiting, patience, hint):
                if task is not None:
                    task.cancel()
                    task.add_done_callback(_retrieve)

    async def _send(self, call: ExecuteRskill) -> Goal:
        """Cancel a goal by its name if its acceptance was lost: it may run."""
        goal_id = f"goal-{uuid.uuid4().hex[:12]}"
        try:
            return await self._runner.send_goal(
                call.rskill_id,
                prompt=call.prompt,
                goal_params=call.goal_params,
                deadline_s=call.deadline_s,
                goal_id=goal_id,
            )
        except (asyncio.CancelledError, RunnerUnreachable):
            await asyncio.shield(asyncio.create_task(self._cancel_unheard(goal_id)))
            raise

    async def _cancel_unheard(self, goal_id: str) -> None:
        """And its end is heard, within `CANCEL_S`."""
        try:
            async with asyncio.timeout(CANCEL_S):
                await self._runner.call("cancel", {"goal_id": goal_id}, timeout_s=CANCEL_S)
                await self._until_ended(goal_id)
        except BadRequest:
            pass  # it never was accepted
        except (VramError, TimeoutError) as error:
            log.error(
                "goal %s may run: %s", goal_id, str(error) or "the runner did not say that it ended"
            )

    async def _until_ended(self, goal_id: str) -> None:
        while True:
            try:
                await self._runner.call("result", {"goal_id": goal_id})
            except BadState:  # it runs
                await asyncio.sleep(ASK_AGAIN_S)
            else:
                return

    async def _transition(self, call: LifecycleTransition) -> Outcome:
        """`configure` checks presence, `activate` loads, `deactivate` and `cleanup` unload.

        Never beside a goal: the state is read just before, and a goal that begins in between has
        its lease in use, which the arbiter protects.
        """
        component = self._components.get(call.node)
        if component is None:
            return Outcome("refused", f"no component {call.node} to manage", "not_permitted")
        if call.transition == "configure":
            identity = await component.ping(timeout_s=IDENTITY_S)
            return Outcome("done", f"{call.node} serves {identity['rskill']}, {identity['state']}")
        if (goal := (await self._runner.state())["goal"]) is not None:
            return Outcome(
                "refused",
                f"goal {goal} runs: nothing is loaded or unloaded beside it",
                "bad_state",
                {"goal": goal},
            )
        if call.transition == "activate":
            if (refusal := await self._not_permitted(component)) is not None:
                return refusal
            loaded = await component.load()
            return Outcome(
                "done", f"{call.node} is resident" + ("" if loaded["loaded"] else " as before")
            )
        await component.unload()
        return Outcome("done", f"{call.node} leaves at its next safe point")

    async def _not_permitted(self, sidecar: SidecarClient) -> Outcome | None:
        """Return why the palette bars the served model, if it does.

        Asked until the sidecar has answered.
        """
        if self._palette is None:
            return None
        identity = sidecar.identity or await sidecar.ping(timeout_s=IDENTITY_S)
        error = self._palette.permits(str(identity.get("rskill", "")))
        return None if error is None else Outcome("refused", str(error), error.code)

    async def _frame(self, camera: str) -> FrameReply:
        return await self._runner.frame(camera, max_age_ms=FRAME_MAX_AGE_MS, encoding="png")


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


def _opinion(task: str, shown: list[Taken], judged: Judgement) -> Outcome:
    span_s = shown[-1].at_s - shown[0].at_s
    now = f"progress {judged.progress[-1]:.2f}"
    if len(judged.progress) > 1:
        now += f", {judged.progress[0]:.2f} {span_s:.1f} s before"
    if judged.success:
        done = "done" if judged.success[-1] >= judged.success_threshold else "not done"
        now += (
            f"; it looks {done} ({judged.success[-1]:.2f},"
            f" done from {judged.success_threshold:.2f} on)"
        )
    data = {
        "task": task,
        "progress": [round(value, 3) for value in judged.progress],
        "success": [round(value, 3) for value in judged.success],
        "success_threshold": judged.success_threshold,
        "pictures": len(shown),
        "span_s": round(span_s, 2),
    }
    return Outcome(
        "answered", f"{task!r}: {now}. An opinion about {len(shown)} pictures, no proof", data=data
    )


def point_on_plane(frame: FrameReply, box: tuple[float, float, float, float]) -> list[float] | None:
    """Return the point in the base's frame (meters) under the center of a detection's box (pixels).

    It lies on the plane that the frame's camera model names. None if the frame carries no model or
    the ray does not meet the plane.
    """
    if "camera_model" not in frame:
        return None
    model = CameraModel.model_validate(frame["camera_model"])
    point = model.ground_point((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
    return None if point is None else list(point)


class Thing(TypedDict):
    """One thing of a look, in the base's frame."""

    point_base_m: list[float]
    score: float
    box: list[float]


def _things(frame: FrameReply, detections: Sequence[Detection]) -> list[Thing]:
    """Return detections as things with their places, best first.

    Several boxes may lie on one thing; its best box counts.
    """
    things: list[Thing] = []
    for detection in detections:
        point = point_on_plane(frame, detection.box)
        if point is not None and all(
            math.dist(point, thing["point_base_m"]) > SAME_M for thing in things
        ):
            things.append(
                {"point_base_m": point, "score": detection.score, "box": list(detection.box)}
            )
    return things[:THINGS_MAX]


def _ended(result: ResultPush) -> Outcome:
    status = result["status"]
    return Outcome(
        "succeeded" if result["success"] else "canceled" if status == "canceled" else "failed",
        result["message"] or status,
        result["code"] or ("deadline" if status == "deadline" else ""),
        dict(result["data"]),
    )


def waits_s(call: ExecuteRskill, palette: Palette | None, grace_s: float) -> float:
    """Return how long to wait for a goal's result.

    Its own deadline and `grace_s`, or what its manifest allows, and never less than `GOAL_MAX_S`
    then.
    """
    if call.deadline_s:
        return call.deadline_s + grace_s
    known = palette.executable.get(call.rskill_id) if palette is not None else None
    return max(GOAL_MAX_S, known.longest_s + START_S + grace_s if known is not None else 0.0)


async def _stands_still(goal: Goal, call: ExecuteRskill) -> bool:
    """Return True once the goal's progress has not grown for `patience_s`, False when its feedback
    ends.

    Preparation before the motion does not count.
    """
    assert call.patience_s is not None, "only watched with patience"
    tolerance = PROGRESS_TOLERANCE if call.progress_tolerance is None else call.progress_tolerance
    best: float | None = None
    time_s = asyncio.get_running_loop().time
    feedback = aiter(goal.feedback())
    coming = asyncio.ensure_future(anext(feedback))
    deadline_s: float | None = None
    over = False
    try:
        while True:
            left_s = None if deadline_s is None else max(0.0, deadline_s - time_s())
            if not (await asyncio.wait({coming}, timeout=left_s))[0]:
                if over:
                    return True
                over, deadline_s = True, time_s() + HEARD_LATE_S
                continue
            item = coming.result()
            coming = asyncio.ensure_future(anext(feedback))
            if item["state"] not in BEFORE_MOTION and (
                best is None or item["progress"] > best + tolerance
            ):
                best, over, deadline_s = item["progress"], False, time_s() + call.patience_s
    except StopAsyncIteration:
        return False
    finally:
        coming.cancel()
        coming.add_done_callback(_retrieve)


async def _called_off(goal: Goal) -> ResultPush | None:
    """Cancel a goal and wait for its end, within `CANCEL_S`; None if the runner does not report it.

    A cancellation of this task does not cut the wait short.
    """

    async def end() -> ResultPush | None:
        try:
            async with asyncio.timeout(CANCEL_S):
                if not goal.done:
                    await goal.cancel()
                return await goal.result()
        except (TimeoutError, VramError) as error:
            log.error(
                "goal %s may still run: %s",
                goal.goal_id,
                str(error) or "the runner did not say that it ended",
            )
            return None

    return await asyncio.shield(asyncio.create_task(end()))


def _how_it_went(result: ResultPush | None) -> str:
    """Return the outcome of an aborted goal: never `canceled` for one that may still move the
    robot.
    """
    if result is None:
        return (
            "the goal was called off, but the runner has not said that it ended: it may still run"
        )
    return (
        "the goal was cancelled"
        if result["status"] == "canceled"
        else f"it ended by then: {result['status']}"
    )


def _retrieve(task: "asyncio.Task[Any]") -> None:
    if not task.cancelled():
        task.exception()


def _failed(error: VramError) -> Outcome:
    match error:
        case Evicted() | NotResident() | LeaseRevoking():
            return Outcome(
                "evicted",
                f"the model is not resident, so nothing was looked at: {error}",
                error.code,
            )
        case FrameStale():
            return Outcome("no_frame", str(error), error.code)
        case GoalRejected():
            return Outcome("failed", str(error), error.code)
        case _:
            return Outcome("error", str(error), error.code)
