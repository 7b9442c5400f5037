"""`why` of those who are not alone: members of a gang, and leases that were carved out of another,
with whoever waits for them."""

from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer
from tests.support.scenes import held, why
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

GIB, MIB = d.GIB, d.MIB


def blockers(driver: CoreDriver, consumer: str) -> list[tuple[Any, ...]]:
    return [
        (b["consumer"], b["lease_id"], b["bytes"] / GIB, b["state"], b["text"])
        for b in why(driver, consumer)["blockers"]
    ]


def plan(driver: CoreDriver, consumer: str) -> list[tuple[str, str, float | None]]:
    return [
        (step["action"], step["consumer"], None if step["in_s"] is None else round(step["in_s"], 1))
        for step in why(driver, consumer)["plan"]
    ]


def gang(driver: CoreDriver, **spec: Any) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    policy, reward = driver.consumer("policy"), driver.consumer("reward")
    first = policy.acquire(4 * GIB, 3 * GIB, gang=("g", 2), **spec)
    return policy, first, reward, reward.acquire(3 * GIB, 2 * GIB, gang=("g", 2), **spec)


# -- gangs
def test_every_member_that_waits_says_what_the_gang_needs_and_who_is_in_its_way() -> None:
    driver = CoreDriver()
    busy, lease = held(driver, "busy", 5, priority=60)
    busy.use_begin(lease)
    _, idle = held(driver, "idle", 2)
    _, _, _, second = gang(driver)
    driver.advance(1.0)
    for member in ("policy", "reward"):
        told = why(driver, member)
        assert told["condition"] == "gang_waits"
        assert told["needed_bytes"] == 3 * GIB + 2 * GIB + 1 * GIB, (
            "all their steady bytes and one headroom"
        )
        assert told["deficit_bytes"] == 6 * GIB - told["free_bytes"]
        assert (
            "no holder that could make room for the whole gang may be revoked now" in told["next"]
        )
        assert blockers(driver, member) == [
            ("busy", lease, 5.0, "held", "is in use and has priority 60, the waiter 50"),
            ("idle", idle, 2.0, "held", "is idle and may be revoked"),
        ]
        assert plan(driver, member) == [("ask", "busy", 49.0), ("ask", "idle", 49.0)]
    busy.use_end(lease)
    assert plan(driver, "reward") == [("deadline", "busy", 30.0), ("deadline", "idle", 30.0)]
    busy.unload(lease)
    driver.until(lambda: driver.state(lease) == "over")
    assert why(driver, "policy")["deficit_bytes"] > 0, "four would fit now, but not all"
    assert [name for name, *_ in blockers(driver, "policy")] == ["idle"]
    assert driver.state(second) == "queued"


def test_a_gang_behind_somebody_has_one_place() -> None:
    driver = CoreDriver()
    busy, lease = held(driver, "busy", 5, priority=90)
    busy.use_begin(lease)
    driver.consumer("first").acquire(6 * GIB, priority=80)
    gang(driver)
    for member in ("policy", "reward"):
        assert why(driver, member)["next"] == "waits as one of gang g behind first as number 2"
        assert why(driver, member)["position"] == 2
        assert plan(driver, member) == []


def test_one_that_waits_for_its_turn_names_who_loads() -> None:
    driver = CoreDriver(settings={"learnt": {"policy": {"load_s": 2.0}, "reward": {"load_s": 3.0}}})
    policy, first, _, second = gang(driver)
    driver.advance(0.5)
    told = why(driver, "reward")
    assert (told["condition"], told["needed_bytes"], told["deficit_bytes"]) == (
        "gang_loads",
        3 * GIB,
        0,
    )
    assert "free or kept for it" in told["text"]
    assert blockers(driver, "reward") == [("policy", first, 4.0, "loading", "is loading")]
    assert plan(driver, "reward") == [("loaded", "policy", 1.5)]
    assert told["eta_s"] == pytest.approx(5.0), "its own load comes after the other's"
    assert (
        f"gang g is complete once all are held: reward ({second}) is queued"
        in why(driver, "policy")["text"]
    )
    policy.load(first)
    driver.advance(0.01)
    assert why(driver, "reward")["next"].endswith("gang g is complete once it is held")


def test_a_member_whose_memory_is_missing_says_until_when() -> None:
    driver = CoreDriver(start=False)
    driver.device.lists_processes = False
    driver.advance(0.01)
    policy, first, _, _ = gang(driver)
    driver.device.set(ProcessKey(9, 9), 3 * GIB, driver.now)
    driver.advance(1.5)
    policy.load(first)
    driver.advance(2.0)
    told = why(driver, "reward")
    assert told["next"] == "its bytes are kept for it, but measured memory is not free yet"
    (read, *_), (broken, _, in_s) = plan(driver, "reward")
    assert (read, broken) == ("read", "break")
    assert in_s == pytest.approx(d.VERIFY_TIMEOUT_S - 2.0, abs=0.2)


