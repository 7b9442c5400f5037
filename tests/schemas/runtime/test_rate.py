"""Messages in a second, as many at once, and what is owed."""

import pytest

from vram_arbiter.schemas.runtime.rate import Rate


def test_a_seconds_worth_comes_at_once_and_the_rest_at_the_rate() -> None:
    rate = Rate(10.0, 10.0, 100.0)
    assert [rate.charge(1, 100.0) for _ in range(12)] == pytest.approx([*[0.0] * 9, 0.1, 0.2, 0.3])
    assert rate.charge(1, 100.3) == pytest.approx(0.1), "after the rest that was asked for"


def test_what_costs_more_is_paid_later() -> None:
    rate = Rate(10.0, 10.0, 0.0)
    assert rate.charge(41, 0.0) == pytest.approx(3.2)
    assert rate.charge(0, 3.1) == pytest.approx(0.1)
    assert rate.charge(1, 3.2) == pytest.approx(0.1)


def test_a_pause_saves_up_one_second_at_most() -> None:
    rate = Rate(10.0, 10.0, 0.0)
    rate.charge(10, 0.0)
    assert not rate.is_full(0.9)
    assert rate.is_full(1.0)
    assert rate.charge(11, 1000.0) == pytest.approx(0.2)
