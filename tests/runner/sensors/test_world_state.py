"""The world state: fresh or said to be stale, latched until it is really back, and nothing ever
made up.
"""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.runner.small_robots import frame_at
from vram_arbiter.runner.sensors.world_state import (
    FUTURE_TOLERANCE_MS,
    JOINT_STATE,
    RECOVERY_UPDATES,
    WorldStateAggregator,
)
from vram_arbiter.schemas.errors import StateStale
from vram_arbiter.schemas.world import JointState

MS = 1_000_000
START_NS = 10_000 * MS


def joint_state(stamp_ns: int, position: float = 0.5) -> JointState:
    return JointState(name=("a",), position=(position,), stamp_ns=stamp_ns)


@pytest.fixture
def aggregator() -> WorldStateAggregator:
    return WorldStateAggregator({"front": 100.0, "wrist": 300.0}, topics={"front": "/front"})


def test_without_a_joint_state_there_is_no_world_state(aggregator: WorldStateAggregator) -> None:
    aggregator.update_image_frame(frame_at(START_NS), START_NS)
    aggregator.note(JOINT_STATE, "the bus is silent")
    with pytest.raises(StateStale, match="the bus is silent"):
        aggregator.snapshot(START_NS)


def test_what_is_fresh_is_shown_with_its_frame_inline(aggregator: WorldStateAggregator) -> None:
    aggregator.update_joint_state(joint_state(START_NS), START_NS)
    aggregator.update_image_frame(frame_at(START_NS), START_NS)
    seen = aggregator.snapshot(START_NS + 99 * MS)
    assert seen.diagnostics == {"front": "ok", "wrist": "stale", JOINT_STATE: "ok"}
    assert seen.image_frames["front"].data == b"x"
    assert (seen.images, seen.joint_state.position) == ({"front": "/front"}, (0.5,))
    assert "nothing has come" in aggregator.why("wrist")


def test_an_old_frame_returns_after_several_fresh_ones(aggregator: WorldStateAggregator) -> None:
    now = START_NS
    aggregator.update_joint_state(joint_state(now), now)
    aggregator.update_image_frame(frame_at(now), now)
    now += 101 * MS
    seen = aggregator.snapshot(now)
    assert seen.diagnostics["front"] == "stale"
    assert seen.image_frames == {}
    for _ in range(RECOVERY_UPDATES - 1):
        now += 30 * MS
        aggregator.update_image_frame(frame_at(now), now)
        assert aggregator.snapshot(now).image_frames == {}
    now += 30 * MS
    aggregator.update_image_frame(frame_at(now), now)
    assert set(aggregator.snapshot(now).image_frames or {}) == {"front"}


def test_the_same_frame_again_is_no_fresh_one(aggregator: WorldStateAggregator) -> None:
    aggregator.update_joint_state(joint_state(START_NS), START_NS)
    aggregator.lose("front", "the cable is out")
    now = START_NS + 10 * MS
    for _ in range(2 * RECOVERY_UPDATES):
        aggregator.update_image_frame(frame_at(START_NS), now)
    assert aggregator.snapshot(now).diagnostics["front"] == "stale"
    assert aggregator.why("front") == "the cable is out"


def test_a_gap_during_recovery_begins_it_anew(aggregator: WorldStateAggregator) -> None:
    aggregator.update_joint_state(joint_state(START_NS), START_NS)
    aggregator.lose("front", "gone")
    now = START_NS
    for gap_ms in (30, 30, 150, 30):
        now += gap_ms * MS
        # the loop goes on, and sees that the second one has become too old
        aggregator.snapshot(now)
        aggregator.update_image_frame(frame_at(now), now)
        assert aggregator.snapshot(now).diagnostics["front"] == "stale"
    now += 30 * MS
    aggregator.update_image_frame(frame_at(now), now)
    assert aggregator.snapshot(now).diagnostics["front"] == "ok"


