"""Delay of pictures in queues, from the source's own time stamps.

By arrival alone, everything that a stream delivers in a rush after a pause would look fresh. A
source counts its own time from an unknown start; the smallest difference seen between arrival and
that count belongs to the picture that waited least, and how far a picture lies above it is how much
longer it waited. The part that every picture takes stays unseen.
"""

from __future__ import annotations

# the smallest difference of this and the window before it counts: the two clocks drift
WINDOW_S = 15.0


class LagMeter:
    """One run of one source. Not for several threads."""

    def __init__(self) -> None:
        self._least_ns: int | None = None  # of this window
        self._before_ns: int | None = None  # of the one before
        self._window_end_ns = 0
        self._last_pts_ns: int | None = None

    def taken_ns(self, arrival_ns: int, pts_ms: float) -> int:
        """Return when the picture was taken, by the clock of `arrival_ns` and never later than it.

        `pts_ms` is the source's own time of it. Pictures of a source whose time does not move count
        from their arrival; a source that restarts is measured anew.
        """
        pts_ns = round(pts_ms * 1e6)
        if self._last_pts_ns is None or pts_ns <= self._last_pts_ns:
            self._least_ns = self._before_ns = None
            self._window_end_ns = arrival_ns + round(WINDOW_S * 1e9)
        self._last_pts_ns = pts_ns
        if arrival_ns >= self._window_end_ns:
            self._before_ns, self._least_ns = self._least_ns, None
            self._window_end_ns = arrival_ns + round(WINDOW_S * 1e9)
        behind_ns = arrival_ns - pts_ns
        self._least_ns = behind_ns if self._least_ns is None else min(self._least_ns, behind_ns)
        least_ns = (
            self._least_ns if self._before_ns is None else min(self._least_ns, self._before_ns)
        )
        return arrival_ns - (behind_ns - least_ns)
