"""Shares of limited places. One process took all places of the queue, or all uses of a lease, and
locked everybody out: the lease's own holder too, which then could not use what it held."""

from typing import Any

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from vram_arbiter.arbiter.core.effects import Refuse
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import LeaseId

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
            return {key: refused.details[key] for key in ("limit", "value", "share")}
    raise AssertionError("nothing was refused")


def test_a_process_and_a_user_have_a_share_of_the_queue() -> None:
    """Regression: one process could take all 16,384 places."""
    driver, _, _ = full()
    greedy = driver.consumer("greedy", uid=7)
    assert waiting(greedy) == {"limit": "waiters_max", "value": 8, "share": "process"}
    second = driver.consumer("second", uid=7)
    assert waiting(second) == {"limit": "waiters_max", "value": 14, "share": "user"}
    other = driver.consumer("other", uid=8)
    answer(other.try_acquire(2 * GIB))


def test_whose_share_is_used_up_is_named_only_where_it_is_a_users() -> None:
    """Nothing noticed a refusal for a user's share that did not say which user's."""
    driver, _, _ = full()
    first = driver.consumer("first", uid=7)
    waiting(first)
    assert "uid" not in refusal(first.try_acquire(2 * GIB, exclusive=True)).details
    second = driver.consumer("second", uid=7)
    waiting(second)
    assert refusal(second.try_acquire(2 * GIB, exclusive=True)).details["uid"] == 7


def test_a_place_is_free_again_when_its_waiter_is_gone() -> None:
    driver, _, _ = full()
    greedy = driver.consumer("greedy", uid=7)
    waiting(greedy)
    assert driver.status()["totals"]["waiting"] == 8
    greedy.die()
    again = driver.consumer("again", uid=7)
    waiting(again)
    assert driver.status()["totals"]["waiting"] == 8


def test_strangers_never_take_the_uses_of_the_holder() -> None:
    """Fails on a limit that counts all uses of a lease together: 256 uses of a stranger kept the
    holder from using its own lease."""
    driver, holder, lease = full()
    holder.load(lease)
    token = holder.token(lease)

    def use_all(person: Consumer) -> dict[str, Any]:
        for number in range(100):
            effects = person.use_begin(lease, f"u{number}", token)
            if any(isinstance(effect, Refuse) for effect in effects):
                details = refusal(effects).details
                return {key: details[key] for key in ("limit", "value", "share")}
        raise AssertionError("nothing was refused")

    runner = driver.consumer("runner", uid=7)
    assert use_all(runner) == {"limit": "uses_per_lease_max", "value": 4, "share": "process"}
    again = driver.consumer("again", uid=7)
    assert use_all(again)["share"] == "process"
    third = driver.consumer("third", uid=7)
    assert use_all(third) == {"limit": "uses_per_lease_max", "value": 8, "share": "user"}
    for uid in (8, 9):
        for number in range(2):
            last = use_all(driver.consumer(f"more{number}", uid=uid))
    assert last == {"limit": "uses_per_lease_max", "value": 16, "share": "others"}
    assert use_all(holder) == {"limit": "uses_per_lease_max", "value": 16, "share": "holder"}
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
    assert refusal(runner.use_begin(lease, "u3", token)).details["share"] == "process"
    answer(runner.use_begin(lease, "goal", token))
