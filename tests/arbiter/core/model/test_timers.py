"""Deadlines by name."""

from vram_arbiter.arbiter.core.model.state import TIMERS_SLACK, Timers


def test_timers_come_in_their_order_and_once() -> None:
    timers = Timers()
    timers.set(("ttl", "b"), 2.0)
    timers.set(("ttl", "a"), 1.0)
    assert timers.next_at() == 1.0
    assert timers.pop_due(0.5) is None
    assert [timers.pop_due(3.0) for _ in range(3)] == [("ttl", "a"), ("ttl", "b"), None]
    assert timers.next_at() is None


def test_renewing_moves_a_deadline_and_earlier_ones_win() -> None:
    timers = Timers()
    timers.set(("ttl", "a"), 1.0)
    timers.set(("ttl", "a"), 5.0)
    assert timers.next_at() == 5.0
    timers.set(("ttl", "a"), 3.0)
    assert timers.next_at() == 3.0
    assert timers.pop_due(4.0) == ("ttl", "a")
    assert timers.next_at() is None


def test_a_cleared_timer_never_fires() -> None:
    timers = Timers()
    timers.set(("ttl", "a"), 1.0)
    timers.cancel(("ttl", "a"))
    timers.cancel(("ttl", "a"))
    assert ("ttl", "a") not in timers
    assert timers.pop_due(9.0) is None


def test_cleared_timers_do_not_pile_up_until_they_would_be_due() -> None:
    """Waits of a year that were given up at once stayed in the heap for the year: the daemon grew
    with every one."""
    timers = Timers()
    timers.set(("ttl", "a"), 5.0)
    for number in range(10 * TIMERS_SLACK):
        timers.set(("wait", f"L{number}"), 1e7 + number)
        timers.cancel(("wait", f"L{number}"))
    assert len(timers._heap) <= TIMERS_SLACK + 2
    timers.set(("ttl", "b"), 3.0)
    assert [timers.pop_due(1e9) for _ in range(3)] == [("ttl", "b"), ("ttl", "a"), None]
