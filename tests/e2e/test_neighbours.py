"""What users of the neighbours complain about, where the complaint is about processes, GPUs and
what an operator is shown: a real daemon, real programs, a simulated GPU. Numbers are those of the
list of complaints; docs/explanation/neighbours.md has the answers.
"""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.children import Child
from tests.support.process import ArbiterProcess, vramctl
from tests.support.stage import GIB, LAG_S, PATIENCE_S
from tests.support.stage import Stage as OneDaemon
from tests.support.wire import WireClient
from vram_arbiter.clients.cli.replies import UNREACHABLE

pytestmark = pytest.mark.e2e
RESIDUE = GIB // 4
CONFIG = """
probe: {period_s: 0.1}
verify: {timeout_s: 5, slow_poll_s: 0.1}
revoke: {deadline_s: 0.5}
"""
GAME = """
import sys
from pathlib import Path
from vram_arbiter.sidecars.device.fake import FakeMemory
FakeMemory(Path(sys.argv[1]), "game", 0).allocate("textures", int(sys.argv[2]))
print("up", flush=True)
sys.stdin.readline()
"""


class Stage(OneDaemon):
    """Its consumers have habits."""

    def spawn(self, name: str, gib: float, **habits: Any) -> Child:
        return self.begin(name, int(gib * GIB), json.dumps(habits))

    def vramctl(self, *arguments: str) -> str:
        """Return what an operator sees, who asks again where the daemon did not answer in time."""
        for _ in range(20):
            done = vramctl(*arguments, environ=self.arbiter.environ)
            if done.returncode != UNREACHABLE:
                break
        return done.stdout + done.stderr


@pytest.fixture(scope="module")
def all_cases() -> Iterator[Stage]:
    made = Stage("neighbour", CONFIG)
    yield made
    made.close()


@pytest.fixture
def stage(all_cases: Stage) -> Iterator[Stage]:
    all_cases.watch()
    yield all_cases
    all_cases.end_case()


def asked_until(ask: Callable[[], str], word: str) -> str:
    """What an operator sees once it says so. Every answer of the program paces the questions."""
    for _ in range(60):
        if word in (said := ask()):
            return said
    raise AssertionError(f"never {word!r}: {said}")


def test_1_the_next_one_loads_when_the_memory_is_back_and_nothing_stays_failed(
    stage: Stage,
) -> None:
    """llama-swap#97: it starts too early, fails, and the failed state then stays."""
    stage.gpu.edit(release_lag_s=0.6)
    first = stage.spawn("first-1", 5)
    first.until("ready")
    second = stage.spawn("second-1", 5)
    second.until("ready")
    assert stage.used_when("second-1") == RESIDUE, (
        "nothing but the context that the first one keeps"
    )
    assert stage.event("verified", consumer="first-1")["verdict"] == "verified"
    stage.gpu.edit(release_lag_s=LAG_S)


def test_1_while_the_gpu_cannot_be_read_no_figure_of_it_is_printed(stage: Stage) -> None:
    """comfyui-mcp#2050: "1205 MB free", and 24 GB a moment later. A failed poll must print
    nothing."""
    asked_until(lambda: stage.vramctl("status"), "free 7.71 GiB")
    stage.gpu.edit(probe="fail")
    shown = asked_until(lambda: stage.vramctl("status"), "measured: unknown")
    assert "free" not in shown
    waiter = stage.spawn("waiter-1", 1)
    stage.event("queued", consumer="waiter-1")
    assert "the GPU cannot be read" in stage.vramctl("why", "waiter-1")
    stage.gpu.edit(probe="ok")
    waiter.until("ready")


def test_2_an_unload_that_does_not_unload_is_named_until_its_process_ends(stage: Stage) -> None:
    """Triton#2023, vLLM#47654, IsaacLab-Arena#670: +8358 MiB over the baseline after "cleanup"."""
    stage.gpu.edit(leak_bytes=4 * GIB)
    leaky = stage.spawn("leaky", 5)
    leaky.until("ready")
    waiter = stage.spawn("waiter-2", 5)
    leaky.until("gone")
    verdict = stage.event("verified", consumer="leaky")
    assert verdict["verdict"] == "residue"
    assert [culprit["pid"] for culprit in verdict["culprits"]] == [leaky.pid]
    assert f"residue of pid {leaky.pid}" in stage.vramctl("status")
    assert "leaky" in (why := stage.vramctl("why", "waiter-2")), why
    assert f"keeps more than its context until its process (pid {leaky.pid})" in why
    leaky.kill()
    waiter.until("ready")


def test_3_a_holder_that_is_stopping_for_ever_is_named_and_ended_by_a_person(stage: Stage) -> None:
    """ollama#7606 and others "Stopping…"; llama-swap#125, #138: only SIGKILL helped, and children
    stayed behind."""
    patient = stage.spawn("patient", 5, stuck=True)
    patient.until("ready")
    first = stage.spawn("first-3", 5)
    patient.until("unloading")
    stage.event("deadline_passed", consumer="patient")
    assert "patient" in stage.vramctl("why", "first-3")
    assert patient.alive, "by default nothing is done to what may move a robot"
    patient.kill()
    first.until("ready")
    first.kill()
    deaf = stage.spawn("deaf", 5, stuck=True, deaf=True)
    deaf.until("ready")
    second = stage.spawn("second-3", 5)
    deaf.until("unloading")
    for kind in ("term", "kill"):
        stage.vramctl("evict", "deaf", "--kill", "-r", "it hangs")
        assert stage.event("signalled", consumer="deaf", signal=kind)["reason"] == "it hangs"
    deaf.wait()
    second.until("ready")


