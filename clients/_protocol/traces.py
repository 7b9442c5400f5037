"""The caller's trace, for the clients: what they send along, and where an answer's work belongs.

A program that has not imported OpenTelemetry has no present span, and pays nothing here, not even
the import.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from vram_arbiter.schemas.plain import JsonMap, Message


def present() -> str | None:
    """The present span as W3C traceparent; None outside any."""
    if "opentelemetry.trace" not in sys.modules:
        return None
    from vram_arbiter.schemas.runtime.telemetry import spans as tracing

    return tracing.traceparent()


def along(fields: JsonMap | None = None) -> Message:
    """The fields of a message, with the present span's traceparent where there is one."""
    sent = dict(fields or {})
    if (traceparent := present()) is not None:
        sent.setdefault("traceparent", traceparent)
    return sent


def environ() -> dict[str, str]:
    """Return the variables by which a program that is started here joins the present trace."""
    traceparent = present()
    return {} if traceparent is None else {"TRACEPARENT": traceparent}


@contextmanager
def joined(traceparent: object) -> Iterator[None]:
    """Within the block (and in the tasks made there) the present span is the one that a message
    named, or none.

    Work that a message causes belongs to the trace of its sender, not to the task that read the
    socket.
    """
    if "opentelemetry.trace" not in sys.modules:
        yield
        return
    from vram_arbiter.schemas.runtime.telemetry import spans as tracing

    with tracing.joined(traceparent if isinstance(traceparent, str) else None):
        yield
