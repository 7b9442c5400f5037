"""A writer that dies again and again: the session ends after its goal, with the reason."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.runner.recording.ticks import DONE, goal, tick
from tests.support.waiting import until
from vram_arbiter.runner.recording import recorder as module
from vram_arbiter.runner.recording.recorder import RESTARTS_MAX, DatasetRecorder
from vram_arbiter.schemas.errors import BadState, InternalError


class Mortal:
    """A writer without a process: the first one takes rows until the test ends it, others fail."""

    made: list["Mortal"]
    pid = 1

    def __init__(
        self, opening: Any, heard: Callable[[Any], None], gone: Callable[[Any, int], None]
    ) -> None:
        self.gone = gone
        self.sent: list[str] = []
        self.made.append(self)

    def await_ready(self) -> None:
        if len(self.made) > 1:
            raise InternalError("the disk is gone")

    def send(self, message: Any, pictures: Any = ()) -> None:
        self.sent.append(message["kind"])

    def wait(self, timeout_s: float) -> int:
        return 0


@pytest.mark.parametrize("runs", [True, False])
def test_the_session_ends_after_the_goal_that_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs: bool
) -> None:
    """Regression: the robot went on for the rest of the day, and nothing was recorded."""
    writer = type("Writer", (Mortal,), {"made": []})
    monkeypatch.setattr(module, "WriterProcess", writer)
    monkeypatch.setattr(module, "PACKAGES", ())
    lost = threading.Event()
    made = DatasetRecorder(
        tmp_path / "set",
        rate_hz=30.0,
        cameras=lambda: ("front",),
        robot="bench",
        on_lost=lost.set,
    )
    made.start()
    if runs:
        made.tick(tick(0))
        until(lambda: writer.made[0].sent == ["row"])
    writer.made[0].gone(writer.made[0], -9)
    until(lambda: made.lost is not None)
    assert len(writer.made) == 1 + RESTARTS_MAX
    if runs:
        assert not lost.is_set()
        made.tick(tick(1))  # the robot goes on to the goal's end
        made.goal_ended(goal(), DONE)
    assert lost.wait(60)
    assert "the disk is gone" in str(made.lost)
    with pytest.raises(BadState):
        made.mark("", "success")
    made.close()
    assert "NOT ALL WAS RECORDED" in made.counts.summary()
