"""Who leaves: the cheapest set that covers the need, nobody in vain."""

from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.engine_state import state_of
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Block

GIB, MIB = d.GIB, d.MIB


class Card:
    """A card with holders; `want` says who is asked when somebody wants room."""

    def __init__(self, capacity_bytes: int = 8 * GIB + d.RESERVE_BYTES) -> None:
        self.driver = CoreDriver(capacity_bytes)
        self.names: dict[LeaseId, str] = {}
        self.people: dict[str, Consumer] = {}
        self.held: dict[str, LeaseId] = {}

    def hold(self, name: str, gib: float, **spec: Any) -> LeaseId:
        person = self.people[name] = self.driver.consumer(name)
        lease = person.acquire(int(gib * GIB), **spec)
        self.driver.until(lambda: self.driver.state(lease) == "loading")
        person.load(lease)
        self.driver.advance(0.01)
        self.names[lease] = name
        self.held[name] = lease
        return lease

    def use(self, name: str) -> None:
        self.people[name].use_begin(self.held[name])

    def want(self, gib: float, **spec: Any) -> set[str]:
        self.people["w"] = self.driver.consumer("w")
        self.held["w"] = self.people["w"].acquire(int(gib * GIB), **spec)
        return self.asked()

    def asked(self) -> set[str]:
        return {self.names[LeaseId(push["lease_id"])] for push in self.driver.pushes("revoke")}

    @property
    def gpu(self) -> Gpu:
        return next(iter(state_of(self.driver.arbiter).gpus.values()))


def test_nobody_is_asked_if_it_fits() -> None:
    card = Card()
    card.hold("a", 3)
    assert card.want(5) == set()
    assert card.driver.state(card.held["w"]) == "loading"


def test_one_that_covers_is_better_than_two() -> None:
    card = Card()
    card.hold("small", 1)
    card.hold("medium", 2)
    card.hold("large", 4)
    assert card.want(5) == {"large"}


def test_of_equals_the_one_that_wastes_least_goes() -> None:
    card = Card()
    card.hold("three", 3)
    card.hold("four", 4)
    assert card.want(4) == {"three"}


def test_of_the_same_size_the_least_recently_used_goes() -> None:
    card = Card()
    card.hold("old", 3)
    card.hold("new", 3)
    card.people["old"].use_begin(card.held["old"])
    card.people["old"].use_end(card.held["old"])
    assert card.want(4) == {"new"}


def test_lower_priority_goes_before_better_size() -> None:
    card = Card()
    card.hold("exact", 3, priority=60)
    card.hold("cheap", 4, priority=40)
    assert card.want(4) == {"cheap"}


def test_a_higher_class_is_touched_only_if_the_lower_one_is_not_enough() -> None:
    card = Card()
    card.hold("low", 1, priority=10)
    card.hold("mid", 2, priority=20)
    card.hold("high", 4, priority=30)
    assert card.want(4) == {"low", "mid"}
    card = Card()
    card.hold("low", 1, priority=10)
    card.hold("mid", 2, priority=20)
    card.hold("high", 4, priority=30)
    assert card.want(5) == {"high"}


def test_idle_goes_before_in_use_even_if_more_have_to() -> None:
    card = Card()
    card.hold("a", 2)
    card.hold("b", 2)
    card.hold("busy", 4)
    card.use("busy")
    assert card.want(4) == {"a", "b"}


def test_in_use_is_asked_when_nothing_else_helps_and_only_as_few_as_needed() -> None:
    card = Card()
    card.hold("a", 2)
    card.hold("busy1", 3)
    card.hold("busy2", 3)
    card.use("busy1")
    card.use("busy2")
    assert card.want(5) == {"a", "busy2"} or card.asked() == {"a", "busy1"}


def test_pinned_is_never_asked_and_nothing_is_asked_in_vain() -> None:
    card = Card()
    card.hold("a", 2)
    waiter = card.driver.consumer("early").acquire(6 * GIB + 1)
    assert card.asked() == {"a"}
    card.driver.consumer("x")
    assert card.driver.state(waiter) == "queued"
    card = Card()
    card.hold("busy", 4, priority=90)
    card.use("busy")
    card.hold("idle", 2)
    assert card.want(5) == set(), "the idle one alone would not be enough"
    card.driver.advance(1.0)
    assert card.asked() == set()


