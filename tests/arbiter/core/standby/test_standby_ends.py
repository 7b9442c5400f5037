"""What ends or changes a lease on standby: its holder, its process, an operator; several GPUs; its
invariants."""

from collections.abc import Callable

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from tests.support.scenes import give_back, held, order, revoked, sent_away
from vram_arbiter.schemas.defaults import GIB


# -- ends
def test_requests_that_make_no_sense_away_are_refused(driver: CoreDriver) -> None:
    det, lease, _, _ = sent_away(driver)
    assert refusal(det.ready(lease)).code == "bad_state"
    assert refusal(det.use_begin(lease)).code == "bad_state"
    assert refusal(det.unloading(lease)).code == "bad_state"
    assert refusal(det.oom(lease, 1)).code == "bad_state"
    assert answer(det.ack(lease))["state"] == "standby"


@pytest.mark.parametrize("end", [Consumer.leave, Consumer.die], ids=["connection", "process"])
def test_who_ends_during_the_measurement_does_not_want_it_back(
    driver: CoreDriver, end: Callable[[Consumer], object]
) -> None:
    """The journal has it too: a restart brought back what its holder had given up."""
    det, lease, _, wanted = revoked(driver)
    det.unload(lease)
    end(det)
    assert "comes_back" not in driver.journal[f"lease:{lease}"]
    driver.until(lambda: driver.state(wanted) == "loading")
    assert driver.state(lease) == "over"


# -- operators
def test_an_operators_word_outweighs_the_engines() -> None:
    """The engine asked it to leave, then an operator evicts it: at any step of its way out."""
    for steps in range(3):
        driver = CoreDriver(8 * GIB)
        driver.device.lag_s = 0.3
        det, lease, _, wanted = revoked(driver)
        if steps > 0:
            det.unload(lease)
        if steps > 1:
            # run at once
            driver.until(lambda: driver.state(wanted) == "loading")  # noqa: B023
        order(driver, "evict", lease)
        if steps == 0:
            det.unload(lease)
        driver.until(lambda: driver.state(lease) == "over")  # noqa: B023  # reason: run at once
        assert f"lease:{lease}" not in driver.journal
    assert driver.pushes("lost", lease)[-1]["error"]["code"] == "lease_lost"


def test_evicting_one_that_leaves_by_itself_is_fine(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5, standby=True)
    det.unload(lease)
    order(driver, "evict", lease)
    driver.until(lambda: driver.state(lease) == "over")
    assert f"lease:{lease}" not in driver.journal


def test_an_operators_eviction_outlives_a_restart(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5, standby=True)
    token = det.token(lease)
    order(driver, "evict", lease)
    driver.restart()
    det.connect()
    det.reattach(lease, token)
    give_back(driver, det, lease)
    assert f"lease:{lease}" not in driver.journal


def test_what_an_operator_evicted_and_its_holder_thinks_away_is_over(driver: CoreDriver) -> None:
    other, resident = held(driver, "other", 1)
    det, lease = held(driver, "det", 5, standby=True)
    token, other_token = det.token(lease), other.token(resident)
    order(driver, "evict", lease)
    det.hold(0)
    driver.restart()
    other.connect()
    other.reattach(resident, other_token)
    det.connect()
    det.reattach(lease, token, away=True)
    driver.until(lambda: driver.state(lease) == "over")
    assert f"lease:{lease}" not in driver.journal


def test_a_pin_on_standby_holds_after_the_return(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver)
    order(driver, "pin", lease)
    assert driver.journal[f"lease:{lease}"]["pinned"] == ["ops", "test"]
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading")
    det.load(lease)
    again = policy.acquire(5 * GIB)
    driver.advance(10.0)
    assert (driver.state(lease), driver.state(again)) == ("held", "queued")


# -- several GPUs, invariants
