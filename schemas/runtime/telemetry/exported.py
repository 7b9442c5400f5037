"""What goes to a collector, so that it can be read there: one odd text would otherwise cost its whole batch of spans, or every later scrape.

Texts come from file names, exceptions and models, and may hold half of a surrogate pair, which UTF-8 has no bytes for, or have no end.
The SDK's types are imported by what is given them.
"""

from collections.abc import Mapping, Sequence
from typing import Any

TEXT_MAX_CHARS = 16_384
"""Of one text of a span: a long stack trace, and no picture."""
LABEL_MAX_CHARS = 256
"""Of a metric's label: each value is a series of its own."""
ITEMS_MAX = 128
"""Of a list or a mapping; the rest is left out."""
DEPTH_MAX = 4


def text(value: str, most: int = TEXT_MAX_CHARS) -> str:
    """The same text if it can be sent; else with what cannot be encoded written out (`\\ud800`), and cut with a `…`."""
    if len(value) <= most and (value.isascii() or _encodable(value)):
        return value
    legible = value[:most].encode(errors="backslashreplace").decode()
    cut = len(value) > most or len(legible) > most
    return legible[: most - 1] + "…" if cut else legible


def attribute(value: Any, depth: int = DEPTH_MAX) -> Any:
    """The same value if it can be sent: text, number, truth, None, or lists and mappings of such. Bytes become text, all else its `str`."""
    match value:
        case None | bool() | float():
            return value
        case str():
            return text(value)
        case int():
            return value if -(1 << 63) <= value < 1 << 63 else text(_said(value))
        case bytes():
            return text(value[: TEXT_MAX_CHARS + 1].decode(errors="replace"))
        case list() | tuple() if depth:
            items = [attribute(item, depth - 1) for item in value[:ITEMS_MAX]]
            same = len(items) == len(value) and all(
                a is b for a, b in zip(items, value, strict=True)
            )
            return value if same else items
        case Mapping() if depth:
            return attributes(value, depth - 1)
        case list() | tuple() | Mapping():
            return "…"
        case _:
            return text(_said(value))


def attributes(values: Mapping[Any, Any], depth: int = DEPTH_MAX) -> Mapping[Any, Any]:
    """The same mapping if all of it can be sent."""
    sent = {
        text(str(key), LABEL_MAX_CHARS): attribute(value, depth)
        for key, value in list(values.items())[:ITEMS_MAX]
    }
    if len(sent) == len(values) and all(
        key in values and values[key] is value for key, value in sent.items()
    ):
        return values
    return sent


def labels(values: Mapping[str, str] | None) -> Mapping[str, str] | None:
    """Of a metric: texts of at most `LABEL_MAX_CHARS`."""
    if values is None or all(
        value.isascii() and len(value) <= LABEL_MAX_CHARS for value in values.values()
    ):
        return values
    return {key: text(value, LABEL_MAX_CHARS) for key, value in values.items()}


class Legible:
    """An exporter of spans (the SDK's) that gets what can be sent: it would leave out a whole batch for one text that cannot."""

    def __init__(self, exporter: Any) -> None:
        self._exporter = exporter
        self.shutdown = exporter.shutdown
        self.force_flush = exporter.force_flush

    def export(self, spans: Sequence[Any]) -> Any:
        return self._exporter.export([span if _fits(span) else _rewritten(span) for span in spans])


def _fits(span: Any) -> bool:
    named = (span, *span.events)
    texts = (*(one.name for one in named), span.status.description or "")
    facts = [one.attributes or {} for one in (*named, *span.links)]
    return all(text(one) is one for one in texts) and all(attributes(one) is one for one in facts)


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


def _encodable(value: str) -> bool:
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def _said(value: object) -> str:
    try:
        return str(value)
    except Exception:  # noqa: BLE001 - whatever a stranger's type does to be shown; a number of 5,000 digits is refused, too
        return f"a {type(value).__name__}"
