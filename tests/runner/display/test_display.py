"""The live view: it never holds the control thread up, and a Rerun file has everything it shows."""

import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.runner.recording.ticks import DONE, FAILED, goal, tick
from tests.support.rerun_files import rows_of
from tests.support.waiting import until
from vram_arbiter.runner.__main__ import main
from vram_arbiter.runner.control.follow import GoalFollower
from vram_arbiter.runner.display.display import PICTURES_UNTIL, QUEUE_TICKS, Display
from vram_arbiter.runner.protocols import GoalTick


class Slow:
    """A viewer that starts when the test says so."""

    def __init__(self) -> None:
        self.may_start = threading.Event()
        self.shown: list[bool] = []

    def make(self) -> Any:
        assert self.may_start.wait(60)
        return self

    def tick(self, shown: GoalTick) -> None:
        self.shown.append(shown.world.image_frames is not None)

    def at(self, *_: object) -> None: ...

    goal = event = leases = at

    def close(self) -> None: ...


def test_a_viewer_that_hangs_costs_pictures_first_and_never_time() -> None:
    viewer = Slow()
    display = Display(viewer.make, lambda: None)
    for index in range(QUEUE_TICKS + 5):
        display.tick(tick(index))
    display.goal_ended(goal(), DONE)
    assert (display.dropped_pictures, display.dropped_ticks) == (QUEUE_TICKS - PICTURES_UNTIL, 5)
    viewer.may_start.set()
    display.close()
    assert viewer.shown == [True] * PICTURES_UNTIL + [False] * (QUEUE_TICKS - PICTURES_UNTIL)


def test_a_viewer_that_breaks_is_said_once_and_the_robot_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def make() -> Any:
        raise OSError("no display")

    display = Display(make, lambda: None)
    until(lambda: "nothing more is displayed" in caplog.text)
    for index in range(2 * QUEUE_TICKS):
        display.tick(tick(index))
    display.close()
    assert display.dropped_ticks == 0


def test_one_runner_is_recorded_and_displayed() -> None:
    viewer, other = Slow(), Slow()
    viewer.may_start.set()
    other.may_start.set()
    both = [Display(each.make, lambda: None) for each in (viewer, other)]
    follower = GoalFollower()
    follower.sinks = tuple(both)
    follower.goal_asked(goal())
    follower.tick_over(lambda _: tick(0))
    follower.goal_ended(goal(), None)
    for display in both:
        display.close()
    assert (viewer.shown, other.shown, follower.facts()) == ([True], [True], {})


@pytest.mark.heavy
def test_a_rerun_file_has_cameras_states_actions_withheld_actions_leases_and_the_goal(
    tmp_path: Path,
) -> None:
    pytest.importorskip("rerun", reason="needs the viz extra")
    from vram_arbiter.runner.display.stream import RerunStream

    out = tmp_path / "run.rrd"
    idle = tick(0).world
    display = Display(lambda: RerunStream(str(out), "bench"), lambda: idle)
    for index in range(3):
        display.tick(tick(index, safety_violations=("too fast",), action_applied=index > 0))
    display.goal_ended(goal(), FAILED)
    display.leases({"grab": 3 << 30})
    display.leases({})
    display.close()
    rows = rows_of(out)
    assert rows["/camera/front"] == 3
    assert rows["/state/pan"] == rows["/action/grip"] == rows["/tick/withheld"] == 3
    assert rows["/base/x"] == rows["/action/base/wz"] == 3
    assert rows["/leases/grab"] == 2
    assert rows["/goal"] == 2  # it begins and ends
    assert rows["/events"] == 3 + 2 + 2  # violations, the goal's ends, the lease's


@pytest.mark.heavy
def test_a_display_that_is_none_is_refused_before_a_world_begins(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["sim", "--no-arbiter", "--display", "foxglove"]) == 2
    assert "expected rerun, rerun+http://HOST:PORT/proxy or FILE.rrd" in capsys.readouterr().err


@pytest.mark.heavy
def test_a_viewer_that_is_not_there_is_said_in_one_line(caplog: pytest.LogCaptureFixture) -> None:
    """The runner reported it when it ended, with a traceback, and its process then hung."""
    pytest.importorskip("rerun", reason="needs the viz extra")
    from vram_arbiter.runner.display.stream import RerunStream

    nobody = "rerun+http://127.0.0.1:1/proxy"  # no program listens there
    display = Display(lambda: RerunStream(nobody, "bench"), lambda: None)
    until(lambda: f"no Rerun viewer answers at {nobody}" in caplog.text)
    display.close()
    assert "write a file: --display FILE.rrd" in caplog.text
    assert "Traceback" not in caplog.text


SHOW_TO_A_HANGING_VIEWER = """
import socket, sys
from vram_arbiter.runner.display import display as module
from vram_arbiter.runner.display.stream import RerunStream

hanging = socket.create_server(("127.0.0.1", 0))
module.CLOSE_S = 3.0
target = f"rerun+http://127.0.0.1:{hanging.getsockname()[1]}/proxy"
shown = module.Display(lambda: RerunStream(target, "bench"), lambda: None)
shown.close()
print("closed")
"""


@pytest.mark.heavy
def test_a_viewer_that_hangs_does_not_keep_the_process() -> None:
    """At exit Rerun waited without limit for a viewer that takes connections and reads nothing."""
    pytest.importorskip("rerun", reason="needs the viz extra")
    ended = subprocess.run(
        [sys.executable, "-c", SHOW_TO_A_HANGING_VIEWER],
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert "closed" in ended.stdout


@pytest.mark.heavy
def test_a_file_that_cannot_be_written_is_refused_before_a_world_begins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The log said it from the view's thread, and the run went on without a file."""
    (folder := tmp_path / "run.rrd").mkdir()
    assert main(["sim", "--no-arbiter", "--display", str(folder)]) == 2
    assert f"--display {folder} cannot be written" in capsys.readouterr().err
