"""Answers and errors of the other side as outcomes for the planner: status, words and numbers.

Pure. Only a detector that really looked may say that something is not there: *not seen*, *evicted*,
*no frame* and *error* stay four different things.
"""

import math
from collections.abc import Sequence
from typing import TypedDict

from vram_arbiter.clients.sidecar.perception import Detection, Judgement
from vram_arbiter.reasoner.history import Taken
from vram_arbiter.reasoner.planner import Outcome
from vram_arbiter.reasoner.search_map import SAME_M
from vram_arbiter.schemas.errors import (
    Evicted,
    FrameStale,
    GoalRejected,
    LeaseRevoking,
    NotPermitted,
    NotResident,
    VramError,
)
from vram_arbiter.schemas.goals import FrameReply, ResultPush
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.world import CameraModel

THINGS_MAX = 8  # reported per look, best first


def of_error(error: VramError) -> Outcome:
    """Return the outcome of a call that ended with an error."""
    match error:
        case Evicted() | NotResident() | LeaseRevoking():
            why = f"the model is not resident, so nothing was looked at: {error}"
            return Outcome("evicted", why, error.code)
        case NotPermitted():
            return Outcome("refused", str(error), error.code)
        case FrameStale():
            return Outcome("no_frame", str(error), error.code)
        case GoalRejected():
            return Outcome("failed", str(error), error.code)
        case _:
            return Outcome("error", str(error), error.code)


def of_result(result: ResultPush) -> Outcome:
    """Return the outcome of a goal that ended."""
    status = result["status"]
    return Outcome(
        "succeeded" if result["success"] else "canceled" if status == "canceled" else "failed",
        result["message"] or status,
        result["code"] or ("deadline" if status == "deadline" else ""),
        dict(result["data"]),
    )


def how_it_went(result: ResultPush | None) -> str:
    """Return the outcome of an aborted goal: never `canceled` for one that may still move the
    robot.
    """
    if result is None:
        return (
            "the goal was called off, but the runner has not said that it ended: it may still run"
        )
    if result["status"] == "canceled":
        return f"the goal was {result['message'] or 'canceled'}"
    return f"it ended by then: {result['status']}"


def of_detections(
    query: str, frame: FrameReply, detections: Sequence[Detection], unknown_words: Sequence[str]
) -> Outcome:
    """Return the outcome of a detector's look: every place where it sees a match, best first.

    `unknown_words` are those of the query that the detector's manifest does not name.
    """
    where: JsonObject = {"camera": frame["camera"]}
    if (pose := frame.get("camera_model", {}).get("base_pose")) is not None:
        where["base_pose"] = list(pose)
    unnamed = ""
    if unknown_words:
        where["unknown_words"] = [*unknown_words]
        unnamed = f"; the detector's manifest does not name {', '.join(unknown_words)}"
    if not detections:
        absent = f"{query} is not in view of {frame['camera']}{unnamed}"
        return Outcome("not_seen", absent, data=where)
    ranked = sorted(detections, key=lambda detection: -detection.score)
    best = ranked[0]
    data = where | {"box": list(best.box), "score": best.score, "label": best.label}
    point = point_on_plane(frame, best.box)
    if point is None:
        why = f"{query} is seen, but the camera cannot say where it stands"
        return Outcome("error", why, "frame_stale", data)
    data["point_base_m"] = point
    data["seen"] = seen = _things(frame, ranked)
    places = [
        "({:.3f}, {:.3f}, {:.3f}) m from the base, score {:.2f}".format(
            *one["point_base_m"], one["score"]
        )
        for one in seen
    ]
    also = f"; less likely at {', or at '.join(places[1:])}" if len(places) > 1 else ""
    return Outcome("found", f"{query} at {places[0]}{also}{unnamed}", data=data)


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


def of_judgement(task: str, shown: Sequence[Taken], judged: Judgement) -> Outcome:
    """Return a reward model's opinion about a task; the pictures are oldest first."""
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
