"""What a crowd leaves behind in the engine has a bound, whatever names it used and however often it
came."""

from collections.abc import Sized
from typing import Any

from tests.support.core_driver import CoreDriver
from tests.support.engine_state import state_of
from tests.support.scenes import held
from vram_arbiter.arbiter.core.learning import CONSUMERS_REMEMBERED
from vram_arbiter.arbiter.core.model.lease import NONCES_MAX
from vram_arbiter.arbiter.core.model.state import ENDED_REMEMBERED
from vram_arbiter.schemas.defaults import GIB


def sizes(owner: object) -> dict[str, int]:
    """Every table of the engine's state by name, with the number of its entries."""
    tables: dict[str, Any] = {
        name: table for name, table in vars(owner).items() if isinstance(table, Sized)
    }
    return {name: len(table) for name, table in tables.items() if not isinstance(table, str)}


def test_a_crowd_that_waited_and_went_leaves_nothing_but_the_memory_of_the_last_ones() -> None:
    driver = CoreDriver(8 * GIB)
    driver.consumer("holder").acquire(7 * GIB)
    core = state_of(driver.arbiter)
    before = {**sizes(core), **sizes(core.costs)}
    for number in range(30):
        person = driver.consumer(f"crowd{number}")
        for _ in range(10):
            person.acquire(5 * GIB, wait_timeout_s=1e6)
        if number % 2:
            person.die()
        else:
            person.leave()
    after = {**sizes(core), **sizes(core.costs)}
    assert after.pop("ended") <= before.pop("ended") + 300 <= ENDED_REMEMBERED
    assert after.pop("nonces") <= before.pop("nonces") + 300
    assert after == before
    assert core.gpus[driver.device.gpu].queue.head is None


def test_consumers_of_ever_new_names_are_remembered_up_to_a_number(driver: CoreDriver) -> None:
    core = state_of(driver.arbiter)
    for number in range(CONSUMERS_REMEMBERED + 10):
        core.costs.learn(f"c{number}", "load_s", 1.0)
        core.costs.left(f"c{number}", 0.0)
    assert len(core.costs.durations) == len(core.costs.reuse) == CONSUMERS_REMEMBERED
    assert core.costs.learnt_s("c0", "load_s") is None
    core.costs.learn("c10", "load_s", 3.0)
    core.costs.learn("new", "load_s", 1.0)
    assert core.costs.learnt_s("c10", "load_s") == 2.0, "the newest stay"
    assert len(core.costs.durations) == CONSUMERS_REMEMBERED


def test_a_lease_that_is_taken_over_again_and_again_is_known_by_its_last_nonces() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease = held(driver, "det", 5, standby=True)
    policy = driver.consumer("policy")
    for number in range(NONCES_MAX + 3):
        wanted = policy.acquire(5 * GIB, min_residency_s=0.0)
        driver.until(lambda: driver.state(lease) == "revoking")
        det.unload(lease)
        driver.until(lambda wanted=wanted: driver.state(wanted) == "loading")  # type: ignore[misc]
        policy.load(wanted)
        assert det.acquire(5 * GIB, nonce=f"again{number}", standby=True) == lease
        driver.until(lambda wanted=wanted: driver.state(wanted) == "revoking")  # type: ignore[misc]
        policy.unload(wanted)
        driver.until(lambda: driver.state(lease) == "loading")
        det.load(lease)
        driver.advance(1.0)
    core = state_of(driver.arbiter)
    mine = [
        nonce
        for (process, nonce), known in core.nonces.items()
        if known == lease and process == det.process
    ]
    assert len(mine) == NONCES_MAX + 1


def test_the_nonce_of_a_debt_found_by_a_restart_is_forgotten_with_it() -> None:
    driver = CoreDriver(8 * GIB)
    hung = driver.consumer("hung")
    lease = hung.acquire(5 * GIB, nonce="n", ttl_s=2.0)
    driver.until(lambda: driver.state(lease) == "over", limit_s=5.0)
    driver.restart()
    core = state_of(driver.arbiter)
    assert core.nonces[hung.process, "n"] == lease
    crowd = driver.consumer("crowd")
    while lease in core.ended:
        crowd.cancel(crowd.acquire(5 * GIB, wait_timeout_s=1e6))
    assert (hung.process, "n") not in core.nonces
