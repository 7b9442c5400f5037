"""Records that say what cannot be: the daemon starts, answers, and names the record that it put
aside.

Regression: a pid of 2^40 ended every start in a traceback, a token of 10^30 left every request for
the status unanswered.
"""

import contextlib
import copy
import json
import sqlite3
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.busy import busy_driver
from tests.support.core_driver import CoreDriver, as_wire
from tests.support.scenes import held, sent_away
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import JournalPut
from vram_arbiter.arbiter.core.events import DOUBT_KEY, MemorySampled, Recovered, Tick
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.host.journal import Journal, Opened
from vram_arbiter.arbiter.host.records import processes_of, record_of, records_of
from vram_arbiter.arbiter.host.seal import digest
from vram_arbiter.arbiter.recovery import try_records
from vram_arbiter.arbiter.rpc import codec
from vram_arbiter.schemas import defaults as d

Records = dict[str, dict[str, Any]]
STARTED_S = 1000.0


@cache
def records_written() -> tuple[tuple[Settings, Records], ...]:
    """Return what three engines wrote, the last of each key.

    A bit of everything, a lease in use by another process, a lease on standby.
    """
    used, alone = CoreDriver(8 * d.GIB), CoreDriver(8 * d.GIB)
    holder, lease = held(used, "policy", 3, residue_bytes=450 * d.MIB)
    used.consumer("runner").use_begin(lease, "goal", label="grab", token=holder.token(lease))
    sent_away(alone)
    found = []
    for driver in (busy_driver(7), used, alone):
        records = {e.key: as_wire(e.record) for e in driver.effects if isinstance(e, JournalPut)}
        records["drain"] = {"by": "operator", "reason": "service"}
        found.append((driver.settings, records))
    return tuple(found)


def start_with(settings: Settings, texts: dict[str, str]) -> Opened:
    """As the daemon does it, with an hour of work afterwards. Raises nothing, whatever the records
    say."""
    with tempfile.TemporaryDirectory(prefix="va", dir="/dev/shm") as root:
        Journal.open(Path(root), "boot").close()
        with (
            contextlib.closing(sqlite3.connect(Path(root) / "journal.sqlite")) as connection,
            connection,
        ):
            rows = [(key, text, digest(key, text)) for key, text in texts.items()]
            connection.executemany("INSERT INTO records VALUES (?, ?, ?)", rows)
        journal = Journal.open(Path(root), "boot", check=record_of)
        with contextlib.closing(journal):
            try_records(journal, settings)
            opened = journal.opened
    core = Arbiter(settings, STARTED_S)
    found = records_of(opened.records)
    core.handle(Recovered(found), STARTED_S)
    assert all(0 < process.pid < 1 << 31 for process in processes_of(found))
    for later_s in (0.0, 1.0, 20.0, 7200.0):
        now = STARTED_S + later_s
        for gpu in settings.gpus:
            core.handle(MemorySampled(gpu.id, now, d.GIB, gpu.capacity_bytes, ()), now)
        core.handle(Tick(), now)
        assert codec.reply(1, 1, core.status(now))
    assert core.status(now).phase == "serving"
    return opened


def texts_of(records: Records) -> dict[str, str]:
    return {key: json.dumps(record) for key, record in records.items()}


def paths(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The way to each value in a record."""
    found = [path] if path else []
    parts = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, part in parts:
        found += paths(part, (*path, key))
    return found


def deep(levels: int) -> Any:
    value: Any = 1
    for _ in range(levels):
        value = [value]
    return value


@pytest.mark.parametrize("index", [0, 1, 2])
def test_what_the_core_writes_is_taken(index: int) -> None:
    settings, records = records_written()[index]
    opened = start_with(settings, texts_of(records))
    assert set(opened.records) == {*records, DOUBT_KEY}, (
        "planted behind the seal's back, so in doubt"
    )
    assert opened.put_aside is None


NASTY = st.sampled_from(
    [None, True, -1, 0, 1 << 31, 1 << 40, 1 << 63, 10**30, -(10**30), 0.5, 1e308, float("nan"),
    float("inf"), "", "x", "7", "\ud800",
     "\0", "\x1b[2J", "x" * 100_000, [], [None], [1, 2], [[]], [-1, -1], [10**30, 1], {}, {"a": 1},
     {"": []}, deep(70), deep(400)]
)  # fmt: skip


def test_a_record_of_another_version_is_read_or_named() -> None:
    """A later version may write more; version 0.1 wrote its spec flat, for clients of another
    wire."""
    _, records = records_written()[0]
    key = next(key for key in records if key.startswith("lease:"))
    later = {**records[key], "color": 1, "spec": {**records[key]["spec"], "color": 1}}
    assert record_of(key, later) == record_of(key, records[key])
    flat = {**later["spec"], **later["spec"]["footprint"]}
    del flat["footprint"]
    with pytest.raises(ValueError, match=r"spec\.footprint: Field required"):
        record_of(key, {**later, "spec": flat})


@given(st.integers(0, 2), st.data())
def test_a_record_with_a_value_that_cannot_be_is_put_aside_or_harmless(
    index: int, data: st.DataObject
) -> None:
    settings, records = records_written()[index]
    records = copy.deepcopy(records)
    changed = set()
    for key in data.draw(
        st.lists(st.sampled_from(sorted(records)), min_size=1, max_size=3, unique=True)
    ):
        *way, last = data.draw(st.sampled_from(paths(records[key])))
        place: Any = records[key]
        for part in way:
            place = place[part]
        if data.draw(st.booleans()) and isinstance(place, dict):
            del place[last]
        else:
            place[last] = data.draw(NASTY)
        changed.add(key)
    opened = start_with(settings, texts_of(records))
    if opened.put_aside is None or "journal.records" in opened.put_aside.name:
        assert set(records) - set(opened.records) <= changed, "its neighbors are kept"


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("lease:L1-1", "[" * 100_000 + "]" * 100_000),
        ("lease:L1-1", '{"pid":' + "9" * 5000 + "}"),
        ("lease:L1-1", "null"),
        ("lease:L1-1", '{"pid": 1, "pid": 2}'),
        ("residue:1@1:GPU", '{"pid":1099511627776,"start_ticks":1,"gpu":"g","residue_bytes":1}'),
        (
            "residue:1@1:GPU",
            '{"pid":1,"start_ticks":1,"gpu":"g","residue_bytes":1' + "0" * 30 + "}",
        ),
        ("drain", '{"by":1,"reason":[]}'),
        ("doubt", "{}"),
        ("", "{}"),
        ("unknown", "{}"),
        ("\0", "{}"),
    ],
)
def test_a_text_that_is_no_record_is_put_aside(key: str, text: str) -> None:
    settings, records = records_written()[2]
    opened = start_with(settings, {**texts_of(records), key: text})
    assert opened.put_aside is not None
    assert any("could not be used" in problem for problem in opened.problems)
    assert set(records) - {key} <= set(opened.records)
