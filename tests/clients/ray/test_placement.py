"""The order of boxes for a model, over views that hypothesis makes up, and views of a status."""

from collections.abc import Mapping
from random import Random

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.support.process import Make
from vram_arbiter.clients.ray.placement import STALE_S, Ranked, Reason, Room, View, rank, view_of
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import VramInsufficient

NOW = 1000.0
MODEL = "pi0"
sizes = st.integers(0, 16).map(lambda gib: gib * GIB)
rooms = st.builds(Room, st.none() | sizes, sizes, sizes)
states = st.sampled_from(["held", "loading", "parked", "standby"])
views = st.builds(
    View,
    st.just("box"),
    st.lists(rooms, max_size=3).map(tuple),
    st.dictionaries(st.sampled_from([MODEL, "other"]), states),
    st.integers(0, 5),
    st.floats(NOW - 2 * STALE_S, NOW),
)
fleets = st.dictionaries(st.text("abc", min_size=1), st.none() | views)


def order(fleet: dict[str, View | None], need: int, seed: int = 0) -> list[Ranked]:
    return rank(fleet, need, MODEL, NOW, Random(seed))


def fresh(view: View | None) -> bool:
    return view is not None and NOW - view.at <= STALE_S


def greatest_budget(fleet: Mapping[str, View | None]) -> int:
    return max(
        (room.budget_bytes for view in fleet.values() if view for room in view.gpus), default=0
    )


@given(fleets.filter(bool), st.integers(1, 20).map(lambda gib: gib * GIB))
def test_only_what_no_box_can_ever_hold_is_refused(
    fleet: dict[str, View | None], need: int
) -> None:
    if all(map(fresh, fleet.values())) and greatest_budget(fleet) < need:
        with pytest.raises(VramInsufficient) as refused:
            order(fleet, need)
        assert refused.value.details["budget_bytes"] == greatest_budget(fleet)
    else:
        assert len(order(fleet, need)) == len(fleet)


@given(fleets, sizes, st.integers(0, 9))
def test_every_box_has_one_place_and_its_reason(
    fleet: dict[str, View | None], need: int, seed: int
) -> None:
    assume(greatest_budget(fleet) >= need or not all(map(fresh, fleet.values())))
    ranked = order(fleet, need, seed)
    assert sorted(one.node for one in ranked) == sorted(fleet)
    reasons = list(Reason)
    places = [reasons.index(one.reason) for one in ranked]
    assert places == sorted(places)
    for one in ranked:
        view = fleet[one.node]
        if view is None or not fresh(view):
            assert one.reason is Reason.UNKNOWN
            continue
        if not one.usable:
            assert not any(
                room.free_bytes is not None and room.budget_bytes >= need for room in view.gpus
            )
            continue
        free, evictable = one.free_bytes or 0, one.evictable_bytes or 0
        assert Room(free, one.budget_bytes or 0, evictable) in view.gpus
        assert (one.reason in (Reason.EVICTABLE, Reason.BUSY)) == (free < need)
        assert (one.reason is Reason.BUSY) == (free + evictable < need)
        warm = view.resident.get(MODEL)
        assert (one.reason is Reason.RESIDENT) == (free >= need and warm in ("held", "loading"))
        assert (one.reason is Reason.PARKED) == (free >= need and warm in ("parked", "standby"))


@given(st.integers(2, 8), st.integers(0, 99))
def test_the_fuller_of_two_equals_comes_later(count: int, seed: int) -> None:
    fleet = {
        str(number): View(str(number), (Room(8 * GIB, 8 * GIB),), {}, number, NOW)
        for number in range(count)
    }
    ranked = order(dict(fleet), GIB, seed)
    assert ranked[0].waiting < count - 1  # it never wins two choices


def test_a_fleet_without_an_answer_refuses_nothing() -> None:
    assert [one.reason for one in order({"a": None, "b": None}, 99 * GIB)] == [Reason.UNKNOWN] * 2
    assert order({}, GIB) == []


def test_a_need_beyond_every_budget_names_the_greatest() -> None:
    small = View("small", (Room(GIB, 8 * GIB),), {}, 0, NOW)
    large = View("large", (Room(GIB, 24 * GIB),), {}, 0, NOW)
    with pytest.raises(
        VramInsufficient, match="40 GiB, and the greatest budget is 24 GiB, on large"
    ):
        order({"a": small, "b": large}, 40 * GIB)
    ranked = order({"a": small, "b": large}, 20 * GIB)
    assert [(one.node, one.reason) for one in ranked] == [
        ("b", Reason.BUSY),
        ("a", Reason.TOO_SMALL),
    ]


def test_a_status_says_what_a_placement_needs(make_arbiter: Make) -> None:
    daemon = make_arbiter().start()
    with Client("robot", endpoint=daemon.endpoint) as arbiter:
        budget = view_of(arbiter.status(), "box").gpus[0].budget_bytes
        lease = arbiter.acquire(vram="2GiB", model=MODEL, unload=lambda: None)
        loading = view_of(arbiter.status(), "box")
        assert loading.gpus == (Room(budget - 2 * GIB, budget, 0),)
        assert loading.resident == {MODEL: "loading"}
        lease.ready(2 * GIB)
        with lease.use():
            assert view_of(arbiter.status(), "box").gpus[0].evictable_bytes == 0
        idle = view_of(arbiter.status(), "box")
        assert (idle.resident, idle.waiting) == ({MODEL: "held"}, 0)
        assert idle.gpus == (Room(budget - 2 * GIB, budget, 2 * GIB),)
        lease.give_up()
