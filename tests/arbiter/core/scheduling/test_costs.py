"""What was learnt of leaving and coming back orders victims that are otherwise alike, and keeps two
from throwing each other out."""

from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.engine_state import state_of
from tests.support.scenes import give_back, held
from vram_arbiter.arbiter.core.scheduling.victims import Choice
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import LeaseId


def asked(driver: CoreDriver, leases: dict[str, LeaseId]) -> list[str]:
    return [name for name, lease in leases.items() if driver.state(lease) == "revoking"]


# -- victims
def test_of_two_alike_the_one_that_reloads_faster_goes() -> None:
    driver = CoreDriver(
        8 * GIB, settings={"learnt": {"slow": {"load_s": 40.0}, "fast": {"load_s": 2.0}}}
    )
    _, slow = held(driver, "slow", 3)
    _, fast = held(driver, "fast", 3)
    driver.consumer("w").acquire(4 * GIB)
    assert asked(driver, {"slow": slow, "fast": fast}) == ["fast"], "though the slow one is older"


def test_who_can_park_goes_before_who_cannot() -> None:
    driver = CoreDriver(
        8 * GIB, settings={"host_ram_budget_bytes": 16 * GIB, "learnt": {"parks": {"load_s": 40.0}}}
    )
    _, stuck = held(driver, "stuck", 3)
    _, parks = held(driver, "parks", 3, park_bytes=3 * GIB)
    driver.consumer("w").acquire(4 * GIB)
    assert asked(driver, {"stuck": stuck, "parks": parks}) == ["parks"]


def test_a_lower_priority_goes_whatever_it_costs() -> None:
    driver = CoreDriver(
        8 * GIB, settings={"learnt": {"cheap": {"load_s": 0.1}, "dear": {"load_s": 99.0}}}
    )
    _, cheap = held(driver, "cheap", 3, priority=60)
    _, dear = held(driver, "dear", 3, priority=40)
    driver.consumer("w").acquire(4 * GIB, priority=70)
    assert asked(driver, {"cheap": cheap, "dear": dear}) == ["dear"]


def come_and_go(driver: CoreDriver, person: Consumer, pause_s: float) -> None:
    """Ten seconds of loading, gone at once, and a pause until it is wanted again."""
    lease = person.acquire(3 * GIB)
    driver.until(lambda: driver.state(lease) == "loading")
    driver.advance(10.0)
    person.load(lease)
    give_back(driver, person, lease)
    driver.advance(pause_s)


def stay(driver: CoreDriver, person: Consumer) -> LeaseId:
    lease = person.acquire(3 * GIB)
    driver.until(lambda: driver.state(lease) == "loading")
    driver.advance(10.0)
    person.load(lease)
    driver.advance(0.01)
    return lease


def test_who_never_comes_back_is_cheaper_to_send_away(driver: CoreDriver) -> None:
    rare, regular = driver.consumer("rare"), driver.consumer("regular")
    for _ in range(4):
        come_and_go(driver, rare, 100.0)
    for _ in range(4):
        come_and_go(driver, regular, 1.0)
    core = driver.arbiter.inspect()
    leases = {"regular": stay(driver, regular), "rare": stay(driver, rare)}
    assert core.costs.reuse["regular"].chance() > 0.5 > core.costs.reuse["rare"].chance()
    driver.consumer("w").acquire(4 * GIB)
    assert asked(driver, leases) == ["rare"], "though it was used last"


# -- thrash
LEARNT = {name: {"load_s": 6.0, "unload_s": 1.0, "verify_s": 1.0} for name in ("a", "b")}


