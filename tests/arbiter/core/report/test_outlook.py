"""What happens next for a waiter, with its instant where one is planned; and it does
happen then."""

from typing import Any

import pytest

from tests.support.core_driver import CoreDriver
from tests.support.scenes import held, in_use, why
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import ProcessKey


def plan(driver: CoreDriver, consumer: str = "w") -> list[dict[str, Any]]:
    (entry,) = driver.why(consumer)["leases"]
    steps: list[dict[str, Any]] = entry["plan"]
    return steps


def only(driver: CoreDriver, consumer: str = "w") -> dict[str, Any]:
    (step,) = plan(driver, consumer)
    return step


def test_it_asks_when_the_minimum_residency_ends(driver: CoreDriver) -> None:
    _, lease = held(driver, "detector", 6, min_residency_s=2.0)
    driver.consumer("w").acquire(4 * GIB)
    step = only(driver)
    assert (step["action"], step["consumer"], step["lease_id"]) == ("ask", "detector", lease)
    assert (
        step["text"] == f"revokes detector in {step['in_s']:.1f} s, when its minimum residency ends"
    )
    assert not driver.pushes("revoke", lease)
    driver.advance(step["in_s"] - 0.01)
    assert not driver.pushes("revoke", lease)
    driver.advance(0.02)
    assert driver.pushes("revoke", lease)


def test_it_asks_when_the_waiter_has_aged_enough(driver: CoreDriver) -> None:
    _, lease = in_use(driver, "important", 6, priority=52)
    driver.consumer("w").acquire(4 * GIB, priority=50)
    step = only(driver)
    assert step["in_s"] == pytest.approx(2 * d.AGEING_S_PER_POINT, abs=0.1)
    assert step["text"].endswith("when the waiter's priority has aged to its own")
    driver.advance(step["in_s"] + 0.01)
    assert driver.pushes("revoke", lease)


def test_several_are_asked_together_when_the_last_of_them_may_be(driver: CoreDriver) -> None:
    held(driver, "first", 3.5, min_residency_s=1.0)
    held(driver, "second", 3.5, min_residency_s=3.0)
    driver.consumer("w").acquire(7 * GIB)
    steps = plan(driver)
    assert [(step["action"], step["consumer"]) for step in steps] == [
        ("ask", "first"),
        ("ask", "second"),
    ]
    assert steps[0]["in_s"] == steps[1]["in_s"]
    assert steps[0]["text"].endswith("when enough may be revoked together")
    assert steps[1]["text"].endswith("when its minimum residency ends")


def test_beside_many_holders_the_one_that_can_make_room_is_found(driver: CoreDriver) -> None:
    for number in range(30):
        held(driver, f"pinned{number}", 0.1, evictable=False)
    held(driver, "detector", 4, min_residency_s=60.0)
    driver.consumer("w").acquire(4 * GIB)
    assert (only(driver)["action"], only(driver)["consumer"]) == ("ask", "detector")


def test_the_nearest_step_comes_first(driver: CoreDriver) -> None:
    held(driver, "detector", 6, min_residency_s=5.0)
    driver.consumer("w").acquire(4 * GIB, wait_timeout_s=2.0)
    assert [step["action"] for step in plan(driver)] == ["give_up", "ask"]


def test_nobody_is_asked_where_nobody_could_make_room(driver: CoreDriver) -> None:
    driver.device.names[ProcessKey(9, 9)] = "game"
    driver.device.set(ProcessKey(9, 9), 5 * GIB, driver.now)
    driver.advance(1.5)
    driver.consumer("w").acquire(4 * GIB)
    step = only(driver)
    assert (step["action"], step["consumer"], step["lease_id"], step["in_s"]) == (
        "wait",
        "",
        None,
        None,
    )
    assert (
        step["text"]
        == "revokes no holder, those that could make room are pinned or in use above its priority"
    )


def test_whoever_may_be_asked_already_waits_for_a_measurement_first(driver: CoreDriver) -> None:
    """A dead process's residue may come back any moment: nobody is asked meanwhile."""
    gone, lease = held(driver, "gone", 1, residue_bytes=1 * GIB)
    gone.unload(lease)
    driver.advance(1.0)
    held(driver, "holder", 5)
    driver.device.lag_s = 5.0
    gone.die()
    driver.consumer("w").acquire(4 * GIB)
    step = only(driver)
    assert (step["action"], step["in_s"]) == ("ask", 0.0)
    assert step["text"] == "revokes holder in 0.0 s, with the next reading of the GPU"


def test_a_holder_on_its_way_out(driver: CoreDriver) -> None:
    holder, lease = in_use(driver, "holder", 6)
    driver.consumer("w").acquire(4 * GIB)
    step = only(driver)
    assert step["action"] == "deadline"
    assert step["in_s"] == pytest.approx(d.REVOKE_DEADLINE_S, abs=0.1)
    assert step["text"] == "waits 30.0 s more for holder to release, after that w waits on"
    driver.advance(d.REVOKE_DEADLINE_S + 0.1)
    assert (only(driver)["action"], only(driver)["in_s"]) == ("wait", None)
    holder.use_end(lease)
    holder.unloading(lease)
    assert only(driver)["text"] == "waits for holder to release, it is being evicted"
    driver.device.lag_s = 20.0
    holder.hold(0)
    holder.release(lease)
    step = only(driver)
    assert (step["action"], step["lease_id"]) == ("measure", lease)
    assert 0 <= step["in_s"] <= 0.05
    assert "a verdict comes in 10.0 s at the latest" in step["text"]
    driver.device.silent = True  # no reading comes, so the verdict is late
    driver.advance(11)
    assert "until its bytes are measured gone" in only(driver)["text"]


