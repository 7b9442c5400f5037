"""Ports of other programs' rules decide as each rule says, and as the engine does not."""

import pytest

from tests.bench.other_rules import RULES, OneGpuOnly, outcomes_of, under
from vram_arbiter.arbiter.lab import compare
from vram_arbiter.arbiter.lab.outcome import Outcome
from vram_arbiter.arbiter.lab.scenarios import settings_of, workload_of
from vram_arbiter.schemas.config.scenario import Scenario, load_scenario

TWO = """
  left: {load_peak: 5GiB, load_s: 1, use_s: 2, arrivals: {at_s: [0, 30, 60]}}
  right: {load_peak: 5GiB, load_s: 1, use_s: 2, arrivals: {at_s: [1, 31, 61]}}
"""


def scenario_of(consumers: str, *, lag_s: float = 0.5, gpus: str = "8GiB") -> Scenario:
    listed = ", ".join(f"{{capacity: {size}, release_lag_s: {lag_s}}}" for size in gpus.split())
    text = f"about: test\nseconds: 120\ngpus: [{listed}]\nconsumers:\n{consumers}"
    return load_scenario(text, "test.yaml")


def run(made: Scenario, rules: str = "") -> Outcome:
    """`rules` "": the engine."""
    if rules:
        return under(workload_of(made), rules)
    return compare.under(workload_of(made), settings_of(made), "default")


def test_without_a_decision_the_second_never_gets_in() -> None:
    outcome = run(scenario_of(TWO), "unmanaged")
    assert outcome.of("right").ooms > 50
    assert outcome.of("right").unserved == 3
    assert outcome.of("left").ooms == 0


def test_llama_swap_starts_the_next_before_the_memory_is_back() -> None:
    assert run(scenario_of(TWO, lag_s=0.5), "llama_swap_rules").total.ooms > 0
    calm = run(scenario_of(TWO, lag_s=0.0), "llama_swap_rules")
    assert (calm.total.ooms, calm.total.unserved, calm.switches) == (0, 0, 5)


def test_llama_swap_holds_one_model_even_where_two_fit() -> None:
    outcome = run(scenario_of(TWO, gpus="24GiB", lag_s=0.0), "llama_swap_rules")
    assert outcome.switches == 5
    assert run(scenario_of(TWO, gpus="24GiB")).switches == 0


def test_ollama_waits_for_the_memory_and_loads_beside_what_fits() -> None:
    outcome = run(scenario_of(TWO, lag_s=1.0), "ollama_rules")
    assert (outcome.total.ooms, outcome.total.unserved, outcome.switches) == (0, 0, 5)
    assert run(scenario_of(TWO, gpus="24GiB"), "ollama_rules").switches == 0


def test_ollama_goes_on_after_five_seconds_anyway() -> None:
    assert run(scenario_of(TWO, lag_s=8.0), "ollama_rules").total.ooms > 0
    assert run(scenario_of(TWO, lag_s=8.0)).total.ooms == 0


def test_a_small_model_waits_behind_a_large_one_with_ollama_and_not_here() -> None:
    text = """
  long: {load_peak: 4GiB, load_s: 1, use_s: 60, arrivals: {at_s: [0]}}
  large: {load_peak: 6GiB, load_s: 1, use_s: 1, arrivals: {at_s: [5]}}
  small: {load_peak: 1GiB, load_s: 1, use_s: 1, arrivals: {at_s: [10]}}
"""
    assert run(scenario_of(text), "ollama_rules").of("small").wait_s(1.0) > 40
    assert run(scenario_of(text)).of("small").wait_s(1.0) < 2


@pytest.mark.parametrize("rules", RULES)
def test_a_request_that_never_fits_is_denied_at_once(rules: str) -> None:
    text = "  huge: {load_peak: 20GiB, use_s: 1, arrivals: {at_s: [1, 2]}}"
    tally = run(scenario_of(text), rules).of("huge")
    assert (tally.denied, tally.loads) == (2, 0)


def test_the_ports_know_one_gpu() -> None:
    made = scenario_of(TWO, gpus="8GiB 8GiB")
    for rules in RULES:
        with pytest.raises(OneGpuOnly):
            run(made, rules)
    assert [outcome.policy for outcome in outcomes_of(scenario_of(TWO))][-3:] == list(RULES)
