"""What the runner's continuous detectors see now, out of its world state.

Read anew for each decision: detections grow old within a second, and the runner leaves out those
beyond the bound of its robot file (`max_age_ms`). Without a continuous detector nothing is told.
"Nothing seen" and "not looking" stay apart.
"""

import logging

from pydantic import ValidationError

from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.reasoner.planner import Seen, Sight
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.goals import GetState
from vram_arbiter.schemas.world import DETECTOR_PREFIX, WorldState

log = logging.getLogger(__name__)

ANSWER_S = 2.0  # a decision does not wait longer for it


async def look_at(runner: RunnerClient) -> Sight | None:
    """Return what is seen now; None: no detector looks all the time, or the runner is silent."""
    try:
        state = await runner.call(GetState(), timeout_s=ANSWER_S)
        world = state.get("world")
        return None if world is None else sight_of(WorldState.model_validate(world))
    except (VramError, ValidationError) as error:
        log.warning("what the detectors see is not known: %s", error)
        return None


def sight_of(world: WorldState) -> Sight | None:
    """Return the detections of cameras whose detector is fresh; None: there is no detector."""
    looks = {
        name.removeprefix(DETECTOR_PREFIX): said == "ok"
        for name, said in world.diagnostics.items()
        if name.startswith(DETECTOR_PREFIX)
    }
    if not looks:
        return None
    seen = [
        Seen(one.label, one.confidence, one.sensor_id, (world.stamp_ns - one.stamp_ns) / 1e9)
        for one in world.detected_objects
        if looks.get(one.sensor_id)
    ]
    return Sight(tuple(seen), tuple(camera for camera, fresh in looks.items() if not fresh))
