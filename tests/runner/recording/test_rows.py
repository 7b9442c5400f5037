"""A tick as a row: every value is one that was measured or commanded, and what lacks one is no
row.
"""

import pytest

from tests.runner.recording.ticks import TRACE, goal, picture, span_of, tick
from vram_arbiter.runner.recording.columns import NO_CHUNK, Incomplete, row_of, trace_of
from vram_arbiter.schemas.world import FrameEncoding


def test_a_row_says_what_was_measured_and_what_was_told() -> None:
    row = row_of(tick(3, safety_violations=("too fast",), deadline_missed=True), ("front",))
    told = {name: column.value for name, column in row.columns.items()}
    assert row.columns["observation.state"].names == row.columns["action"].names == ["pan", "grip"]
    assert told["observation.state"] == pytest.approx([0.3, 0.5])
    assert told["action"] == pytest.approx([0.35, 0.4])
    assert told["base_pose"] == pytest.approx([1.0, 2.0, 3.14159], abs=1e-4)
    assert told["base_velocity"] == [0.0, 0.1, 0.2]
    assert (row.task, row.skill, row.goal_id) == ("grab the cube", "test/grab@abc", "g1")
    assert (told["trace_id"], told["span_id"], told["trace_sampled"]) == (TRACE, span_of(3), True)
    assert (told["tick.index"], told["tick.chunk_index"]) == (103, NO_CHUNK)
    assert (told["tick.violations"], told["tick.deadline_missed"]) == ("too fast", True)
    assert told["tick.timings_ms"] == [12.5, 0.0, 0.0, 3.0, 0.0, 0.0]
    assert told["tick.camera_ages_ms"] == [2.0]
    assert [frame.data for frame in row.frames] == [bytes([30, 30, 30]) * (32 * 24)]


def test_a_goal_without_a_prompt_is_called_by_its_skill() -> None:
    assert row_of(tick(0, of=goal(prompt="")), ()).task == "test/grab"


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        (tick(0, targets={"pan": 0.1}), "joint grip has no target yet"),
        (tick(0, frames={}), "camera front has no picture"),
        (
            tick(0, frames={"front": picture("front", 0, encoding=FrameEncoding.RAW)}),
            r"camera front \(raw\) have no colors",
        ),
        (
            tick(0, frames={"front": picture("front", 0, data=None, topic="/front")}),
            "have no colors",
        ),
    ],
)
def test_what_lacks_a_part_is_no_row(made: object, reason: str) -> None:
    with pytest.raises(Incomplete, match=reason):
        row_of(made, ("front",))  # type: ignore[arg-type]  # made by the cases above


@pytest.mark.parametrize(
    "text", [None, "", "00-abc-def-01", f"00-{TRACE}-{'0' * 15}1-zz", "nonsense"]
)
def test_without_a_trace_there_are_no_ids(text: str | None) -> None:
    assert trace_of(text) == ("", "", False)


def test_an_unsampled_trace_keeps_its_ids() -> None:
    assert trace_of(f"00-{TRACE}-{span_of(0)}-00") == (TRACE, span_of(0), False)
