"""The demo's judgement and its reading of the GPU's log."""

import json
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.clients.cli.demo_display import describe
from vram_arbiter.clients.cli.demo_report import (
    MemoryStory,
    Point,
    draw_timeline,
    read_log,
    returned,
    summarise,
)
from vram_arbiter.schemas.defaults import GIB

SWITCH = {
    "kind": "switch", "at_wall_s": 103.0, "seq": 4, "consumer": "grab", "switched": True,
    "verified": True,
    "evicted": [{"consumer": "detector", "lease_id": "L1-1", "verdict": "verified",
    "charge_bytes": 5 * GIB}],
    "wait_ms": 1.0, "drain_ms": 2.0, "unload_ms": 3.0, "verify_ms": 4.0, "load_ms": 5.0,
    "total_ms": 15.0,
}  # fmt: skip
LOAD = SWITCH | {"seq": 5, "switched": False, "evicted": []}
SUCCESS = {"status": "success", "vlm_confirmed": True, "attempts": 1, "reason": "held"}
HELD = {"held_above_table": {"red cube": True, "blue ball": False}}


def line(pid: int, t: float, op: str, process: int, used: int) -> str:
    return (
        json.dumps({"pid": pid, "t": t, "op": op, "process_bytes": process, "used_after": used})
        + "\n"
    )


def demo_summary(**changes: Any) -> dict[str, Any]:
    story = MemoryStory((), 5 * GIB, ())
    given: dict[str, Any] = {
        "seed": 3, "arbiter": True, "task": "grab the red cube", "story": story,
        "capacity_bytes": 8 * GIB, "events": [LOAD, SWITCH],
        "reasoner": SUCCESS, "truth": HELD, "target": "red cube", "seconds": 61.23,
        "detector_resident": True,
    }  # fmt: skip
    return summarise(**(given | changes))


def test_the_log_gives_bytes_by_program_peak_and_refusals() -> None:
    text = (
        line(7, 1.0, "alloc", 5, 5)
        + line(8, 2.0, "oom", 0, 5)
        + line(8, 3.0, "alloc", 4, 9)
        + '{"torn'
    )
    story = read_log(text, {7: "detector"})
    assert story == MemoryStory(
        (Point(1.0, "detector", 5), Point(2.0, "pid 8", 0), Point(3.0, "pid 8", 4)), 9, (2.0,)
    )


def test_a_models_process_has_the_name_that_it_gave_itself() -> None:
    """Its pid is not the sidecar's: the timeline was grey and named pids."""
    named = json.loads(line(9, 1.0, "alloc", 5, 5)) | {"name": "detector"}
    story = read_log(json.dumps(named), {7: "detector"})
    assert story.points == (Point(1.0, "detector", 5),)


def test_completed_needs_all_three_witnesses() -> None:
    assert demo_summary()["completed"]
    assert not demo_summary(truth={"held_above_table": {"red cube": False}})["completed"]
    assert not demo_summary(target="blue ball")["completed"]
    assert not demo_summary(reasoner=SUCCESS | {"vlm_confirmed": False})["completed"]
    assert not demo_summary(reasoner=SUCCESS | {"status": "failure"})["completed"]
    assert not demo_summary(reasoner={})["completed"]


def test_switches_are_counted_apart_from_loads_beside_others() -> None:
    told = demo_summary()
    assert (told["switches"], told["switches_verified"]) == (1, 1)
    assert told["loads"][1] == {
        "consumer": "grab", "evicted": ["detector"], "verdicts": ["verified"],
        "wait_ms": 1.0, "drain_ms": 2.0, "unload_ms": 3.0, "verify_ms": 4.0, "load_ms": 5.0,
        "total_ms": 15.0,
    }  # fmt: skip
    assert demo_summary(events=[SWITCH | {"verified": False}])["switches_verified"] == 0


def test_the_detector_returns_after_the_grabs_bytes_are_measured_gone() -> None:
    told = [
        {"kind": "use_ended", "consumer": "grab"},
        {"kind": "verified", "consumer": "grab", "verdict": "verified"},
        {"kind": "granted", "consumer": "detector", "reason": "there is room"},
        {"kind": "ready", "consumer": "detector"},
    ]
    events = [one | {"seq": n, "at_wall_s": 100.0 + n} for n, one in enumerate(told)]
    back = {"after_s": 3.0, "reason": "there is room", "verdict": "verified"}
    assert demo_summary(events=events)["detector_back"] == back
    failed = [events[0] | {"kind": "granted"}, *events[1:]]
    assert returned(failed) == back, "its model did not load"
    assert returned(events[:-1]) is None, "its model is not loaded yet"
    before = [events[-2] | {"seq": -2}, events[-1] | {"seq": -1}, *events[:2]]
    assert returned(before) is None, "that was before the grab"


def test_events_read_as_sentences() -> None:
    assert describe(SWITCH) == "grab took over from detector in 15 ms"
    assert describe(LOAD) == "grab loaded beside the others in 5 ms, no eviction"
    assert (
        describe({"kind": "denied", "consumer": "x", "reason": "too big"}) == "x: denied (too big)"
    )


@pytest.mark.heavy
def test_a_timeline_is_drawn_even_of_nothing(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the runner extra")
    story = MemoryStory(
        (Point(1.0, "detector", GIB), Point(2.0, "detector", 0), Point(2.5, "grab", 2 * GIB)),
        2 * GIB,
        (2.2,),
    )
    events = [{"kind": "revoke_asked", "at_wall_s": 101.9, "consumer": "detector"}]
    for number, told in enumerate((story, MemoryStory((), 0, ()))):
        path = tmp_path / f"{number}.png"
        draw_timeline(
            path, told, 8 * GIB, events, [(1.0, 5)], start_s=0.5, wall_offset_s=100.0, title="t"
        )
        assert path.read_bytes().startswith(b"\x89PNG")
