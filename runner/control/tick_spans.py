"""Trace spans of ticks: which ticks get one, and which trace they join."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager

from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing


class TickSpans:
    """Opens the span of a tick. `share` of the ticks get one (0 to 1).

    Until a goal's first action is applied every tick gets a span, whatever `share` says.
    """

    def __init__(self) -> None:
        self.share = 1.0
        self.trace_id: str | None = None  # of the first traced tick
        self._credit = 0.0
        self._acted = False  # an action of the present goal was applied

    def goal_began(self) -> None:
        self._acted = False

    def applied(self, action_applied: bool) -> None:
        self._acted = self._acted or action_applied

    def tick(
        self, traceparent: str | None, labels: Mapping[str, str]
    ) -> AbstractContextManager[object]:
        """Return the tick's span.

        It joins the goal's trace or the present one. Outside both a tick begins no trace of its
        own: an idle robot would begin thirty a second. A tick that is left out opens no span, and
        the trace that it would have joined stands for it.
        """
        if traceparent is None and not tracing.traced():
            return tracing.left_out(None)
        if self._acted:
            self._credit += self.share
            if self._credit < 1.0:
                return tracing.left_out(traceparent)
            self._credit -= 1.0
        return tracing.span(telemetry.SPAN_TICK, traceparent, labels)

    def carrier(self) -> dict[str, str] | None:
        """Return the trace context of the present tick, None outside a trace."""
        carrier = tracing.carrier() or {}
        if self.trace_id is None and "traceparent" in carrier:
            self.trace_id = carrier["traceparent"].split("-")[1]
        return carrier or None
