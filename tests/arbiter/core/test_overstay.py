"""After the ladder's deadline: what a holder agreed to for itself, never while its process uses
anything, and nothing without agreement."""

from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from vram_arbiter.arbiter.core.effects import Signal
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId

GIB = d.GIB


def idle_and_revoked(driver: CoreDriver, **spec: Any) -> tuple[Consumer, LeaseId, LeaseId]:
    """An idle holder that was just asked to leave and will not, and the waiter."""
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB, **spec)
    det.load(lease)
    driver.advance(0.01)
    waiter = driver.consumer("vlm").acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    return det, lease, waiter


def signals(driver: CoreDriver) -> list[Signal]:
    return [effect for effect in driver.effects if isinstance(effect, Signal)]


def test_by_default_nothing_is_ever_done() -> None:
    driver = CoreDriver(8 * GIB)
    _, lease, waiter = idle_and_revoked(driver)
    driver.advance(3000.0)
    assert not signals(driver)
    assert (driver.state(lease), driver.state(waiter)) == ("revoking", "queued")


def test_terminate_is_said_once_and_then_it_is_waited() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease, waiter = idle_and_revoked(driver, on_overstay="terminate")
    driver.advance(29.9)
    assert not signals(driver)
    driver.advance(0.2)
    assert signals(driver) == [Signal(det.process, "term")]
    (note,) = driver.notes("signalled")
    assert (note["signal"], note["wanted_by"], note["pid"]) == ("term", "vlm", det.process.pid)
    assert "on_overstay=terminate" in note["reason"]
    driver.advance(3000.0)
    assert len(signals(driver)) == 1
    det.die()
    driver.until(lambda: driver.state(waiter) == "loading")
    assert driver.state(lease) == "over"


def test_kill_comes_after_terminate_and_its_grace() -> None:
    driver = CoreDriver(8 * GIB)
    det, _, waiter = idle_and_revoked(driver, on_overstay="kill")
    driver.advance(30.1)
    assert [signal.kind for signal in signals(driver)] == ["term"]
    driver.advance(4.8)
    assert len(signals(driver)) == 1
    driver.advance(0.2)
    assert [signal.kind for signal in signals(driver)] == ["term", "kill"]
    driver.advance(3000.0)
    assert len(signals(driver)) == 2
    det.die()
    driver.until(lambda: driver.state(waiter) == "loading")


def test_a_holder_that_leaves_in_its_grace_is_left_alone() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease, waiter = idle_and_revoked(driver, on_overstay="kill")
    driver.advance(31.0)
    det.unload(lease)
    driver.until(lambda: driver.state(waiter) == "loading")
    driver.advance(60.0)
    assert len(signals(driver)) == 1


def test_a_lease_in_use_is_never_signalled_and_has_its_whole_time_after_it() -> None:
    driver = CoreDriver(8 * GIB)
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB, on_overstay="kill")
    det.load(lease)
    det.use_begin(lease)
    driver.consumer("vlm").acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    driver.advance(1000.0)
    assert not signals(driver)
    det.use_end(lease)
    driver.advance(29.0)
    assert not signals(driver)
    driver.advance(31.0)
    assert signals(driver)


def test_a_process_that_uses_anything_is_not_signalled() -> None:
    """Its idle lease outstays, but the same process drives the arm with another one, or with
    somebody else's."""
    driver = CoreDriver(8 * GIB)
    det, _, _ = idle_and_revoked(driver, on_overstay="kill")
    policy = driver.consumer("policy")
    arm = policy.acquire(1 * GIB)
    driver.until(lambda: driver.state(arm) == "loading", limit_s=1.0)
    policy.load(arm)
    token = policy.token(arm)
    det.use_begin(arm, "grab", token)
    driver.advance(1000.0)
    assert not signals(driver)
    det.use_end(arm, "grab", token)
    driver.advance(61.0)
    assert signals(driver)


def test_a_use_of_others_on_another_lease_of_it_counts_too() -> None:
    driver = CoreDriver(8 * GIB)
    det, _, _ = idle_and_revoked(driver, on_overstay="terminate")
    second = det.acquire(1 * GIB, key="second")
    driver.until(lambda: driver.state(second) == "loading", limit_s=1.0)
    det.ready(second)
    token = det.token(second)
    runner = driver.consumer("runner")
    runner.use_begin(second, "goal", token)
    driver.advance(1000.0)
    assert not signals(driver)
    runner.use_end(second, "goal", token)
    driver.advance(61.0)
    assert signals(driver)


def test_an_unload_that_hangs_outstays_too() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease, _ = idle_and_revoked(driver, on_overstay="terminate")
    driver.advance(20.0)
    det.unloading(lease)
    driver.advance(29.0)
    assert not signals(driver)
    driver.advance(1.1)
    assert signals(driver)


@pytest.mark.parametrize("standby", [False, True])
def test_a_lease_that_left_is_not_pursued(standby: bool) -> None:
    driver = CoreDriver(8 * GIB)
    det, lease, waiter = idle_and_revoked(driver, on_overstay="kill", standby=standby)
    det.unload(lease)
    driver.until(lambda: driver.state(waiter) == "loading")
    driver.advance(100.0)
    assert not signals(driver)


def test_a_slow_verdict_is_no_overstay() -> None:
    driver = CoreDriver(8 * GIB)
    driver.device.lag_s = 50.0
    det, lease, _ = idle_and_revoked(driver, on_overstay="kill")
    driver.advance(25.0)
    det.unload(lease)
    driver.advance(40.0)
    assert not signals(driver)
