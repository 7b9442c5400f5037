"""Each named step of a switch, hit by SIGKILL and by SIGSTOP then SIGCONT, in the holder, the
waiter and the daemon: what the design promises comes true each time. Real processes; every wait is
for an event.

The promise: whoever lives is served in the end; the newcomer's first byte comes after the last of
the holder's (but for a context that lives on); a use is never cut short; and afterwards nothing is
left.
"""

import os
import signal
from collections.abc import Callable, Iterator

import pytest

from tests.support.children import Child
from tests.support.stage import GIB
from tests.support.stage import Stage as OneDaemon

pytestmark = pytest.mark.e2e
SIZE, RESIDUE = 5 * GIB, GIB // 4
STEPS = ("loading", "in use", "unloading", "verifying")


class Stage(OneDaemon):
    """Its consumers stop at each step."""

    cases = 0

    def spawn(self, name: str) -> Child:
        return self.begin(name, SIZE, str(RESIDUE))

    def restart(self) -> None:
        self.arbiter.kill()
        self.arbiter.start()
        self.watch()


@pytest.fixture(scope="module")
def all_steps() -> Iterator[Stage]:
    made = Stage("stepper", "lease: {fence_grace_s: 1.0}\n")
    yield made
    made.close()


@pytest.fixture
def stage(all_steps: Stage) -> Iterator[Stage]:
    all_steps.watch()
    yield all_steps
    all_steps.end_case()


def reach(stage: Stage, step: str) -> tuple[Child, Child]:
    """(holder, waiter) with the holder at a step and the waiter queued behind it."""
    stage.cases += 1
    holder, waiter = f"holder{stage.cases}", f"waiter{stage.cases}"
    first = stage.spawn(holder)
    first.until("loading")
    if step == "loading":
        second = stage.spawn(waiter)
        stage.event("queued", consumer=waiter)
        return first, second
    first.tell("go")
    first.until("ready")
    if step == "in use":
        first.tell("use")
        first.until("in_use")
        second = stage.spawn(waiter)
        stage.event("revoke_asked", consumer=holder)
        return first, second
    second = stage.spawn(waiter)
    first.until("unloading")
    if step == "verifying":
        first.tell("go")
        stage.event("released", consumer=holder)
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


@pytest.mark.parametrize("how", ["kill", "stop"])
@pytest.mark.parametrize("role", ["holder", "waiter", "daemon"])
@pytest.mark.parametrize("step", STEPS)
def test_what_is_promised_comes_true(stage: Stage, step: str, role: str, how: str) -> None:
    holder, waiter = reach(stage, step)
    go_on = strike(stage, {"holder": holder, "waiter": waiter, "daemon": None}[role], how)
    if (role, how) == ("holder", "stop"):
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
        assert load_granted(waiter) > token_of(holder), "tokens grow, across a restart too"
        left = 0 if not holder.alive else RESIDUE
        assert stage.used_when(waiter.name) <= left


def test_a_killed_waiter_leaves_its_place_and_the_use_its_end(stage: Stage) -> None:
    holder, doomed = reach(stage, "in use")
    later = stage.spawn(f"later{stage.cases}")
    stage.event("queued", consumer=later.name)
    doomed.kill()
    stage.event("cancelled", consumer=doomed.name)
    leave(holder, "in use")
    load_granted(later)
    assert stage.used_when(later.name) == RESIDUE
    holder.until("released")
    assert [line["event"] for line in holder.said] == [
        "waiting", "loading", "ready", "in_use", "idle", "unloading", "released",
    ]  # fmt: skip


def test_daemon_and_holder_killed_together(stage: Stage) -> None:
    holder, waiter = reach(stage, "unloading")
    stage.arbiter.kill()
    holder.kill()
    stage.arbiter.start()
    load_granted(waiter)
    assert stage.used_when(waiter.name) == 0


def load_granted(waiter: Child) -> list[int]:
    """Let a waiter load once it is granted. Return its token."""
    waiter.until("loading")
    waiter.tell("go")
    waiter.until("ready")
    return token_of(waiter)


def token_of(child: Child) -> list[int]:
    token: list[int] = next(line["token"] for line in child.said if line["event"] == "loading")
    return token


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
