"""The lag of pictures by the source's own stamps: queues, rushes, drifting clocks, sources without
stamps.
"""

from hypothesis import given
from hypothesis import strategies as st

from vram_arbiter.runner.sensors.lag import WINDOW_S, LagMeter

S = 10**9
MS = 10**6


def test_a_steady_source_has_no_lag() -> None:
    lag = LagMeter()
    for index in range(200):
        arrival_ns = 7 * S + index * 40 * MS
        assert lag.taken_ns(arrival_ns, index * 40.0) == arrival_ns


def test_a_rush_after_a_standstill_is_old() -> None:
    lag = LagMeter()
    for index in range(25):
        lag.taken_ns(index * 40 * MS, index * 40.0)
    for index in range(25, 100):  # three seconds of pictures, all at once
        assert lag.taken_ns(4 * S, index * 40.0) == index * 40 * MS
    assert lag.taken_ns(4 * S + 40 * MS, 4040.0) == 4 * S + 40 * MS  # caught up


def test_what_a_camera_sends_first_in_a_rush_is_not_taken_for_the_usual() -> None:
    """A recorder begins with what it has since its last key frame; from then on pictures come as
    they are taken.
    """
    lag = LagMeter()
    for index in range(50):
        lag.taken_ns(S, index * 40.0)
    assert lag.taken_ns(S + 40 * MS, 2000.0) == S + 40 * MS


def test_a_source_that_begins_anew_is_measured_anew() -> None:
    lag = LagMeter()
    lag.taken_ns(S, 900_000.0)
    assert lag.taken_ns(2 * S, 0.0) == 2 * S
    assert lag.taken_ns(3 * S, 500.0) == 2 * S + 500 * MS


def test_a_source_without_stamps_counts_from_arrival() -> None:
    lag = LagMeter()
    for index in range(10):
        assert lag.taken_ns(index * S, 0.0) == index * S


def test_a_clock_that_runs_slow_does_not_make_pictures_old_for_good() -> None:
    lag = LagMeter()
    rate = 1 - 200e-6  # a bad quartz: 0.7 s an hour
    lags = []
    for index in range(3600 * 25):
        arrival_ns = index * 40 * MS
        lags.append(arrival_ns - lag.taken_ns(arrival_ns, index * 40.0 * rate))
    assert max(lags) <= 2 * WINDOW_S * S * 200e-6 + MS  # 6 ms


@given(st.lists(st.tuples(st.integers(0, 2 * S), st.floats(-1e6, 1e9)), max_size=60))
def test_no_picture_was_taken_after_it_arrived(steps: list[tuple[int, float]]) -> None:
    lag, now_ns = LagMeter(), 0
    for wait_ns, pts_ms in steps:
        now_ns += wait_ns
        assert lag.taken_ns(now_ns, pts_ms) <= now_ns
