"""The whole arbiter under faults, a few seeds of it; `make sim SEEDS=1000` runs more, `make sim SEED=n` one again."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from sim_run import run_seed, summary

from arbiter.testing.simulation.card import Device, SimOutOfMemory
from arbiter.testing.simulation.clock import Clock, ProcessLoop
from arbiter.testing.simulation.daemon import Happening
from arbiter.testing.simulation.world import Entitlement, SimFailure, World
from schemas.defaults import GIB
from schemas.ids import GpuId, ProcessKey

A, B, GPU = ProcessKey(1, 1), ProcessKey(2, 2), GpuId("GPU-0")


@pytest.mark.parametrize("seed", range(6))
def test_nothing_that_must_hold_breaks_under_faults(seed: int) -> None:
    report = run_seed(seed)
    assert not report.failure, report.failure
    assert report.granted > 0
    assert sum(report.faults.values()) > 20


def test_a_seed_replays_exactly() -> None:
    assert run_seed(11).digest == run_seed(11).digest
    assert run_seed(11).digest != run_seed(12).digest


def test_sums_over_runs_name_the_seeds_that_failed() -> None:
    report = run_seed(0)
    report.failure = "planted"
    sums = summary([report, report])
    assert sums["failed"] == [0, 0]
    assert sums["granted"] == 2 * report.granted


# -- the checks can fail ---------------------------------------------------------------------------------------------
def world(tmp_path: Path) -> World:
    made = World(7, tmp_path)
    made.start_daemon()
    made.run(0.1)
    return made


def granted(*leases: tuple[ProcessKey, int, bool]) -> Iterator[Entitlement]:
    for number, (process, size, exclusive) in enumerate(leases):
        yield Entitlement(process, f"L1-{number}", GPU, size, 0, exclusive)


def test_more_granted_than_the_card_has_is_a_breach_that_names_the_seed(tmp_path: Path) -> None:
    made = world(tmp_path)
    made.entitlements = lambda: granted((A, 5 * GIB, False), (B, 4 * GIB, False))
    made.clock.after(0.0, made.touch)
    with pytest.raises(
        SimFailure, match=r"(?s)daemon starts.*seed 7: GPU-0: \d+ bytes are granted or occupied"
    ):
        made.run(1.0)
    made.kill_daemon()


def test_freed_memory_that_is_not_back_yet_counts(tmp_path: Path) -> None:
    made = world(tmp_path)
    card = made.cards[GPU]
    card.lag_s = 10.0
    card.allocate(A, "L0-1", 5 * GIB)
    card.free(A, "L0-1")
    made.entitlements = lambda: granted((B, 4 * GIB, False))
    made.clock.after(0.0, made.touch)
    with pytest.raises(SimFailure, match="granted or occupied"):
        made.run(1.0)
    made.kill_daemon()


def test_company_of_an_exclusive_lease_is_a_breach(tmp_path: Path) -> None:
    made = world(tmp_path)
    made.entitlements = lambda: granted((A, GIB, True), (B, GIB, False))
    made.clock.after(0.0, made.touch)
    with pytest.raises(SimFailure, match="beside the exclusive"):
        made.run(1.0)
    made.kill_daemon()


def test_a_token_that_does_not_grow_is_a_breach(tmp_path: Path) -> None:
    made = world(tmp_path)
    for token in ([1, 5], [1, 4]):
        made.machine.history.append(Happening(made.clock.now, 1, "granted", {"token": token}))
    made.clock.after(0.0, lambda: None)
    with pytest.raises(SimFailure, match="was granted after"):
        made.run(1.0)
    made.kill_daemon()


# -- the parts ---------------------------------------------------------------------------------------------------------
def test_a_frozen_process_catches_up_and_a_dead_one_never_does() -> None:
    clock = Clock(1)
    loop, dead, happened = ProcessLoop(clock, "frozen"), ProcessLoop(clock, "dead"), []
    loop.freeze()
    loop.call_later(1.0, happened.append, "late")
    dead.call_later(1.0, happened.append, "never")
    dead.kill()
    clock.run_until(clock.now + 5.0)
    assert happened == []
    loop.thaw()
    clock.run_until(clock.now)
    assert happened == ["late"]


def test_the_card_refuses_what_it_has_not_got_and_gives_back_late() -> None:
    clock = Clock(1)
    card = Device(clock, GPU, 8 * GIB, 0)
    card.lag_s = 1.0
    card.allocate(A, "x", 6 * GIB)
    card.free(A, "x")
    with pytest.raises(SimOutOfMemory):
        card.allocate(B, "x", 4 * GIB)
    clock.run_until(clock.now + 1.0)
    card.allocate(B, "x", 4 * GIB)
    assert card.used_bytes() == 4 * GIB
