"""A caller's W3C `traceparent`, read once and in one way, on every wire and of every environment.

Telemetry never refuses a request: a malformed traceparent is ignored, and the request begins a
trace of its own. A later version than ours (00) is read as far as ours goes, which is what
https://www.w3.org/TR/trace-context/ asks for, and handed on as ours. Pure.
"""

import re
from collections.abc import Callable
from typing import Annotated

from vram_arbiter.schemas.plain import JsonObject

READ_MAX_CHARS = 512
"""Of a later version, with what it has behind ours: as much as OpenTelemetry's own propagators
read."""

_SHAPE = re.compile(r"([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-.*)?", re.ASCII)
_SAMPLED = 0x01


def read(value: object) -> str | None:
    """`00-TRACE-SPAN-FLAGS` in lower-case hexadecimal, or None for everything that is no
    traceparent."""
    if not isinstance(value, str) or len(value) > READ_MAX_CHARS:
        return None
    found = _SHAPE.fullmatch(value.strip(" \t"))
    if found is None:
        return None
    version, trace, span, flags, more = found.groups()
    if version == "ff" or not trace.strip("0") or not span.strip("0"):
        return None
    if version == "00":
        return None if more is not None else f"00-{trace}-{span}-{flags}"
    return f"00-{trace}-{span}-{int(flags, 16) & _SAMPLED:02x}"


class _Read:
    """Applied by pydantic, which this module does not import: clients start without it."""

    def __get_pydantic_core_schema__(
        self, source: object, handler: Callable[[object], JsonObject]
    ) -> JsonObject:
        before = {"type": "no-info", "function": read}
        return {"type": "function-before", "function": before, "schema": handler(source)}


Traceparent = Annotated[str | None, _Read()]
"""Of a request: never a reason to refuse it."""
