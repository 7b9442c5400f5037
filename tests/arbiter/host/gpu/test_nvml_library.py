"""The NVML reader through the real `pynvml` and a compiled library: structs, versions, N/A fields
and error codes as they really arrive."""

import os
import textwrap
from typing import Any

import pytest

from tests.arbiter.host.gpu.conftest import answer_of_child
from tests.support.nvml_stub import GIB, MIB, NvmlStub

pytest.importorskip("pynvml")
READ = """
    from vram_arbiter.arbiter.host.gpu.nvml import NvmlProbe
    probe = NvmlProbe()
    gpus = probe.gpus()
    reading = probe.sample(gpus[0].id)
    print(json.dumps({
        "gpus": [[c.id, c.index, c.name, c.total_bytes] for c in gpus],
        "used": reading.used_bytes,
        "total": reading.total_bytes,
        "processes": reading.processes and [
            [found.process.pid, found.process.start_ticks, found.used_bytes]
            for found in reading.processes
        ],
    }))
"""
ALL = """
    from vram_arbiter.arbiter.host.gpu.nvml import NvmlProbe
    probe = NvmlProbe()
    print(json.dumps([
        [gpu.index, gpu.id, gpu.name, gpu.total_bytes, reading.used_bytes, reading.processes and [
            [found.process.pid, found.used_bytes] for found in reading.processes
        ]]
        for gpu in probe.gpus()
        for reading in [probe.sample(gpu.id)]
    ]))
"""
SENSORS = """
    from dataclasses import astuple
    from vram_arbiter.arbiter.host.gpu.nvml import NvmlProbe
    probe = NvmlProbe()
    print(json.dumps([astuple(probe.sensors(gpu.id)) for gpu in probe.gpus()]))
"""
PROGRAMS = """
    from vram_arbiter.clients.calibration.gpu import open_gpu
    from vram_arbiter.clients.cli.doctor.machine import ask_nvml
    from vram_arbiter.sidecars.device.capacity import capacities
    second = open_gpu("cuda:1", {})
    print(json.dumps([
        capacities("cuda", {}),
        capacities("cuda", {"CUDA_VISIBLE_DEVICES": "MIG-stub-2"}),
        [second.environ["CUDA_VISIBLE_DEVICES"], second.read().used_bytes],
        ask_nvml().gpus,
    ]))
"""
OWN = """
    from opentelemetry.sdk.metrics import MeterProvider
    from opentelemetry.exporter.prometheus import PrometheusMetricReader
    from opentelemetry import metrics
    from prometheus_client import CollectorRegistry, generate_latest
    from vram_arbiter.runner import gpu_memory
    registry = CollectorRegistry()
    reader = PrometheusMetricReader(scope_info_enabled=False, registry=registry)
    metrics.set_meter_provider(MeterProvider([reader]))
    gpu_memory.observe_gpu()
    said = []
    for mine in (0, 300):
        with open(os.environ["NVML_STUB"], "a") as control:
            control.write(f"process 0 graphics {os.getpid()} {mine}\\n" if mine else "")
        said.append(generate_latest(registry).decode())
    print(json.dumps(said))
"""
REFUSED = """
    from vram_arbiter.arbiter.host.gpu.nvml import NvmlProbe
    from vram_arbiter.schemas.errors import VramError
    try:
        NvmlProbe().gpus()
    except VramError as error:
        print(json.dumps([type(error).__name__, error.message, error.hint]))
"""
LOST = """
    from vram_arbiter.arbiter.host.gpu.nvml import NvmlProbe
    from vram_arbiter.schemas.errors import ProbeFailed
    probe = NvmlProbe()
    gpu = probe.gpus()[0].id
    said = []
    for line in sys.stdin:
        with open(os.environ["NVML_STUB"], "w") as control:
            control.write(line.replace(";", "\\n"))
        try:
            said.append(probe.sample(gpu).used_bytes)
        except ProbeFailed as error:
            said.append(error.message)
    print(json.dumps(said))
"""


def answer_of(stub: NvmlStub, code: str, text: str = "") -> Any:
    """Return what `code` prints with the stub's library."""
    code = "import json, os, sys\n" + textwrap.dedent(code)
    return answer_of_child(code, environ=stub.environ, text=text)


