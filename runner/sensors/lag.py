"""How late a picture comes, from the source's own time stamps: what waited in a driver's or the network's queue is as old as it is.

Arrival alone would call everything fresh that a stream delivers in a rush after it, or this program, stood still. A source counts its own
time from an unknown start; the smallest difference seen between arrival and that count belongs to the picture that waited least, and how far a
picture lies above it is how much longer it waited. The part that every picture takes stays unseen.
"""

from __future__ import annotations

WINDOW_S = 15.0  # the smallest difference of this and the window before it counts: the two clocks drift apart, some ms a minute


class LagMeter:
    """One run of one source. Not for several threads."""

    def __init__(self) -> None:
        self._least_ns: int | None = None  # of this window
        self._before_ns: int | None = None  # of the one before
        self._window_end_ns = 0
        self._last_pts_ns: int | None = None

    def taken_ns(self, arrival_ns: int, pts_ms: float) -> int:
        """When the picture was taken, by the clock of `arrival_ns` and never later than it. `pts_ms` is the source's own time of it.

        A source whose time does not move has none: its pictures count from their arrival. One that begins anew is measured anew.
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
