"""What a demo leaves behind: `summary.json` and `timeline.png`, from the GPU's own allocation log
and the arbiter's history.

Pure but for writing those two files. It must not know how the programs were started.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.clients.cli.timeline.command import write
from vram_arbiter.clients.cli.timeline.reader import Reader
from vram_arbiter.clients.cli.timeline.story import Mark
from vram_arbiter.schemas.plain import JsonMap, JsonObject

LEAD_S = 1.0
SPLIT = ("wait_ms", "drain_ms", "unload_ms", "verify_ms", "load_ms", "total_ms")


@dataclass(frozen=True, slots=True)
class Point:
    """Bytes of one program on the GPU from `at_s` (monotonic) on."""

    at_s: float
    name: str
    held_bytes: int


@dataclass(frozen=True, slots=True)
class MemoryStory:
    """What happened on the GPU: every change of every program, the peak, and how often an
    allocation was refused."""

    points: tuple[Point, ...]
    peak_bytes: int
    refused_at_s: tuple[float, ...]  # each an out-of-memory in the process that asked


def read_log(text: str, names: Mapping[int, str]) -> MemoryStory:
    """Story of a simulated GPU from its allocation log; `names` says which pid is which program.
    Any other process, such as a sidecar's model, has the name that it gave itself. Torn lines are
    skipped."""
    points: list[Point] = []
    refused: list[float] = []
    peak = 0
    for line in text.splitlines():
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        name = names.get(entry["pid"]) or entry.get("name") or f"pid {entry['pid']}"
        points.append(Point(entry["t"], name, entry["process_bytes"]))
        peak = max(peak, entry["used_after"])
        if entry["op"] == "oom":
            refused.append(entry["t"])
    return MemoryStory(tuple(points), peak, tuple(refused))


def summarise(
    *, seed: int, arbiter: bool, task: str, story: MemoryStory, capacity_bytes: int,
    events: Sequence[JsonMap],
    reasoner: JsonMap, truth: JsonMap, target: str, seconds: float, detector_resident: bool,
) -> JsonObject:  # fmt: skip
    """The demo's outcome. `completed` needs three witnesses: the simulator, the scene VLM and the
    reasoner."""
    switches = [event for event in events if event["kind"] == "switch"]
    held = bool(truth.get("held_above_table", {}).get(target))
    confirmed = bool(reasoner.get("vlm_confirmed"))
    succeeded = reasoner.get("status") == "success"
    return {
        "completed": held and confirmed and succeeded,
        "task": task,
        "seed": seed,
        "arbiter": arbiter,
        "simulator_says_held": held,
        "vlm_says_held": confirmed,
        "reasoner_status": reasoner.get("status", "unknown"),
        "reason": reasoner.get("reason", ""),
        "attempts": reasoner.get("attempts", 0),
        "oom_events": len(story.refused_at_s),
        "switches": sum(bool(event["switched"]) for event in switches),
        "switches_verified": sum(
            bool(event["switched"] and event["verified"]) for event in switches
        ),
        "peak_bytes": story.peak_bytes,
        "capacity_bytes": capacity_bytes,
        "seconds": round(seconds, 1),
        "detector_resident": detector_resident,
        "detector_back": returned(events),
        "loads": [
            {
                "consumer": event["consumer"],
                "evicted": [victim["consumer"] for victim in event["evicted"]],
                "verdicts": [victim["verdict"] for victim in event["evicted"]],
                **{key: event.get(key) for key in SPLIT},
            }
            for event in switches
        ],
    }


def returned(events: Sequence[JsonMap]) -> JsonObject | None:
    """Return how the detector came back after the grab; None: it did not, or was never away.

    `after_s` is from the grab's last use (its grant, where it failed before one) until the detector
    was loaded; `verdict` is on the bytes that the grab gave up.
    """
    newest: dict[tuple[str, str], JsonMap] = {}
    for event in events:
        newest[event["kind"], event.get("consumer", "")] = event
    used = newest.get(("use_ended", "grab")) or newest.get(("granted", "grab"))
    gone = newest.get(("verified", "grab"))
    granted, ready = newest.get(("granted", "detector")), newest.get(("ready", "detector"))
    if used is None or gone is None or granted is None or ready is None:
        return None
    if not used["seq"] < gone["seq"] < granted["seq"] < ready["seq"]:
        return None
    return {
        "after_s": round(ready["at_wall_s"] - used["at_wall_s"], 1),
        "reason": granted["reason"],
        "verdict": gone["verdict"],
    }


def draw_timeline(
    path: Path,
    story: MemoryStory,
    capacity_bytes: int,
    events: Sequence[JsonMap],
    measured: Sequence[tuple[float, int]] = (),
    *,
    start_s: float,
    end_s: float = 0.0,
    wall_offset_s: float,
    title: str,
) -> None:
    """Draw the bytes of each program as `vramctl timeline` does, from `LEAD_S` before the first
    ones to `end_s` or the last event; each refused allocation is a moment."""
    first_s = min((point.at_s for point in story.points), default=start_s)
    begin_s = max(start_s, first_s - LEAD_S) + wall_offset_s
    gpu = next((str(event["gpu"]) for event in events if event.get("gpu")), "GPU")
    reader = Reader(begin_s)
    drawn, ends = reader.gpu(gpu, "GPU", capacity_bytes), [begin_s + 1.0, end_s + wall_offset_s]
    drawn.measured += [(at_s + wall_offset_s, used) for at_s, used in measured]
    for point in sorted(story.points, key=lambda point: point.at_s):
        at_s = point.at_s + wall_offset_s
        drawn.held.setdefault(point.name, []).append((at_s, point.held_bytes))
        ends.append(at_s)
    for event in events:
        if event["kind"] != "oom":  # the GPU's log has them all
            reader.event(event)
            ends.append(event["at_wall_s"])
    for at_s in story.refused_at_s:
        reader.marks.append(Mark(at_s + wall_offset_s, "oom", "out of memory", gpu))
    write(path, reader.story(max(ends)), title)
