"""On which cards a lease may be, and what that becomes when pins end, daemons restart and cards go."""

from dataclasses import replace
from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer
from tests.support.scenes import held, place
from vram_arbiter.arbiter.core.events import OperatorAsked
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import GpuId, LeaseId

GIB = d.GIB
ZERO, ONE = GpuId("GPU-0"), GpuId("GPU-1")


@pytest.fixture
def driver() -> CoreDriver:
    return CoreDriver(8 * GIB, cards=2)


def busy_and_pinned(driver: CoreDriver) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    """Card 0 is in use above everybody, card 1 is pinned."""
    busy, used = held(driver, "busy", 6, gpu="0", priority=99)
    busy.use_begin(used)
    keeper, pinned = held(driver, "keeper", 6, gpu="1", evictable=False)
    return busy, used, keeper, pinned


# -- pins that end ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("end", ["release", "death", "unpin"])
def test_a_card_whose_pin_ended_is_a_place_for_who_waits(driver: CoreDriver, end: str) -> None:
    """Regression: whoever came while it was pinned waited for the other card only, for hours beside an empty one."""
    _, _, keeper, pinned = busy_and_pinned(driver)
    if end == "unpin":
        keeper.unload(pinned)
        driver.until(lambda: driver.state(pinned) == "over")
        keeper, pinned = held(driver, "another", 6, gpu="1")
        order(driver, "pin", pinned)
    waiter = driver.consumer("w").acquire(5 * GIB)
    driver.advance(1.0)
    assert driver.state(waiter) == "queued"
    if end == "unpin":
        order(driver, "unpin", pinned)
        driver.until(lambda: driver.state(pinned) == "revoking", limit_s=1.0)
    if end == "death":
        keeper.die()
    else:
        keeper.unload(pinned)
    late = driver.consumer("late").acquire(5 * GIB, gpu="1") if end != "unpin" else None
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=2.0)
    assert place(driver, waiter) == ONE
    assert late is None or driver.state(late) == "queued", "who came first is first there too"


def order(driver: CoreDriver, action: str, lease: LeaseId) -> None:
    ops = driver.consumer("ops")
    driver.post(OperatorAsked(ops.client, driver.next_request(), action, lease, "ops", "test"))


def test_whoever_names_another_card_or_is_too_large_waits_only_where_it_may_be(
    driver: CoreDriver,
) -> None:
    busy_and_pinned(driver)
    named = driver.consumer("named").acquire(5 * GIB, gpu="0")
    any_card = driver.consumer("any").acquire(7 * GIB)
    waiting = driver.arbiter.inspect().waiting
    assert (waiting[named].request.gpus, waiting[any_card].request.gpus) == ((ZERO,), (ZERO, ONE))


def test_a_growth_stays_on_its_card(driver: CoreDriver) -> None:
    _, _, keeper, pinned = busy_and_pinned(driver)
    small, lease = held(driver, "small", 1)
    assert place(driver, lease) == ZERO
    small.use_begin(lease)
    assert answer(small.resize(lease, 3 * GIB))["state"] == "growing"
    keeper.unload(pinned)
    driver.until(lambda: driver.state(pinned) == "over")
    driver.advance(1.0)
    (growth,) = driver.arbiter.inspect().waiting.values()
    assert growth.request.gpus == (ZERO,)


# -- away ------------------------------------------------------------------------------------------------------------
def gone_for_policy(driver: CoreDriver, **spec: Any) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    """On standby, since a policy that is used on card 0."""
    det, lease = held(driver, "det", 5, standby=True, **spec)
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB, gpu="0")
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    policy.load(wanted)
    policy.use_begin(wanted)
    driver.advance(0.1)
    return det, lease, policy, wanted


def test_a_card_that_was_pinned_when_it_asked_is_one_to_come_back_to(driver: CoreDriver) -> None:
    """Regression: where it may come back to was where it could have been granted when it asked."""
    keeper, pinned = held(driver, "keeper", 6, gpu="1", evictable=False)
    _, lease, _, _ = gone_for_policy(driver)
    driver.advance(5.0)
    assert driver.state(lease) == "standby"
    keeper.unload(pinned)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=2.0)
    assert place(driver, lease) == ONE


def test_after_a_restart_it_comes_back_to_any_card_still(driver: CoreDriver) -> None:
    """Regression: a lease that was held when the daemon restarted could come back to its own card only."""
    det, lease = held(driver, "det", 5, standby=True)
    other, fills = held(driver, "other", 6, gpu="1")
    tokens = [det.token(lease), other.token(fills)]
    driver.restart()
    for person, one, token in ((det, lease, tokens[0]), (other, fills, tokens[1])):
        person.connect()
        person.reattach(one, token)
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB, gpu="0")
    driver.until(lambda: driver.state(lease) == "revoking")
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    policy.load(wanted)
    policy.use_begin(wanted)
    other.unload(fills)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=2.0)
    assert place(driver, lease) == ONE


def test_a_lease_that_is_away_from_a_card_that_is_gone_ends(driver: CoreDriver) -> None:
    """Regression: `status` and `why` of a lease without any card ended the daemon."""
    det, lease, _, wanted = gone_for_policy(driver, gpu="GPU-0")
    token = det.token(lease)
    driver.settings = replace(driver.settings, gpus=driver.settings.gpus[1:])
    del driver.cards[ZERO]
    driver.restart()
    assert driver.state(lease) == "over"
    assert f"lease:{lease}" not in driver.journal
    det.connect()
    (told,) = answer(det.reattach(lease, token, away=True))["leases"]
    assert (told["kept"], told["error"]["code"]) == (False, "lease_lost")
    assert (driver.arbiter.why("det", driver.now)["leases"], driver.state(wanted)) == ([], "over")
    _, other = held(driver, "other", 5)
    assert place(driver, other) == ONE, "the daemon grants"


def test_one_that_is_too_large_for_a_card_keeps_nobody_from_returning_to_it(
    driver: CoreDriver,
) -> None:
    """Regression: it counted as the one before them there, for whom room had to be kept."""
    large, first = held(driver, "large", 7, gpu="any", standby=True)
    small, second = held(driver, "small", 5, gpu="any", standby=True)
    people = [(large, first), (small, second)]
    for index, (person, lease) in enumerate(list(people)):
        policy = driver.consumer(f"policy{index}")
        wanted = policy.acquire(7 * GIB, gpu=str(index))
        person.unload(lease)
        driver.until(lambda wanted=wanted: driver.state(wanted) == "loading")  # type: ignore[misc]
        policy.load(wanted)
        policy.use_begin(wanted)
        driver.advance(0.1)
        people.append((policy, wanted))
    tokens = [person.token(lease) for person, lease in people]
    people.pop()[0].die()
    driver.shrink(ONE, 6 * GIB)
    driver.restart()
    for (person, lease), token in zip(people, tokens, strict=False):
        person.connect()
        person.reattach(lease, token, away=driver.state(lease) == "standby")
    driver.until(lambda: driver.state(second) == "loading", limit_s=20.0)
    assert (place(driver, second), driver.state(first)) == (ONE, "standby")
