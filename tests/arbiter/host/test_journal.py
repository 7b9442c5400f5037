"""The journal survives the daemon; what cannot be trusted is put aside and reported."""

import os
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from pydantic_core import PydanticSerializationError

from vram_arbiter.arbiter.core.events import DOUBT_KEY
from vram_arbiter.arbiter.host.journal import AT_ONCE_MAX, Journal, Opened
from vram_arbiter.schemas.errors import ConfigError, JournalUnavailable

RECORDS = {
    "lease:L1-1": {"token": [1, 2], "state": "held"},
    "residue:7@9:GPU-1": {"residue_bytes": 5},
}


def filled(folder: Path) -> int:
    journal = Journal.open(folder, "boot-1")
    journal.apply(list(RECORDS.items()))
    journal.close()
    return journal.opened.epoch


def opened(folder: Path, boot_id: str = "boot-1", **options: Any) -> Opened:
    journal = Journal.open(folder, boot_id, **options)
    journal.close()
    return journal.opened


def test_records_come_back_and_the_epoch_grows(tmp_path: Path) -> None:
    filled(tmp_path)
    journal = Journal.open(tmp_path, "boot-1")
    assert journal.opened.records == RECORDS
    assert journal.opened.doubt == ""
    epoch = journal.opened.epoch
    journal.apply([("lease:L1-1", None), ("lease:L2-1", {"a": 1})])
    journal.close()
    again = opened(tmp_path, at_least=0)
    assert set(again.records) == {"residue:7@9:GPU-1", "lease:L2-1"}
    assert again.epoch == epoch + 1


def test_another_boot_voids_every_record(tmp_path: Path) -> None:
    filled(tmp_path)
    found = opened(tmp_path, "boot-2")
    assert (found.records, found.voided, found.doubt) == ({}, 2, "")
    assert opened(tmp_path, "boot-1").records == {}, "they do not come back"


def test_a_commit_survives_kill_9(tmp_path: Path) -> None:
    script = (
        "import sys, os, signal; from pathlib import Path; from vram_arbiter.arbiter.host.journal "
        "import Journal\n"
        "j = Journal.open(Path(sys.argv[1]), 'boot-1'); j.apply([('lease:L1-1', {'state': "
        "'held'})])\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    root = str(Path(__file__).parents[3])
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": f"{root}/src:{root}"},
        timeout=60,
        check=False,
    )
    assert done.returncode == -9
    assert Journal.open(tmp_path, "boot-1").opened.records == {"lease:L1-1": {"state": "held"}}


