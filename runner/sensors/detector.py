"""A detector that looks at one camera all the time, for the world state's `detected_objects`.

Runs on the event loop at a rate of its own and never delays the control loop. The sidecar holds the
lease: every look names its token, so that a look never brings an evicted model back. After an
eviction the detections are absent until the model is resident again, which is the arbiter's
decision: a sidecar on standby returns by itself, another one is loaded again every `reload_s`.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from pydantic import ValidationError

from vram_arbiter.clients.sidecar.perception import DetectorClient
from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.protocols import Picture
from vram_arbiter.runner.sensors.detections import DetectionSlot
from vram_arbiter.runner.sensors.pictures import encode
from vram_arbiter.schemas.config.robot import DetectorConfig
from vram_arbiter.schemas.errors import (
    Evicted,
    FrameStale,
    ModelError,
    NotResident,
    VramError,
)
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.world import DetectedObject

log = logging.getLogger(__name__)

LOAD_WAIT_S = 30.0  # for the lease, before the detector asks again
LOOK_S = 30.0  # a detector that takes longer for one picture hangs
SEPARATOR = "</c>"  # of several queries, as the field writes them


class ContinuousDetector:
    """`await run()` looks until it is canceled.

    Args: `picture(sensor_id, max_age_s)` returns the camera's newest frame or raises FrameStale;
    `labels` are asked for where the configuration has no queries.
    """

    def __init__(
        self,
        config: DetectorConfig,
        labels: tuple[str, ...],
        client: DetectorClient,
        picture: Callable[[str, float], Picture],
        slot: DetectionSlot,
        clock: Clock,
    ) -> None:
        self._config = config
        self._query = SEPARATOR.join(config.queries or labels)
        self._client = client
        self._picture = picture
        self._slot = slot
        self._clock = clock
        self._resident = False
        self._token: tuple[int, ...] | None = None  # None: a server without a lease
        self._load_after_s: float | None = 0.0  # None: not again
        self._said = ""  # the problem that was logged last

    async def run(self) -> None:
        """Look at every period; a look that takes longer skips periods."""
        period_s = 1.0 / self._config.rate_hz
        due_s = self._clock.now_s()
        try:
            while True:
                await self.look()
                now_s = self._clock.now_s()
                due_s += period_s * (1 + max(0.0, now_s - due_s) // period_s)
                await asyncio.sleep(max(0.0, due_s - now_s))
        except Exception:
            log.exception("the detector of camera %s broke down", self._config.sensor_id)
            raise
        finally:
            self._slot.lose("its detector has ended")

    async def look(self) -> None:
        """Look once: the detections, or the reason why there are none, are then in the slot."""
        labels = {telemetry.ATTR_SENSOR: self._config.sensor_id}
        try:
            if not self._resident and not await self._become_resident():
                return
            await self._look()
        except FrameStale as error:  # no picture, or the detector came to it too late
            labels[telemetry.ATTR_ERROR_TYPE] = error.code
            self._slot.note(error.message)
        except VramError as error:
            labels[telemetry.ATTR_ERROR_TYPE] = error.code
            self._resident = False
            gone = isinstance(error, Evicted | NotResident)
            if gone:
                self._wait_to_load()
            self._lose("its model was evicted" if gone else error.message, error.code)
        meters.count(telemetry.METRIC_LOOKS, labels)

    async def _look(self) -> None:
        sensor_id, limit_s = self._config.sensor_id, self._slot.max_age_s
        taken = self._picture(sensor_id, limit_s)
        image = await asyncio.to_thread(lambda: encode(taken.rgb, "png"))
        found = await self._client.detect(
            image,
            self._query,
            score_threshold=self._config.score_threshold,
            token=self._token,
            timeout_s=LOOK_S,
            fresh_s=max(0.0, limit_s - (self._clock.now_ns() - taken.stamp_ns) / 1e9),
        )
        try:
            objects = [
                DetectedObject(
                    label=one.label,
                    confidence=one.score,
                    box=one.box,
                    sensor_id=sensor_id,
                    stamp_ns=taken.stamp_ns,
                )
                for one in found
            ]
        except ValidationError as error:
            raise ModelError(
                f"the detector's answer is not valid: {error.errors()[0]['msg']}"
            ) from error
        if self._slot.put(objects, taken.stamp_ns, self._clock.now_ns()):
            if self._said:
                log.info("detections of camera %s are there again", sensor_id)
            self._said = ""
        else:
            self._say(f"its answer came too late: {self._slot.why}", "late")

    async def _become_resident(self) -> bool:
        """Return whether the model is there, loading it where that is due."""
        state = await self._client.ping()
        if state.get("state") != "resident":
            if state.get("standby"):
                self._lose("its model is evicted and returns when there is room")
                return False
            if not self._may_load():
                return False
            self._lose("its model is not loaded")
            loaded = await self._client.load(LOAD_WAIT_S)
            token = loaded["token"]
        else:
            token = state.get("token")
        self._resident, self._token = True, None if token is None else tuple(token)
        return True

    def _may_load(self) -> bool:
        """Return whether the lease may be asked for now: at first, then every `reload_s`."""
        if self._load_after_s is None or self._clock.now_s() < self._load_after_s:
            return False
        self._wait_to_load()
        return True

    def _wait_to_load(self) -> None:
        again_s = self._config.reload_s
        self._load_after_s = None if again_s is None else self._clock.now_s() + again_s

    def _lose(self, why: str, kind: str = "") -> None:
        self._slot.lose(why)
        self._say(why, kind)

    def _say(self, why: str, kind: str = "") -> None:
        """Log a problem once, not with every look; `kind` where its words may vary."""
        if (kind or why) != self._said:
            self._said = kind or why
            log.warning("no detections of camera %s: %s", self._config.sensor_id, why)
