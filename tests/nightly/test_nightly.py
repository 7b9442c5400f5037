"""The night's walk itself: it counts, it tells a failure with the line that walks it again, and the
same seed finds it again."""

import hypothesis.strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from tests.nightly import nightly_run as night_run
from tests.support.machines import walk


class Sound(RuleBasedStateMachine):
    @rule(n=st.integers())
    def step(self, n: int) -> None:
        assert n == n


class Broken(RuleBasedStateMachine):
    @rule(n=st.integers(0, 100))
    def step(self, n: int) -> None:
        assert n < 50


Sound.TestCase.settings = Broken.TestCase.settings = walk(5)


def test_the_histories_are_split_evenly_under_seeds_of_their_own() -> None:
    todo = night_run.portions(["a", "b"], 5000, 70)
    assert sum(portion.wanted for portion in todo) == 5000
    assert {machine: sum(p.wanted for p in todo if p.machine == machine) for machine in "ab"} == {
        "a": 2500,
        "b": 2500,
    }
    assert [portion.seed for portion in todo] == list(range(70, 70 + len(todo)))


def test_every_machine_is_there() -> None:
    for machine in night_run.MACHINES:
        assert issubclass(night_run.load(machine), RuleBasedStateMachine)


def test_a_sound_machine_is_counted() -> None:
    done = night_run.walk(night_run.Portion("sound", 1, 20), Sound)
    assert not done.failure
    assert done.histories >= 20
    report = night_run.summary([done], 1.0)
    assert report["histories"] == done.histories
    assert not report["failures"]


def test_a_failure_is_told_shrunk_and_found_again() -> None:
    done = night_run.walk(night_run.Portion("broken", 3, 20), Broken)
    assert "state.step(n=50)" in done.failure
    (failure,) = night_run.summary([done], 1.0)["failures"]
    assert failure["again"].endswith("--machine broken --seed 3 --histories 20")
    assert night_run.walk(night_run.Portion("broken", 3, 20), Broken).failure == done.failure
