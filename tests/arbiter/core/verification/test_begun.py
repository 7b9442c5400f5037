"""How a verification begins: what may stay, and which reading it is compared with."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.engine_state import state_of
from tests.support.scenes import give_back, held
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.ids import LeaseId

RESIDUE_BYTES = 450 * MIB


def under_way(driver: CoreDriver) -> dict[str, Any]:
    """The only verification that is under way, but for its clock."""
    (one,) = state_of(driver.arbiter).gpus[driver.device.gpu].verifications.values()
    clock = ("paced_from", "deadline_at", "next_poll_at", "last_used_bytes")
    return {
        field.name: getattr(one, field.name) for field in fields(one) if field.name not in clock
    }


def leaves(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    det.unload(lease)


def exits(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    det.unloading(lease)
    det.hold(0)
    det.release(lease, exiting=True)


def dies(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    det.die()


@pytest.mark.parametrize(
    ("how", "alive", "vanishes", "stays_bytes"),
    [(leaves, True, False, RESIDUE_BYTES), (exits, True, True, 0), (dies, False, True, 0)],
)
def test_what_a_holder_declared_may_stay_only_while_it_lives(
    driver: CoreDriver,
    how: Callable[[CoreDriver, Consumer, LeaseId], None],
    alive: bool,
    vanishes: bool,
    stays_bytes: int,
) -> None:
    det, lease = held(driver, "det", 5, residue_bytes=RESIDUE_BYTES)
    driver.advance(1.0)
    driver.device.lag_s = 1.0
    baseline = state_of(driver.arbiter).gpus[driver.device.gpu].sample
    assert baseline is not None
    how(driver, det, lease)
    assert under_way(driver) == {
        "key": lease,
        "process": det.process,
        "lease": lease,
        "consumer": "det",
        "model": "det det-model",
        "retained_bytes": stays_bytes,
        "baseline": baseline,
        "baseline_comparable": True,
        "confirmed_at": driver.now,
        "not_before": driver.now,
        "alive": alive,
        "vanishes": vanishes,
        "exclusive": False,
        "fenced_at": 0.0,
        "verdict": None,
        "overdue": False,
    }


@pytest.mark.parametrize("seen", [True, False], ids=["seen", "not seen yet"])
def test_what_a_dead_process_kept_is_compared_with_the_newest_reading(
    driver: CoreDriver, seen: bool
) -> None:
    det, lease = held(driver, "det", 5, residue_bytes=RESIDUE_BYTES)
    give_back(driver, det, lease)
    if seen:
        driver.advance(1.0)
    driver.device.lag_s = 1.0
    baseline = state_of(driver.arbiter).gpus[driver.device.gpu].sample
    assert baseline is not None
    det.die()
    assert under_way(driver) == {
        "key": f"residue:{det.process}",
        "process": det.process,
        "lease": None,
        "consumer": str(det.process),
        "model": "",
        "retained_bytes": 0,
        "baseline": baseline,
        "baseline_comparable": seen,
        "confirmed_at": driver.now,
        "not_before": driver.now,
        "alive": False,
        "vanishes": True,
        "exclusive": False,
        "fenced_at": 0.0,
        "verdict": None,
        "overdue": False,
    }
