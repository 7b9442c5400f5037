"""The event log's writer: rotation within a bound, a disk that fails, and what is left after a
crash. Real threads and files."""

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.support.core_driver import START_S, CoreDriver
from tests.support.waiting import PATIENCE_S
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.eventlog import replay as runner
from vram_arbiter.arbiter.eventlog import writer as module
from vram_arbiter.arbiter.eventlog.logfile import FOLDER, LogError, header_line
from vram_arbiter.arbiter.eventlog.snapshot import to_plain
from vram_arbiter.arbiter.eventlog.writer import Recorder
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import KIB


class Recorded:
    """An engine that is recorded as the daemon does it: a run's events, as many at a time as the
    test says."""

    def __init__(self, run: CoreDriver, folder: Path, **bounds: int) -> None:
        self.folder = folder / FOLDER
        self.notes: list[tuple[str, Mapping[str, Any]]] = []
        self.noted = asyncio.Event()
        self.events = list(run.events)
        self.engine = Arbiter(run.settings, START_S)
        self.clock = START_S
        self.recorder = Recorder(
            folder,
            run.settings,
            "0.1",
            max_bytes=bounds.get("max_bytes", 8 * d.MIB),
            file_bytes=bounds.get("file_bytes", d.MIB),
            state=partial(to_plain, self.engine),
            told=self._told,
            clock=lambda: self.clock,
        )
        self.recorder.start(asyncio.get_running_loop(), START_S)

    def _told(self, kind: str, facts: Mapping[str, Any]) -> None:
        self.notes.append((kind, facts))
        self.noted.set()

    def go(self, count: int, later_s: float = 0.0) -> None:
        """Handle and record so many events."""
        for _ in range(count):
            now, event = self.events.pop(0)
            self.clock = now + later_s
            self.recorder.record(self.clock, event, self.engine.handle(event, self.clock))

    async def written(self) -> None:
        """Everything recorded so far is on the disk, or was given up."""
        self.recorder.flush()
        async with asyncio.timeout(PATIENCE_S):
            while self.recorder.behind:
                await asyncio.sleep(0)

    def files(self) -> list[Path]:
        return sorted(self.folder.iterdir())

    def replayed(self) -> runner.Replayed:
        return runner.replay(runner.load(self.folder))


def recording(test: Callable[[], Awaitable[None]]) -> None:
    async def run() -> None:
        async with asyncio.timeout(2 * PATIENCE_S):
            await test()

    asyncio.run(run())


def test_what_was_recorded_replays_identically(busy: CoreDriver, tmp_path: Path) -> None:
    async def test() -> None:
        recorded = Recorded(busy, tmp_path)
        count = len(recorded.events)
        recorded.go(count)
        recorded.recorder.close()
        found = recorded.replayed()
        assert (found.identical, found.events) == (True, count)
        assert recorded.files()[0].stat().st_mode & 0o777 == 0o600

    recording(test)


def test_files_rotate_and_any_of_them_is_a_beginning(busy: CoreDriver, tmp_path: Path) -> None:
    async def test() -> None:
        recorded = Recorded(busy, tmp_path, file_bytes=64 * KIB)
        while recorded.events:
            recorded.go(min(50, len(recorded.events)))
            await recorded.written()
        recorded.recorder.close()
        files = runner.load(recorded.folder)
        assert len(files) > 3
        for some in (files, *([file] for file in files)):
            found = runner.replay(some)
            assert (found.identical, found.gaps) == (True, 0), len(some)
        assert [file.header.cause for file in files] == ["start", *["size"] * (len(files) - 1)]

    recording(test)


def test_the_folder_stays_within_its_bound(busy: CoreDriver, tmp_path: Path) -> None:
    async def test() -> None:
        bound = 256 * KIB
        recorded = Recorded(busy, tmp_path, file_bytes=64 * KIB, max_bytes=bound)
        recorded.folder.mkdir()
        (recorded.folder / "19700101T000000-000001-0000.jsonl").write_text("x" * 100 * KIB)
        while recorded.events:
            recorded.go(min(20, len(recorded.events)))
            await recorded.written()
            # a batch is written whole, so the newest file may exceed its size by one batch
            assert sum(path.stat().st_size for path in recorded.files()) <= bound + 40 * KIB
        recorded.recorder.close()
        assert not recorded.files()[0].name.startswith("1970")
        assert recorded.replayed().identical

    recording(test)


