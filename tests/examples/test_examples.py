"""Each program of `examples/` against a real daemon with a simulated GPU."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.support.boxes import Boxes
from tests.support.prepared import run
from tests.support.process import ArbiterProcess, Finished
from tests.support.running import running
from vram_arbiter import Client

pytestmark = pytest.mark.e2e

EXAMPLES = Path(__file__).parents[2] / "examples"
LIMIT_S = 120.0


def environ(daemon: ArbiterProcess) -> dict[str, str]:
    return {**daemon.environ, "VRAM_ARBITER_ENDPOINT": daemon.endpoint}


def example(daemon: ArbiterProcess, name: str, *arguments: str) -> Finished:
    return run("script", [str(EXAMPLES / name), *arguments], environ(daemon), LIMIT_S)


def said_by(daemon: ArbiterProcess, name: str, *arguments: str) -> str:
    """Return what an example prints; it must end well and warn of nothing."""
    done = example(daemon, name, *arguments)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    return done.stdout


def event_kinds(daemon: ArbiterProcess, consumer: str | None = None) -> list[str]:
    """Kinds of the history events of a consumer, or of all, in order."""
    with Client("test", endpoint=daemon.endpoint) as arbiter:
        events = arbiter.history().events
    return [event["kind"] for event in events if consumer in (None, event.get("consumer"))]


def in_order(wanted: Sequence[str], said: Sequence[str]) -> bool:
    rest = iter(said)
    return all(word in rest for word in wanted)


def test_every_example_has_a_test() -> None:
    programs = {path.name for path in EXAMPLES.iterdir() if path.is_file()}
    assert programs == set(re.findall(r'"(\w+\.(?:py|pl))"', Path(__file__).read_text()))


def test_a_consumer(arbiter_daemon: ArbiterProcess) -> None:
    said = said_by(arbiter_daemon, "consumer.py").splitlines()
    assert said[0].startswith("detecting on GPU-")
    assert said[1] == "released: gone, 0 weights left"
    story = ["granted", "ready", "use_began", "use_ended", "released"]
    assert in_order(story, event_kinds(arbiter_daemon, "detector"))


def test_two_models_take_turns(arbiter_daemon: ArbiterProcess) -> None:
    said = said_by(arbiter_daemon, "taking_turns.py").splitlines()
    loaded: list[str] = []
    for line in said:
        model, what = line.split(": ")
        match what:
            case "load":
                assert not loaded, f"{model} was loaded beside {loaded}"
                loaded.append(model)
            case "unload":
                loaded.remove(model)
            case _:
                assert loaded == [model], f"{line}, but {loaded} is loaded"
    assert loaded == []
    jobs = sorted(line for line in said if "job" in line)
    assert jobs == [f"{model}: job {job}" for model in ("detector", "policy") for job in range(3)]


def test_standby(arbiter_daemon: ArbiterProcess) -> None:
    assert said_by(arbiter_daemon, "standby.py").splitlines() == [
        "detector: loaded",
        "detector: unloaded",
        "training is loading, detector is standby",
        "detector: loaded",
        "detector is held again, with 1 weights",
        "detector: unloaded",
    ]


def test_a_wrapped_program_runs_to_its_end(arbiter_daemon: ArbiterProcess) -> None:
    said = said_by(arbiter_daemon, "wrap_program.py", "5GB", "sh", "-c", "echo working")
    assert said == "working\n"
    assert in_order(["granted", "ready", "released"], event_kinds(arbiter_daemon, "sh"))


def test_wrapping_nothing_says_how(arbiter_daemon: ArbiterProcess) -> None:
    """Without arguments it ended in an IndexError."""
    for arguments in ([], ["5GB"]):
        done = example(arbiter_daemon, "wrap_program.py", *arguments)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith("usage: wrap_program.py VRAM PROGRAM")


def test_a_wrapped_program_is_ended_for_another(arbiter_daemon: ArbiterProcess) -> None:
    program = [str(EXAMPLES / "wrap_program.py"), "5GB", "sh", "-c", "echo up; exec sleep 600"]
    with running("script", program, environ(arbiter_daemon)) as wrapper:
        assert wrapper.line() == "up"
        with Client("detector", endpoint=arbiter_daemon.endpoint) as arbiter:
            arbiter.acquire(wait_timeout_s=LIMIT_S, vram="5GB").release()
        assert wrapper.line().startswith("the room is needed")
        assert wrapper.ended() == 128 + 15


@pytest.mark.skipif(shutil.which("perl") is None, reason="Perl is not installed")
def test_a_client_in_another_language(arbiter_daemon: ArbiterProcess) -> None:
    done = subprocess.run(
        ["perl", str(EXAMPLES / "raw_wire.pl")],
        env=environ(arbiter_daemon), capture_output=True, text=True, timeout=LIMIT_S,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    said = done.stdout.splitlines()
    assert said[0].startswith("granted L")
    assert said[1:] == ["working", "released"]
    story = ["granted", "ready", "use_began", "use_ended", "released"]
    assert in_order(story, event_kinds(arbiter_daemon, "sorter"))


@pytest.mark.nightly
def test_a_fleet(short_folder: Path, tmp_path: Path) -> None:
    program = [sys.executable, str(EXAMPLES / "fleet.py"), str(tmp_path / "out")]
    said = []
    with Boxes(short_folder, nodes=1) as boxes:
        for _ in range(2):
            done = subprocess.run(
                program, env=os.environ | {"RAY_ADDRESS": boxes.address},
                capture_output=True, text=True, timeout=LIMIT_S, check=False,
            )  # fmt: skip
            assert done.returncode == 0, done.stderr
            said.append(done.stdout.splitlines())
        told = event_kinds(boxes.nodes[0].daemon)
    assert sorted(line.partition(",")[0] for line in said[0]) == [
        f"episode {seed}: {seed % 3 > 0}" for seed in range(6)
    ]
    assert all("weights on GPU-fake-" in line for line in said[0])
    assert said[1] == []
    assert in_order(["granted", "ready", "use_began", "use_ended"], told)
