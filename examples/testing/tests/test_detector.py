"""The detector beside other programs on one GPU of 8 GiB, on a machine without one."""

import sys

import pytest
from bin_picker.detector import Model, serve

from vram_arbiter.testing.gpu import FakeGpu
from vram_arbiter.testing.stand_in import hold

pytestmark = pytest.mark.gpu_budget("8GiB", lag="100ms")


class SimulatedModel(Model):
    """Bytes on the simulated GPU in place of tensors."""

    def load(self) -> None:
        self.gpu = FakeGpu(name="detector")
        self.gpu.allocate("5GiB")

    def unload(self) -> None:
        self.gpu.free()


def detector() -> None:
    """The program under test, in a process of its own."""
    serve(SimulatedModel(), map(str.strip, sys.stdin))


def test_it_makes_room_and_returns_for_its_next_look(consumer, timeline, eventually):
    running = consumer("detector", detector)
    running.tell("bin 1")
    eventually(lambda: "nothing in bin 1" in running.output)
    policy = consumer("policy", hold, "policy", "4GiB", min_residency_s=0.0)
    policy.reached("held")
    timeline.evicted_once("detector")
    timeline.granted_before("detector", "policy")
    running.tell("bin 2")
    eventually(lambda: "nothing in bin 2" in running.output)
    timeline.evicted_once("policy")
    timeline.no_overcommit()


def test_it_survives_the_arbiter(arbiter, consumer, timeline, eventually):
    running = consumer("detector", detector)
    running.reached("held")
    arbiter.kill()
    arbiter.start()
    eventually(lambda: timeline.events("reattached", consumer="detector"))
    running.tell("bin 1")
    eventually(lambda: "nothing in bin 1" in running.output)


def test_it_waits_until_the_gpu_can_be_read(fake_gpu, consumer, timeline, eventually):
    with fake_gpu.edited(probe="fail"):
        eventually(lambda: timeline.events("probe_failed"))  # a reading from before may still grant
        running = consumer("detector", detector)
        running.reached("queued")
    running.reached("held")
