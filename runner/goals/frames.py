"""Pictures for other processes: the newest frame of a camera, encoded, with its stamp.

A frame that is older than the caller accepts is never served: `frame_stale` names its age. Must not
know goals or the wire.
"""

from __future__ import annotations

import asyncio

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.sensors.pictures import Encoding, encode
from vram_arbiter.schemas.errors import BadRequest, FrameStale
from vram_arbiter.schemas.goals import FrameReply

FIRST_FRAME_GRACE_S = (
    1.0  # a tick may be long once (scene set-up); a hung loop is refused after this at the latest
)


async def fetch(
    control: ControlThread,
    clock: Clock,
    camera: str,
    max_age_ms: float,
    encoding: Encoding,
) -> FrameReply:
    """Return the newest picture of `camera` ("" takes the first camera).

    Raises BadRequest for an unknown camera, FrameStale otherwise.
    """
    source = control.runner
    known = source.camera_names()
    name = camera or (known[0] if known else "")
    if name not in known:
        raise BadRequest(f"there is no camera {camera!r}", hint=f"choose from {', '.join(known)}")
    max_age_s = max_age_ms / 1e3
    try:
        async with asyncio.timeout(max(max_age_s, FIRST_FRAME_GRACE_S)):
            taken = await control.call(lambda: source.snapshot(name, max_age_s))
    except TimeoutError:
        raise FrameStale(
            f"camera {name} has given no frame for {max(max_age_s, FIRST_FRAME_GRACE_S):.1f} s",
            hint="the control loop hangs or is overloaded",
        ) from None
    data = await asyncio.to_thread(lambda: encode(taken.rgb, encoding))
    age_ms = (clock.now_ns() - taken.stamp_ns) / 1e6
    if age_ms > max_age_ms:
        raise FrameStale(
            f"the newest frame of {name} is {age_ms:.0f} ms old, {max_age_ms:.0f} ms are accepted",
            hint="accept older frames or look at the control loop's rate",
            details={"age_ms": age_ms},
        )
    height, width = taken.rgb.shape[:2]
    reply = FrameReply(
        camera=name,
        encoding=encoding,
        data=data,
        width=int(width),
        height=int(height),
        stamp_monotonic_ns=taken.stamp_ns,
        age_ms=age_ms,
    )
    if taken.model is not None:
        reply["camera_model"] = taken.model.model_dump(mode="json")
    return reply
