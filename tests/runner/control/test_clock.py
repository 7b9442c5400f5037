"""precise_sleep: asleep up to the last millisecond, awake for that one."""

from vram_arbiter.runner.control.clock import BUSY_TAIL_S, SystemClock, precise_sleep


class Ticking:
    """Every look at the clock takes 0.1 ms; sleeping oversleeps by `late_s`."""

    def __init__(self, late_s: float) -> None:
        self.time_s, self.late_s, self.slept, self.looks = 0.0, late_s, [], 0

    def now_s(self) -> float:
        self.looks += 1
        self.time_s += 1e-4
        return self.time_s

    def sleep(self, duration_s: float) -> None:
        self.slept.append(duration_s)
        self.time_s += duration_s + self.late_s


def test_sleeps_all_but_the_last_millisecond_and_wakes_on_time() -> None:
    time = Ticking(late_s=5e-4)
    precise_sleep(0.030, sleep=time.sleep, now_s=time.now_s)
    assert time.slept == [0.030 - BUSY_TAIL_S]
    assert 0.030 <= time.time_s < 0.0304
    assert time.looks <= 12  # the busy tail is a millisecond at most


def test_short_waits_never_reach_the_kernel() -> None:
    time = Ticking(late_s=0.01)
    precise_sleep(0.0005, sleep=time.sleep, now_s=time.now_s)
    assert time.slept == []
    assert time.time_s < 0.001


def test_no_wait_for_a_moment_that_has_passed() -> None:
    time = Ticking(late_s=0.0)
    precise_sleep(-1.0, sleep=time.sleep, now_s=time.now_s)
    assert time.slept == []
    assert time.looks <= 2


def test_the_system_clock_waits_at_least_as_long_as_asked() -> None:
    clock = SystemClock()
    before = clock.now_s()
    clock.sleep_s(0.003)
    assert clock.now_s() - before >= 0.003
