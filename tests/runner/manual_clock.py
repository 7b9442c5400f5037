"""A clock of the tests: what a busy machine does to a test's time does not count on it."""


class ManualClock:
    """Time passes by `advance` and by sleeping, never by itself."""

    def __init__(self) -> None:
        self.time_s = 100.0
        self.slept: list[float] = []

    def now_s(self) -> float:
        return self.time_s

    def now_ns(self) -> int:
        return round(self.time_s * 1e9)

    def wall_ns(self) -> int:
        return round(self.time_s * 1e9)

    def sleep_s(self, duration_s: float) -> None:
        self.slept.append(duration_s)
        self.time_s += max(0.0, duration_s)

    def advance(self, duration_s: float) -> None:
        self.time_s += duration_s