def test_a_load_under_way(driver: CoreDriver) -> None:
    driver.consumer("loader").acquire(3 * GIB)
    driver.advance(0.01)
    driver.consumer("w").acquire(3 * GIB)
    step = only(driver)
    assert (step["text"], step["in_s"]) == (
        "lets loader finish loading, only one model loads at a time",
        None,
    )

    known = CoreDriver(settings={"learnt": {"loader": {"load_s": 4.0}}})
    known.consumer("loader").acquire(3 * GIB)
    known.advance(0.5)
    known.consumer("w").acquire(3 * GIB)
    assert only(known)["in_s"] == pytest.approx(3.5, abs=0.1)


def test_a_gpu_that_cannot_be_read_and_one_that_shows_no_room(driver: CoreDriver) -> None:
    driver.device.failing = "hangs"
    driver.advance(1.5)
    driver.consumer("w").acquire(3 * GIB)
    step = only(driver)
    assert (step["action"], step["text"].split(",")[1]) == (
        "read",
        " nothing is granted on a GPU that cannot be read",
    )
    assert 0 < step["in_s"] <= d.PROBE_PERIOD_S

    silent = CoreDriver()
    silent.device.silent = True
    silent.advance(3)
    silent.consumer("w").acquire(3 * GIB)
    assert only(silent)["text"].endswith("the ledger has room, but the GPU has to show it")


def test_pressure_plans_nothing_of_its_own(driver: CoreDriver) -> None:
    holder, _ = held(driver, "holder", 4, evictable=False)
    holder.hold(int(7.9 * GIB))
    driver.advance(1.5)
    driver.consumer("w").acquire(3 * GIB)
    assert plan(driver) == []


def test_behind_others_only_its_own_end_is_planned(driver: CoreDriver) -> None:
    in_use(driver, "holder", 6)
    driver.consumer("head").acquire(4 * GIB)
    driver.consumer("w").acquire(5 * GIB, wait_timeout_s=12.0)
    step = only(driver)
    assert (step["action"], step["in_s"]) == ("give_up", 12.0)
    assert step["text"] == "gives up in 12.0 s, when its wait timeout is over"


def test_the_estimate_counts_those_who_will_be_asked() -> None:
    learnt = {"detector": {"drain_s": 1.0, "unload_s": 0.5, "verify_s": 0.5}, "w": {"load_s": 3.0}}
    driver = CoreDriver(settings={"learnt": learnt})
    held(driver, "detector", 6, min_residency_s=2.0)
    driver.consumer("w").acquire(4 * GIB)
    (entry,) = driver.why("w")["leases"]
    assert entry["eta_source"] == "learnt"
    assert entry["eta_s"] == pytest.approx(7.0, abs=0.1)
    unknown = CoreDriver(settings={"learnt": {"w": {"load_s": 3.0}}})
    held(unknown, "detector", 6, min_residency_s=2.0)
    unknown.consumer("w").acquire(4 * GIB)
    (entry,) = unknown.why("w")["leases"]
    assert (entry["eta_s"], entry["eta_source"]) == (None, "none")


def test_there_is_no_estimate_where_nobody_will_be_asked() -> None:
    driver = CoreDriver(settings={"learnt": {"w": {"load_s": 3.0}}})
    held(driver, "pinned", 6, evictable=False)
    driver.consumer("w").acquire(4 * GIB)
    assert why(driver, "w")["eta_s"] is None


LOADS = {name: {"load_s": 3.0} for name in ("head", "second", "third")}


def eta(driver: CoreDriver, name: str) -> float | None:
    (entry,) = driver.why(name)["leases"]
    return entry["eta_s"]


def test_the_estimate_behind_others_counts_their_loads() -> None:
    """Regression: a request behind others was estimated as if it were the head, and one that only
    fits once those ahead of it have left was too."""
    learnt = {"detector": {"drain_s": 1.0, "unload_s": 0.5, "verify_s": 0.5}, **LOADS}
    driver = CoreDriver(8 * GIB, settings={"learnt": learnt})
    _, lease = in_use(driver, "detector", 7)
    driver.consumer("head").acquire(4 * GIB)
    driver.consumer("second").acquire(2 * GIB)
    driver.consumer("third").acquire(3 * GIB)
    assert driver.state(lease) == "revoking"
    assert eta(driver, "head") == pytest.approx(2.0 + 3.0)
    assert eta(driver, "second") == pytest.approx(2.0 + 3.0 + 3.0), "only one model loads at a time"
    assert eta(driver, "third") is None, "head and second have to leave for it; it is unknown when"


def test_the_estimate_behind_a_load_counts_what_is_left_of_it() -> None:
    """Regression: a request that fits beside a loading lease was estimated as if it loaded now."""
    driver = CoreDriver(8 * GIB, settings={"learnt": LOADS})
    driver.consumer("head").acquire(4 * GIB)
    driver.consumer("second").acquire(2 * GIB)
    driver.advance(1.0)
    assert eta(driver, "second") == pytest.approx(2.0 + 3.0)