class Pair:
    """Two consumers that each need the whole GPU, again and again."""

    def __init__(self, **settings: Any) -> None:
        self.driver = CoreDriver(8 * GIB, settings={"learnt": LEARNT, **settings})
        self.people = {name: self.driver.consumer(name) for name in ("a", "b")}
        self.holder, self.lease = "a", self.people["a"].acquire(5 * GIB)
        self.people["a"].load(self.lease)

    def want(self, **spec: Any) -> LeaseId:
        """The other one asks."""
        return self.people["b" if self.holder == "a" else "a"].acquire(5 * GIB, **spec)

    def switch(self, wanted: LeaseId) -> float:
        """The holder leaves when it is asked. Returns how long that took; the loads themselves take
        no time here."""
        waited = self.driver.until(lambda: self.driver.state(self.lease) == "revoking")
        self.people[self.holder].unload(self.lease)
        self.driver.until(lambda: self.driver.state(wanted) == "loading")
        self.holder, self.lease = ("b" if self.holder == "a" else "a"), wanted
        self.people[self.holder].load(wanted)
        return waited


def test_mutual_evictors_stay_for_what_a_switch_costs() -> None:
    pair = Pair()
    assert pair.switch(pair.want()) < 0.1, "the first time"
    assert pair.switch(pair.want()) < 0.1, "and back: only now they have switched both ways"
    wanted = pair.want()
    pair.driver.advance(0.1)
    assert pair.driver.state(pair.lease) == "held"
    why = pair.driver.why("b")["leases"]
    (blocker,) = next(one["blockers"] for one in why if one["lease_id"] == wanted)
    assert blocker["condition"] == "thrashing"
    core = state_of(pair.driver.arbiter)
    held = core.leases[pair.lease]
    expected = Choice.of(core).residency_ends_at(held, core.leases[wanted]) - held.ready_at
    assert pair.switch(wanted) == pytest.approx(expected, abs=0.2)
    assert 3.0 < expected <= 8.0


@pytest.mark.parametrize(
    ("settings", "wish", "low", "high"),
    [
        ({"thrash_hold_max_s": 1.0}, {}, 0.8, 1.2),
        ({"thrash_hold_max_s": 0.0}, {}, 0.0, 0.1),
        ({}, {"priority": 51}, 0.0, 0.1),
        ({"learnt": {}}, {}, 0.0, 0.2),
    ],
    ids=["capped", "turned off", "a higher priority", "nothing learnt"],
)
def test_how_long_the_hold_is(
    settings: dict[str, Any], wish: dict[str, Any], low: float, high: float
) -> None:
    pair = Pair(**settings)
    pair.switch(pair.want())
    pair.switch(pair.want())
    assert low <= pair.switch(pair.want(**wish)) <= high


def test_a_pair_that_was_calm_for_a_while_is_forgotten() -> None:
    pair = Pair(thrash_window_s=20.0)
    pair.switch(pair.want())
    pair.driver.advance(15.0)
    pair.switch(pair.want())
    pair.driver.advance(10.0)
    assert pair.switch(pair.want()) < 0.1, "the first way is older than the window"
    assert set(pair.driver.arbiter.inspect().costs.switches) == {("b", "a"), ("a", "b")}
    pair.driver.advance(100.0)
    pair.switch(pair.want())
    assert len(pair.driver.arbiter.inspect().costs.switches) == 1


def test_equals_take_turns_at_safe_points(driver: CoreDriver) -> None:
    """The second of two equals waited for ever. Each stays for its minimum residency at least, and
    finishes its use."""
    people = {name: driver.consumer(name) for name in ("a", "b")}
    leases = {name: one.acquire(5 * GIB, min_residency_s=2.0) for name, one in people.items()}
    for name, other in (("a", "b"), ("b", "a"), ("a", "b")):
        person, lease = people[name], leases[name]
        driver.until(lambda lease=lease: driver.state(lease) == "loading")
        person.load(lease)
        person.use_begin(lease)
        driver.advance(1.9)
        assert driver.state(lease) == "held"
        driver.until(lambda lease=lease: driver.state(lease) == "revoking")
        driver.advance(60.0)
        assert driver.state(leases[other]) == "queued", "it is in use"
        person.use_end(lease)
        person.unload(lease)
        leases[name] = person.acquire(5 * GIB, min_residency_s=2.0)
