"""`vramctl calibrate` beside a running arbiter, of a program whose bytes are known."""

import json
import sys

import pytest

from tests.gpu.conftest import MIB, TOLERANCE_BYTES, Machine
from tests.support.process import vramctl

pytestmark = [pytest.mark.heavy, pytest.mark.e2e]

WEIGHTS, EXTRA = 600 * MIB, 300 * MIB
PROGRAM = f"""
import sys, time
from pathlib import Path
device = sys.argv[1]
if device.startswith("fake:"):
    from vram_arbiter.sidecars.device.fake import FakeMemory
    memory = FakeMemory(Path(device.removeprefix("fake:")), "program")
else:
    from vram_arbiter.sidecars.device.cuda import CudaMemory
    memory = CudaMemory()
memory.touch()
memory.allocate("weights", {WEIGHTS})
extra = memory.allocate("extra", {EXTRA})
loaded = time.monotonic()
time.sleep(0.3)  # the driver and ten readings
memory.free(extra)
memory.empty_cache()
time.sleep(3.0)  # most of its life, also where memory returns late
"""


def test_the_bytes_of_a_program(machine: Machine) -> None:
    if machine.gpu.read().processes is None:
        pytest.skip("the driver does not list bytes by process here (a container?)")
    done = vramctl(
        "calibrate", "--device", machine.gpu.device, "--json",
        "--", sys.executable, "-c", PROGRAM, machine.gpu.device, environ=machine.environ,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    found = answer["bytes"]
    # torch's own context is larger than an empty one by the kernels that it has loaded
    assert WEIGHTS <= found["steady"] <= WEIGHTS + 1536 * MIB
    assert abs(found["load_peak"] - found["steady"] - EXTRA) <= TOLERANCE_BYTES
