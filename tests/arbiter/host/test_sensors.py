"""Sensors of GPUs: read beside everything else, and shown only while they are new. The thread is
real, the probe is scripted."""

import queue
from dataclasses import dataclass, field

import pytest

from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.arbiter.host.gpu.probe import GpuDevice, Reading
from vram_arbiter.arbiter.host.sensors import KEPT_S, PERIOD_S, SensorReader
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.views import SensorsView

GPU = GpuId("GPU-1")
WARM, HOT = SensorsView(0.1, 50.0, 60.0), SensorsView(0.9, 80.0, 200.0)


@dataclass
class Sensors:
    """A probe whose `sensors` return what is put on `answers`; a clock that stands still."""

    answers: "queue.SimpleQueue[SensorsView | Exception]" = field(default_factory=queue.SimpleQueue)
    calls: int = 0
    now: float = 100.0

    def gpus(self) -> tuple[GpuDevice, ...]:
        return (GpuDevice(GPU, 0, "scripted", 100),)

    def sample(self, gpu: GpuId) -> Reading:
        raise AssertionError("sensors read no memory")

    def sensors(self, gpu: GpuId) -> SensorsView:
        self.calls += 1
        answer = self.answers.get(timeout=PATIENCE_S)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self) -> None: ...


def test_values_are_read_once_a_second_and_shown_for_a_while() -> None:
    probe = Sensors()
    reader = SensorReader(probe, [GPU], lambda: probe.now)
    assert reader.known() == {}
    reader.ask()
    reader.ask()  # while it reads
    assert reader.known() == {}, "no answer waits for a sensor"
    probe.answers.put(WARM)
    assert until(reader.known) == {GPU: WARM}
    probe.answers.put(HOT)
    probe.now += PERIOD_S / 2
    reader.ask()
    probe.now += PERIOD_S
    assert (reader.known(), probe.calls) == ({GPU: WARM}, 1)
    reader.ask()
    until(lambda: reader.known() == {GPU: HOT})
    probe.now += KEPT_S
    assert reader.known() == {}
    reader.close()


def test_a_defect_leaves_values_unknown(caplog: pytest.LogCaptureFixture) -> None:
    probe = Sensors()
    reader = SensorReader(probe, [GPU], lambda: probe.now)
    for answer, known in ((WARM, {GPU: WARM}), (RuntimeError("a defect"), {}), (HOT, {GPU: HOT})):
        probe.now += PERIOD_S
        reader.ask()
        probe.answers.put(answer)
        until(lambda known=known: reader.known() == known)
        until(reader._idle.is_set)
    assert "a defect" in caplog.text
    reader.close()
