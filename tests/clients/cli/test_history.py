"""`vramctl history`: times as people write them, filters, paging, and following a real daemon."""

import argparse
import datetime
import json
import shutil
import signal
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import pytest

from tests.support.process import ArbiterProcess, vramctl
from tests.support.running import Running, running
from vram_arbiter.clients.cli import history
from vram_arbiter.clients.cli.history import Wanted, collect, since
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.wire.requests import History
from vram_arbiter.schemas.wire.spec import LeaseSpec

NOON = datetime.datetime(2026, 11, 21, 12, 0).timestamp()


@pytest.mark.parametrize(
    ("written", "ago_s"),
    [
        ("90s", 90),
        ("10m", 600),
        ("10 min", 600),
        ("1.5h", 5400),
        ("2d", 172_800),
        ("11:30", 1800),
        ("11:59:30", 30),
        ("12:30", 23.5 * 3600),  # not yet today: yesterday's
        ("2026-11-21 11:00", 3600),
    ],
)
def test_times_as_people_write_them(written: str, ago_s: float) -> None:
    assert since(written, NOON) == pytest.approx(NOON - ago_s)


@pytest.mark.parametrize("written", ["", "yesterday", "10", "1010", "25:00", "-3s"])
def test_what_is_no_time_says_what_may_be_written(written: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="expected 90s, 10m"):
        since(written, NOON)


def test_a_filter_knows_kind_consumer_and_time() -> None:
    event = {
        "seq": 1,
        "kind": "revoke_asked",
        "consumer": "detector",
        "wanted_by": "grab",
        "at_wall_s": 100.0,
    }
    assert Wanted().keeps(event)
    assert Wanted(consumers=["grab"]).keeps(event)
    assert Wanted(consumers=["detector"], kinds=["revoke_asked"], since_wall_s=100.0).keeps(event)
    assert not Wanted(consumers=["chat"]).keeps(event)
    assert not Wanted(kinds=["granted"]).keeps(event)
    assert not Wanted(since_wall_s=100.1).keeps(event)


STEP = {"kind": "use_began", "lease_id": "L1-1", "consumer": "detector"}
LOAD = {"kind": "switch", "lease_id": "L1-1", "consumer": "detector", "switched": False}
SWITCH = LOAD | {"switched": True}
PROCESS = {"kind": "verified", "lease_id": None, "pid": 7}


def test_quiet_events_are_folded_for_people() -> None:
    """History listed every use, a `switch` for each plain load, and verdicts on processes without
    a lease: the dozen lines that mattered stood among hundreds."""
    folding = Wanted(quiet=False)
    assert [folding.keeps(event) for event in (STEP, LOAD, PROCESS)] == [False] * 3
    assert folding.keeps(SWITCH)
    assert folding.keeps({"kind": "verified", "lease_id": "L1-1"})
    assert all(Wanted().keeps(event) for event in (STEP, LOAD, PROCESS, SWITCH))
    assert Wanted(kinds=["use_began"], quiet=False).keeps(STEP)
    assert not Wanted(kinds=["switch"], quiet=False).keeps(LOAD)


class Archive:
    """A daemon's answers: one event a second, with a gap in the numbers."""

    def __init__(self, count: int) -> None:
        self.events = [
            {
                "seq": n if n < 1000 else n + 2000,
                "kind": "granted",
                "consumer": f"c{n % 3}",
                "at_wall_s": float(n),
            }
            for n in range(1, count + 1)
        ]
        self.asked = 0

    def ask(self, request: History, endpoint: str | None) -> dict[str, Any]:
        self.asked += 1
        assert request.before is not None
        known = [e for e in self.events if request.after < int(str(e["seq"])) < request.before]
        return {"ok": True, "events": known[-request.limit :], "last_seq": self.events[-1]["seq"]}


@pytest.fixture
def archive(monkeypatch: pytest.MonkeyPatch) -> Archive:
    made = Archive(9000)
    monkeypatch.setattr(history.request, "ask", made.ask)
    return made


