"""Names, labels and reasons of any local process are read by an operator at a terminal: none of
them is obeyed there.

An escape sequence in a consumer name could clear the screen, rename the window or show a lease that
does not exist; a line break in a reason forged lines of the log.
"""

import json
import logging
import unicodedata
from argparse import Namespace
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.clients.cli import test_text as said
from vram_arbiter.arbiter import log as telemetry
from vram_arbiter.clients.cli import demo_display, doctor, replies, text
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import BadState
from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime import terminal

HOSTILE = (
    "x\x1b]0;owned\x07\x1b[2J\x9b31m\u202egnp\u2066\u200b\x00\r\n2026 forged "
    "[red]line[/red]\t\udcff"
)


def obeyed(shown: str) -> list[str]:
    """What a terminal would not simply show."""
    return [
        c for c in shown if c != "\n" and unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")
    ]


def poisoned(value: Any, name: str, keys: frozenset[str] | None = None) -> Any:
    """A reply with `name` for every text, or for the texts of some keys."""
    if isinstance(value, Mapping):
        return {
            key: poisoned(item, name, keys)
            if not isinstance(item, str) or keys is None or key in keys
            else item
            for key, item in value.items()
        }
    if isinstance(value, list):
        return [poisoned(item, name, keys) for item in value]
    return name if isinstance(value, str) else value


GPU = said.GPU | {
    "stowaway_bytes": GIB,
    "blocked": {"code": "pressure", "text": "pressure"},
    "processes": [
        {"pid": 8, "name": "Xorg", "used_bytes": GIB, "residue_bytes": 0, "stowaway": True},
        {"pid": 7, "name": "python", "used_bytes": GIB, "residue_bytes": GIB, "stowaway": False},
    ],
}
STATUS = said.STATUS | {
    "drained": "uid 1000",
    "problems": ["the journal cannot be written"],
    "gpus": [GPU],
    "leases": [said.LEASE, said.LEASE | {"state": "queued", "position": 1}],
    "demands": [{"consumer": "llm", "in_flight": 1, "waiting": 2, "client": "gateway"}],
}
WHY = {"consumer": "grab", "leases": [said.WAITS | {"plan": [{"text": "x leaves"}]}]}
EVENT = {
    "seq": 1,
    "at_wall_s": 1.0,
    "kind": "revoke_asked",
    "lease_id": "L1-1",
    "consumer": "detector",
    "reason": "room is wanted",
    "wanted_by": "grab",
    "label": "detect",
}


SAID: dict[str, Callable[[str], list[str]]] = {
    "status": lambda name: text.status_lines(
        {
            **STATUS,
            "drained": name,
            "problems": [name],
            "gpus": poisoned([GPU], name),
            "leases": poisoned(
                STATUS["leases"], name, frozenset({"consumer", "model", "lease_id", "gpu"})
            ),
        }
    ),
    "status, every text": lambda name: text.status_lines(poisoned(STATUS, name)),
    "why": lambda name: text.why_lines(
        {
            "consumer": name,
            "leases": [{**entry, "state": "queued"} for entry in poisoned(WHY, name)["leases"]],
        }
    ),
    "why, nothing": lambda name: text.why_lines({"consumer": name, "leases": []}),
    "by hand": lambda name: [
        line
        for action in ("pin", "unpin", "evict")
        for line in text.by_hand_lines(action, {"lease": poisoned(said.LEASE, name)})
    ],
    "drained": lambda name: text.by_hand_lines("drain", {"drained": name}),
    "event": lambda name: [text.event_line(poisoned(EVENT, name))],
    "event, new field": lambda name: [text.event_line({**EVENT, name: name})],
    "error": lambda name: [text.error_line({"message": name, "hint": name})],
    "table": lambda name: text.table(["LEASE", "CONSUMER"], [["L1", name], [name, "x"]]),
}


