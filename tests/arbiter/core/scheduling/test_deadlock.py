"""Waits that can never end are refused at once, with the circle in words; waits that can end are
left alone."""

from typing import Any

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from vram_arbiter.arbiter.core.effects import Effect, Push, Refuse
from vram_arbiter.arbiter.core.scheduling import deadlock
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.pushes import RevokePush

GIB = d.GIB


def using(driver: CoreDriver, name: str, gib: float, **spec: Any) -> tuple[Consumer, LeaseId]:
    """A process in the middle of a use of its own model."""
    person = driver.consumer(name)
    lease = person.acquire(int(gib * GIB), **spec)
    driver.until(lambda: driver.state(lease) == "loading")
    person.load(lease)
    person.use_begin(lease)
    driver.advance(0.01)
    return person, lease


def idle(driver: CoreDriver, name: str, gib: float, **spec: Any) -> tuple[Consumer, LeaseId]:
    person, lease = using(driver, name, gib, **spec)
    person.use_end(lease)
    return person, lease


def links(refused: Refuse) -> list[tuple[str, list[str], list[str]]]:
    return [
        (
            link["consumer"],
            [one["consumer"] for one in link["waits_for"]],
            [one["consumer"] for one in link["holds"]],
        )
        for link in refused.details["cycle"]
    ]


def revokes_in(effects: list[Effect]) -> list[Effect]:
    return [e for e in effects if isinstance(e, Push) and isinstance(e.body, RevokePush)]


# -- circles
def test_who_uses_what_is_in_his_way_is_told_at_once(driver: CoreDriver) -> None:
    job, lease = using(driver, "job", 5)
    effects = job.try_acquire(5 * GIB)
    refused = refusal(effects)
    assert refused.code == "would_deadlock"
    assert links(refused) == [("job", ["job"], ["job"])]
    assert not revokes_in(effects), "nobody is asked to leave in vain"
    assert driver.state(lease) == "held"
    assert [n["code"] for n in driver.notes("denied")] == ["would_deadlock"]


def test_the_same_nonce_gets_the_same_answer(driver: CoreDriver) -> None:
    job, _ = using(driver, "job", 5)
    for _ in range(2):
        assert refusal(job.try_acquire(5 * GIB, nonce="n")).code == "would_deadlock"


def test_a_circle_of_two_is_broken_at_its_newest(driver: CoreDriver) -> None:
    a, _ = using(driver, "a", 3)
    b, _ = using(driver, "b", 3)
    first = a.acquire(4 * GIB)
    assert driver.state(first) == "queued", "b may end its use any time"
    refused = refusal(b.try_acquire(4 * GIB))
    assert refused.code == "would_deadlock"
    assert {name for name, _, _ in links(refused)} == {"a", "b"}
    assert driver.state(first) == "queued", "the older wait stands"
    b.use_end(next(iter(b.specs)))
    b.unload(next(iter(b.specs)))
    driver.until(lambda: driver.state(first) == "loading")


def test_a_use_that_closes_the_circle_ends_the_wait_by_push(driver: CoreDriver) -> None:
    a, own = idle(driver, "a", 3)
    b, theirs = using(driver, "b", 4, priority=90)
    waiting = a.acquire(5 * GIB)
    assert driver.state(waiting) == "queued"
    a.use_begin(theirs, "call", b.token(theirs))
    assert driver.state(waiting) == "over"
    (denied,) = driver.pushes("denied", waiting)
    assert denied["error"]["code"] == "would_deadlock"
    assert driver.state(own) in ("held", "revoking")


def test_a_circle_of_three_over_two_gpus() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    a, _ = using(driver, "a", 5, gpu="0")
    b, _ = using(driver, "b", 5, gpu="1")
    c, third = using(driver, "c", 2, gpu="1")
    del third
    assert driver.state(a.acquire(5 * GIB, gpu="1")) == "queued"
    assert driver.state(c.acquire(1 * GIB, gpu="1", independent=True)) == "queued", "behind a"
    refused = refusal(b.try_acquire(4 * GIB, gpu="0"))
    assert refused.code == "would_deadlock"
    assert sorted(name for name, _, _ in links(refused)) == ["a", "b"]


def test_a_wait_behind_somebody_who_waits_for_my_use_is_a_circle_too(driver: CoreDriver) -> None:
    """The small one would fit, but would delay the big one before it, and that one waits for the
    small one's process."""
    job, _ = using(driver, "job", 5)
    big = driver.consumer("big").acquire(7 * GIB)
    assert driver.state(big) == "queued"
    refused = refusal(job.try_acquire(1 * GIB))
    assert refused.code == "would_deadlock"
    assert links(refused) == [("job", ["big"], ["job"]), ("big", ["job"], [])]
    assert driver.state(big) == "queued", "who holds nothing is not the one to be refused"


def test_an_exclusive_waiter_lets_nobody_pass(driver: CoreDriver) -> None:
    job, _ = using(driver, "job", 2)
    driver.consumer("all").acquire(2 * GIB, exclusive=True)
    assert refusal(job.try_acquire(1 * GIB)).code == "would_deadlock"


def test_several_circles_are_all_broken(driver: CoreDriver) -> None:
    a, _ = using(driver, "a", 5)
    waits = [a.acquire(5 * GIB, independent=True) for _ in range(2)]
    assert [driver.state(lease) for lease in waits] == ["queued", "queued"]
    assert refusal(a.try_acquire(6 * GIB)).code == "would_deadlock"
    assert [driver.state(lease) for lease in waits] == ["queued", "queued"]


# -- no circles
def test_what_fits_beside_my_use_is_no_circle(driver: CoreDriver) -> None:
    job, _ = using(driver, "job", 4)
    _, other = using(driver, "other", 3)
    wanted = job.acquire(3 * GIB)
    assert driver.state(wanted) == "queued"
    assert driver.state(other) == "revoking", "somebody else has to finish: that is a wait"