def test_the_newest_are_found_without_reading_everything(archive: Archive) -> None:
    found = collect(Wanted(limit=3), None)["events"]
    assert [event["at_wall_s"] for event in found] == [8998.0, 8999.0, 9000.0]
    assert archive.asked == 1


def test_the_newest_are_found_behind_several_crashes(archive: Archive) -> None:
    """Each crash leaves 2,000 numbers out: after three of them `vramctl history` showed an empty
    list."""
    for event in archive.events[-5:]:
        event["seq"] = int(str(event["seq"])) + 20_000
    found = collect(Wanted(limit=8), None)["events"]
    assert [event["at_wall_s"] for event in found] == [float(n) for n in range(8993, 9001)]


def test_since_starts_at_its_time(archive: Archive) -> None:
    found = collect(Wanted(since_wall_s=8000.0, consumers=["c1"], limit=5000), None)["events"]
    assert found[0]["at_wall_s"] == 8002.0
    assert len(found) == 333
    assert archive.asked == 1


def test_after_a_number_come_the_first_that_are_wanted(archive: Archive) -> None:
    found = collect(Wanted(after=990, consumers=["c0"], limit=4), None)["events"]
    assert [event["at_wall_s"] for event in found] == [993.0, 996.0, 999.0, 1002.0]


def test_folded_events_are_counted_and_do_not_fill_the_limit(
    archive: Archive, capsys: pytest.CaptureFixture[str]
) -> None:
    for event in archive.events:
        if event["seq"] not in (7000, 8000):
            event["kind"] = "use_began"
    assert history.history(Wanted(limit=2, quiet=False)) == 0
    *events, count = capsys.readouterr().out.splitlines()
    assert [line.split()[2] for line in events] == ["granted"] * 2
    assert count == "(3999 quiet events not shown: --all)"


def following(arbiter: ArbiterProcess, kind: str) -> AbstractContextManager[Running]:
    words = ("history", "--follow", "--kind", kind, "--json")
    return running("vramctl", words, arbiter.environ)


@pytest.mark.e2e
def test_following_shows_the_past_and_then_the_present(
    arbiter_daemon: ArbiterProcess, spec: Callable[..., LeaseSpec]
) -> None:
    with Client("t", endpoint=arbiter_daemon.endpoint) as client:
        client.acquire(spec("early", 1)).ready()
        shown = vramctl(
            "history", "--since", "1h", "-c", "early", "--json", environ=arbiter_daemon.environ
        )
        kinds = [event["kind"] for event in json.loads(shown.stdout)["events"]]
        # where the first reading was still under way
        kinds = [kind for kind in kinds if kind != "queued"]
        assert kinds == ["granted", "ready", "switch"]
        assert vramctl("history", "--since", "soon", environ=arbiter_daemon.environ).returncode == 2

        with following(arbiter_daemon, "granted") as run:
            assert json.loads(run.line())["consumer"] == "early"
            client.acquire(spec("late", 1)).ready()
            assert json.loads(run.line())["consumer"] == "late"
            assert run.ended(signal.SIGINT) in (0, 130)


@pytest.mark.e2e
def test_following_goes_on_after_a_restart_with_a_new_history(
    make_arbiter: Callable[..., ArbiterProcess],
) -> None:
    """A deleted state folder begins the numbers at 1 again: nothing was shown any more."""
    arbiter = make_arbiter().start()
    for _ in range(3):
        assert vramctl("drain", "-r", "x", environ=arbiter.environ).returncode == 0
    with following(arbiter, "operator") as run:
        assert [json.loads(run.line())["action"] for _ in range(3)] == ["drain"] * 3
        arbiter.stop()
        for path in arbiter.state.glob("*"):
            path.unlink() if path.is_file() else shutil.rmtree(path)
        arbiter.start()
        # perhaps before the follower is back
        assert vramctl("drain", "-r", "after", environ=arbiter.environ).returncode == 0
        assert json.loads(run.line())["reason"] == "after"
