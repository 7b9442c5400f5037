"""Simulated consumers: the engine never overfills a GPU, and the ports decide as each rule says."""

from dataclasses import replace

import pytest

from tests.bench.policies.outcome import Outcome
from tests.bench.policies.rules import RULES, run
from tests.bench.policies.scenarios import SCENARIOS, Consumer, Scenario, Stowaway


def one(**fields: object) -> Consumer:
    return Consumer(**({"load_s": (1.0, 1.0)} | fields))  # type: ignore[arg-type]


def scenario(seconds: float = 120, lag_s: float = 0.5, **consumers: Consumer) -> Scenario:
    return Scenario(about="test", seconds=seconds, release_lag_s=lag_s, consumers=consumers)


def two(lag_s: float = 0.5, capacity: str = "8GiB") -> Scenario:
    """Two models of 5 GiB that are asked for in turn."""
    left = one(load_peak="5GiB", use_s=(2, 2), at_s=(0, 30, 60))
    right = one(load_peak="5GiB", use_s=(2, 2), at_s=(1, 31, 61))
    return replace(scenario(lag_s=lag_s, left=left, right=right), capacity=capacity)


def story(outcome: Outcome, *kinds: str) -> list[tuple[str, str]]:
    return [
        (note.kind, note.about.consumer)
        for _, note in outcome.timeline
        if note.kind in kinds and note.about is not None
    ]


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_engine_never_overfills_the_gpu(name: str) -> None:
    made = replace(SCENARIOS[name], seconds=120.0)
    outcome = run(made)
    assert outcome.total.ooms == 0
    assert outcome.peak_bytes <= made.gpu.capacity_bytes - made.gpu.reserve_bytes


def test_a_run_repeats_itself() -> None:
    made = replace(SCENARIOS["desktop"], seconds=120.0)
    outcome, again = run(made), run(made)
    assert (outcome.rows(), outcome.timeline) == (again.rows(), again.timeline)


def test_a_switch_waits_for_the_safe_point_and_for_the_memory() -> None:
    outcome = run(replace(two(), seconds=20))
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


def test_consumers_follow_each_other_wait_time_out_and_release_by_themselves() -> None:
    circle = run(
        scenario(
            a=one(load_peak="1GiB", after="b", think_s=(1, 1), start_s=0),
            b=one(load_peak="1GiB", after="a", think_s=(1, 1), count=3),
        )
    )
    assert [consumer for _, consumer in story(circle, "use_began")] == ["a", "b"] * 3 + ["a"]
    hasty = run(
        scenario(
            long=one(load_peak="6GiB", use_s=(50, 50), at_s=(0,)),
            hasty=one(load_peak="6GiB", wait_timeout_s=5, at_s=(2, 60)),
        )
    ).of("hasty")
    assert (hasty.denied, hasty.loads) == (1, 1)
    assert hasty.waits_s[0] == pytest.approx(5.0)
    polite = run(
        scenario(
            polite=one(load_peak="5GiB", idle_release_s=3, at_s=(0,)),
            back=one(load_peak="5GiB", standby=True, at_s=(10,)),
            guest=one(load_peak="5GiB", idle_release_s=1, at_s=(20,)),
        )
    )
    assert story(polite, "revoke_asked") == [("revoke_asked", "back")]
    granted = [consumer for _, consumer in story(polite, "granted")]
    assert granted == ["polite", "back", "guest", "back"]


def test_a_stowaway_keeps_a_model_out_while_it_stays() -> None:
    made = scenario(model=one(load_peak="6GiB", at_s=(10,)))
    made = replace(made, stowaways=(Stowaway("browser", "3GiB", 0, 60),))
    assert 50 <= run(made).of("model").wait_s(1.0) < 65


# -- rules of other programs
def test_without_a_decision_the_second_never_gets_in() -> None:
    outcome = run(two(), "unmanaged")
    assert outcome.of("right").ooms > 50
    assert (outcome.of("right").unserved, outcome.of("left").ooms) == (3, 0)


def test_llama_swap_starts_the_next_before_the_memory_is_back() -> None:
    assert run(two(lag_s=0.5), "llama_swap_rules").total.ooms > 0
    calm = run(two(lag_s=0.0), "llama_swap_rules")
    assert (calm.total.ooms, calm.total.unserved, calm.switches) == (0, 0, 5)


def test_llama_swap_holds_one_model_even_where_two_fit() -> None:
    assert run(two(lag_s=0.0, capacity="24GiB"), "llama_swap_rules").switches == 5
    assert run(two(lag_s=0.0, capacity="24GiB")).switches == 0


def test_ollama_waits_for_the_memory_and_loads_beside_what_fits() -> None:
    outcome = run(two(lag_s=1.0), "ollama_rules")
    assert (outcome.total.ooms, outcome.total.unserved, outcome.switches) == (0, 0, 5)
    assert run(two(capacity="24GiB"), "ollama_rules").switches == 0


def test_ollama_goes_on_after_five_seconds_anyway() -> None:
    assert run(two(lag_s=8.0), "ollama_rules").total.ooms > 0
    assert run(two(lag_s=8.0)).total.ooms == 0


def test_a_small_model_waits_behind_a_large_one_with_ollama_and_not_here() -> None:
    made = scenario(
        long=one(load_peak="4GiB", use_s=(60, 60), at_s=(0,)),
        large=one(load_peak="6GiB", at_s=(5,)),
        small=one(load_peak="1GiB", at_s=(10,)),
    )
    assert run(made, "ollama_rules").of("small").wait_s(1.0) > 40
    assert run(made).of("small").wait_s(1.0) < 2


@pytest.mark.parametrize("rules", RULES)
def test_a_request_that_never_fits_is_denied_at_once(rules: str) -> None:
    tally = run(scenario(huge=one(load_peak="20GiB", at_s=(1, 2))), rules).of("huge")
    assert (tally.denied, tally.loads) == (2, 0)