def test_memory_v2_leaves_the_drivers_reserve_out(nvml: NvmlStub) -> None:
    nvml.gpus = [
        f"gpu GPU-stub-b {8 * GIB} {256 * MIB} {GIB}",
        f"gpu GPU-stub-a {24 * GIB} {512 * MIB} 0",
    ]
    nvml.write()
    said = answer_of(nvml, READ)
    assert said["gpus"] == [
        ["GPU-stub-b", 0, "NVIDIA Stub", 8 * GIB - 256 * MIB],
        ["GPU-stub-a", 1, "NVIDIA Stub", 24 * GIB - 512 * MIB],
    ]
    assert (said["used"], said["total"], said["processes"]) == (GIB, 8 * GIB - 256 * MIB, [])


@pytest.mark.parametrize("code", [13, 3], ids=["FUNCTION_NOT_FOUND", "NOT_SUPPORTED"])
def test_a_driver_without_memory_v2_counts_its_reserve_as_used(nvml: NvmlStub, code: int) -> None:
    nvml.gpu(GIB)
    nvml.write(f"error memory_v2 {code}")
    said = answer_of(nvml, READ)
    assert (said["used"], said["total"]) == (GIB + 256 * MIB, 8 * GIB)


def test_process_lists_come_with_na_as_unknown_and_both_kinds_counted_once(nvml: NvmlStub) -> None:
    me = os.getpid()
    nvml.gpu(3 * GIB)
    nvml.write(
        f"process 0 compute {me} {2 * GIB}",
        f"process 0 graphics {me} {2 * GIB}",
        "process 0 compute 4194301 na",
        "process 0 graphics 4194302 7",
    )
    mine, unknown, other = answer_of(nvml, READ)["processes"]
    assert (mine[0], mine[2]) == (me, 2 * GIB)
    assert mine[1] > 0, "seen from here: with its start time"
    assert unknown == [4194301, 0, None], "all ones is N/A, not 16 EiB"
    assert other == [4194302, 0, 7]


def test_a_list_that_is_refused_leaves_the_total_as_truth(nvml: NvmlStub) -> None:
    nvml.gpu(GIB)
    nvml.write("error compute 3")
    said = answer_of(nvml, READ)
    assert (said["used"], said["processes"]) == (GIB, None)


TWO_IN_ONE = [f"instance 0 {place} 5 MIG-{place} {GIB} 0 0" for place in range(2)]


@pytest.mark.parametrize(
    ("more", "lines", "error", "words"),
    [
        ("", ["error init 9"], "NoGpu", "Driver Not Loaded"),
        ("", ["error memory 15"], "ProbeFailed", "GPU is lost"),
        ("", ["error memory 999"], "ProbeFailed", "Unknown Error"),
        ("", ["error count 999"], "NoGpu", "cannot list its GPUs"),
        ("mig", [], "NoGpu", "in MIG mode no instance"),
        ("mig", TWO_IN_ONE, "ConfigError", "instance 5 of GPU 0 has several compute instances"),
    ],
)
def test_what_cannot_be_served_is_a_typed_error(
    nvml: NvmlStub, more: str, lines: list[str], error: str, words: str
) -> None:
    nvml.gpu(0, more=more)
    nvml.write(*lines)
    name, message, hint = answer_of(nvml, REFUSED)
    assert (name, words in message) == (error, True), message
    assert hint


def test_no_gpu_at_all(nvml: NvmlStub) -> None:
    nvml.gpus = []
    nvml.write()
    assert answer_of(nvml, REFUSED)[0] == "NoGpu"


def test_a_gpu_that_was_lost_is_read_again_after_the_driver_came_back(nvml: NvmlStub) -> None:
    """Every GPU failed, so everything is opened anew; a driver that is away meanwhile is one more
    failed reading."""
    gpu = f"gpu GPU-stub-0 {8 * GIB} 0"
    said = answer_of(
        nvml,
        LOST,
        f"{gpu} 1\n{gpu} 2;error memory 15\n{gpu} 3;error init 9\ngpu GPU-other {GIB} 0 "
        f"4\n{gpu} 5\n{gpu} 6\n",
    )
    assert said[0] == 1
    assert "GPU is lost" in said[1]
    assert "Driver Not Loaded" in said[2]
    assert "no longer lists GPU-stub-0" in said[3]
    assert said[4:] == [5, 6]


