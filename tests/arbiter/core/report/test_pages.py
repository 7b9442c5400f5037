"""`status` in pages: one answer must not hold the loop for seconds because thousands wait."""

from typing import Any

from tests.support.core_driver import CoreDriver
from tests.support.scenes import held, why
from vram_arbiter.arbiter.core.arbiter import DUE_MAX
from vram_arbiter.arbiter.core.events import Tick
from vram_arbiter.arbiter.core.report.why import BLOCKERS_MAX, EXPLAINED_MAX
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB


def pages(driver: CoreDriver, limit: int) -> list[list[dict[str, Any]]]:
    found: list[list[dict[str, Any]]] = []
    after = None
    while True:
        page = driver.status(None, after, limit)
        found.append(page["leases"])
        if "next" not in page:
            return found
        after = tuple(page["next"])


def crowd() -> CoreDriver:
    """Two GPUs on which somebody loads, a lease on standby, waiters for one GPU and for both."""
    driver = CoreDriver(8 * GIB, gpus=2)
    sleeper, first, second = (driver.consumer(name) for name in ("sleeper", "first", "second"))
    away = sleeper.acquire(7 * GIB, gpu="0", standby=True)
    sleeper.load(away)
    first.acquire(7 * GIB, gpu="0")
    sleeper.unload(away)
    driver.advance(3.0)
    second.acquire(7 * GIB, gpu="1")
    for number in range(5):
        driver.consumer(f"any{number}").acquire(5 * GIB, priority=40 + 5 * number)
        driver.consumer(f"zero{number}").acquire(5 * GIB, gpu="0")
        driver.advance(0.5)
    return driver


def test_pages_hold_every_lease_once_whatever_their_size() -> None:
    """Regression: one reply with thousands of leases held the loop for seconds."""
    driver = crowd()
    (whole,) = pages(driver, 1000)
    assert whole == driver.status()["leases"]
    assert len(whole) == 13
    assert [view["state"] for view in whole[:4]] == ["standby", "loading", "loading", "queued"]
    for limit in (1, 2, 5, 13):
        found = pages(driver, limit)
        assert [view for page in found for view in page] == whole
        assert max(len(page) for page in found) == limit


def test_waiters_are_listed_in_the_order_in_which_they_are_served() -> None:
    driver = crowd()
    waiting = [view for view in driver.status()["leases"] if view["state"] == "queued"]
    for index in ("0", "1"):
        places = [
            view["position"]
            for view in waiting
            if view["consumer"].startswith("any" if index == "1" else "zero")
        ]
        assert places == sorted(places)
    urgent = driver.consumer("urgent").acquire(5 * GIB, priority=100)
    (page,) = [driver.status(None, (1, float("-inf"), 0), 1)]
    assert [view["lease_id"] for view in page["leases"]] == [urgent]
    assert page["totals"] == {"leases": 14, "waiting": 11}


def test_a_page_goes_on_where_the_last_one_ended_though_that_lease_is_gone() -> None:
    driver = CoreDriver(8 * GIB)
    driver.consumer("holder").acquire(7 * GIB)
    people = [driver.consumer(f"p{number}") for number in range(4)]
    leases = [person.acquire(5 * GIB) for person in people]
    first = driver.status(None, None, 2)
    assert first["leases"][-1]["lease_id"] == leases[0]
    people[0].cancel(leases[0])
    rest = driver.status(None, tuple(first["next"]), 10)
    assert [view["lease_id"] for view in rest["leases"]] == leases[1:]
    assert "next" not in rest


def test_why_explains_the_oldest_leases_of_a_consumer_with_many(driver: CoreDriver) -> None:
    driver.consumer("holder").acquire(7 * GIB)
    crowd = driver.consumer("crowd")
    leases = [crowd.acquire(5 * GIB) for _ in range(EXPLAINED_MAX + 3)]
    told = driver.why("crowd")
    assert [lease["lease_id"] for lease in told["leases"]] == leases[:EXPLAINED_MAX]
    assert told["more"] == 3
    alone = driver.why(leases[-1])
    assert [lease["lease_id"] for lease in alone["leases"]] == leases[-1:]
    assert "more" not in alone


def test_of_many_blockers_the_largest_are_told(driver: CoreDriver) -> None:
    for number in range(BLOCKERS_MAX + 5):
        person = driver.consumer(f"small{number}")
        person.load(person.acquire((1 + number) * d.MIB))
        driver.advance(0.01)
    driver.consumer("alone").acquire(GIB, exclusive=True)
    (lease,) = driver.why("alone")["leases"]
    assert len(lease["blockers"]) == BLOCKERS_MAX
    assert {blocker["consumer"] for blocker in lease["blockers"]}.isdisjoint(
        f"small{number}" for number in range(5)
    )


def test_waits_that_end_together_are_denied_in_slices() -> None:
    """Thousands of timeouts in one Tick held the loop for seconds."""
    driver = CoreDriver(8 * GIB, settings={"leases_per_client_max": 1000})
    driver.consumer("holder").acquire(7 * GIB)
    crowd = driver.consumer("crowd")
    leases = [crowd.acquire(5 * GIB, wait_timeout_s=1.0) for _ in range(2 * DUE_MAX + 5)]
    driver.advance(0.5)
    driver.now += 1.0
    driver.post(Tick())
    first = len(driver.notes("denied"))
    assert 0 < first <= DUE_MAX
    due = driver.arbiter.next_deadline()
    assert due is not None
    assert due <= driver.now, "the next Tick comes at once"
    driver.post(Tick())
    driver.post(Tick())
    assert len(driver.notes("denied")) == len(leases)


def test_details_say_what_why_says(driver: CoreDriver) -> None:
    """The words and the estimate of a waiter come from the arbiter, in one request for all."""
    held(driver, "detector", 5)
    first, second = driver.consumer("grab"), driver.consumer("vlm")
    first.acquire(6 * GIB)
    second.acquire(7 * GIB)
    driver.advance(0.001)
    told = driver.status(details=True)
    assert "details" not in driver.status()
    detector, grab, vlm = told["details"]
    assert [lease["lease_id"] for lease in told["leases"]] == [
        detail["lease_id"] for detail in told["details"]
    ]
    assert (detector["declared_bytes"], detector["measured_bytes"]) == (5 * GIB, 5 * GIB)
    assert "why" not in detector
    assert grab["why"] == why(driver, "grab")
    behind = why(driver, "vlm")
    assert vlm["why"]["text"] == behind["text"]
    assert (vlm["why"]["eta_s"], vlm["why"]["plan"]) == (behind["eta_s"], behind["plan"])
    assert not vlm["why"]["blockers"], "the blockers are the head's"


def test_waiters_follow_the_holders_page_where_their_rank_is_below_zero() -> None:
    """Soon after boot the clock shows fewer seconds than a priority is worth."""
    driver = CoreDriver(8 * GIB, settings={"ageing_s_per_point": 100.0})
    driver.consumer("holder").acquire(7 * GIB)
    driver.consumer("urgent").acquire(5 * GIB, priority=90)
    found = [view["consumer"] for page in pages(driver, 1) for view in page]
    assert found == ["holder", "urgent"]
