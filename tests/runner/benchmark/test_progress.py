"""Progress of a benchmark: rate and time left."""

import logging

import pytest

from tests.runner.manual_clock import ManualClock
from vram_arbiter.runner.benchmark.outcomes import Cell, SeedOutcome, unplayed
from vram_arbiter.runner.benchmark.progress import ProgressLine


def test_rate_and_time_left_are_of_this_run(caplog: pytest.LogCaptureFixture) -> None:
    clock, cell = ManualClock(), Cell("so101", "random", "grab")
    progress = ProgressLine(5, clock.now_s)
    with caplog.at_level(logging.INFO):
        clock.advance(30)
        progress.tell(cell, SeedOutcome(7, True, 40))
        clock.advance(30)
        progress.tell(cell, unplayed(8, "a\nb"))
    first, second = (record.getMessage() for record in caplog.records)
    assert first == "so101, random, seed 7: success after 40 steps; 1/5, 2 a minute, 0:02:00 left"
    assert second.endswith("; 2/5, 2 a minute, 0:01:30 left, 1 errors")


def test_a_terminal_has_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import sys

    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    progress = ProgressLine(2)
    for seed in (0, 1):
        progress.tell(Cell("so101", "random", "grab"), unplayed(seed, "a\x1b[2Jb\n"))
    progress.end()
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.count("\x1b") == said.count("\r\x1b[K") == 2
