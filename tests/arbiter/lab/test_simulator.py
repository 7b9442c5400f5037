"""Simulated consumers under the engine and under other programs' rules: safe, reproducible, and as
each rule says."""

import pytest

from tests.support.paths import ROOT
from vram_arbiter.arbiter.core.settings import SCHEDULING, Settings
from vram_arbiter.arbiter.lab import compare
from vram_arbiter.arbiter.lab.outcome import Outcome, as_plain
from vram_arbiter.arbiter.lab.rules import RULES, OneCardOnly
from vram_arbiter.arbiter.lab.scenarios import settings_of, workload_of
from vram_arbiter.schemas.config.scenario import Scenario, load_scenario

SCENARIOS = ROOT / "configs" / "scenarios"


def shipped(name: str) -> Scenario:
    """Its first two minutes."""
    text = (SCENARIOS / f"{name}.yaml").read_text()
    return load_scenario(text, name).model_copy(update={"seconds": 120.0})


def scenario_of(
    consumers: str, *, seconds: float = 120, lag_s: float = 0.5, card: str = "8GiB", more: str = ""
) -> Scenario:
    text = (
        f"about: test\nseconds: {seconds}\ncards: [{{capacity: {card}, release_lag_s: "
        f"{lag_s}}}]\n{more}\nconsumers:\n"
    )
    return load_scenario(text + consumers, "test.yaml")


TWO = """
  left: {load_peak: 5GiB, load_s: 1, use_s: 2, arrivals: {at_s: [0, 30, 60]}}
  right: {load_peak: 5GiB, load_s: 1, use_s: 2, arrivals: {at_s: [1, 31, 61]}}
"""


def under(made: Scenario, policy: str = "default") -> Outcome:
    return compare.under(workload_of(made), settings_of(made), policy)


def story(outcome: Outcome, *kinds: str) -> list[tuple[str, str]]:
    return [
        (note.kind, note.about.consumer)
        for _, note in outcome.timeline
        if note.kind in kinds and note.about is not None
    ]


@pytest.mark.parametrize("policy", SCHEDULING)
def test_no_policy_of_the_engine_overfills_a_card(policy: str) -> None:
    made = shipped("small-behind-large")
    outcome = under(made, policy)
    assert outcome.total.ooms == 0
    assert outcome.total.unserved == 0
    assert outcome.peak_bytes <= made.cards[0].capacity - made.cards[0].reserve


def test_the_same_scenario_gives_the_same_outcome() -> None:
    made = shipped("find-navigate-grab")
    assert as_plain(under(made)) == as_plain(under(made))
    assert under(made).timeline == under(made).timeline


def test_a_switch_waits_for_the_safe_point_and_for_the_memory() -> None:
    outcome = under(scenario_of(TWO, seconds=20))
    assert story(outcome, "granted", "revoke_asked", "verified")[:4] == [
        ("granted", "left"),
        ("revoke_asked", "left"),
        ("verified", "left"),
        ("granted", "right"),
    ]
    at = {(note.kind, note.about.consumer): when for when, note in outcome.timeline if note.about}
    assert at["use_ended", "left"] <= at["unloading", "left"]
    assert at["granted", "right"] - at["released", "left"] >= 0.5  # the card's lag
    assert outcome.switches == 1
    assert outcome.of("right").wait_s(1.0) == pytest.approx(at["ready", "right"] - 1.0)


def test_a_resident_model_makes_nobody_wait() -> None:
    outcome = under(
        scenario_of(
            "  a: {load_peak: 1GiB, load_s: 2, use_s: 1, arrivals: {every_s: 10}}", seconds=35
        )
    )
    tally = outcome.of("a")
    assert (tally.jobs, tally.loads, tally.waits_s[1:]) == (4, 1, [0.0, 0.0, 0.0])
    assert tally.waits_s[0] == pytest.approx(2.0, abs=0.01)


def test_jobs_that_follow_each_other_make_a_circle() -> None:
    circle = """
  a: {load_peak: 1GiB, load_s: 0, use_s: 1, arrivals: {after: b, think_s: 1, start_s: 0}}
  b: {load_peak: 1GiB, load_s: 0, use_s: 1, arrivals: {after: a, think_s: 1, count: 3}}
"""
    outcome = under(scenario_of(circle, seconds=60))
    assert [who for _, who in story(outcome, "use_began")] == ["a", "b"] * 3 + ["a"]


def test_who_waits_too_long_is_denied_and_the_rest_goes_on() -> None:
    text = """
  long: {load_peak: 6GiB, load_s: 1, use_s: 50, arrivals: {at_s: [0]}}
  hasty: {load_peak: 6GiB, load_s: 1, use_s: 1, wait_timeout_s: 5, arrivals: {at_s: [2, 60]}}
"""
    outcome = under(scenario_of(text))
    tally = outcome.of("hasty")
    assert (tally.denied, tally.loads, tally.unserved) == (1, 1, 0)
    assert tally.waits_s[0] == pytest.approx(5.0)


