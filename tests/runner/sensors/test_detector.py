"""A continuous detector, over the sidecar's wire, in the world state of a robot: fresh, too old,
evicted, back. The model is the test's; time moves only when told.
"""

from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.runner.manual_clock import ManualClock
from tests.runner.small_robots import FedCamera, Twin, twin_runner
from tests.support.serving import answering
from vram_arbiter.clients.net.server import RouterServer
from vram_arbiter.clients.sidecar.perception import DetectorClient
from vram_arbiter.runner.robots.hardware import HardwareRunner
from vram_arbiter.runner.sensors.detections import DetectionSlot
from vram_arbiter.runner.sensors.detector import ContinuousDetector
from vram_arbiter.schemas.config.robot import DetectorConfig
from vram_arbiter.schemas.errors import Evicted, ModelError
from vram_arbiter.sidecars.wires import Wire, unread_reply

pytestmark = [pytest.mark.anyio, pytest.mark.heavy]  # pictures need numpy

PERIOD_S, RELOAD_S = 0.5, 10.0


class Model:
    """What a sidecar's host says, as `sidecars.wires` asks it."""

    model_ops = frozenset({"detect"})

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        self.tokens = 0
        self.resident = self.standby = False
        self.takes_s = 0.0
        self.label = "red cube"
        self.breaks = False
        self.faults = 0
        self.loads: list[float | None] = []
        self.asked: list[tuple[str, float]] = []

    def identity(self) -> dict[str, Any]:
        state = "resident" if self.resident else "unloaded"
        token = [1, self.tokens] if self.resident else None
        return {"ok": True, "model": "m", "state": state, "token": token, "standby": self.standby}

    def come_back(self) -> None:
        self.resident, self.tokens = True, self.tokens + 1

    async def load(self, timeout_s: float | None) -> dict[str, Any]:
        self.loads.append(timeout_s)
        self.come_back()
        return {"ok": True, "lease_id": "l", "token": [1, self.tokens], "loaded": True}

    async def run(self, name: str, call: Any, message: dict[str, Any]) -> dict[str, Any]:
        if call.token is None or tuple(call.token) != (1, self.tokens) or not self.resident:
            raise Evicted("another token")
        if self.breaks:
            self.faults += 1
            raise ModelError(f"no memory left, the {self.faults}. time")
        self.asked.append((call.query, call.fresh_s))
        self.clock.advance(self.takes_s)
        box = [1.0, 2.0, 3.0, 4.0]
        return {"ok": True, "detections": [{"label": self.label, "score": 0.9, "box": box}]}


@pytest.fixture
def model(clock: ManualClock) -> Model:
    return Model(clock)


@pytest.fixture
async def client(short_folder: Path, model: Any) -> AsyncIterator[DetectorClient]:
    endpoint = f"ipc://{short_folder}/d.sock"
    server = RouterServer(endpoint, unread_reply(model.model_ops))
    async with (
        answering(server, Wire(model, server.send).handle),
        DetectorClient(endpoint) as client,
    ):
        yield client


@pytest.fixture
def camera(clock: ManualClock) -> FedCamera:
    return FedCamera("front", clock)


@pytest.fixture
def hardware(clock: ManualClock, camera: FedCamera) -> Iterator[HardwareRunner]:
    hardware = twin_runner(
        Twin(clock), camera, clock=clock, detections=[DetectionSlot("front", 1000.0)]
    )
    hardware.activate()
    yield hardware
    hardware.deactivate()


@pytest.fixture
def detector(
    client: DetectorClient, hardware: HardwareRunner, clock: ManualClock
) -> ContinuousDetector:
    config = DetectorConfig(id="a/d", sensor_id="front", rate_hz=1 / PERIOD_S, reload_s=RELOAD_S)
    (slot,) = hardware.robot.detections
    look = hardware.robot.snapshot
    return ContinuousDetector(config, ("red cube", "ball"), client, look, slot, clock)


def detections_of(hardware: HardwareRunner) -> tuple[list[str], str]:
    """What a tick sees: labels, and the diagnostics of the detector."""
    hardware.tick()
    labels = [one.label for one in hardware.world.detected_objects]
    return labels, hardware.world.diagnostics["detector:front"]


