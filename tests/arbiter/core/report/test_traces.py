"""Traces that facts and pushes name."""

from tests.support.core_driver import CoreDriver
from tests.support.scenes import held, sent_away
from vram_arbiter.schemas.defaults import GIB

HERS = f"00-{'a' * 32}-{'1' * 16}-01"
HIS = f"00-{'b' * 32}-{'2' * 16}-01"


def test_a_lease_that_is_called_back_belongs_to_the_caller(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver)
    det.traceparent = HERS
    det.reacquire(lease)
    assert driver.notes("queued")[-1]["traceparent"] == HERS
    assert driver.pushes("revoke", wanted)[0]["traceparent"] == HERS
    det.cancel(lease)
    assert policy.traceparent is None


def test_one_that_is_called_back_while_it_is_measured_too(driver: CoreDriver) -> None:
    driver.device.lag_s = 1.0
    det, lease = held(driver, "det", 5, standby=True)
    det.traceparent = HIS
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB, wait_timeout_s=60.0)
    det.unload(lease)
    assert driver.state(lease) == "verifying"
    det.reacquire(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    policy.load(wanted)
    driver.until(lambda: bool(driver.pushes("revoke", wanted)))
    assert driver.pushes("revoke", wanted)[0]["traceparent"] == HIS