def test_a_request_that_never_fits_is_denied_at_once() -> None:
    text = "  huge: {load_peak: 20GiB, use_s: 1, arrivals: {at_s: [1, 2]}}"
    for policy in ("default", "ollama_rules"):
        tally = under(scenario_of(text), policy).of("huge")
        assert (tally.denied, tally.loads) == (2, 0)


def test_whoever_still_waits_at_the_end_is_counted() -> None:
    text = """
  pinned: {load_peak: 6GiB, load_s: 1, use_s: 1, evictable: false, min_residency_s: 0,
           arrivals: {at_s: [0]}, wait_timeout_s: 5}
  other: {load_peak: 1.5GiB, load_s: 1, use_s: 200, arrivals: {at_s: [2]}}
  late: {load_peak: 1.5GiB, use_s: 1, arrivals: {at_s: [20]}}
"""
    tally = under(scenario_of(text)).of("late")
    assert (tally.unserved, tally.waits_s) == (1, [100.0])


def test_idle_release_and_standby() -> None:
    text = """
  polite: {load_peak: 5GiB, load_s: 1, use_s: 1, idle_release_s: 3, arrivals: {at_s: [0]}}
  back: {load_peak: 5GiB, load_s: 1, use_s: 1, standby: true, arrivals: {at_s: [10]}}
  guest: {load_peak: 5GiB, load_s: 1, use_s: 1, idle_release_s: 1, arrivals: {at_s: [20]}}
"""
    outcome = under(scenario_of(text))
    assert ("revoke_asked", "polite") not in story(outcome, "revoke_asked")
    assert [who for _, who in story(outcome, "granted")] == ["polite", "back", "guest", "back"]


def test_stowaways_are_charged_and_come_and_go() -> None:
    text = "  a: {load_peak: 6GiB, load_s: 1, use_s: 1, arrivals: {at_s: [10]}}"
    more = "stowaways: [{name: game, bytes: 3GiB, from_s: 1, to_s: 30}]"
    outcome = under(scenario_of(text, more=more))
    assert outcome.total.ooms == 0
    assert 20.0 < outcome.of("a").waits_s[0] < 24.0


# -- other programs' rules
def test_without_anybody_to_decide_the_second_never_gets_in() -> None:
    outcome = under(scenario_of(TWO), "unmanaged")
    assert outcome.of("right").ooms > 50
    assert outcome.of("right").unserved == 3
    assert outcome.of("left").ooms == 0


def test_llama_swap_starts_the_next_before_the_memory_is_back() -> None:
    assert under(scenario_of(TWO, lag_s=0.5), "llama_swap_rules").total.ooms > 0
    calm = under(scenario_of(TWO, lag_s=0.0), "llama_swap_rules")
    assert (calm.total.ooms, calm.total.unserved, calm.switches) == (0, 0, 5)


def test_llama_swap_holds_one_model_even_where_two_fit() -> None:
    outcome = under(scenario_of(TWO, card="24GiB", lag_s=0.0), "llama_swap_rules")
    assert outcome.switches == 5
    assert under(scenario_of(TWO, card="24GiB")).switches == 0


def test_ollama_waits_for_the_memory_and_loads_beside_what_fits() -> None:
    outcome = under(scenario_of(TWO, lag_s=1.0), "ollama_rules")
    assert (outcome.total.ooms, outcome.total.unserved, outcome.switches) == (0, 0, 5)
    assert under(scenario_of(TWO, card="24GiB"), "ollama_rules").switches == 0


def test_ollama_goes_on_after_five_seconds_anyway() -> None:
    assert under(scenario_of(TWO, lag_s=8.0), "ollama_rules").total.ooms > 0
    assert under(scenario_of(TWO, lag_s=8.0)).total.ooms == 0


def test_a_small_model_waits_behind_a_large_one_with_ollama_and_not_here() -> None:
    text = """
  long: {load_peak: 4GiB, load_s: 1, use_s: 60, arrivals: {at_s: [0]}}
  large: {load_peak: 6GiB, load_s: 1, use_s: 1, arrivals: {at_s: [5]}}
  small: {load_peak: 1GiB, load_s: 1, use_s: 1, arrivals: {at_s: [10]}}
"""
    assert under(scenario_of(text), "ollama_rules").of("small").wait_s(1.0) > 40
    assert under(scenario_of(text)).of("small").wait_s(1.0) < 2


def test_the_ports_know_one_card_and_names_are_checked() -> None:
    made = load_scenario(
        "about: t\nseconds: 5\ncards: [{capacity: 8GiB}, {capacity: 8GiB}]\nconsumers:\n"
        "  a: {load_peak: 1GiB, use_s: 1, arrivals: {at_s: [0, 1]}}\n  b: {load_peak: 7GiB, use_s: "
        "1, gpu: '1', arrivals: {at_s: [0]}}",
        "two.yaml",
    )
    for policy in RULES:
        with pytest.raises(OneCardOnly):
            under(made, policy)
    assert under(made).total.unserved == 0
    with pytest.raises(compare.UnknownPolicy, match="unknown policy 'best'"):
        compare.under(workload_of(made), Settings(1, ()), "best")
