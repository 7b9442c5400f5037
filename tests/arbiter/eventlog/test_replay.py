"""A log through the engine again: identical, or the first decision that is another, with its
surroundings."""

import json
import shutil
from pathlib import Path

import pytest

from tests.support.core_driver import CoreDriver
from tests.support.recording import write_log
from vram_arbiter.arbiter.eventlog import replay as runner
from vram_arbiter.arbiter.eventlog import text
from vram_arbiter.arbiter.eventlog.logfile import LogError
from vram_arbiter.arbiter.offline.__main__ import main


@pytest.fixture(scope="module")
def written(busy: CoreDriver, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of that run; read only."""
    return write_log(busy, tmp_path_factory.mktemp("written"))


@pytest.fixture
def log(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(written, tmp_path))


def tamper(log: Path, number: int, **changes: object) -> None:
    """Change fields of the n-th event (0: the header)."""
    lines = log.read_text().splitlines()
    lines[number] = json.dumps(json.loads(lines[number]) | changes)
    log.write_text("\n".join(lines) + "\n")


def test_a_run_is_repeated_byte_for_byte(busy: CoreDriver, log: Path) -> None:
    found = runner.replay(runner.load(log))
    assert (found.identical, found.events, found.same_engine) == (True, len(busy.events), True)
    assert text.replay_lines(found)[-1].startswith(f"{len(busy.events)} events, identical (1 file")


def test_the_first_divergence_is_shown_with_its_surroundings(log: Path) -> None:
    tamper(log, 40, digest="0" * 16)
    tamper(log, 41, digest="1" * 16)
    found = runner.replay(runner.load(log))
    odd = found.divergence
    assert (odd.number, odd.entry.line, len(odd.before), found.events) == (
        40,
        41,
        runner.CONTEXT,
        40,
    )
    lines = text.replay_lines(found)
    assert lines[0] == f"event 40 is decided otherwise ({log.name}:41)"
    assert any(line.startswith("  logged") and "0" * 16 in line for line in lines)
    assert runner.report(found)["divergence"]["replayed"]["digest"] != "0" * 16


def test_another_input_is_another_decision(log: Path) -> None:
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    number = next(
        i for i, line in enumerate(lines[1:], 1) if "nonce" in line["data"].get("request", ())
    )
    data = lines[number]["data"]
    data["request"]["spec"]["footprint"]["load_peak_bytes"] = 1 << 40
    tamper(log, number, data=data)
    found = runner.replay(runner.load(log))
    assert found.divergence.number == number
    assert "Refuse" in text.replay_lines(found)[-2]


def test_a_log_of_another_engine_says_so_beside_its_divergence(log: Path) -> None:
    tamper(log, 0, engine="abcdef", version="0.0.7")
    tamper(log, 3, digest="0" * 16)
    lines = text.replay_lines(runner.replay(runner.load(log)))
    assert "recorded by version 0.0.7 (engine abcdef)" in lines[1]


def test_a_torn_last_line_is_tolerated_and_said(busy: CoreDriver, log: Path) -> None:
    log.write_bytes(log.read_bytes()[:-20])
    found = runner.replay(runner.load(log))
    assert (found.identical, found.events) == (True, len(busy.events) - 1)
    assert "torn" in text.replay_lines(found)[0]


def test_a_crash_of_the_engine_is_repeated_too(busy: CoreDriver, log: Path) -> None:
    """The last line of a daemon that stopped on a defect has no digest."""
    broken = {"t": 5000.0, "event": "MemorySampled", "effects": "", "digest": None}
    data = {
        "gpu": "GPU-0",
        "taken_at": 5000.0,
        "used_bytes": None,
        "total_bytes": 8 << 30,
        "processes": None,
    }
    with log.open("a") as file:
        file.write(json.dumps(broken | {"data": data}) + "\n")
    found = runner.replay(runner.load(log))
    assert (found.identical, found.events) == (True, len(busy.events) + 1)
    assert "up to the defect that ended the daemon: TypeError" in text.replay_lines(found)[-1]


def test_a_defect_that_is_new_is_a_divergence(log: Path) -> None:
    lines = log.read_text().splitlines()
    number = next(i for i, line in enumerate(lines) if '"event":"MemorySampled"' in line)
    tamper(log, number, data=json.loads(lines[number])["data"] | {"used_bytes": None})
    found = runner.replay(runner.load(log))
    assert "now     the engine raises TypeError" in text.replay_lines(found)[-1]


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('{"log"', 'hello\n{"log"', "no event log of an arbiter"),
        ('"log":2', '"log":9', "a log of format 9"),
        ('"epoch"', '"epoche"', "Header has no field epoche"),
        ('"event":"Tick"', '"event":"Tock"', "no event is called Tock"),
        ('"digest"', '"digits"', "not a line of an event log"),
    ],
)
def test_what_is_no_log_of_ours_is_told_with_its_file(
    log: Path, old: str, new: str, says: str
) -> None:
    log.write_text(log.read_text().replace(old, new, 1))
    with pytest.raises(LogError, match=says) as caught:
        runner.load(log)
    assert log.name in str(caught.value)


@pytest.mark.parametrize(
    "line",
    [
        "garbage",
        "[1, 2]",
        "[" * 100_000,
        '{"t": "late", "event": "Tick", "data": {}, "effects": "", "digest": null}',
    ],
)
def test_a_damaged_line_is_named_with_what_can_be_replayed(log: Path, line: str) -> None:
    """Regression: a damaged event log ended `vramctl replay` with a traceback."""
    lines = log.read_text().splitlines()
    log.write_text("\n".join([*lines[:5], line, *lines[5:], ""]))
    with pytest.raises(LogError, match=r":6: not a line of an event log.*head -n 5"):
        runner.load(log)
    log.write_text(line + "\n")
    with pytest.raises(LogError, match="no event log of an arbiter"):
        runner.load(log)


def test_a_log_without_events_does_not_pass_for_a_proof(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log.write_text(log.read_text().splitlines()[0] + "\n")
    assert main(["replay", str(log)]) == 0
    assert "nothing was compared" in capsys.readouterr().out


def test_an_empty_file_is_no_log(log: Path) -> None:
    log.write_text("")
    with pytest.raises(LogError, match="not even the first line is whole"):
        runner.load(log)


def test_a_folder_without_logs(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no event log here"):
        runner.load(tmp_path)


def test_the_newest_start_of_a_folder_is_taken(log: Path) -> None:
    older = log.with_name("19691231T000000-000001-0000.jsonl")
    older.write_text("from another time\n")
    assert [file.path for file in runner.load(log.parent)] == [log]


def test_a_file_that_needs_an_earlier_one_says_so(log: Path) -> None:
    header, *_ = log.read_text().splitlines()
    later = log.with_name(log.name.replace("-0000.", "-0002."))
    later.write_text(header.replace('"segment":0', '"segment":2') + "\n")
    with pytest.raises(LogError, match="a file before it is missing"):
        runner.load(log.parent)


def test_the_program_prints_and_exits(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(log)]) == 0
    assert "identical" in capsys.readouterr().out
    assert main(["replay", str(log), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["identical"] is True
    tamper(log, 2, digest="0" * 16)
    assert main(["replay", str(log)]) == 1
    assert "event 2 is decided otherwise" in capsys.readouterr().out
    assert main(["replay", str(log), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["divergence"]["number"] == 2
    assert main(["replay", str(log.parent / "no")]) == 1
    assert "vramctl: " in capsys.readouterr().err
    assert main(["replay", str(log.parent / "no"), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "bad_log"
