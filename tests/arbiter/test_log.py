"""The log says every event once, for people and for programs."""

import json
import logging
import re
import threading
from collections.abc import Iterator

import pytest

from tests.support.waiting import until
from vram_arbiter.arbiter import log as telemetry
from vram_arbiter.arbiter.log import LINES_MAX, REFUSALS_BURST, REFUSED_USERS_MAX, RefusalLog

EVENT = {"seq": 4, "at_wall_s": 1.0, "kind": "granted", "lease_id": "L1-4", "consumer": "detector",
         "charge_bytes": 5 << 30, "waited_s": 1.25, "reason": "fits"}  # fmt: skip


@pytest.fixture(autouse=True)
def _root_logger() -> Iterator[None]:
    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    yield
    for handler in list(root.handlers):
        root.removeHandler(handler)
    for handler in before:
        root.addHandler(handler)
    root.setLevel(level)


def test_an_event_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    telemetry.set_up_logging("human", "info")
    telemetry.log_event(EVENT)
    line = capsys.readouterr().err
    assert line.endswith(
        'info     granted L1-4 (detector): charge=5 GiB, waited_s=1.25, reason="fits"\n'
    )


def test_an_event_for_programs(capsys: pytest.CaptureFixture[str]) -> None:
    telemetry.set_up_logging("json", "info")
    telemetry.log_event(EVENT)
    line = json.loads(capsys.readouterr().err)
    assert line["event"] == EVENT
    assert line["level"] == "info"


def test_a_line_for_programs_names_its_span(capsys: pytest.CaptureFixture[str]) -> None:
    telemetry.set_up_logging("json", "info")
    ids = {"trace_id": "a" * 32, "span_id": "b" * 16}
    telemetry.log_event({**EVENT, **ids})
    line = json.loads(capsys.readouterr().err)
    assert (line["event"], line["trace_id"], line["span_id"]) == (
        {**EVENT, **ids}, "a" * 32, "b" * 16,
    )  # fmt: skip
    acquirer = f"00-{'c' * 32}-{'d' * 16}-01"
    telemetry.log_event({**EVENT, "traceparent": acquirer})
    line = json.loads(capsys.readouterr().err)
    assert (line["trace_id"], line["span_id"]) == ("c" * 32, "d" * 16), "of its acquirer"


def test_frequent_events_are_quiet_and_trouble_is_loud(capsys: pytest.CaptureFixture[str]) -> None:
    telemetry.set_up_logging("human", "info")
    telemetry.log_event({**EVENT, "kind": "use_began"})
    assert capsys.readouterr().err == ""
    telemetry.log_event({**EVENT, "kind": "lost"})
    assert " warning  lost L1-4" in capsys.readouterr().err


def test_an_exception_is_part_of_the_line(capsys: pytest.CaptureFixture[str]) -> None:
    for form in ("human", "json"):
        telemetry.set_up_logging(form, "error")  # type: ignore[arg-type]  # both are forms
        try:
            raise ValueError("why")
        except ValueError:
            logging.getLogger("x").exception("it failed")
        assert "ValueError: why" in capsys.readouterr().err


def test_a_log_that_is_not_read_holds_up_nothing_and_loses_lines_in_words() -> None:
    """A reader of stderr that stopped held up the whole daemon, until its watchdog killed it."""
    read, lines = threading.Event(), list[str]()

    class Slow(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            read.wait(60)
            lines.append(record.getMessage())

    root = logging.getLogger()
    root.handlers, root.level = [Slow()], logging.INFO
    close = telemetry.write_in_thread()
    for _ in range(LINES_MAX + 10):
        telemetry.log_event(EVENT)
    read.set()
    until(lambda: len(lines) >= LINES_MAX)
    telemetry.log_event(EVENT)
    close()
    logging.getLogger("x").warning("after the end")
    assert re.fullmatch(r"(9|10) lines are left out: the log was not read", lines[-3])
    assert lines[-2].startswith("granted L1-4 (detector)")
    assert lines[-1] == "after the end"


def test_a_flood_of_refusals_does_not_flood_the_log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    now = 100.0
    refusals = RefusalLog(lambda: now)
    for _ in range(1000):
        refusals.say(7, 1, "chat", "bad_state", "again")
    assert len(caplog.records) == REFUSALS_BURST
    refusals.say(8, 2, "", "bad_frame", "of another user")
    assert caplog.records[-1].getMessage() == "refused pid 2, uid 8: bad_frame: of another user"
    now += 1.0
    refusals.say(7, 1, "chat", "bad_state", "later")
    assert caplog.records[-1].getMessage() == (
        f"refused chat (pid 1, uid 7): bad_state: later ({1000 - REFUSALS_BURST} more before it "
        "are not shown)"
    )
    for uid in range(REFUSED_USERS_MAX + 10):
        refusals.say(uid, 1, "", "bad_state", "x")
    assert len(refusals._users) == REFUSED_USERS_MAX