def test_8_of_two_that_come_at_once_one_loads_after_the_other(stage: Stage) -> None:
    """vLLM#55827, ollama#13235: two loads at once mis-size each other, although both fit."""
    both = {name: stage.spawn(name, 2, slow=True) for name in ("loader-a", "loader-b")}
    first = both.pop(stage.event("granted")["consumer"])
    (second,) = both.values()
    stage.event("queued", consumer=second.name)
    first.until("loading")
    assert "is loading" in stage.vramctl("why", second.name)
    first.tell("go")
    second.until("loading")
    second.tell("go")
    second.until("ready")
    assert stage.used_when(second.name) == 2 * GIB, "the first one was there in full"


def test_11_a_game_that_starts_is_seen_named_and_makes_idle_models_leave(stage: Stage) -> None:
    """gpu-arbiter's whole purpose; Berth's stowaways; Castwright#1976: what was missing
    was a name."""
    idle = stage.spawn("idle-11", 5)
    idle.until("ready")
    with subprocess.Popen(
        [sys.executable, "-c", GAME, str(stage.arbiter.gpu_folder), str(int(2.9 * GIB))],
        env=stage.arbiter.environ, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as game:  # fmt: skip
        seen = stage.event("stowaway", pid=game.pid)
        assert (seen["name"], seen["used_bytes"]) == ("game", int(2.9 * GIB))
        assert f"stowaway pid {game.pid} game: 2.9 GiB without a lease" in stage.vramctl("status")
        idle.until("gone")
        stage.event("verified", consumer="idle-11")
        waiter = stage.spawn("waiter-11", 6)
        stage.event("queued", consumer="waiter-11")
        assert "game (holds bytes without a lease)" in stage.vramctl("why", "waiter-11")
        game.communicate("\n", PATIENCE_S)
    waiter.until("ready")


def test_12_the_running_manager_has_no_bytes_on_the_gpu_and_no_cuda_in_it(stage: Stage) -> None:
    """llama.cpp#20582, #21692: 120-550 MB of every GPU, for a router that only asked how much is
    free."""
    stage.spawn("user-12", 1).until("ready")
    maps = Path(f"/proc/{stage.arbiter.pid}/maps").read_text()
    assert not [word for word in ("libcuda", "libcudart", "libtorch", "libnvrtc") if word in maps]
    processes = stage.watcher.ask("status")["gpus"][0]["processes"]
    assert stage.arbiter.pid not in [process["pid"] for process in processes]


def test_13_a_second_authority_on_the_same_gpu_does_not_give_away_what_the_first_one_gave(
    stage: Stage,
) -> None:
    """taOS#859: two VRAM authorities. Each arbiter sees the other's holders: bytes without a lease
    of its own."""
    holder = stage.spawn("holder-13", 5)
    holder.until("ready")
    other = ArbiterProcess(
        gpu=f"fake:{stage.arbiter.gpu_folder}", config=CONFIG, prepared=True
    ).start()
    try:
        with WireClient(other.endpoint) as client:
            assert client.hello("elsewhere").acquire("elsewhere", 5 * GIB)["state"] == "queued"
            while not (seen := client.ask("status"))["gpus"][0]["stowaway_bytes"]:
                # it has just started: its first reading of the GPU may be under way
                client.receive(0.02)
            assert seen["gpus"][0]["stowaway_bytes"] == 5 * GIB
            assert [lease["state"] for lease in seen["leases"]] == ["queued"]
    finally:
        other.close()


def test_14_after_a_restart_it_is_said_who_lives_and_who_has_exited(stage: Stage) -> None:
    """Berth 0.5.1-rc.1: an engine without a lease after the daemon's restart, and nobody says
    whether its wrapper is alive."""
    silent, exits = stage.spawn("silent-14", 2), stage.spawn("exits-14", 2)
    silent.until("ready")
    exits.until("ready")
    silent.signal(signal.SIGSTOP)
    stage.arbiter.kill()
    exits.kill()
    stage.arbiter.start()
    stage.watch()
    assert f"silent-14 (pid {silent.pid}) must reattach first" in stage.vramctl("status")
    asked_until(
        lambda: stage.vramctl("history", "--kind", "lost", "-c", "exits-14"),
        f"process {exits.pid} died",
    )
    waiter = stage.spawn("waiter-14", 1)
    stage.event("queued", consumer="waiter-14")
    silent.signal(signal.SIGCONT)
    waiter.until("ready")


def test_17_a_crash_looping_load_empties_the_gpu_once(stage: Stage) -> None:
    """A supervisor starts it again at once, every time. The model that works stays, and the program
    is told the cause."""
    # after that it is refused for a minute: however slowly the rest of this goes, it is
    for _ in range(8):
        start = stage.spawn("crashes", 5, slow=True)
        start.until("loading")
        start.kill()
        stage.event("verified", consumer="crashes")
    working = stage.spawn("working", 5)
    working.until("ready")
    again = stage.spawn("crashes", 5)
    again.wait()
    assert "LoadFailing" in stage.errors.read_text()
    assert working.alive
    assert "held, idle" in stage.vramctl("status")


def test_21_whoever_was_made_to_leave_and_starts_again_at_once_does_not_get_in_between(
    stage: Stage,
) -> None:
    """OpenRAL ADR-0050: within 15 ms an autostarted node activates again and takes the memory that
    was made free."""
    detector = stage.spawn("detector-21", 5, again=True)
    detector.until("ready")
    policy = stage.spawn("policy-21", 5)
    detector.until("gone")
    detector.until("waiting")
    policy.until("ready")
    assert stage.used_when("policy-21") == RESIDUE
    detector.until("ready")
    policy.until("gone")
