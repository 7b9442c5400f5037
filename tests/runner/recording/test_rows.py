"""A tick as a row: every value is one that was measured or commanded, and what lacks one is no
row.
"""

import socket
import threading
from dataclasses import replace

import pytest

from tests.runner.recording.ticks import TRACE, goal, picture, span_of, tick
from vram_arbiter.runner.protocols import GoalTick, Transition
from vram_arbiter.runner.recording import wire
from vram_arbiter.runner.recording.rows import NO_CHUNK, NUMBERS_MAX, Incomplete, row_of, trace_of
from vram_arbiter.schemas.world import FrameEncoding


def test_a_row_says_what_was_measured_and_what_was_told() -> None:
    row, pictures = row_of(
        tick(3, safety_violations=("too fast",), deadline_missed=True), ("front",)
    )
    assert (row["units"], row["state_names"], row["action_names"]) == (
        "rad",
        ["pan", "grip"],
        ["pan", "grip"],
    )
    assert (row["state"], row["action"]) == (
        pytest.approx([0.3, 0.5]),
        pytest.approx([0.35, 0.4]),
    )
    assert row["base_pose"] == pytest.approx([1.0, 2.0, 3.14159], abs=1e-4)
    assert row["base_velocity"] == [0.0, 0.1, 0.2]
    assert (row["task"], row["skill"], row["goal_id"]) == ("grab the cube", "test/grab@abc", "g1")
    assert (row["trace_id"], row["span_id"], row["sampled"]) == (TRACE, span_of(3), True)
    assert (row["tick_idx"], row["chunk_index"], row["violations"]) == (103, NO_CHUNK, "too fast")
    assert row["deadline_missed"] is True
    assert row["timings_ms"] == [12.5, 0.0, 0.0, 3.0, 0.0, 0.0]
    assert row["ages_ms"] == [2.0]
    assert pictures == [bytes([30, 30, 30]) * (32 * 24)]


def test_a_goal_without_a_prompt_is_called_by_its_skill() -> None:
    assert row_of(tick(0, of=goal(prompt="")), ())[0]["task"] == "test/grab"


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


def stepped(shown: dict[str, float], sent: dict[str, float]) -> GoalTick:
    return replace(tick(0), transition=Transition(shown, sent))


def test_a_world_that_is_no_robot_has_its_own_numbers() -> None:
    row, _ = row_of(stepped({"gap": 0.5, "speed": 2.0}, {"push": -0.5}), ())
    assert (row["units"], row["state_names"], row["state"]) == ("own", ["gap", "speed"], [0.5, 2.0])
    assert (row["action_names"], row["action"]) == (["push"], [-0.5])


@pytest.mark.parametrize(
    ("shown", "sent", "reason"),
    [
        ({"gap": 0.5}, {}, "nothing was sent: the world stood still"),
        (
            {"gap": 0.5, "speed": float("nan")},
            {"push": 1.0},
            "speed is nan, which no column can hold",
        ),
        ({"gap": 0.5}, {"push": 1e39}, r"push is 1e\+39, which no column can hold"),
        ({str(n): 0.0 for n in range(NUMBERS_MAX + 1)}, {"push": 1.0}, "at most 4096 are recorded"),
    ],
)
def test_a_step_that_lacks_a_part_is_no_row(
    shown: dict[str, float], sent: dict[str, float], reason: str
) -> None:
    with pytest.raises(Incomplete, match=reason):
        row_of(stepped(shown, sent), ())


@pytest.mark.parametrize(
    "text", [None, "", "00-abc-def-01", f"00-{TRACE}-{'0' * 15}1-zz", "nonsense"]
)
def test_without_a_trace_there_are_no_ids(text: str | None) -> None:
    assert trace_of(text) == ("", "", False)


def test_an_unsampled_trace_keeps_its_ids() -> None:
    assert trace_of(f"00-{TRACE}-{span_of(0)}-00") == (TRACE, span_of(0), False)


# -- the socket
def test_messages_come_over_whole_and_in_order() -> None:
    ours, theirs = socket.socketpair()
    large = bytes(range(256)) * 4096  # more than a socket takes at once
    with ours, theirs:
        sending = threading.Thread(
            target=lambda: [wire.send(ours, {"n": 1}, [large, b""]), wire.send(ours, {"n": 2})]
        )
        sending.start()
        assert wire.receive(theirs) == ({"n": 1}, [large, b""])
        assert wire.receive(theirs) == ({"n": 2}, [])
        sending.join()


@pytest.mark.parametrize("sent", [b"", b"\x00\x00", b"\x00\x00\x00\x10abc"])
def test_a_stream_that_breaks_off_is_the_others_end(sent: bytes) -> None:
    ours, theirs = socket.socketpair()
    with theirs:
        ours.sendall(sent)
        ours.close()
        assert wire.receive(theirs) is None


def test_what_is_no_message_is_refused() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.sendall(b"\xff\xff\xff\xff")
        with pytest.raises(ValueError, match="a header of"):
            wire.receive(theirs)
