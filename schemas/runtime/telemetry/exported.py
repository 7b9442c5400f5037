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
DEPTH_MAX = 4


def text(value: str, most: int = TEXT_MAX_CHARS) -> str:
    """Return the text if it can be sent; else escaped (`\\ud800`) and cut with a `…`."""
    if len(value) <= most and (value.isascii() or _encodable(value)):
        return value
    legible = value[:most].encode(errors="backslashreplace").decode()
    cut = len(value) > most or len(legible) > most
    return legible[: most - 1] + "…" if cut else legible


def attribute(value: Any, depth: int = DEPTH_MAX) -> Any:
    """Return the value if it can be sent: text, number, bool, None, or lists and mappings of these.

    Bytes become text, other types their `str`.
    """
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
    """Return the mapping if all of it can be sent, else one that can be."""
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
    """Return a metric's labels: texts of at most `LABEL_MAX_CHARS`."""
    if values is None or all(
        value.isascii() and len(value) <= LABEL_MAX_CHARS for value in values.values()
    ):
        return values
    return {key: text(value, LABEL_MAX_CHARS) for key, value in values.items()}


class Legible:
    """Exporter of spans that passes only values that can be sent to the SDK's exporter.

    That one would omit a whole batch for one bad text.
    """

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
    # a foreign type may raise anything; a number of 5,000 digits is refused too
    except Exception:  # noqa: BLE001
        return f"a {type(value).__name__}"
