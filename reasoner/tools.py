"""What the tools do: each call becomes one request to the runner or to a sidecar, each answer a typed outcome.

The difference between *not seen*, *evicted*, *no frame* and *error* is kept: only a detector that really looked may say that something is not there.
"""

import logging
from typing import Any, Protocol

from clients.runner import RunnerClient
from clients.sidecar.perception import DetectorClient, SceneVlmClient
from reasoner.planner import Outcome
from schemas.errors import (
    Evicted,
    FrameStale,
    GoalRejected,
    LeaseRevoking,
    NotResident,
    RunnerUnreachable,
    VramError,
)
from schemas.goals import FrameReply
from schemas.tools import ExecuteRskill, LocateInView, QueryScene, ToolCall
from schemas.world import CameraModel

log = logging.getLogger(__name__)

FRAME_MAX_AGE_MS = 1000.0
GOAL_GRACE_S = 60.0  # beyond the goal's own deadline: loading the skill's model is not part of the motion
GOAL_MAX_S = 600.0  # when the manifest sets the deadline


class Dispatcher(Protocol):
    async def __call__(self, call: ToolCall) -> Outcome: ...


class Tools:
    """Dispatch to a runner, a detector and a scene VLM. None of the sidecars needs to be up before it is asked."""

    def __init__(
        self, runner: RunnerClient, detector: DetectorClient | None, scene_vlm: SceneVlmClient | None
    ) -> None:
        self._runner = runner
        self._detector = detector
        self._scene_vlm = scene_vlm

    async def __call__(self, call: ToolCall) -> Outcome:
        """Never raises for what the other side does; the outcome says it."""
        try:
            match call:
                case LocateInView():
                    return await self._locate(call)
                case QueryScene():
                    return await self._query(call)
                case ExecuteRskill():
                    return await self._execute(call)
                case _:
                    return Outcome("refused", f"{call.tool} is not provided here", "not_permitted")
        except VramError as error:
            return _failed(error)

    async def _locate(self, call: LocateInView) -> Outcome:
        if self._detector is None:
            return Outcome("refused", "no detector is provided", "not_permitted")
        frame = await self._frame(call.camera)
        detections = await self._detector.detect(frame["data"], call.query)
        if not detections:
            return Outcome(
                "not_seen",
                f"{call.query} is not in view of {frame['camera']}",
                data={"camera": frame["camera"]},
            )
        best = max(detections, key=lambda detection: detection.score)
        data: dict[str, Any] = {
            "camera": frame["camera"],
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
        x, y, z = point
        return Outcome(
            "found",
            f"{call.query} at ({x:.3f}, {y:.3f}, {z:.3f}) m from the base, score {best.score:.2f}",
            data=data,
        )

    async def _query(self, call: QueryScene) -> Outcome:
        if self._scene_vlm is None:
            return Outcome("refused", "no scene VLM is provided", "not_permitted")
        frame = await self._frame(call.camera)
        answer = await self._scene_vlm.query(frame["data"], call.question)
        return Outcome("answered", answer, data={"camera": frame["camera"], "question": call.question})

    async def _execute(self, call: ExecuteRskill) -> Outcome:
        goal = await self._runner.send_goal(
            call.rskill_id, prompt=call.prompt, goal_params=call.goal_params, deadline_s=call.deadline_s
        )
        limit_s = call.deadline_s + GOAL_GRACE_S if call.deadline_s else GOAL_MAX_S
        try:
            result = await goal.result(timeout_s=limit_s)
        except (TimeoutError, RunnerUnreachable):
            await goal.cancel()
            return Outcome(
                "failed", f"no result within {limit_s:.0f} s; the goal was cancelled", "wait_timeout"
            )
        return Outcome(
            "succeeded" if result["success"] else "failed",
            result["message"] or result["status"],
            result["code"],
            dict(result["data"]),
        )

    async def _frame(self, camera: str) -> FrameReply:
        return await self._runner.frame(camera, max_age_ms=FRAME_MAX_AGE_MS, encoding="png")


def point_on_plane(frame: FrameReply, box: tuple[float, float, float, float]) -> list[float] | None:
    """Centre of a detection's box (pixels) → point in the base's frame (metres), on the plane that the frame's camera model names.

    None if the frame carries no model or the ray does not meet the plane.
    """
    if "camera_model" not in frame:
        return None
    model = CameraModel.model_validate(frame["camera_model"])
    point = model.ground_point((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
    return None if point is None else list(point)


def _failed(error: VramError) -> Outcome:
    match error:
        case Evicted() | NotResident() | LeaseRevoking():
            return Outcome(
                "evicted", f"the model is not resident, so nothing was looked at: {error}", error.code
            )
        case FrameStale():
            return Outcome("no_frame", str(error), error.code)
        case GoalRejected():
            return Outcome("failed", str(error), error.code)
        case _:
            return Outcome("error", str(error), error.code)