def test_an_independent_wait_is_no_circle(driver: CoreDriver) -> None:
    job, lease = using(driver, "job", 5)
    wanted = job.acquire(5 * GIB, independent=True)
    assert driver.state(wanted) == "queued"
    job.use_end(lease)
    job.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")


def test_yielding_opens_the_circle_before_it_closes(driver: CoreDriver) -> None:
    job, lease = using(driver, "job", 5)
    job.use_yield(lease)
    wanted = job.acquire(5 * GIB)
    assert driver.state(wanted) == "queued"
    job.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")


def test_resuming_a_use_while_waiting_closes_it(driver: CoreDriver) -> None:
    driver.consumer("first")
    job, lease = using(driver, "job", 5, min_residency_s=30.0)
    job.use_yield(lease)
    wanted = job.acquire(5 * GIB)
    assert (driver.state(lease), driver.state(wanted)) == ("held", "queued")
    job.use_begin(lease)
    assert driver.pushes("denied", wanted)[0]["error"]["code"] == "would_deadlock"


def test_a_pinned_holder_is_a_wait_and_no_circle(driver: CoreDriver) -> None:
    job, lease = using(driver, "job", 1)
    other = driver.consumer("pinner").acquire(1 * GIB)
    driver.until(lambda: driver.state(other) == "loading")
    wanted = job.acquire(6 * GIB)
    del lease
    assert driver.state(wanted) == "queued"


def test_what_waits_for_a_residue_or_a_stowaway_is_left_alone(driver: CoreDriver) -> None:
    from vram_arbiter.schemas.ids import ProcessKey

    driver.device.set(ProcessKey(9, 9), 4 * GIB, driver.now)
    driver.advance(2.0)
    job, _ = using(driver, "job", 1)
    assert driver.state(job.acquire(5 * GIB)) == "queued", "the stowaway may go any time"


def test_a_low_priority_waiter_before_a_busy_holder_only_waits(driver: CoreDriver) -> None:
    a, _ = using(driver, "a", 1, priority=10)
    using(driver, "b", 5, priority=90)
    assert driver.state(a.acquire(4 * GIB, priority=10)) == "queued"


def test_a_process_that_waits_and_uses_nothing_is_in_no_circle(driver: CoreDriver) -> None:
    _, lease = using(driver, "job", 5)
    waits = [driver.consumer(f"w{n}").acquire(5 * GIB) for n in range(3)]
    assert [driver.state(w) for w in waits] == ["queued"] * 3
    assert driver.state(lease) == "revoking"


def test_a_process_that_can_be_served_elsewhere_is_in_no_circle() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    job, _ = using(driver, "job", 5, gpu="0")
    using(driver, "other", 5, gpu="1")
    assert driver.state(job.acquire(5 * GIB)) == "queued", "the other GPU's holder will end its use"


def test_a_debt_is_on_its_way_back(driver: CoreDriver) -> None:
    job, _ = using(driver, "job", 2)
    other, _ = idle(driver, "other", 5)
    driver.device.lag_s = 5.0
    other.die()
    wanted = job.acquire(5 * GIB)
    assert driver.state(wanted) == "queued"
    driver.until(lambda: driver.state(wanted) == "loading", limit_s=15.0)


def test_uses_that_come_back_after_a_restart_are_looked_at_too(driver: CoreDriver) -> None:
    job, lease = using(driver, "job", 5)
    token = job.token(lease)
    driver.restart()
    job.connect()
    wanted = job.acquire(5 * GIB)
    assert driver.state(wanted) == "queued", "what it uses is not known yet"
    answer(job.reattach(lease, token, uses=["u1"]))
    assert driver.pushes("denied", wanted)[0]["error"]["code"] == "would_deadlock"


def test_who_only_waits_for_a_circle_is_not_the_one_to_be_refused() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    a, _ = using(driver, "a", 5, gpu="0")
    b, theirs = idle(driver, "b", 5, gpu="1", min_residency_s=600.0)
    c, _ = using(driver, "c", 1, gpu="1")
    first = b.acquire(5 * GIB, gpu="0")
    second = a.acquire(5 * GIB, gpu="1")
    newest = c.acquire(5 * GIB, gpu="0")
    assert [driver.state(lease) for lease in (first, second, newest)] == ["queued"] * 3
    b.use_begin(theirs)
    assert [driver.state(lease) for lease in (first, second, newest)] == [
        "queued",
        "over",
        "queued",
    ]
    (denied,) = driver.pushes("denied", second)
    assert sorted(link["consumer"] for link in denied["error"]["details"]["cycle"]) == ["a", "b"]


def test_a_process_that_waits_for_very_many_is_not_looked_at() -> None:
    """One look weighs every wait: with thousands each acquire of a process in a use held the loop
    for a tenth of a second."""
    driver = CoreDriver(8 * GIB, settings={"leases_per_client_max": 1000})
    job, lease = using(driver, "job", 5)
    first, _ = using(driver, "other", 1)
    for _ in range(deadlock.WAITS_MAX):
        job.acquire(5 * GIB, independent=True)
    assert refusal(job.try_acquire(5 * GIB)).code == "would_deadlock", (
        "independent waits do not count"
    )
    job.use_yield(lease)
    crowd = [job.acquire(int(5.5 * GIB)) for _ in range(deadlock.WAITS_MAX + 1)]
    job.use_begin(lease)
    assert {driver.state(one) for one in crowd} == {"queued"}
    assert driver.state(first.acquire(GIB // 2)) == "loading", (
        "and nobody else is denied because of it"
    )
