"""What users of the neighbours complain about: a program that crashes in its load, is started
again, and takes the GPU each time. Number 17."""

from typing import Any

from tests.support.core_driver import Consumer, CoreDriver, refusal
from tests.support.scenes import held
from vram_arbiter.arbiter.core.effects import Effect, Refuse
from vram_arbiter.arbiter.core.learning import FORGOTTEN_S, NAMES_MAX, PAUSE_MAX_S
from vram_arbiter.schemas.defaults import GIB


def refusals_in(effects: list[Effect]) -> list[Refuse]:
    return [effect for effect in effects if isinstance(effect, Refuse)]


def crash(driver: CoreDriver, name: str = "policy", gib: int = 5) -> Consumer:
    """One start of a program that dies in its load; whoever is asked to leave for it does."""
    person = driver.consumer(name)
    lease = person.acquire(gib * GIB)
    driver.until(lambda: driver.state(lease) == "loading")
    person.die()
    driver.advance(0.1)
    return person


def crashed(driver: CoreDriver, times: int) -> None:
    for _ in range(times):
        crash(driver)


def test_17_a_crash_loop_does_not_take_the_gpu_for_every_try(driver: CoreDriver) -> None:
    """Berth's gateway backs off 15 s → 5 min with the same cause. Here the one that works stays,
    and the one that crashes is told why."""
    crashed(driver, 3)
    _, working = held(driver, "working", 5)
    again = driver.consumer("policy")
    error = refusal(again.try_acquire(5 * GIB))
    assert error.code == "load_failing"
    assert "policy failed 3 times in a row to load policy-model" in error.message
    assert "died" in error.details["cause"]
    assert 0 < error.details["retry_in_s"] <= 2.0
    assert driver.state(working) == "held", "and it was not revoked"
    driver.advance(2.0)
    waiter = again.acquire(5 * GIB)
    driver.until(lambda: driver.state(working) == "revoking")
    assert driver.state(waiter) == "queued"


def test_17_the_pause_grows_with_each_failure_and_has_a_bound(driver: CoreDriver) -> None:
    crashed(driver, 2)
    held(driver, "working", 3)
    pauses = []
    for _ in range(8):
        crash(driver, gib=4)  # fits: it costs nobody anything, and is tried as often as it likes
        pauses.append(refusal(driver.consumer("policy").try_acquire(5 * GIB)).details["retry_in_s"])
    assert [round(pause) for pause in pauses] == [2, 4, 8, 16, 32, 60, 60, 60]
    assert max(pauses) <= PAUSE_MAX_S


def test_17_a_load_that_succeeds_or_time_forgets_it() -> None:
    for heals in (True, False):
        driver = CoreDriver(8 * GIB)
        crashed(driver, 2)
        if heals:
            held(driver, "policy", 1)
        else:
            driver.advance(FORGOTTEN_S + 1.0)
        crash(driver, gib=1)
        held(driver, "working", 5)
        assert not refusals_in(driver.consumer("policy").try_acquire(5 * GIB))


def test_17_others_and_what_an_exclusive_one_or_a_queue_would_cost(driver: CoreDriver) -> None:
    crashed(driver, 3)
    small, _ = held(driver, "small", 1)
    exclusive: dict[str, Any] = {"exclusive": True}
    assert (
        refusal(driver.consumer("policy").try_acquire(1 * GIB, **exclusive)).code == "load_failing"
    )
    assert not refusals_in(driver.consumer("other").try_acquire(7 * GIB)), (
        "another consumer is not meant"
    )
    assert refusal(driver.consumer("policy").try_acquire(1 * GIB)).code == "load_failing", (
        "it would stand behind others"
    )
    small.die()


def test_17_dying_while_resident_is_no_failed_load_and_the_table_is_bounded() -> None:
    driver = CoreDriver(8 * GIB)
    for _ in range(4):
        person, _ = held(driver, "policy", 5)
        person.hold(0)
        person.die()
        driver.advance(1.0)
    held(driver, "working", 5)
    assert not refusals_in(driver.consumer("policy").try_acquire(5 * GIB))
    driver = CoreDriver(8 * GIB)
    for n in range(NAMES_MAX + 3):
        crash(driver, f"p{n}", 1)
    assert len(driver.arbiter.inspect().costs.failures) == NAMES_MAX
