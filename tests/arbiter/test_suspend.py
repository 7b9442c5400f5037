"""A suspend is what CLOCK_BOOTTIME saw and CLOCK_MONOTONIC did not. The clocks are the test's."""

from vram_arbiter.arbiter.inbox import NOTICED_S, SuspendWatch


class Clocks:
    def __init__(self) -> None:
        self.monotonic_s, self.lead_s, self.held_up_s = 100.0, 7.0, 0.0

    def boottime(self) -> float:
        now = self.monotonic_s + self.lead_s
        self.monotonic_s += self.held_up_s  # between this reading and the next
        return now

    def monotonic(self) -> float:
        return self.monotonic_s


def watch(clocks: Clocks) -> SuspendWatch:
    return SuspendWatch(clocks.boottime, clocks.monotonic)


def test_a_sleep_is_told_once() -> None:
    clocks = Clocks()
    watching = watch(clocks)
    assert watching.slept_s() == 0.0
    clocks.monotonic_s += 5000.0
    assert watching.slept_s() == 0.0, "time that passed awake is no sleep"
    clocks.lead_s += 3600.0
    assert watching.slept_s() == 3600.0
    assert watching.slept_s() == 0.0
    clocks.lead_s += 60.0
    assert watching.slept_s() == 60.0


def test_naps_add_up() -> None:
    clocks = Clocks()
    watching = watch(clocks)
    told = []
    for _ in range(10):
        clocks.lead_s += NOTICED_S * 0.3
        told.append(watching.slept_s())
    assert 0.0 in told
    assert abs(sum(told) - NOTICED_S * 2.4) < 1e-6, (
        "what is below the threshold is kept, not forgotten"
    )


def test_a_process_that_was_held_up_did_not_sleep() -> None:
    """SIGSTOP, a debugger, a busy machine: between two readings of two clocks anything can pass."""
    clocks = Clocks()
    watching = watch(clocks)
    clocks.held_up_s = 300.0
    assert watching.slept_s() == 0.0
    clocks.held_up_s = 0.0
    assert watching.slept_s() == 0.0


def test_this_machine_has_both_clocks_and_does_not_sleep_during_a_test() -> None:
    watching = SuspendWatch()
    assert watching.slept_s() == 0.0
