"""Which waiting request is next."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vram_arbiter.schemas.defaults import AGEING_S_PER_POINT
from vram_arbiter.schemas.errors import LimitExceeded
from vram_arbiter.sidecars.gateway.turns import Request, Turns


def waiting(turns: Turns, key: str, since: float = 0.0, priority: int = 50) -> Request:
    request = Request(key, priority, since)
    turns.enter(request)
    return request


def test_a_key_with_a_higher_priority_is_first_until_others_have_aged() -> None:
    turns = Turns(1, 9, {})
    batch = waiting(turns, "batch", 0.0, 40)
    person = waiting(turns, "person", 10.0, 60)
    assert turns.next(10.0) is person
    turns.leave(person, 11.0)
    later = 20 * AGEING_S_PER_POINT
    waiting(turns, "person", later, 60)
    assert turns.next(later) is batch


def test_among_equals_the_key_is_next_that_used_least() -> None:
    turns = Turns(1, 9, {})
    waiting(turns, "a"), waiting(turns, "a"), waiting(turns, "b", 0.5)
    order = []
    for now in (1.0, 2.0, 3.0):
        request = turns.next(now)
        order.append(request.key)
        assert turns.next(now) is None  # one at a time
        turns.leave(request, now + 1.0)
    assert order == ["a", "b", "a"]


def test_reserved_places_stay_free_for_their_key() -> None:
    turns = Turns(3, 9, {"person": 1})
    for _ in range(3):
        waiting(turns, "batch")
    assert [turns.next(1.0) is not None for _ in range(3)] == [True, True, False]
    person = waiting(turns, "person", 1.0)
    assert turns.next(1.0) is person
    assert turns.next(1.0) is None
    turns.leave(person, 2.0)
    assert turns.next(2.0) is None


def test_a_full_queue_refuses_and_a_request_that_left_makes_room() -> None:
    turns = Turns(1, 2, {})
    first = waiting(turns, "a")
    waiting(turns, "b")
    with pytest.raises(LimitExceeded):
        waiting(turns, "c")
    turns.leave(first, 1.0)
    waiting(turns, "c")


def test_a_request_that_is_put_back_is_first_of_its_key() -> None:
    turns = Turns(1, 9, {})
    first = waiting(turns, "a")
    waiting(turns, "a")
    assert turns.next(1.0) is first
    turns.put_back(first, 1.0)
    assert (turns.running, turns.waiting) == (0, 2)
    assert turns.next(1.0) is first


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 100)), max_size=40),
    st.integers(2, 4),
    st.dictionaries(st.sampled_from("ab"), st.integers(0, 1), max_size=1),
)
def test_every_request_has_its_turn_and_no_more_run_than_may(
    asked: list[tuple[str, int]], parallel: int, reserved: dict[str, int]
) -> None:
    turns, now = Turns(parallel, 100, reserved), 0.0
    for key, priority in asked:
        waiting(turns, key, now, priority)
    running: list[Request] = []
    served = 0
    while turns.waiting or running:
        now += 1.0
        while (request := turns.next(now)) is not None:
            running.append(request)
        assert 0 < turns.running == len(running) <= parallel
        turns.leave(running.pop(0), now)
        served += 1
    assert served == len(asked)
