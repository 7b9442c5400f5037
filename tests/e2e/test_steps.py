"""Each named step of a switch, hit by SIGKILL and by SIGSTOP then SIGCONT, in the holder, the
waiter and the daemon: what the design promises comes true each time. Real processes; every wait is
for an event.

The promise: whoever lives is served in the end; the newcomer's first byte comes after the last of
the holder's (but for a context that lives on); a use is never cut short; and afterwards nothing is
left.
"""

import json
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.support.fakegpu_check import check_log
from tests.support.forkserver import Child, ForkServer
from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient
from vram_arbiter.schemas import fakegpu

pytestmark = pytest.mark.e2e
GIB, MIB = 1 << 30, 1 << 20
SIZE, RESIDUE = 5 * GIB, 256 * MIB
LAG_S = 0.15
STEPS = ("loading", "in use", "unloading", "verifying")


@dataclass
class Stage:
    """One daemon and one fork server for all cases of this file."""

    arbiter: ArbiterProcess
    forks: ForkServer
    cases: int = 0
    children: list[Child] = field(default_factory=list)
    watcher: WireClient | None = None

    def watch(self) -> WireClient:
        """A fresh subscriber: its first events are those from now on."""
        if self.watcher is not None:
            self.watcher.close()
        self.watcher = WireClient(self.arbiter.endpoint).hello("watcher", role="observer")
        assert self.watcher.ask("subscribe")["ok"]
        return self.watcher

    def event(self, kind: str, consumer: str) -> dict[str, Any]:
        assert self.watcher is not None
        push = self.watcher.push(
            "event",
            60.0,
            where=lambda p: p["event"]["kind"] == kind and p["event"].get("consumer") == consumer,
        )
        event: dict[str, Any] = push["event"]
        return event

    def spawn(self, name: str) -> Child:
        child = self.forks.spawn(
            name, str(SIZE), str(self.arbiter.gpu_folder), str(RESIDUE), name=name
        )
        self.children.append(child)
        return child

    def restart(self) -> None:
        self.arbiter.kill()
        self.arbiter.start()
        self.watch()

    def log(self) -> str:
        return (self.arbiter.gpu_folder / fakegpu.LOG_FILE).read_text()

    def end_case(self) -> None:
        """Everybody dies; nothing of them stays with the daemon."""
        for child in self.children:
            child.close()
        self.children.clear()
        watcher = self.watch()
        while not self._clean(watcher.ask("status")):
            watcher.receive(0.02)  # the next event; the GPU is being read meanwhile

    @staticmethod
    def _clean(status: dict[str, Any]) -> bool:
        charged = status["gpus"][0]["charged_bytes"]
        return (status["phase"], status["leases"], charged) == ("serving", [], 0)


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    arbiter = ArbiterProcess(config="lease: {fence_grace_s: 1.0}\n", prepared=True).start()
    set_lag(arbiter.gpu_folder)
    forks = ForkServer(
        Path(__file__).with_name("stepper.py"), arbiter.environ, arbiter.runtime / "errors.log"
    )
    made = Stage(arbiter, forks)
    yield made
    if made.watcher is not None:
        made.watcher.close()
    forks.close()
    report = check_log(made.log())
    arbiter.close()
    assert not report.problems
    assert report.oom_events == 0
    assert report.peak_bytes <= 8 * GIB


def set_lag(gpu_folder: Path) -> None:
    path = gpu_folder / fakegpu.GPU_FILE
    config = fakegpu.parse_config(path.read_text()).model_copy(update={"release_lag_s": LAG_S})
    temporary = path.with_name(".new")
    temporary.write_text(fakegpu.dump_config(config))
    temporary.rename(path)


def reach(stage: Stage, step: str) -> tuple[Child, Child]:
    """(holder, waiter) with the holder at a step and the waiter queued behind it."""
    stage.cases += 1
    holder, waiter = f"holder{stage.cases}", f"waiter{stage.cases}"
    stage.watch()
    first = stage.spawn(holder)
    first.until("loading")
    if step == "loading":
        second = stage.spawn(waiter)
        stage.event("queued", waiter)
        return first, second
    first.tell("go")
    first.until("ready")
    if step == "in use":
        first.tell("use")
        first.until("in_use")
        second = stage.spawn(waiter)
        stage.event("revoke_asked", holder)
        return first, second
    second = stage.spawn(waiter)
    first.until("unloading")
    if step == "verifying":
        first.tell("go")
        stage.event("released", holder)
    return first, second


def strike(stage: Stage, target: Child | None, how: str) -> Callable[[], None]:
    """Kill or stop somebody (None: the daemon). Returns how what was stopped goes on."""
    if how == "kill":
        if target is None:
            stage.restart()
        else:
            target.kill()
        return lambda: None
    if target is None:
        os.kill(stage.arbiter.pid, signal.SIGSTOP)
        return lambda: os.kill(stage.arbiter.pid, signal.SIGCONT)
    target.signal(signal.SIGSTOP)
    return lambda: target.signal(signal.SIGCONT)


def bytes_beside(log: str, holder: str, newcomer: str) -> int:
    """Bytes of the holder when the newcomer put its first ones on the GPU."""
    held = 0
    for line in map(json.loads, log.splitlines()):
        if line["name"] == newcomer and line["op"] in ("context", "alloc"):
            return held
        if line["name"] == holder:
            held = line["process_bytes"]
    pytest.fail(f"{newcomer} never loaded")


@pytest.mark.parametrize("how", ["kill", "stop"])
@pytest.mark.parametrize("role", ["holder", "waiter", "daemon"])
@pytest.mark.parametrize("step", STEPS)
def test_what_is_promised_comes_true(stage: Stage, step: str, role: str, how: str) -> None:
    holder, waiter = reach(stage, step)
    go_on = strike(stage, {"holder": holder, "waiter": waiter, "daemon": None}[role], how)
    if (role, how) == ("holder", "stop"):
        assert stage.watcher is not None
        queued = [v for v in stage.watcher.ask("status")["leases"] if v["consumer"] == waiter.name]
        assert step == "verifying" or [v["state"] for v in queued] == ["queued"], (
            "a stopped holder has it still"
        )
    go_on()
    if holder.alive:
        leave(holder, step)
    if (role, how) == ("waiter", "kill"):
        if step not in ("loading", "in use"):  # else the revoke is withdrawn with its waiter
            holder.until("released")
    else:
        waiter.until("loading")
        waiter.tell("go")
        waiter.until("ready")
        left = 0 if not holder.alive else RESIDUE
        assert bytes_beside(stage.log(), holder.name, waiter.name) <= left
    stage.end_case()


def leave(holder: Child, step: str) -> None:
    """The holder goes on from its step to the end, as it would have done."""
    if step == "loading":
        holder.tell("go")
        holder.until("ready")
    if step == "in use":
        holder.tell("go")
        holder.until("idle")
    if step != "verifying":
        holder.tell("go")  # the unloading, whenever it is asked for