def test_instances_stand_in_the_place_of_their_gpu(nvml: NvmlStub) -> None:
    """Name, memory and processes are those of the instance. Of a process whose instance the driver
    does not tell it is unknown where it runs, not that it runs nowhere."""
    nvml.instances(GIB, 2 * GIB)
    nvml.gpus += [f"gpu GPU-stub-b {24 * GIB} 0 3"]
    total, name = 4 * GIB - 64 * MIB, "NVIDIA Stub MIG 1g.4gb"
    where = [
        "process 0 compute 4194301 5 inf 1",
        "process 0 compute 4194302 na inf 2",
        "process 0 graphics 4194302 7 inf 2",
        "process 1 compute 4194303 3",
    ]
    nvml.write(*where)
    assert answer_of(nvml, ALL) == [
        [0, "MIG-stub-1", name, total, GIB, [[4194301, 5]]],
        [1, "MIG-stub-2", name, total, 2 * GIB, [[4194302, 7]]],
        [2, "GPU-stub-b", "NVIDIA Stub", 24 * GIB, 3, [[4194303, 3]]],
    ]
    nvml.write(*where, "process 0 compute 4194304 9")
    assert [gpu[-1] for gpu in answer_of(nvml, ALL)] == [None, None, [[4194303, 3]]]


def test_an_instance_that_was_made_anew_is_unknown(nvml: NvmlStub) -> None:
    """NVML may use the handle of a destroyed instance for another one."""
    gpu = f"gpu GPU-stub-0 {8 * GIB} 0 0 mig"
    former, other = (f"{gpu};instance 0 0 1 MIG-{name} {GIB} 0" for name in ("a", "b"))
    nvml.gpus = [*f"{former} 1".split(";")]
    nvml.write()
    said = answer_of(nvml, LOST, f"{former} 2\n{other} 3\n{other} 4\n{former} 5\n")
    assert (said[0], said[3]) == (2, 5)
    assert said[1] == "MIG-a is gone, MIG-b is in its place"
    assert "no longer lists MIG-a" in said[2]


def test_sensors_are_those_of_the_board(nvml: NvmlStub) -> None:
    """A GPU without them is none the worse for it, and an instance is not its GPU."""
    nvml.gpus += [f"gpu GPU-stub-1 {GIB} 0 0", f"gpu GPU-stub-2 {GIB} 0 0 mig"]
    nvml.write(f"instance 2 0 1 MIG-1 {GIB} 0 0", "sensors 0 87 64 215400", "sensors 2 5 50 60000")
    unknown = [None, None, None]
    assert answer_of(nvml, SENSORS) == [[0.87, 64.0, 215.4], unknown, unknown]
    nvml.write("sensors 0 87 64 215400", "error sensors 15")
    assert answer_of(nvml, SENSORS) == [unknown, unknown]


def test_programs_take_instances_for_gpus(nvml: NvmlStub) -> None:
    nvml.instances(GIB, 2 * GIB)
    nvml.write()
    of_all, of_named, second, counted = answer_of(nvml, PROGRAMS)
    assert of_all == {"MIG-stub-1": 4 * GIB, "MIG-stub-2": 4 * GIB}
    assert of_named == {"MIG-stub-2": 4 * GIB}
    assert second == ["MIG-stub-2", 2 * GIB + 64 * MIB]
    assert counted == 2


def test_a_program_shows_what_it_holds_itself(nvml: NvmlStub) -> None:
    """As the runner's dashboard names it."""
    pytest.importorskip("prometheus_client", reason="the extra `telemetry`")
    from tests.support import promql

    idle, rendering = (promql.scrape(page) for page in answer_of(nvml, OWN))
    (drawn,) = (
        expression
        for text, expression in promql.panels("runner.json").items()
        if "gpu_memory_usage" in text
    )
    (selector,) = promql.selectors(drawn)
    labels = frozenset({("vram_gpu", "GPU-stub-0")})
    assert promql.matched(selector, idle) == {labels: 0.0}
    assert promql.matched(selector, rendering) == {labels: 300.0}
