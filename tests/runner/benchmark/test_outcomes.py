"""Rates with their interval, and when a cell is given up."""

import pytest

from vram_arbiter.runner.benchmark.outcomes import (
    Cell,
    SeedOutcome,
    file_name,
    given_up,
    unplayed,
    wilson,
)


@pytest.mark.heavy  # the interval is SciPy's
@pytest.mark.parametrize(
    ("successes", "of", "low", "high"),
    # Wilson's score interval without continuity correction, as statsmodels' `proportion_confint(…,
    # method="wilson")` gives it
    [
        (0, 10, 0.0, 0.2775),
        (5, 10, 0.2366, 0.7634),
        (10, 10, 0.7225, 1.0),
        (1, 1, 0.2065, 1.0),
        (95, 100, 0.8882, 0.9785),
    ],
)
def test_wilsons_interval(successes: int, of: int, low: float, high: float) -> None:
    assert wilson(successes, of) == pytest.approx((low, high), abs=5e-5)


def test_nothing_played_has_no_rate() -> None:
    assert wilson(0, 0) is None
    assert Cell("w", "c", None).summary()["success_rate"] is None


def test_any_name_can_be_a_file() -> None:
    assert file_name("so101:a/b v0") == "so101-a-b-v0"
    assert file_name("../x") == "x"


def test_errors_in_a_row_give_a_cell_up() -> None:
    won, lost = SeedOutcome(1, True), unplayed(2, "nothing answers")
    assert given_up([lost, lost]) == ""
    assert given_up([lost, won, lost, lost]) == ""
    assert given_up([won, lost, lost, lost]) == "given up after 3 errors in a row: nothing answers"
