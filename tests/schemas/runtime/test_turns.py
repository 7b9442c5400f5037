"""`schemas.runtime.turns`: every key has its turn before another has its second."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vram_arbiter.schemas.runtime.turns import Turns


def drained(turns: Turns[str]) -> list[str]:
    return [turns.pop() for _ in range(len(turns))]


def test_an_item_that_comes_again_waits_behind_its_neighbors() -> None:
    turns: Turns[str] = Turns()
    for item in "ab":
        turns.add(item, (0, "p"))
    first = turns.pop()
    turns.add(first, (0, "p"))
    turns.add(first, (0, "p"))
    assert (first, drained(turns)) == ("a", ["b", "a"])


def test_an_item_that_leaves_is_not_called() -> None:
    turns: Turns[str] = Turns()
    turns.add("a", (0, "p"))
    turns.discard("a")
    turns.discard("a")
    assert "a" not in turns
    with pytest.raises(KeyError):
        turns.pop()


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 3)), unique=True))
def test_each_item_has_one_turn_and_users_differ_by_one_at_most(
    items: list[tuple[int, int, int]],
) -> None:
    turns: Turns[tuple[int, int, int]] = Turns()
    for item in items:
        turns.add(item, item[:2])
    order = []
    left = [item[0] for item in items]
    while turns:
        item = turns.pop()
        order.append(item)
        waiting = {user for user in left if left.count(user)}
        left.remove(item[0])
        served = {user: sum(done[0] == user for done in order) for user in waiting}
        assert all(served[user] >= max(served.values()) - 1 for user in waiting)
    assert sorted(order) == sorted(items)
