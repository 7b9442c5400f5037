"""A rate of messages, kept without a timer."""

from dataclasses import dataclass


@dataclass(slots=True)
class Rate:
    """Messages that may come: `per_s` of them a second, and as many at once."""

    per_s: float
    left: float
    at: float

    def charge(self, cost: int, now: float) -> float:
        """Charge one message; return for how many seconds none may follow. One that costs more
        than what is left is paid later."""
        self.left = min(self.per_s, self.left + (now - self.at) * self.per_s) - cost
        self.at = now
        return max(0.0, (1.0 - self.left) / self.per_s)

    def is_full(self, now: float) -> bool:
        """Return whether nothing is owed any more."""
        return self.left + (now - self.at) * self.per_s >= self.per_s
