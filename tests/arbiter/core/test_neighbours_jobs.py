"""What users of other arbiters and model servers complain about, where one job needs several
models. Numbers are those of the list.
"""

from tests.support.core_driver import CoreDriver
from vram_arbiter.schemas import defaults as d

GIB = d.GIB


def test_3_a_hung_holder_is_not_stopping_for_ever(driver: CoreDriver) -> None:
    """ollama#7606, #12179, llama-swap#125: "Stopping…" until it is killed by hand.

    Here the hung holder's lease expires, and its death or the measurement gives its bytes back.
    The waiter is told all the while which holder it waits for.
    """
    policy = driver.consumer("policy")
    lease = policy.acquire(5 * GIB, ttl_s=10.0)
    policy.load(lease)
    driver.advance(0.01)
    waiter = driver.consumer("w").acquire(5 * GIB)
    driver.advance(9.0)
    assert "policy" in driver.why("w")["leases"][0]["text"]
    driver.advance(20.0)
    assert (driver.state(lease), driver.state(waiter)) == ("over", "queued")
    policy.die()
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=2.0)


def test_3_the_end_of_a_ttl_and_an_unload_do_not_block_each_other() -> None:
    """llama-swap#946: a ttl that runs out while the model unloads deadlocks both.

    Here either order ends in the same state.
    """
    for released_first in (True, False):
        driver = CoreDriver(8 * GIB)
        policy = driver.consumer("policy")
        lease = policy.acquire(5 * GIB, ttl_s=2.0)
        policy.load(lease)
        driver.advance(0.01)
        waiter = driver.consumer("w").acquire(5 * GIB)
        policy.unloading(lease)
        if released_first:
            policy.release(lease)
        driver.advance(3.0)
        policy.hold(0)
        driver.until(
            lambda: driver.state(waiter) == "loading",  # noqa: B023 - called at once
            limit_s=20.0,
        )
        assert driver.state(lease) == "over"
