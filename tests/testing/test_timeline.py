"""Consumers on a private daemon, and assertions on what happened: they hold, or name the lines that
prove the opposite."""

import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.process import ArbiterProcess
from vram_arbiter.schemas.fakegpu import SimulatedOutOfMemory
from vram_arbiter.testing.consumer import Consumer
from vram_arbiter.testing.gpu import FakeGpu
from vram_arbiter.testing.stand_in import hold
from vram_arbiter.testing.timeline import Timeline
from vram_arbiter.testing.waiting import eventually

pytestmark = [pytest.mark.e2e, pytest.mark.gpu_budget("8GiB", lag="50ms")]
Start = Callable[..., Consumer]


def print_and_end(word: str, *, code: int) -> None:
    print(word)
    sys.exit(code)


def test_two_consumers_take_turns(consumer: Start, timeline: Timeline) -> None:
    detector = consumer("detector", hold, "detector", "5GiB", min_residency_s=0.0)
    detector.reached("held")
    assert (detector.lease is not None, detector.state) == (True, "held")
    policy = consumer("policy", hold, "policy", "4GiB")
    policy.reached("held")
    assert detector.state == "gone"
    timeline.no_overcommit()
    timeline.granted_before("detector", "policy")
    timeline.evicted_once("detector")
    with pytest.raises(AssertionError) as raised:
        timeline.granted_before("policy", "detector")
    problem, *grants = str(raised.value).splitlines()
    assert problem == "policy was not granted before detector"
    assert [line.split()[4] for line in grants] == ["detector", "policy"]
    with pytest.raises(AssertionError, match=r"^policy was evicted 0 times, not once$"):
        timeline.evicted_once("policy")
    assert [policy.wait(), detector.stop()] == [0, -15]
    with pytest.raises(AssertionError, match=r"evicted 0 times.*\n#.* released "):
        timeline.evicted_once("policy")


def test_a_withdrawn_revoke_is_no_eviction(consumer: Start, timeline: Timeline) -> None:
    detector = consumer("detector", hold, "detector", "5GiB", min_residency_s=0.0)
    detector.reached("held")
    detector.tell("use")
    eventually(lambda: timeline.events("use_began"))
    policy = consumer("policy", hold, "policy", "4GiB")
    detector.reached("revoking")
    policy.stop(signal.SIGKILL)
    policy.reached("gone")
    detector.reached("held")
    with pytest.raises(AssertionError, match=r"evicted 0 times.*\n#.*\n#.* revoke_withdrawn "):
        timeline.evicted_once("detector")


def test_a_refused_allocation_is_an_overcommit(fake_gpu: FakeGpu, timeline: Timeline) -> None:
    with fake_gpu.stowaway(), pytest.raises(SimulatedOutOfMemory):
        fake_gpu.allocate("1GiB")
    with pytest.raises(
        AssertionError, match=r"^a GPU was overcommitted\nfakegpu/log.jsonl:2  .*oom"
    ):
        timeline.no_overcommit()
    assert "alloc 8 GiB by stowaway" in timeline.text()


def test_a_timeline_without_a_daemon_says_so(arbiter: ArbiterProcess, timeline: Timeline) -> None:
    arbiter.kill()
    assert "no history: " in timeline.text()


def test_a_consumer_that_ends_early_shows_its_output(consumer: Start) -> None:
    ended = consumer("eager", print_and_end, "no weights", code=3)
    with pytest.raises(RuntimeError, match=r"eager ended with 3 before .* held:\nno weights"):
        ended.reached("held")


def test_only_what_can_be_called_elsewhere_is_a_consumer(consumer: Start) -> None:
    with pytest.raises(TypeError, match=r"at the top level of a file, got .*<lambda>"):
        consumer("odd", lambda: None)


def test_a_program_finds_what_the_test_can_import(
    consumer: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: a project that is not installed is on the path of its tests alone (`pythonpath`
    in their configuration), and `python -m` of its own module ended at once."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "not_installed.py").write_text("print('found')")
    program = consumer("program", [sys.executable, "-m", "not_installed"])
    assert (program.wait(), program.output) == (0, "found\n")


def test_what_a_consumer_started_ends_with_it(consumer: Start) -> None:
    shell = consumer("shell", ["sh", "-c", "sleep 600 & echo $!; wait"])
    pid = int(eventually(lambda: shell.output))
    shell.close()
    eventually(lambda: not _lives(pid))


def _lives(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False
