"""Simulated consumers under the engine: safe and reproducible."""

import pytest

from tests.support.paths import ROOT
from vram_arbiter.arbiter.core.settings import SCHEDULING
from vram_arbiter.arbiter.lab import compare
from vram_arbiter.arbiter.lab.outcome import Outcome, as_plain
from vram_arbiter.arbiter.lab.scenarios import settings_of, workload_of
from vram_arbiter.schemas.config.scenario import Scenario, load_scenario

SCENARIOS = ROOT / "configs" / "scenarios"


def shipped(name: str) -> Scenario:
    """Its first two minutes."""
    text = (SCENARIOS / f"{name}.yaml").read_text()
    return load_scenario(text, name).model_copy(update={"seconds": 120.0})


def scenario_of(
    consumers: str, *, seconds: float = 120, lag_s: float = 0.5, gpu: str = "8GiB", more: str = ""
) -> Scenario:
    text = (
        f"about: test\nseconds: {seconds}\ngpus: [{{capacity: {gpu}, release_lag_s: "
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
def test_no_policy_of_the_engine_overfills_a_gpu(policy: str) -> None:
    made = shipped("small-behind-large")
    outcome = under(made, policy)
    assert outcome.total.ooms == 0
    assert outcome.total.unserved == 0
    assert outcome.peak_bytes <= made.gpus[0].capacity - made.gpus[0].reserve


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
    assert at["granted", "right"] - at["released", "left"] >= 0.5  # the GPU's lag
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
    tally = under(scenario_of(text)).of("huge")
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
