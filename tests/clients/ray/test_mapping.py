"""Bookkeeping of seeds, without Ray."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vram_arbiter.clients.ray.mapping import ATTEMPTS_MAX, Seeds, SeedsFailed


@given(st.lists(st.integers(0, 9)), st.sets(st.integers(0, 9)), st.data())
def test_each_seed_ends_with_a_result_or_a_failure_and_is_lost_so_often_at_most(
    wanted: list[int], done: set[int], data: st.DataObject
) -> None:
    seeds, ended, lost = Seeds(wanted, done), set[int](), dict.fromkeys(wanted, 0)
    while seeds:
        seed = seeds.take()
        match data.draw(st.sampled_from(["ended", "lost", "refused"])):
            case "ended":
                ended.add(seed)
            case "lost":
                lost[seed] += 1
                seeds.lost(seed, "it died")
            case "refused" if data.draw(st.booleans()):
                seeds.give_back(seed)
                assert seeds.take() == seed
                seeds.give_back(seed)
            case "refused":
                seeds.give_back(seed)
                seeds.strand("no actor is left")
    assert ended.isdisjoint(seeds.failed)
    assert ended | set(seeds.failed) == set(wanted) - done
    assert max(lost.values(), default=0) <= ATTEMPTS_MAX


def test_failures_are_named_and_none_is_silent() -> None:
    seeds = Seeds([3, 1, 3], done=[])
    seeds.check()
    seeds.lost(seeds.take(), "it died")
    seeds.strand("no actor is left")
    with pytest.raises(SeedsFailed, match="2 seeds have no result: 1: no actor is left; 3: no ac"):
        seeds.check()
