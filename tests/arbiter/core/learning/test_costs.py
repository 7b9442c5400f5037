"""Durations, returns and switches by themselves: what each expectation of a cost is made of."""

import pytest

from vram_arbiter.arbiter.core.learning import Costs, Failures, Reuse

LEARNT = {
    "a": {"load_s": 6.0, "unload_s": 1.0, "verify_s": 2.0},
    "b": {"load_s": 10.0, "unload_s": 3.0, "verify_s": 4.0},
}


def test_the_chance_of_a_return_begins_at_half_and_follows_what_was_seen() -> None:
    reuse, chances = Reuse(), []
    for soon in (True, True, False):
        chances.append(reuse.chance())
        reuse.soon.append(soon)
    assert chances == [1 / 2, 2 / 3, 3 / 4]
    assert reuse.chance() == 3 / 5


@pytest.mark.parametrize(("pause_s", "expected_s"), [(60.0, 4.0), (60.1, 2.0)])
def test_a_departure_costs_more_where_the_consumer_returns_within_a_minute(
    pause_s: float, expected_s: float
) -> None:
    costs = Costs(LEARNT, 30.0)
    costs.left("a", 100.0)
    costs.wanted("a", 100.0 + pause_s)
    costs.wanted("a", 500.0)  # it has not left since
    assert (costs.reload_s("a"), costs.reload_s("b"), costs.reload_s("c")) == (expected_s, 5.0, 0.0)


def test_only_two_that_switched_both_ways_within_the_window_cost_a_switch() -> None:
    costs = Costs(LEARNT, 30.0)
    costs.switched("a", "b", 100.0)
    assert (costs.switch_s("a", "b", 100.0), costs.switch_s("b", "a", 100.0)) == (0.0, 0.0)
    costs.switched("b", "a", 110.0)
    assert costs.switch_s("a", "b", 129.9) == 1.0 + 2.0 + 10.0, "unload, verify, the other's load"
    assert costs.switch_s("b", "a", 129.9) == 3.0 + 4.0 + 6.0
    assert costs.switch_s("a", "b", 130.0) == 0.0, "one way is older than the window"
    costs.switched("a", "d", 130.0)
    assert costs.switches == {("b", "a"): 110.0, ("a", "d"): 130.0}
    costs.switched("d", "a", 130.0)
    assert (costs.switch_s("a", "d", 130.0), costs.switch_s("d", "a", 130.0)) == (3.0, 6.0)


def test_durations_are_medians_and_none_where_a_phase_was_never_seen() -> None:
    costs = Costs({"a": {"drain_s": 2.0}}, 30.0)
    for phase, seconds in (("drain_s", 1.0), ("drain_s", 9.0), ("load_s", 4.0), ("verify_s", -1.0)):
        costs.learn("a", phase, seconds)
    assert costs.medians() == {"a": {"drain_s": 2.0, "load_s": 4.0, "verify_s": 0.0}}
    assert costs.usual_s("a", ("drain_s", "load_s")) == 6.0
    assert costs.usual_s("a", ("drain_s", "unload_s")) is None


def test_a_load_that_keeps_failing_is_paused_for_longer_each_time_up_to_a_minute() -> None:
    costs = Costs({}, 30.0)
    pauses = []
    for _ in range(9):
        costs.load_failed("m", "oom", 100.0)
        pauses.append(costs.pause_s("m", 100.0))
    assert pauses == [0.0, 0.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    assert (costs.pause_s("m", 159.0), costs.pause_s("m", 161.0)) == (1.0, 0.0)
    costs.load_failed("m", "died", 700.0)
    assert costs.failures["m"].count == 10, "ten minutes later they still are in a row"
    costs.load_failed("m", "died", 1300.1)
    assert costs.failures == {"m": Failures(1, 1300.1, "died")}