def test_a_bus_that_repeats_its_last_answer_does_not_look_alive(
    aggregator: WorldStateAggregator,
) -> None:
    for passed_ms in range(0, 120, 20):
        aggregator.update_joint_state(joint_state(START_NS), START_NS + passed_ms * MS)
    aggregator.note(JOINT_STATE, "no answer from motor 3")
    seen = aggregator.snapshot(START_NS + 120 * MS)
    assert seen.stale == ("front", JOINT_STATE, "wrist")
    assert "no answer from motor 3" in aggregator.why(JOINT_STATE)
    assert seen.joint_state == joint_state(START_NS)  # what was measured, never zeros


def test_a_slow_loop_is_not_a_stale_robot(aggregator: WorldStateAggregator) -> None:
    for tick in range(5):
        now = START_NS + tick * 400 * MS
        aggregator.update_joint_state(joint_state(now), now)
        assert aggregator.snapshot(now).diagnostics[JOINT_STATE] == "ok"


def test_a_stamp_of_another_clock_is_refused(aggregator: WorldStateAggregator) -> None:
    aggregator.update_joint_state(joint_state(START_NS), START_NS)
    aggregator.update_joint_state(joint_state(START_NS + 60_000 * MS, 9.0), START_NS + MS)
    seen = aggregator.snapshot(START_NS + 2 * MS)
    assert JOINT_STATE in seen.stale
    assert seen.joint_state.position == (0.5,)
    assert "future" in aggregator.why(JOINT_STATE)


def test_a_failed_source_is_told_from_a_late_one(aggregator: WorldStateAggregator) -> None:
    aggregator.update_joint_state(joint_state(START_NS), START_NS)
    aggregator.update_image_frame(frame_at(START_NS), START_NS)
    aggregator.lose("wrist", "its stream ended", failed=True)
    late = aggregator.snapshot(START_NS + 101 * MS)
    assert late.diagnostics == {"front": "stale", "wrist": "error", JOINT_STATE: "stale"}
    assert late.stale == ("front", JOINT_STATE, "wrist")


def test_a_camera_of_unknown_age_is_refused(aggregator: WorldStateAggregator) -> None:
    with pytest.raises(KeyError):
        aggregator.update_image_frame(frame_at(START_NS, "rear"), START_NS)
    with pytest.raises(ValueError, match=JOINT_STATE):
        WorldStateAggregator({JOINT_STATE: 100.0})


@pytest.mark.parametrize(("loop_hz", "reads"), [(200.0, 60), (50.0, 60), (30.0, 60), (10.0, 20)])
def test_cameras_are_read_at_its_own_cadence(
    aggregator: WorldStateAggregator, loop_hz: float, reads: int
) -> None:
    period_ns = 1e9 / loop_hz
    times = [START_NS + round(tick * period_ns) for tick in range(round(2 * loop_hz))]
    assert sum(aggregator.due(now) for now in times) == pytest.approx(reads, abs=1)


def test_jitter_of_the_loop_skips_no_picture(aggregator: WorldStateAggregator) -> None:
    times = [START_NS + round(tick * 1e9 / 30) + (-1) ** tick * 2 * MS for tick in range(90)]
    assert all(aggregator.due(now) for now in times)


@given(st.lists(st.tuples(st.integers(0, 200), st.integers(-20, 250), st.booleans()), max_size=40))
def test_no_history_serves_a_frame_older_than_allowed(story: list[tuple[int, int, bool]]) -> None:
    """Each step: ms that pass, the age (ms) of the frame that then comes, whether the camera is
    lost first.
    """
    aggregator = WorldStateAggregator({"front": 100.0})
    now = START_NS
    for passed_ms, age_ms, lost in story:
        now += passed_ms * MS
        aggregator.update_joint_state(joint_state(now), now)
        if lost:
            aggregator.lose("front", "lost")
        aggregator.update_image_frame(frame_at(now - age_ms * MS), now)
        seen = aggregator.snapshot(now)
        shown = (seen.image_frames or {}).get("front")
        assert (shown is not None) == (seen.diagnostics["front"] == "ok")
        assert not (lost and shown)
        if shown is not None:
            assert -FUTURE_TOLERANCE_MS * MS <= now - shown.stamp_monotonic_ns <= 100 * MS