def test_whoever_waits_beside_a_gang_sees_what_is_kept_for_it() -> None:
    driver = CoreDriver()
    _, first, _, second = gang(driver)
    driver.consumer("w").acquire(4 * GIB)
    assert blockers(driver, "w") == [
        ("policy", first, 4.0, "loading", "is loading"),
        ("reward", second, 2.0, "queued", "has its bytes kept for its turn in gang g"),
    ]
    assert (
        sum(count for _, _, count, *_ in blockers(driver, "w")) * GIB
        == driver.gpu()["charged_bytes"]
    )


def test_a_holder_of_an_unfinished_gang_says_so_to_its_waiter() -> None:
    driver = CoreDriver()
    policy, first, _, second = gang(driver)
    policy.load(first)
    driver.consumer("w").acquire(7 * GIB)
    assert blockers(driver, "w") == [
        ("policy", first, 3.0, "held", "belongs to gang g, which is not complete"),
        ("reward", second, 3.0, "loading", "is loading"),
    ]


def test_the_context_of_a_members_process_is_told_from_what_is_kept_for_it() -> None:
    driver = CoreDriver()
    policy, reward = driver.consumer("policy"), driver.consumer("reward")
    before = reward.acquire(GIB, residue_bytes=400 * MIB)
    reward.load(before)
    driver.advance(0.01)
    reward.unload(before)
    driver.until(lambda: driver.state(before) == "over")
    policy.acquire(2 * GIB, gang=("g", 2))
    second = reward.acquire(2 * GIB, gang=("g", 2))
    driver.consumer("w").acquire(7 * GIB)
    assert [(name, lease, state) for name, lease, _, state, _ in blockers(driver, "w")][1:] == [
        ("reward", second, "queued"),
        ("reward", None, "residue"),
    ]


def test_a_gang_over_two_gpus_tells_each_member_its_own_gpu() -> None:
    driver = CoreDriver(gpus=2)
    left, lease = held(driver, "left", 5, gpu="0")
    right, _ = held(driver, "right", 5, gpu="1")
    left.use_begin(lease)
    right.use_begin(LeaseId("L1-3"))
    a, b = driver.consumer("a"), driver.consumer("b")
    a.acquire(4 * GIB, gang=("g", 2), gpu="0")
    b.acquire(6 * GIB, gang=("g", 2), gpu="1")
    assert [(name, count) for name, _, count, *_ in blockers(driver, "a")] == [("left", 5.0)]
    assert [(name, count) for name, _, count, *_ in blockers(driver, "b")] == [("right", 5.0)]
    assert (why(driver, "a")["needed_bytes"], why(driver, "b")["needed_bytes"]) == (
        4 * GIB,
        6 * GIB,
    )


def test_a_gang_of_which_not_all_are_back_says_so() -> None:
    driver = CoreDriver()
    policy, first, _, _ = gang(driver)
    token = policy.token(first)
    driver.restart()
    policy.connect()
    answer(policy.reattach(first, token, held=False))
    assert why(driver, "policy")["text"].endswith("once all are held: 1 of 2 have to come back")
    driver.consumer("late").acquire(GIB, gang=("h", 2))
    assert plan(driver, "late") == [], "that one waits for its own"


def test_a_member_that_waits_for_the_rest_after_a_restart_knows_until_when() -> None:
    driver = CoreDriver()
    people = [driver.consumer(name) for name in "abc"]
    leases = [person.acquire(GIB, gang=("g", 3)) for person in people]
    token = people[0].token(leases[0])
    driver.restart()
    for person in people[:2]:
        person.connect()
    answer(people[0].reattach(leases[0], token, held=False))
    people[1].acquire(GIB, gang=("g", 3))
    assert plan(driver, "b") == [
        ("break", "", pytest.approx(d.LEASE_TTL_S + d.FENCE_GRACE_S, abs=0.1))
    ]
    assert why(driver, "b")["eta_s"] is None


def test_what_a_dead_holder_left_is_a_debt() -> None:
    driver = CoreDriver()
    dead, lease = held(driver, "dead", 5)
    driver.device.lag_s = 5.0
    dead.die()
    driver.consumer("w").acquire(5 * GIB)
    assert blockers(driver, "w")[0][2:] == (5.0, "debt", "is over, its bytes are being measured")
    assert driver.state(lease) == "over"
