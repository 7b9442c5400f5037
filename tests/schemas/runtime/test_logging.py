"""A program's log as JSON: one object a line, with the ids of the present span."""

import json
import logging

import pytest

from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

TRACE, SPAN = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"


def test_a_line_of_json_names_its_span(capsys: pytest.CaptureFixture[str]) -> None:
    logs.set_up("tool", "info", "json", "")
    log = logging.getLogger("a")
    log.info("before")
    log.debug("hidden")
    with tracing.joined(f"00-{TRACE}-{SPAN}-01"):
        log.warning("%s\nlines", "two")
    try:
        raise ZeroDivisionError
    except ZeroDivisionError:
        log.exception("after")
    before, within, after = map(json.loads, capsys.readouterr().err.splitlines())
    named = [before[key] for key in ("message", "level", "program", "logger")]
    assert named == ["before", "info", "tool", "a"]
    assert (within["trace_id"], within["span_id"], within["message"]) == (TRACE, SPAN, "two\nlines")
    assert "ZeroDivisionError" in after["exception"]
    assert "trace_id" not in before | after
