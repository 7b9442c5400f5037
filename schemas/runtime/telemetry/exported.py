"""Values for a collector, in a form that can be sent.

Without it one odd text would cost its whole batch of spans, or every later scrape. Texts come from
file names, exceptions and models; they may have half of a surrogate pair, which UTF-8 cannot
encode, or any length. The SDK is imported only where it is used.
"""

from collections.abc import Mapping, Sequence
from typing import Any

TEXT_MAX_CHARS = 16_384
"""Longest text of a span: a long stack trace fits, a picture does not."""
LABEL_MAX_CHARS = 256
"""Longest label of a metric: each value is a series of its own."""
ITEMS_MAX = 128
"""Most items of a list or mapping; the rest is omitted."""


def text(value: str, most: int = TEXT_MAX_CHARS) -> str:
    """Return the text if it can be sent; else escaped (`\\ud800`) and cut with a `…`."""
    legible = value[: most + 1].encode(errors="backslashreplace").decode()
    return legible if len(legible) <= most else legible[: most - 1] + "…"


def attribute(value: Any) -> Any:
    """Return the value as it can be sent: text, number, bool, None, or a list of these."""
    match value:
        case None | bool() | float():
            return value
        case int() if -(1 << 63) <= value < 1 << 63:
            return value
        case bytes():
            return text(value[: TEXT_MAX_CHARS + 1].decode(errors="replace"))
        case list() | tuple():
            return [
                text(str(one)) if isinstance(one, list | tuple) else attribute(one)
                for one in value[:ITEMS_MAX]
            ]
        case _:
            return text(str(value))


def attributes(values: Mapping[Any, Any]) -> Mapping[str, Any]:
    """Return the mapping as it can be sent."""
    kept = list(values.items())[:ITEMS_MAX]
    return {text(str(key), LABEL_MAX_CHARS): attribute(value) for key, value in kept}


def labels(values: Mapping[str, str] | None) -> Mapping[str, str] | None:
    """Return a metric's labels: texts of at most `LABEL_MAX_CHARS`."""
    if values is None:
        return None
    return {key: text(value, LABEL_MAX_CHARS) for key, value in values.items()}


class Legible:
    """Exporter of spans that passes only values that can be sent to the SDK's exporter.

    That one would omit a whole batch for one bad text. The counts of what the SDK dropped from a
    span are not passed on.
    """

    def __init__(self, exporter: Any) -> None:
        self._exporter = exporter
        self.shutdown = exporter.shutdown
        self.force_flush = exporter.force_flush

    def export(self, spans: Sequence[Any]) -> Any:
        return self._exporter.export([_rewritten(span) for span in spans])


def _rewritten(span: Any) -> Any:
    from opentelemetry.sdk.trace import Event, ReadableSpan
    from opentelemetry.trace import Link, Status

    said = span.status.description
    return ReadableSpan(
        name=text(span.name),
        context=span.context,
        parent=span.parent,
        resource=span.resource,
        attributes=attributes(span.attributes or {}),
        events=[
            Event(text(event.name), attributes(event.attributes or {}), event.timestamp)
            for event in span.events
        ],
        links=[Link(link.context, attributes(link.attributes or {})) for link in span.links],
        kind=span.kind,
        status=Status(span.status.status_code, None if said is None else text(said)),
        start_time=span.start_time,
        end_time=span.end_time,
        instrumentation_scope=span.instrumentation_scope,
    )
