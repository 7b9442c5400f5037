"""Residencies on a GPU: sidecars take turns on a budget, come from host RAM and leave nothing."""

import json
import os
import signal

import pytest

from tests.gpu.conftest import GIB, NF4, Machine, Model, back
from tests.gpu.weights_model import LAYER_BYTES
from tests.support.process import vramctl
from tests.support.processes import threads
from tests.support.waiting import until

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.nightly]


def test_two_models_take_turns_and_leave_nothing(machine: Machine) -> None:
    """Each is granted 60 % of the GPU, so one leaves for the other: every byte of its process is
    gone, the context too. Its weights come back from host RAM unchanged, at the speed of a copy."""
    before = machine.used()
    share = str(machine.budget() * 6 // 10)
    # the last figure: what is charged while resident, also where fewer bytes are measured
    flags = ("--footprint", f"{share},{share},0,{share}", "--min-residency-s", "0")
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
    evict_in_the_middle(machine, second, answers[second.log])
    assert back(machine, before)
    verdicts = until(lambda: six_verdicts(machine))
    assert verdicts == ["verified"] * 6
    assert copies["bytes"] == machine.weights_bytes
    if machine.kind == "cuda":
        speed = {name: copies["bytes"] / copies[name] / 1e9 for name in copies if name != "bytes"}
        print("GB/s:", {name.removesuffix("_s"): round(rate, 1) for name, rate in speed.items()})
        assert copies["restore_s"] <= 2 * copies["plain_s"], copies


def test_nf4_comes_back_the_same_after_every_death(machine: Machine) -> None:
    """Quantized in host RAM: an eighth of float32 and its statistics are on the GPU, and the answer
    is that of the same weights on the CPU, also after the model's process, or the keeper of its
    weights, was killed."""
    before = machine.used()
    size = machine.weights_bytes // 8
    model = machine.start("packed", "--footprint", f"{size},{size},0", quantization=NF4)
    answer = model.detect()
    pid = model.pid
    assert pid is not None
    in_use = machine.bytes_of(pid)
    packed = json.loads(model.detect("copies"))["bytes"]
    assert packed == machine.weights_bytes // LAYER_BYTES * LAYER_BYTES // 8
    if machine.kind == "cuda":
        assert packed < in_use < packed + GIB, "with a context, statistics and workspaces"
    assert float(answer) == pytest.approx(float(model.detect("reference")), rel=1e-3)
    keeper = model.forks[1]
    for victim in (pid, keeper):
        os.kill(victim, signal.SIGKILL)
        until(lambda: model.state() == "unloaded")
        assert back(machine, before)
        assert model.detect() == answer
    assert model.forks[1] != keeper


def evict_in_the_middle(machine: Machine, model: Model, answer: str) -> None:
    """Revoke a model that works: it answers `ping` meanwhile, ends its work, then leaves."""
    go = machine.arbiter.runtime / "go"
    request = model.send_detect(f"hold {go}")
    until(go.with_suffix(".held").exists)
    said = vramctl("evict", "second", "-r", "test", environ=machine.arbiter.environ)
    assert said.returncode == 0, said.stderr
    until(lambda: machine.lease_state("second") == "revoking")
    assert model.state() == "resident"
    assert model.pid is not None
    go.touch()
    assert model.result(request)["answer"] == answer
    until(lambda: model.pid is None)


def six_verdicts(machine: Machine) -> list[str] | None:
    environ = machine.arbiter.environ
    said = vramctl("history", "--kind", "verified", "--json", environ=environ)
    found = [event["verdict"] for event in json.loads(said.stdout)["events"]]
    return found if len(found) >= 6 else None
