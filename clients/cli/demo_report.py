"""What a demo leaves behind: `summary.json` and `timeline.png`, from the card's own allocation log
and the arbiter's history.

Pure but for writing those two files. It must not know how the programs were started.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.plain import JsonMap, JsonObject
from vram_arbiter.schemas.units import format_bytes

SPLIT = ("wait_ms", "drain_ms", "unload_ms", "verify_ms", "load_ms", "total_ms")
COLOURS = {"detector": "#d1495b", "scene-vlm": "#3d7ea6", "grab": "#5b8c5a"}
OTHER_COLOUR = "#8d8d8d"


@dataclass(frozen=True, slots=True)
class Point:
    """Bytes of one program on the GPU from `at_s` (monotonic) on."""

    at_s: float
    name: str
    held_bytes: int


@dataclass(frozen=True, slots=True)
class CardStory:
    """What happened on the GPU: every change of every program, the peak, and how often an
    allocation was refused."""

    points: tuple[Point, ...]
    peak_bytes: int
    refused_at_s: tuple[float, ...]  # each an out-of-memory in the process that asked


def read_log(text: str, names: Mapping[int, str]) -> CardStory:
    """Story of a simulated card from its allocation log; `names` says which pid is which program.
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
    return CardStory(tuple(points), peak, tuple(refused))


def read_samples(
    samples: Sequence[tuple[float, JsonMap]],
    names: Mapping[int, str],
    events: Iterable[JsonMap],
    wall_offset_s: float,
) -> CardStory:
    """The same for a real card, from `status` readings of the arbiter: (monotonic seconds,
    GpuView)."""
    points: list[Point] = []
    peak = 0
    for at_s, gpu in samples:
        peak = max(peak, gpu["measured_used_bytes"] or 0)
        points += [
            Point(
                at_s, names.get(process["pid"], f"pid {process['pid']}"), process["used_bytes"] or 0
            )
            for process in gpu["processes"]
        ]
    refused = tuple(
        event["at_wall_s"] - wall_offset_s for event in events if event["kind"] == "oom"
    )
    return CardStory(tuple(points), peak, refused)


def summarise(
    *, seed: int, arbiter: bool, task: str, story: CardStory, capacity_bytes: int,
    events: Sequence[JsonMap],
    reasoner: JsonMap, truth: JsonMap, target: str, seconds: float,
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


def draw_timeline(
    path: Path,
    story: CardStory,
    capacity_bytes: int,
    events: Sequence[JsonMap],
    *,
    start_s: float,
    wall_offset_s: float,
    title: str,
) -> None:
    """Stacked bytes per program over seconds since the start; capacity as a line; evictions and
    refusals marked."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = [name for name in COLOURS if any(point.name == name for point in story.points)]
    names += sorted({point.name for point in story.points} - set(names))
    times, stacks = _stacks(story.points, names, start_s)
    figure, axes = pyplot.subplots(figsize=(11, 4.2), layout="constrained")
    if times:
        colours = [COLOURS.get(name, OTHER_COLOUR) for name in names]
        axes.stackplot(times, stacks, step="post", labels=names, colors=colours, alpha=0.85)
    axes.axhline(capacity_bytes / GIB, color="black", linewidth=1.2)
    axes.annotate(f"capacity {format_bytes(capacity_bytes)}", (0.005, capacity_bytes / GIB),
    xycoords=("axes fraction", "data"),
                  xytext=(0, 3), textcoords="offset points", fontsize=8)  # fmt: skip
    for event in events:
        at_s = event["at_wall_s"] - wall_offset_s - start_s
        if event["kind"] == "revoke_asked":
            axes.axvline(at_s, color="#333333", linestyle=":", linewidth=1)
            axes.annotate(
                f"evict {event.get('consumer', '')}",
                (at_s, capacity_bytes / GIB * 1.08),
                rotation=30,
                fontsize=8,
            )
    for at_s in story.refused_at_s:
        axes.plot(
            [at_s - start_s],
            [capacity_bytes / GIB],
            marker="x",
            color="#d00000",
            markersize=11,
            markeredgewidth=3,
        )
    axes.set(
        xlabel="seconds",
        ylabel="GiB on the GPU",
        ylim=(0, capacity_bytes / GIB * 1.25),
        title=title,
    )
    if times:
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _stacks(
    points: Sequence[Point], names: Sequence[str], start_s: float
) -> tuple[list[float], list[list[float]]]:
    held = dict.fromkeys(names, 0)
    times: list[float] = []
    stacks: list[list[float]] = [[] for _ in names]
    for point in sorted(points, key=lambda point: point.at_s):
        held[point.name] = point.held_bytes
        times.append(point.at_s - start_s)
        for stack, name in zip(stacks, names, strict=True):
            stack.append(held[name] / GIB)
    return times, stacks
