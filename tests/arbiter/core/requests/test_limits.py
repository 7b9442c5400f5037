"""Shares of limited places. One process took all places of the queue, or all uses of a lease, and locked everybody out: the lease's own
holder too, which then could not use what it held."""

from typing import Any

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from vram_arbiter.arbiter.core.effects import Refuse
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId

GIB = d.GIB
LIMITS: dict[str, Any] = {
    "waiters_max": 32,
    "uses_per_lease_max": 16,
    "process_share": 0.25,
    "user_share": 0.5,
    "priority_reserve": 0.125,
}


def full() -> tuple[CoreDriver, Consumer, LeaseId]:
    """A GPU on which a holder loads: nothing else is granted."""
    driver = CoreDriver(8 * GIB, settings=LIMITS)
    holder = driver.consumer("holder", uid=1)
    lease = holder.acquire(5 * GIB)
    return driver, holder, lease


def waiting(person: Consumer, **spec: Any) -> dict[str, Any]:
    """Ask until it is refused. Returns the details of the refusal."""
    for _ in range(100):
        effects = person.try_acquire(2 * GIB, exclusive=True, **spec)
        if any(isinstance(effect, Refuse) for effect in effects):
            refused = refusal(effects)
            assert refused.code == "limit_exceeded"
            assert str(refused.details["value"]) in refused.message
            assert "limits." in refused.hint
            return dict(refused.details)
    raise AssertionError("nothing was refused")


def test_a_process_and_a_user_have_a_share_of_the_queue() -> None:
    """Regression: one process could take all 16,384 places."""
    driver, _, _ = full()
    greedy = driver.consumer("greedy", uid=7)
    assert waiting(greedy) == {"limit": "waiters_max", "value": 8, "share": "of this process"}
    second = driver.consumer("second", uid=7)
    assert waiting(second) == {"limit": "waiters_max", "value": 14, "share": "of uid 7"}
    other = driver.consumer("other", uid=8)
    answer(other.try_acquire(2 * GIB))


def test_the_last_places_are_for_requests_above_the_default_priority() -> None:
    driver, _, _ = full()
    for uid in (7, 8):
        for number in range(2):
            waiting(driver.consumer(f"crowd{number}", uid=uid))
    late = driver.consumer("late", uid=9)
    assert waiting(late) == {"limit": "waiters_max", "value": 28, "share": "of all users"}
    assert waiting(late, priority=51) == {
        "limit": "waiters_max",
        "value": 32,
        "share": "of all users",
    }


def test_a_place_is_free_again_when_its_waiter_is_gone() -> None:
    driver, _, _ = full()
    greedy = driver.consumer("greedy", uid=7)
    waiting(greedy)
    assert driver.arbiter.status(driver.now)["totals"]["waiting"] == 8
    greedy.die()
    again = driver.consumer("again", uid=7)
    waiting(again)
    assert driver.arbiter.status(driver.now)["totals"]["waiting"] == 8


def test_strangers_never_take_the_uses_of_the_holder() -> None:
    """Fails on a limit that counts all uses of a lease together: 256 uses of a stranger kept the holder from using its own lease."""
    driver, holder, lease = full()
    holder.load(lease)
    token = holder.token(lease)

    def use_all(person: Consumer) -> dict[str, Any]:
        for number in range(100):
            effects = person.use_begin(lease, f"u{number}", token)
            if number % 2:
                person.use_yield(lease, f"u{number}", token)
            if any(isinstance(effect, Refuse) for effect in effects):
                return dict(refusal(effects).details)
        raise AssertionError("nothing was refused")

    runner = driver.consumer("runner", uid=7)
    assert use_all(runner) == {
        "limit": "uses_per_lease_max",
        "value": 4,
        "share": "of this process",
    }
    again = driver.consumer("again", uid=7)
    assert use_all(again)["share"] == "of this process"
    third = driver.consumer("third", uid=7)
    assert use_all(third) == {"limit": "uses_per_lease_max", "value": 8, "share": "of uid 7"}
    for uid in (8, 9):
        for number in range(2):
            last = use_all(driver.consumer(f"more{number}", uid=uid))
    assert last == {
        "limit": "uses_per_lease_max",
        "value": 16,
        "share": "of others than its holder",
    }
    assert use_all(holder) == {"limit": "uses_per_lease_max", "value": 16, "share": "of its holder"}
    answer(runner.use_begin(lease, "u0", token))
    runner.use_end(lease, "u0", token)
    answer(runner.use_begin(lease, "another", token))


def test_uses_of_before_a_restart_are_counted_to_their_process() -> None:
    driver, holder, lease = full()
    holder.load(lease)
    token = holder.token(lease)
    runner = driver.consumer("runner", uid=7)
    answer(runner.use_begin(lease, "goal", token))
    driver.restart()
    for person in (holder, runner):
        person.connect()
    answer(holder.reattach(lease, token))
    for number in range(3):
        answer(runner.use_begin(lease, f"u{number}", token))
    assert refusal(runner.use_begin(lease, "u3", token)).details["share"] == "of this process"
    answer(runner.use_begin(lease, "goal", token))
