"""Uses that yield: a job that pauses keeps nobody out, and comes back under its own name."""

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from vram_arbiter.arbiter.core.effects import Push
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.pushes import RevokePush

GIB = d.GIB


def in_use(driver: CoreDriver, name: str = "job") -> tuple[Consumer, LeaseId]:
    person = driver.consumer(name)
    lease = person.acquire(5 * GIB)
    person.load(lease)
    person.use_begin(lease, "u1", label="render")
    driver.advance(0.01)
    return person, lease


def test_a_yielded_use_lets_the_holder_leave_before_the_job_has_ended(driver: CoreDriver) -> None:
    job, lease = in_use(driver)
    waiter = driver.consumer("llm").acquire(5 * GIB)
    assert driver.pushes("revoke", lease)[-1]["uses"] == 1
    assert refusal(job.unloading(lease)).code == "bad_state"
    effects = job.use_yield(lease)
    assert answer(effects)["uses"] == 0
    pushed = [e.body for e in effects if isinstance(e, Push)]
    assert [isinstance(one, RevokePush) and one.uses for one in pushed] == [0], (
        "it is told that it may unload"
    )
    assert driver.view(lease)["yielded"] == 1  # type: ignore[index]
    job.unload(lease)
    driver.until(lambda: driver.state(waiter) == "loading")
    assert [n["why"] for n in driver.notes("use_ended")] == ["paused"]


def test_a_yielded_use_makes_an_idle_holder_that_may_be_asked(driver: CoreDriver) -> None:
    job, lease = in_use(driver)
    job.use_yield(lease)
    driver.consumer("low").acquire(5 * GIB, priority=1)
    assert driver.state(lease) == "revoking", "even one of lower priority may ask an idle holder"


def test_beginning_a_yielded_use_again_resumes_it(driver: CoreDriver) -> None:
    job, lease = in_use(driver)
    job.use_yield(lease)
    assert answer(job.use_begin(lease, "u1"))["uses"] == 1
    assert driver.notes("use_began")[-1]["resumed"] is True
    assert driver.notes("use_began")[-1]["label"] == "render", "it is the same use"
    assert "yielded" not in (driver.view(lease) or {})
    driver.consumer("w").acquire(5 * GIB)
    assert refusal(job.unloading(lease)).code == "bad_state"


def test_a_use_that_yielded_is_not_resumed_on_a_holder_that_was_asked_to_leave(
    driver: CoreDriver,
) -> None:
    job, lease = in_use(driver)
    job.use_yield(lease)
    driver.consumer("w").acquire(5 * GIB)
    assert refusal(job.use_begin(lease, "u1")).code == "lease_revoking"
    job.unload(lease)
    assert refusal(job.use_begin(lease, "u1")).code == "lease_revoking"


def test_yielding_again_is_fine_and_yielding_what_is_not_there_is_not(driver: CoreDriver) -> None:
    job, lease = in_use(driver)
    stranger = driver.consumer("stranger")
    assert refusal(stranger.use_yield(lease, "u1", job.token(lease))).code == "bad_state", (
        "not its use"
    )
    job.use_yield(lease)
    before = len(driver.notes("use_yielded"))
    assert answer(job.use_yield(lease))["uses"] == 0
    assert len(driver.notes("use_yielded")) == before
    job.use_end(lease)
    assert driver.notes("use_ended")[-1]["reason"] == "ended"
    assert refusal(job.use_yield(lease)).code == "bad_state"


def test_one_use_that_yields_beside_a_busy_one_changes_nothing_for_the_holder(
    driver: CoreDriver,
) -> None:
    job, lease = in_use(driver)
    job.use_begin(lease, "u2")
    driver.consumer("w").acquire(5 * GIB)
    effects = job.use_yield(lease, "u2")
    assert answer(effects)["uses"] == 1
    assert not [e for e in effects if isinstance(e, Push)]
    holder = driver.why("job")["leases"][0]["holder"]
    assert (holder["uses"], holder["paused"]) == (1, 1)


def test_yielded_uses_count_to_the_limit(driver: CoreDriver) -> None:
    driver = CoreDriver(8 * GIB, settings={"uses_per_lease_max": 1})
    job, lease = in_use(driver)
    job.use_yield(lease)
    assert refusal(job.use_begin(lease, "u2")).details["limit"] == "uses_per_lease_max"
    assert answer(job.use_begin(lease, "u1"))["uses"] == 1


def test_yielded_uses_end_with_their_process_and_with_their_client(driver: CoreDriver) -> None:
    job, lease = in_use(driver)
    runner = driver.consumer("runner")
    runner.use_begin(lease, "goal", job.token(lease))
    runner.use_yield(lease, "goal", job.token(lease))
    runner.die()
    assert driver.notes("use_ended")[-1]["why"] == "process_died"
    job.use_yield(lease)
    job.leave("dropped")
    assert driver.notes("use_ended")[-1]["why"] == "client_left"
    assert driver.state(lease) == "held"


def test_a_holder_that_dies_takes_its_yielded_uses_along(driver: CoreDriver) -> None:
    job, lease = in_use(driver)
    runner = driver.consumer("runner")
    runner.use_begin(lease, "goal", job.token(lease))
    runner.use_begin(lease, "goal2", job.token(lease))
    runner.use_yield(lease, "goal", job.token(lease))
    job.die()
    assert driver.state(lease) == "over"
    driver.advance(1.0)
    assert driver.gpu()["charged_bytes"] == 0


def test_a_yielded_use_survives_a_reconnect_and_is_resumed_by_name_after_a_restart(
    driver: CoreDriver,
) -> None:
    job, lease = in_use(driver)
    job.use_yield(lease)
    token = job.token(lease)
    answer(job.reattach(lease, token, uses=[]))
    assert driver.view(lease)["yielded"] == 1  # type: ignore[index]
    answer(job.reattach(lease, token, uses=["u1"]))
    view = driver.view(lease)
    assert view is not None
    assert (view["uses"], "yielded" in view) == (1, False), "its holder says that it runs"
    job.use_yield(lease)
    driver.restart()
    job.connect()
    answer(job.reattach(lease, token, uses=[]))
    assert answer(job.use_begin(lease, "u1", token))["uses"] == 1
