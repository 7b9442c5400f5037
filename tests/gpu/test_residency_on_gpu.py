"""Residencies on a GPU: two sidecars take turns on a budget, each from host RAM, and leave nothing."""

import json

import pytest

from tests.gpu.conftest import NF4, TOLERANCE_BYTES, Machine, back, threads
from tests.gpu.weights_model import LAYER_BYTES
from tests.support.process import vramctl
from tests.support.waiting import until

pytestmark = [pytest.mark.heavy, pytest.mark.e2e]


def test_two_models_take_turns_and_leave_nothing(machine: Machine) -> None:
    """Each is granted 60 % of the GPU, so one leaves for the other: every byte of its process is
    gone, the context too. Its weights come back from host RAM unchanged, at the speed of a copy."""
    before = machine.used()
    share = str(machine.budget() * 6 // 10)
    flags = ("--footprint", f"{share},{share},0", "--min-residency-s", "0")
    first, second = machine.start("first", *flags), machine.start("second", *flags)
    answers = {model.log: model.detect() for model in (first, second)}
    assert second.pid is not None
    for _ in range(2):
        for model, other in ((first, second), (second, first)):
            left = other.pid
            assert left is not None
            assert machine.bytes_of(left) >= machine.weights_bytes
            assert machine.has_context(left), "the check below can fail"
            for fork in (*model.forks, *other.forks):
                assert not machine.has_context(fork), "a context does not survive a fork"
                assert threads(fork) == 1, "nor do locks that other threads hold"
            assert model.detect() == answers[model.log]
            assert other.pid is None
            assert machine.bytes_of(left) == 0
    copies = json.loads(second.detect("copies"))
    said = vramctl("evict", "second", "-r", "test", environ=machine.arbiter.environ)
    assert said.returncode == 0, said.stderr
    until(lambda: second.pid is None)
    assert back(machine, before)
    verdicts = until(lambda: six_verdicts(machine))
    assert verdicts == ["verified"] * 6
    assert copies["bytes"] == machine.weights_bytes
    if machine.kind == "cuda":
        speed = {name: copies["bytes"] / copies[name] / 1e9 for name in copies if name != "bytes"}
        print("GB/s:", {name.removesuffix("_s"): round(rate, 1) for name, rate in speed.items()})
        assert copies["restore_s"] <= 2 * copies["plain_s"], copies


def test_nf4_on_the_gpu(machine: Machine) -> None:
    """Quantized in host RAM: a quarter of float16 and its statistics are on the GPU, and the answer
    is that of the same weights on the CPU."""
    size = machine.weights_bytes // 8
    model = machine.start("packed", "--footprint", f"{size},{size},0", quantization=NF4)
    answer = float(model.detect())
    pid = model.pid
    assert pid is not None
    with_context = machine.bytes_of(pid)
    whole = machine.weights_bytes // LAYER_BYTES * LAYER_BYTES
    packed = json.loads(model.detect("copies"))["bytes"]
    assert packed == whole // 8, "4 of 32 bits, beside statistics that are no parameters"
    assert answer == pytest.approx(float(model.detect("reference")), rel=1e-3)
    if machine.kind == "cuda":
        context = with_context - packed
        assert 0 < context < 1024 * 2**20 + TOLERANCE_BYTES, "a context, statistics and workspaces"


def six_verdicts(machine: Machine) -> list[str] | None:
    environ = machine.arbiter.environ
    said = vramctl("history", "--kind", "verified", "--json", environ=environ)
    found = [event["verdict"] for event in json.loads(said.stdout)["events"]]
    return found if len(found) >= 6 else None