def test_a_holder_in_use_yields_only_to_its_priority_and_ageing_gets_there() -> None:
    card = Card()
    card.hold("busy", 5, priority=52)
    card.use("busy")
    assert card.want(5) == set()
    card.driver.advance(9.9)
    assert card.asked() == set()
    card.driver.advance(0.2)
    assert card.asked() == {"busy"}, "two points are worth 10 s"


def test_an_idle_holder_yields_to_anybody_after_its_residency() -> None:
    card = Card()
    card.hold("calm", 5, priority=90, min_residency_s=2.0)
    assert card.want(5, priority=10) == set()
    card.driver.advance(2.1)
    assert card.asked() == {"calm"}


def test_a_residency_is_waited_for_rather_than_somebody_in_use_asked() -> None:
    card = Card()
    card.hold("busy", 4)
    card.use("busy")
    card.hold("fresh", 4, min_residency_s=2.0)
    assert card.want(4) == set()
    card.driver.advance(2.1)
    assert card.asked() == {"fresh"}


def test_a_fresh_one_that_would_not_help_is_not_waited_for() -> None:
    card = Card()
    card.hold("busy", 5)
    card.use("busy")
    card.hold("fresh", 0.5, min_residency_s=2.0)
    assert card.want(4) == {"busy"}


def test_exclusive_empties_the_card_and_waits_for_everyone() -> None:
    card = Card()
    card.hold("a", 1)
    card.hold("b", 1)
    assert card.want(1, exclusive=True) == {"a", "b"}
    card = Card()
    card.hold("a", 1)
    card.hold("busy", 1, priority=90)
    card.use("busy")
    assert card.want(1, exclusive=True) == set(), "one stays: the other would leave in vain"


def test_an_exclusive_holder_has_to_go_for_anyone() -> None:
    card = Card()
    card.hold("alone", 1, exclusive=True)
    assert card.want(1) == {"alone"}


@pytest.mark.parametrize("count", [14, 20])
def test_many_holders_are_searched_greedily_and_nobody_goes_in_vain(count: int) -> None:
    card = Card(count * GIB // 4 + 2 * GIB + d.RESERVE_BYTES)
    for n in range(count):
        card.hold(f"h{n}", 0.25)
    card.hold("big", 1.5)
    asked = card.want(2.0)
    assert asked == {"big"}
    card = Card(count * GIB // 4 + GIB // 8 + d.RESERVE_BYTES)
    for n in range(count):
        card.hold(f"h{n}", 0.25)
    assert len(card.want(0.5)) == 2, "an eighth is free: two quarters have to go"


def test_greedy_gives_back_who_is_not_needed() -> None:
    card = Card(16 * GIB + d.RESERVE_BYTES)
    for n in range(13):
        card.hold(f"low{n}", 0.5, priority=10)
    card.hold("high", 9, priority=20)
    assert card.want(8.9) == {"high"}


def test_a_reading_that_is_missing_failed_or_old_gives_no_room() -> None:
    driver = CoreDriver(8 * GIB, start=False)
    core = state_of(driver.arbiter)
    gpu = next(iter(core.gpus.values()))
    assert admission.measured_room_bytes(core, gpu) is None
    assert admission.blocked(core, gpu) == Block.UNREAD
    driver.advance(0.01)
    assert admission.measured_room_bytes(core, gpu) == 8 * GIB
    core.now += 5.0
    assert admission.measured_room_bytes(core, gpu) is None


def test_the_measured_need_is_less_by_what_the_process_holds() -> None:
    card = Card()
    lease = card.hold("a", 3, residue_bytes=450 * MIB)
    core = state_of(card.driver.arbiter)
    inner: Lease = core.leases[lease]
    assert admission.measured_need_bytes(card.gpu, inner) == 3 * GIB, (
        "beside a resident lease of its own: everything"
    )
    card.people["a"].unload(lease)
    card.driver.until(lambda: card.driver.state(lease) == "over")
    card.driver.advance(0.1)
    assert admission.measured_need_bytes(card.gpu, inner) == 3 * GIB - 450 * MIB
    card.driver.card.lists_processes = False
    card.driver.advance(2.0)
    assert admission.measured_need_bytes(card.gpu, inner) == 3 * GIB - 450 * MIB, (
        "by the books, without a list"
    )
    card.people["b"] = card.driver.consumer("b")
    other = card.people["b"].acquire(1 * GIB)
    assert card.driver.state(other) == "loading"
