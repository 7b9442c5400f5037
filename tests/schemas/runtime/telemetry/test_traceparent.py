"""A caller's traceparent is read as W3C says, by one rule, wherever it comes in: one that is none
begins a new trace and refuses nothing."""

from contextlib import suppress
from typing import Any

import msgpack
from pydantic import TypeAdapter

from vram_arbiter.arbiter.rpc.codec import decode
from vram_arbiter.schemas.goals import RunnerRequest
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.runtime.telemetry.traceparent import read
from vram_arbiter.schemas.sidecar import ENDPOINT_REQUEST, OP_REQUEST

TRACE, SPAN = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
GOOD = f"00-{TRACE}-{SPAN}-01"

READ: list[tuple[object, str | None]] = [
    (GOOD, GOOD),
    (f"00-{TRACE}-{SPAN}-00", f"00-{TRACE}-{SPAN}-00"),
    (f"00-{TRACE}-{SPAN}-03", f"00-{TRACE}-{SPAN}-03"),
    (f" \t{GOOD} ", GOOD),
    # a later version: what this one knows of it, and no flag but `sampled`
    (f"01-{TRACE}-{SPAN}-01", GOOD),
    (f"cc-{TRACE}-{SPAN}-ff-what-the-future-will-be-like", GOOD),
    (f"cc-{TRACE}-{SPAN}-fe-", f"00-{TRACE}-{SPAN}-00"),
    (f"cc-{TRACE}-{SPAN}-01-" + "x" * 400, GOOD),
    (f"cc-{TRACE}-{SPAN}-01-" + "x" * 1000, None),
    (f"cc-{TRACE}-{SPAN}-01.what", None),
    # none
    (f"{GOOD}-what", None),
    (f"{GOOD}-", None),
    (f"ff-{TRACE}-{SPAN}-01", None),
    (f"00-{'0' * 32}-{SPAN}-01", None),
    (f"00-{TRACE}-{'0' * 16}-01", None),
    (f"00-{TRACE.upper()}-{SPAN}-01", None),
    (f"00-{TRACE}-{SPAN.upper()}-01", None),
    (f"00-{TRACE}-{SPAN}-0A", None),
    (f"CC-{TRACE}-{SPAN}-01", None),
    (f"00-{TRACE[1:]}-{SPAN}-01", None),
    (f"00-{TRACE}-{SPAN}", None),
    (f"0٠-{TRACE}-{SPAN}-01", None),
    (f"{GOOD}\n", None),
    (f"x{GOOD}", None),
    ("", None),
    ("?" * 1_000_000, None),
    ("\ud800", None),
    (None, None),
    (7, None),
    (b"00-", None),
    ([GOOD], None),
    ({"traceparent": GOOD}, None),
]


def test_it_is_read_as_w3c_says() -> None:
    assert [read(given) for given, _ in READ] == [kept for _, kept in READ]


def test_no_request_is_refused_for_it() -> None:
    """Regression: a goal, an acquire and a question to a sidecar were refused for a traceparent of
    more than 64 characters."""
    image = b"\x89PNG\r\n\x1a\n"
    messages: list[tuple[Any, dict[str, Any]]] = [
        (TypeAdapter(RunnerRequest), {"op": "goal", "id": 1, "goal_id": "g", "rskill_id": "a/b"}),
        (OP_REQUEST, {"op": "detect", "image": image, "query": "cube"}),
        (ENDPOINT_REQUEST, {"endpoint": "reset"}),
    ]
    for given, kept in READ:
        for wire, message in messages:
            assert wire.validate_python({**message, "traceparent": given}).traceparent == kept
        with suppress(UnicodeEncodeError):  # such a text is in no message
            frame = msgpack.packb({"op": "status", "id": 1, "traceparent": given})
            assert decode(frame, len(frame))[0].traceparent == kept


def test_a_span_joins_the_callers_trace_by_the_same_rule() -> None:
    """Also where none was validated: TRACEPARENT of a program's environment."""
    for given, kept in READ:
        if isinstance(given, str):
            with tracing.joined(given):
                found = tracing.traceparent()
                assert (found and found[:53]) == (kept and kept[:53]), given[:100]