@pytest.mark.parametrize("what", SAID)
def test_no_line_that_vramctl_prints_has_a_control_or_is_two(what: str) -> None:
    plain, hostile = SAID[what]("name"), SAID[what](HOSTILE)
    assert len(hostile) == len(plain)
    assert not any(obeyed(line) or "\n" in line for line in hostile)
    assert "\\x1b]0;owned\\x07" in "\n".join(hostile)


@given(st.sampled_from(sorted(SAID)), st.text(st.characters(codec=None)))
def test_whatever_the_name(what: str, name: str) -> None:
    assert all(line.isprintable() for line in SAID[what](name))


def test_columns_stay_columns_beside_an_escaped_name() -> None:
    head, one, other = text.table(["CONSUMER", "PRIO"], [["x\x1b[2J", "50"], ["detector", "7"]])
    assert head.index("PRIO") + len("PRIO") == len(one) == len(other)


# -- the demo's lines
def test_the_demos_lines_obey_no_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    display = demo_display.Display()
    display.event(poisoned(EVENT, HOSTILE, frozenset({"consumer", "reason"})), 1.0)
    display.robot(HOSTILE, 2.0)
    shown = capsys.readouterr().out
    assert not obeyed(shown)
    assert shown.count("[red]line[/red]") == 3
    assert shown.count("\n") == 2


# -- logs and errors
def log_line(set_up: Callable[[], None]) -> str:
    set_up()
    (handler,) = logging.getLogger().handlers
    try:
        raise ValueError(HOSTILE)
    except ValueError as error:
        record = logging.LogRecord(
            HOSTILE,
            logging.WARNING,
            "",
            1,
            "lease of %s",
            (HOSTILE,),
            (type(error), error, error.__traceback__),
        )
    record.event = {"consumer": HOSTILE}
    return handler.format(record)


@pytest.mark.parametrize(
    ("form", "set_up"),
    [
        ("human", lambda: telemetry.set_up_logging("human", "info")),
        ("json", lambda: telemetry.set_up_logging("json", "info")),
        ("human", lambda: logs.set_up("p", "info", "human", "%(asctime)s %(name)s %(message)s")),
        ("json", lambda: logs.set_up("p", "info", "json", "")),
    ],
)
def test_no_log_line_has_a_control_or_is_two(form: str, set_up: Callable[[], None]) -> None:
    written = log_line(set_up)
    assert not obeyed(written)
    if form == "json":
        assert "\n" not in written
        assert HOSTILE in json.loads(written)["message"]
    else:
        first, *trace = written.split("\n")
        assert "\\x1b]0;owned" in first
        assert trace[0].startswith("Traceback")
        assert "\\x1b]0;owned" in trace[-2]


def test_a_history_event_in_the_daemons_log() -> None:
    telemetry.set_up_logging("human", "debug")
    (handler,) = logging.getLogger().handlers
    sentence = telemetry.sentence(poisoned(EVENT, HOSTILE))
    written = handler.format(
        logging.LogRecord("arbiter.events", logging.INFO, "", 1, "%s", (sentence,), None)
    )
    assert not obeyed(written)
    assert "\n" not in written


def test_errors_on_the_way_out(capsys: pytest.CaptureFixture[str]) -> None:
    terminal.complain("vram-runner", BadState(HOSTILE, hint=HOSTILE))
    replies.complain({"message": HOSTILE, "hint": HOSTILE}, as_json=False)
    replies.complain({"message": HOSTILE, "hint": HOSTILE}, as_json=True)
    said = capsys.readouterr()
    assert not obeyed(said.err)
    assert not obeyed(said.out)


def test_doctor_quotes_what_the_arbiter_said(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    monkeypatch.setenv("VRAM_ARBITER_ENDPOINT", f"ipc://{tmp_path}/{HOSTILE}".replace("\0", ""))
    doctor.run(Namespace(as_json=False, endpoint=None))
    said = capsys.readouterr()
    assert "\\x1b]0;owned" in said.out
    assert not obeyed(said.out)
