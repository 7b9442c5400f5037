"""How a verification begins: what may stay, which reading it is compared with, and its clock."""

from collections.abc import Callable
from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.engine_state import state_of
from tests.support.scenes import give_back, held
from vram_arbiter.arbiter.core.events import ProcessDied
from vram_arbiter.arbiter.core.model.lease import Verification
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import LeaseId

RESIDUE_BYTES = 450 * MIB
TTL_S = 20.0
GRACE_S = d.FENCE_GRACE_S


def under_way(driver: CoreDriver) -> Verification:
    """The only verification that is under way."""
    (one,) = state_of(driver.arbiter).gpus[driver.device.gpu].verifications.values()
    return one


def begun(at: float, grace_s: float = 0.0, **fields: Any) -> Verification:
    """A verification that begins at this moment, without a verdict for `grace_s`."""
    clock = {
        "confirmed_at": at,
        "not_before": at + grace_s,
        "paced_from": at + grace_s,
        "deadline_at": at + grace_s + d.VERIFY_TIMEOUT_S,
        "next_poll_at": at + max(grace_s, d.VERIFY_CONFIRM_S),
    }
    return Verification(**{**clock, **fields})


def leaves(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    det.unload(lease)


def exits(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    det.unloading(lease)
    det.hold(0)
    det.release(lease, exiting=True)


def dies(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    det.die()


def expires(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    view = driver.view(lease)
    assert view is not None
    driver.advance(view["ttl_left_s"])


def expires_and_dies(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    expires(driver, det, lease)
    driver.post(ProcessDied(det.process))


def restarts(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    driver.restart(start=False)


def leaves_and_restarts(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    leaves(driver, det, lease)
    restarts(driver, det, lease)


def expires_and_restarts(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    expires(driver, det, lease)
    restarts(driver, det, lease)


def restarts_and_expires(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    driver.restart()
    expires(driver, det, lease)


LIVES = {"alive": True, "vanishes": False, "retained_bytes": RESIDUE_BYTES}
DEAD = {"alive": False, "vanishes": True, "retained_bytes": 0}
FENCED = {"fenced_at": GRACE_S}
UNSEEN = {"baseline": None, "baseline_comparable": False}


@pytest.mark.parametrize(
    ("how", "grace_s", "expected"),
    [
        (leaves, 0.0, LIVES),
        (exits, 0.0, {**DEAD, "alive": True}),
        (dies, 0.0, DEAD),
        (expires, GRACE_S, LIVES | FENCED),
        (expires_and_dies, 0.0, DEAD | FENCED | {"deadline_at": GRACE_S + d.VERIFY_TIMEOUT_S}),
        (leaves_and_restarts, 0.0, LIVES | UNSEEN),
        (expires_and_restarts, GRACE_S, LIVES | UNSEEN | {"fenced_at": TTL_S + GRACE_S}),
        (restarts_and_expires, 0.0, LIVES | {"fenced_at": 0.0}),
    ],
)
def test_what_a_holder_declared_may_stay_only_while_it_lives(
    driver: CoreDriver,
    how: Callable[[CoreDriver, Consumer, LeaseId], None],
    grace_s: float,
    expected: dict[str, Any],
) -> None:
    """`fenced_at` and `deadline_at` are in seconds from now."""
    det, lease = held(driver, "det", 5, residue_bytes=RESIDUE_BYTES, exclusive=True, ttl_s=TTL_S)
    driver.advance(1.0)
    driver.device.lag_s = 1.0
    how(driver, det, lease)
    at = driver.now
    found = under_way(driver)
    moments = {key: at + expected[key] for key in ("fenced_at", "deadline_at") if key in expected}
    assert found == begun(
        **{
            "at": at,
            "grace_s": grace_s,
            "key": lease,
            "process": det.process,
            "lease": lease,
            "consumer": "det",
            "model": "det det-model",
            "baseline": found.baseline,
            "baseline_comparable": True,
            "exclusive": True,
            **expected,
            **moments,
        }
    )
    assert found.baseline is None or found.baseline.used_bytes == 5 * GIB


@pytest.mark.parametrize("later_s", [0.001, 0.0, -0.001])
def test_what_a_dead_process_kept_is_compared_with_the_newest_reading(
    driver: CoreDriver, later_s: float
) -> None:
    """`later_s`: how much later than the charge it began."""
    det, lease = held(driver, "det", 5, residue_bytes=RESIDUE_BYTES)
    give_back(driver, det, lease)
    driver.device.lag_s = 1.0
    gpu = state_of(driver.arbiter).gpus[driver.device.gpu]
    baseline = gpu.sample
    assert baseline is not None
    gpu.ledger.accounts[det.process].changed_at = baseline.taken_at - later_s
    det.die()
    assert under_way(driver) == begun(
        driver.now,
        key=f"residue:{det.process}",
        process=det.process,
        lease=None,
        consumer=str(det.process),
        model="",
        baseline=baseline,
        baseline_comparable=later_s > 0,
        **DEAD,
    )