async def test_detections_are_in_the_world_state_until_old(
    detector: ContinuousDetector, hardware: HardwareRunner, model: Model, clock: ManualClock
) -> None:
    assert detections_of(hardware) == ([], "stale")  # it has not looked yet
    await detector.look()
    assert detections_of(hardware) == (["red cube"], "ok")
    (cube,) = hardware.world.detected_objects
    assert (cube.box, cube.sensor_id, cube.confidence) == ((1.0, 2.0, 3.0, 4.0), "front", 0.9)
    assert cube.stamp_ns == clock.now_ns()  # when its picture was taken
    ((query, fresh_s),) = model.asked
    assert query == "red cube</c>ball"
    assert 0 < fresh_s <= 1.0  # a picture that waits too long is not looked at
    clock.advance(1.0)
    assert detections_of(hardware) == (["red cube"], "ok")
    clock.advance(0.1)
    assert [detections_of(hardware), detections_of(hardware)] == [([], "stale")] * 2
    assert hardware.result().metadata["detectors"] == {
        "front": {"looks": 1, "stale": 1, "withdrawn": 0}
    }


async def test_a_late_answer_and_a_camera_without_pictures_are_no_detections(
    detector: ContinuousDetector,
    hardware: HardwareRunner,
    model: Model,
    clock: ManualClock,
    camera: FedCamera,
) -> None:
    model.takes_s = 1.5
    await detector.look()
    assert detections_of(hardware) == ([], "stale")
    model.takes_s = 0.0
    await detector.look()
    camera.always = False
    clock.advance(0.9)
    await detector.look()  # the camera shows nothing new; the last look is still good
    assert detections_of(hardware) == (["red cube"], "ok")
    clock.advance(0.2)
    await detector.look()
    assert detections_of(hardware) == ([], "stale")
    (slot,) = hardware.robot.detections
    assert "camera front" in slot.why
    assert slot.facts() == {"looks": 3, "stale": 2, "withdrawn": 0}


async def test_an_evicted_model_sees_nothing_and_is_not_brought_back_from_standby(
    detector: ContinuousDetector, hardware: HardwareRunner, model: Model, clock: ManualClock
) -> None:
    await detector.look()
    model.resident, model.standby = False, True
    await detector.look()
    # at once, though the last look was young enough
    assert detections_of(hardware) == ([], "stale")
    (slot,) = hardware.robot.detections
    assert "evicted" in slot.why
    clock.advance(10 * RELOAD_S)
    await detector.look()
    assert len(model.loads) == 1
    model.come_back()
    await detector.look()
    assert detections_of(hardware) == (["red cube"], "ok")
    assert slot.facts() == {"looks": 2, "stale": 0, "withdrawn": 1}
    model.standby = False  # an eviction that ends its lease: it is loaded again, but not at once
    model.resident = False
    await detector.look()
    clock.advance(RELOAD_S / 2)
    await detector.look()
    assert (detections_of(hardware), len(model.loads)) == (([], "stale"), 1)
    clock.advance(RELOAD_S / 2)
    await detector.look()
    assert (detections_of(hardware), len(model.loads)) == ((["red cube"], "ok"), 2)


@pytest.mark.parametrize("fault", ["breaks", "an answer that is none", "its server is gone"])
async def test_a_detector_that_fails_is_absent_and_comes_back(
    detector: ContinuousDetector,
    hardware: HardwareRunner,
    model: Model,
    fault: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Also a regression: a problem whose words vary was logged with every look."""
    await detector.look()
    caplog.clear()
    model.breaks = fault == "breaks"
    if fault == "an answer that is none":
        model.label = ""
    elif fault == "its server is gone":
        model.tokens += 1  # a new process: the old token is none of its own
    for _ in range(3 if fault == "breaks" else 1):
        await detector.look()
        assert detections_of(hardware) == ([], "stale")
    assert sum("no detections" in line for line in caplog.messages) == 1
    model.breaks, model.label = False, "ball"
    await detector.look()
    assert detections_of(hardware) == (["ball"], "ok")