@pytest.mark.parametrize("damage", ["garbage", "torn", "schema", "table"])
def test_a_corrupt_journal_is_put_aside_and_the_epoch_still_grows(
    tmp_path: Path, damage: str
) -> None:
    epoch = filled(tmp_path)
    path = tmp_path / "journal.sqlite"
    match damage:
        case "garbage":
            path.write_bytes(os.urandom(8192))
        case "torn":
            with path.open("r+b") as file:
                file.truncate(path.stat().st_size // 2)
        case "table":
            edit(path, "DROP TABLE records", "CREATE TABLE records (other TEXT)")
        case _:
            edit(path, "UPDATE meta SET value = '99' WHERE name = 'schema'")
    journal = Journal.open(tmp_path, "boot-1")
    assert journal.opened.put_aside == tmp_path / "journal.sqlite.corrupt-1"
    assert journal.opened.put_aside.exists()
    assert journal.opened.problem
    assert journal.opened.doubt.startswith("it could not be read")
    assert set(journal.opened.records) == {DOUBT_KEY}
    assert journal.opened.epoch > epoch
    journal.apply([("lease:L2-1", {"a": 1}), (DOUBT_KEY, None)])
    journal.close()
    assert opened(tmp_path).records == {"lease:L2-1": {"a": 1}}


def edit(path: Path, *statements: str) -> None:
    database = sqlite3.connect(path)
    with database:
        for statement in statements:
            database.execute(statement)
    database.close()


def test_several_corrupt_files_are_all_kept(tmp_path: Path) -> None:
    for _ in range(3):
        opened(tmp_path)
        (tmp_path / "journal.sqlite").write_bytes(b"junk" * 1000)
    opened(tmp_path)
    assert sorted(p.name for p in tmp_path.glob("*.corrupt-?")) == [
        f"journal.sqlite.corrupt-{n}" for n in (1, 2, 3)
    ]


def test_records_that_nobody_understands_are_put_aside_in_the_same_epoch(tmp_path: Path) -> None:
    filled(tmp_path)
    journal = Journal.open(tmp_path, "boot-1")
    epoch = journal.opened.epoch
    journal.put_aside("KeyError: 'spec'")
    assert (set(journal.opened.records), journal.opened.epoch) == ({DOUBT_KEY}, epoch)
    assert journal.opened.put_aside is not None
    journal.apply([("lease:L2-1", {})])
    journal.close()
    again = opened(tmp_path, at_least=0)
    assert (set(again.records), again.doubt, again.epoch) == (
        {DOUBT_KEY, "lease:L2-1"},
        "",
        epoch + 1,
    )
    assert "KeyError" in again.records[DOUBT_KEY]["why"], (
        "the doubt outlives a restart until the core deletes it"
    )


@pytest.mark.parametrize(
    ("name", "kept", "nonsense"),
    [
        ("learnt", {"detector": {"load_s": 2.5}}, '{"a": {"b": "c"}}'),
        ("footprints", {"detector m@1": {"load_peak": [5, 6], "oom": [9, 20]}}, '{"a": {"b": 1}}'),
    ],
)
def test_what_was_learnt_survives_a_boot_and_a_journal_that_is_put_aside(
    tmp_path: Path, name: Any, kept: Any, nonsense: str
) -> None:
    journal = Journal.open(tmp_path, "boot-1")
    assert getattr(journal.opened, name) == {}
    journal.keep(name, kept)
    journal.keep(name, kept)
    journal.close()
    journal = Journal.open(tmp_path, "boot-2")
    assert getattr(journal.opened, name) == kept
    journal.put_aside("KeyError: 'spec'")
    assert getattr(journal.opened, name) == kept, "for this run; it will be kept again"
    journal.close()
    for text in ("[1]", "{", nonsense, '{"a": 1}'):
        statement = f"INSERT OR REPLACE INTO meta VALUES ('{name}', '{text}')"
        edit(tmp_path / "journal.sqlite", statement)
        found = opened(tmp_path, "boot-2")
        assert (getattr(found, name), found.put_aside) == ({}, None)


def test_a_write_that_fails_is_typed_and_writes_nothing(tmp_path: Path) -> None:
    """A full disk lets an empty transaction pass: that proves nothing."""
    journal = Journal.open(tmp_path, "boot-1")
    blocker = sqlite3.connect(tmp_path / "journal.sqlite", isolation_level=None)
    blocker.execute("BEGIN IMMEDIATE")
    with pytest.raises(JournalUnavailable, match="locked"):
        journal.apply([("lease:L1-1", {"a": 1})])
    journal.settle()
    assert "nothing new is granted" in journal.problem, "the disk is no better yet"
    blocker.execute("ROLLBACK")
    blocker.close()
    journal.apply([("lease:L1-1", None)])
    assert journal.problem
    journal.settle()
    assert journal.problem == ""
    journal.apply([("lease:L1-2", {"a": 1})])
    journal.close()
    assert set(Journal.open(tmp_path, "boot-1").opened.records) == {"lease:L1-2"}


def test_one_failing_change_of_a_batch_undoes_all(tmp_path: Path) -> None:
    journal = Journal.open(tmp_path, "boot-1")
    with pytest.raises(PydanticSerializationError):
        journal.apply([("lease:L1-1", {"a": 1}), ("lease:L1-2", {"a": object()})])
    assert Journal.open(tmp_path, "boot-1").opened.records == {}


def test_a_folder_that_cannot_be_used_is_a_config_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="state folder"):
        Journal.open(tmp_path / "file", "boot-1")
    (tmp_path / "journal.sqlite").mkdir()
    with pytest.raises(ConfigError, match="state folder"):
        Journal.open(tmp_path, "boot-1")


@pytest.mark.parametrize("count", [1, 2, AT_ONCE_MAX, AT_ONCE_MAX + 1, 40])
def test_batches_of_any_size_and_kind_are_written_whole(tmp_path: Path, count: int) -> None:
    journal = Journal.open(tmp_path, "boot")
    keys = [f"lease:L{n:02d}" for n in range(count)]
    journal.apply([(key, {"n": 1}) for key in keys])
    journal.apply([("residue", {"n": 2}), (keys[0], None)])
    journal.apply([(keys[0], {"n": 3}), (keys[0], {"n": 4})])
    journal.close()
    journal = Journal.open(tmp_path, "boot")
    expected = {key: {"n": 1} for key in keys} | {keys[0]: {"n": 4}, "residue": {"n": 2}}
    assert journal.opened.records == expected
    journal.apply([(key, None) for key in [*keys, "nobody"]])
    journal.close()
    journal = Journal.open(tmp_path, "boot")
    assert journal.opened.records == {"residue": {"n": 2}}
    journal.close()