def test_a_state_that_is_larger_than_a_file_does_not_begin_a_new_one_at_every_event(
    busy: CoreDriver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file that began with it was full at once: the engine was copied again and again, a
    quarter of a second each time."""
    monkeypatch.setattr(
        module, "header_line", lambda header: header_line(header)[:-1] + " " * 100 * KIB + "\n"
    )

    async def test() -> None:
        recorded = Recorded(busy, tmp_path, file_bytes=64 * KIB, max_bytes=1024 * KIB)
        count = len(recorded.events)
        sizes: list[int] = []
        while recorded.events:
            recorded.go(min(5, len(recorded.events)))
            await recorded.written()
            sizes.append(sum(path.stat().st_size for path in recorded.files()))
        recorded.recorder.close()
        files = recorded.files()
        assert 2 < len(files) < count / 20
        assert all(path.stat().st_size >= 200 * KIB for path in files[:-1]), (
            "as much again as the state took"
        )
        assert max(sizes) <= 1024 * KIB
        assert recorded.replayed().identical

    recording(test)


def test_a_state_that_is_too_large_for_the_bound_stops_the_recording(
    busy: CoreDriver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        module, "header_line", lambda header: header_line(header)[:-1] + " " * 100 * KIB + "\n"
    )

    async def test() -> None:
        recorded = Recorded(busy, tmp_path, file_bytes=64 * KIB, max_bytes=128 * KIB)
        recorded.go(5)
        await recorded.written()
        async with asyncio.timeout(PATIENCE_S):
            await recorded.noted.wait()
        recorded.recorder.close()
        [(kind, facts)] = recorded.notes
        assert kind == "record_stopped"
        assert "record.max_bytes" in str(facts["reason"])
        assert not recorded.files(), "nothing was begun that could not be ended"

    recording(test)


def test_a_disk_that_fails_stops_the_recording_with_a_note_and_it_begins_again(
    busy: CoreDriver, tmp_path: Path
) -> None:
    async def test() -> None:
        (tmp_path / FOLDER).write_text("in the way")
        recorded = Recorded(busy, tmp_path)
        recorded.go(100)
        recorded.recorder.flush()
        async with asyncio.timeout(PATIENCE_S):
            await recorded.noted.wait()
        assert [kind for kind, _ in recorded.notes] == ["record_stopped"]
        assert "FileExistsError" in recorded.notes[0][1]["reason"]

        recorded.go(100, later_s=module.RETRY_S)  # tried again, still in the way: not said twice
        await recorded.written()
        await asyncio.sleep(0)  # the thread's word arrives
        (tmp_path / FOLDER).unlink()
        recorded.noted.clear()
        recorded.go(100, later_s=3 * module.RETRY_S)
        recorded.recorder.flush()
        async with asyncio.timeout(PATIENCE_S):
            await recorded.noted.wait()
        assert [kind for kind, _ in recorded.notes] == ["record_stopped", "record_resumed"]
        recorded.recorder.close()
        (file,) = runner.load(recorded.folder)
        assert file.header.cause == "resumed"
        found = recorded.replayed()
        assert found.identical
        assert found.events >= 90  # what began it again is in its state already

    recording(test)


def test_events_that_pile_up_are_dropped_with_a_note(
    busy: CoreDriver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BUFFER_MAX", 10)

    async def test() -> None:
        recorded = Recorded(busy, tmp_path)
        recorded.go(20)
        assert [kind for kind, _ in recorded.notes] == ["record_stopped"]
        assert "more than 10 events" in recorded.notes[0][1]["reason"]
        recorded.recorder.close()
        with pytest.raises(LogError):
            recorded.replayed()

    recording(test)


def test_a_defect_of_the_engine_is_the_last_line(busy: CoreDriver, tmp_path: Path) -> None:
    async def test() -> None:
        recorded = Recorded(busy, tmp_path)
        recorded.go(5)
        now, event = recorded.events[0]
        recorded.recorder.record(now, event, None)
        recorded.recorder.close()
        last = json.loads(recorded.files()[0].read_text().splitlines()[-1])
        assert (last["event"], last["digest"]) == (type(event).__name__, None)

    recording(test)


def test_an_interrupted_recording_is_replayed_in_parts(busy: CoreDriver, tmp_path: Path) -> None:
    async def test() -> None:
        recorded = Recorded(busy, tmp_path)
        recorded.go(60)
        await recorded.written()
        recorded.recorder._stopped("the disk is full")
        recorded.go(30)
        recorded.go(60, later_s=2 * module.RETRY_S)
        recorded.recorder.close()
        found = recorded.replayed()
        assert (found.identical, found.gaps, found.events) == (True, 1, 119)

    recording(test)
