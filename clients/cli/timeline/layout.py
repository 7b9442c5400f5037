"""A story as a picture: shapes in pixels, each with the name of its paint. Pure.

From top to bottom: one chart of bytes per GPU, moments, one lane or more per consumer (waits,
states, phases of evictions, uses), the time axis, the legend. `svg` and `png` draw it.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, floor, log10

from vram_arbiter.clients.cli.text import duration
from vram_arbiter.clients.cli.timeline.shapes import Area, Label, Path, Picture, Rect, Shape
from vram_arbiter.clients.cli.timeline.story import EvictionStory, GpuStory, LeaseStory, Span, Story
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes

WIDTH = 1100.0
LEFT, RIGHT, TOP = 150.0, 24.0, 72.0
CHART, LANE, GAP = 170.0, 22.0, 34.0
HEADROOM = 1.22
"""Height of a chart over its highest value: names of evictions stand there."""
LANES_MAX = 40
"""Lanes that are drawn; the consumers beyond are counted."""
COLORS = 8
"""Paints of consumers, `c0` to `c7`; more consumers share them."""
LABEL_CHARS = 20
THIN = 0.6
"""Pixels; of the intervals of a lane that are shorter one is drawn for each pixel."""
STEPS_MAX = 4000
"""Changes of bytes that are all drawn; of more, the last one of each half pixel."""

LEGEND: Mapping[str, str] = {
    "queued": "waits",
    "loading": "loads",
    "held": "held",
    "use": "in use",
    "revoke": "revoke",
    "quiesce": "quiesce",
    "unload": "unload",
    "verify": "verify",
    "standby": "standby",
    "parked": "parked",
}
_OF_STATE = {"revoking": "revoke", "unloading": "unload", "verifying": "verify"}
_LOUD = frozenset({"oom", "denied", "lost", "expired", "signalled", "probe_failed", "stowaway"})


type _Scale = Callable[[float], float]
"""Bytes to pixels."""


@dataclass(frozen=True, slots=True)
class _Axis:
    """Seconds to pixels."""

    begin_s: float
    end_s: float

    def x(self, at_s: float) -> float:
        share = (at_s - self.begin_s) / max(1e-9, self.end_s - self.begin_s)
        return LEFT + min(1.0, max(0.0, share)) * (WIDTH - LEFT - RIGHT)

    def ticks(self) -> Iterable[tuple[float, str]]:
        """Yield (pixel, text) of about ten round times."""
        length = max(1e-6, self.end_s - self.begin_s)
        step = _round_step(length / 8)
        for number in range(floor(length / step) + 1):
            yield self.x(self.begin_s + number * step), _after(number * step)


def _round_step(least: float) -> float:
    """Return the next of 1, 2, 5 × 10ⁿ seconds, or of round minutes and hours."""
    for step in (15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0, 7200.0, 21_600.0, 86_400.0):
        if 10.0 < least <= step:
            return step
    if least > 86_400.0:
        return ceil(least / 86_400.0) * 86_400.0
    power = 10.0 ** floor(log10(least))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least * 0.999)


def _after(seconds: float) -> str:
    if seconds >= 3600:
        return f"{seconds / 3600:g} h"
    if seconds >= 120:
        return f"{seconds / 60:g} min"
    return f"{seconds:g} s"


def draw(story: Story, title: str = "") -> Picture:
    """Return the picture of a story."""
    axis = _Axis(story.begin_s, story.end_s)
    # by name: two pictures of the same consumers have the same colors
    paints = {name: f"c{at % COLORS}" for at, name in enumerate(sorted(story.consumers))}
    began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(story.begin_s))
    length = duration(story.end_s - story.begin_s)
    picture = Picture(title or "GPU memory by consumer", _described(story, began, length), WIDTH)
    shapes = picture.shapes
    shapes.append(Label(LEFT, 22.0, picture.title, size=16.0))
    shapes.append(Label(LEFT, 40.0, f"{length} from {began}", size=11.0, paint="faint"))
    y = TOP
    for gpu in story.gpus:
        shapes += _chart(story, gpu, axis, paints, y)
        y += CHART + GAP
    y = _moments(shapes, story, axis, y)
    y = _lanes(shapes, story, axis, paints, y)
    shapes += [Label(x, y + 14.0, text, "middle", paint="faint") for x, text in axis.ticks()]
    y += 34.0
    x = LEFT
    seen = {shape.paint for shape in shapes if isinstance(shape, Rect)}
    for paint, word in LEGEND.items():
        if paint not in seen:
            continue
        shapes.append(Rect(x, y - 9.0, 12.0, 10.0, paint))
        shapes.append(Label(x + 16.0, y, word))
        x += 30.0 + 7.0 * len(word)
    for notice in story.notices:
        y += 18.0
        shapes.append(Label(LEFT, y, printable(notice), paint="loud"))
    picture.height = y + 16.0
    return picture


def _described(story: Story, began: str, length: str) -> str:
    """Return the picture in words, for a reader that cannot see it."""
    over = sum(1 for one in story.evictions if one.verified_s is not None)
    waits = sum(span.name == "queued" for lease in story.leases for span in lease.states)
    return printable(
        f"{length} from {began}: {len(story.gpus)} GPU(s), consumers "
        f"{', '.join(story.consumers) or 'none'}; {waits} wait(s), {len(story.evictions)} "
        f"eviction(s), {over} of them verified; {len(story.marks)} other moment(s)."
    )


# -- bytes of one GPU
def _chart(
    story: Story, gpu: GpuStory, axis: _Axis, paints: Mapping[str, str], top: float
) -> Iterable[Shape]:
    bytes_by_name = story.bytes_by_name(gpu)
    stack = _stacked(bytes_by_name, axis)
    highest = max([gpu.capacity_bytes, *(used for _, used in gpu.measured), *_tops(stack)])
    scale = CHART / max(1.0, highest * HEADROOM)
    bottom = top + CHART

    def y(count: float) -> float:
        return bottom - count * scale

    shapes: list[Shape] = [Rect(LEFT, top, WIDTH - LEFT - RIGHT, CHART, "frame")]
    what = "bytes of its processes" if gpu.held else "charged bytes"
    shapes.append(Label(LEFT, top - 6.0, printable(f"{gpu.title}, {what}"), size=12.0))
    step = _gib_step(highest)
    for number in range(floor(highest / step) + 1):
        level = number * step
        shapes.append(Path(((LEFT, y(level)), (WIDTH - RIGHT, y(level))), "grid"))
        shapes.append(Label(LEFT - 8.0, y(level) + 4.0, f"{level / GIB:g} GiB", "end"))
    for span in gpu.pressure:
        x, end = axis.x(span.begin_s), axis.x(span.end_s)
        told = f"pressure: {span.note}, {duration(span.end_s - span.begin_s)}"
        shapes.append(Rect(x, top, max(1.0, end - x), CHART, "pressure", told))
    for name, points in stack.items():
        shapes.append(_area(points, axis, y, paints.get(name, "c0"), printable(name)))
    if gpu.measured:
        shapes.append(_measured(gpu, axis, y, story.end_s))
    if gpu.capacity_bytes:
        levels = [("capacity", gpu.capacity_bytes, False)]
        if gpu.reserve_bytes:
            levels.append(("budget", gpu.capacity_bytes - gpu.reserve_bytes, True))
        for word, level, dashed in levels:
            line = ((LEFT, y(level)), (WIDTH - RIGHT, y(level)))
            told = f"{word} {format_bytes(level)}"
            shapes.append(Path(line, "text", told, dashed=dashed))
        told = f"capacity {format_bytes(gpu.capacity_bytes)}"
        shapes.append(Label(LEFT + 4.0, y(gpu.capacity_bytes) - 4.0, told, size=10.0))
    return [*shapes, *_evicted(story, gpu, axis, top), *_refused(story, gpu, axis, y)]


def _gib_step(highest: float) -> float:
    for step in (0.25, 0.5, 1, 2, 4, 8, 16, 32, 64):
        if highest <= 6 * step * GIB:
            return step * GIB
    return ceil(highest / 6 / GIB / 64) * 64 * GIB


type _Band = list[tuple[float, float, float]]
"""(since, bytes below, bytes up to the top)"""


def _stacked(steps: Mapping[str, Sequence[tuple[float, int]]], axis: _Axis) -> dict[str, _Band]:
    """Return the band of each name, one on the other."""
    changes = sorted((at, name, count) for name, points in steps.items() for at, count in points)
    now = dict.fromkeys(steps, 0)
    bands: dict[str, _Band] = {name: [] for name in steps}
    for place, (at, name, count) in enumerate(changes):
        now[name] = count
        if place + 1 < len(changes):
            following = changes[place + 1][0]
            hidden = len(changes) > STEPS_MAX and int(axis.x(at) * 2) == int(axis.x(following) * 2)
            if following == at or hidden:
                continue
        below = 0
        for one, held in now.items():
            band = bands[one]
            if not band or band[-1][1:] != (below, below + held):
                band.append((at, below, below + held))
            below += held
    return {name: [*band, (axis.end_s, *band[-1][1:])] for name, band in bands.items() if band}


def _tops(stack: Mapping[str, _Band]) -> list[float]:
    return [top for band in stack.values() for _, _, top in band]


def _area(band: _Band, axis: _Axis, y: _Scale, paint: str, title: str) -> Area:
    upper: list[tuple[float, float]] = []
    lower: list[tuple[float, float]] = []
    for (at, below, top), (until, _, _) in pairwise(band):
        x, end = axis.x(at), axis.x(until)
        upper += [(x, y(top)), (end, y(top))]
        lower += [(x, y(below)), (end, y(below))]
    return Area(tuple(upper + lower[::-1]), paint, title)


def _measured(gpu: GpuStory, axis: _Axis, y: _Scale, end_s: float) -> Path:
    points: list[tuple[float, float]] = []
    ends = [at for at, _ in gpu.measured[1:]] + [end_s]
    for (at, used), end in zip(gpu.measured, ends, strict=True):
        points += [(axis.x(at), y(used)), (axis.x(end), y(used))]
    return Path(tuple(points), "measured", "measured bytes in use", width=1.6)


def _evicted(story: Story, gpu: GpuStory, axis: _Axis, top: float) -> list[Shape]:
    """Draw when holders were revoked; a name where there is room for it in one of two rows."""
    shapes: list[Shape] = []
    free_from, last = [LEFT, LEFT], -1
    for one in story.evictions:
        if one.gpu not in (gpu.gpu, None) or not story.begin_s <= one.asked_s <= story.end_s:
            continue
        x = axis.x(one.asked_s)
        if int(x) == last:
            continue
        last = int(x)
        told = printable(f"{one.consumer} revoked: {one.reason}")
        shapes.append(Path(((x, top), (x, top + CHART)), "faint", told, dashed=True))
        name = _short(f"evict {one.consumer}")
        end = x + 6.0 * len(name)
        row = next((row for row, free in enumerate(free_from) if free <= x), None)
        if row is not None and end < WIDTH - RIGHT:
            place = top + 11.0 + 11.0 * row
            shapes.append(Label(x + 3.0, place, name, size=10.0, paint="faint"))
            free_from[row] = end + 10.0
    return shapes


def _refused(story: Story, gpu: GpuStory, axis: _Axis, y: _Scale) -> list[Shape]:
    """Draw each out-of-memory as a cross at the capacity."""
    shapes: list[Shape] = []
    for mark in story.marks:
        if mark.kind == "oom" and mark.gpu in (gpu.gpu, None):
            x, level = axis.x(mark.at_s), y(gpu.capacity_bytes)
            for rise in (-5.0, 5.0):
                line = ((x - 5.0, level - rise), (x + 5.0, level + rise))
                shapes.append(Path(line, "loud", printable(mark.text), width=3.0))
    return shapes


# -- lanes
def _moments(shapes: list[Shape], story: Story, axis: _Axis, top: float) -> float:
    if not story.marks:
        return top - 14.0
    shapes.append(Label(LEFT - 8.0, top + 4.0, "moments", "end"))
    for mark in story.marks:
        paint = "loud" if mark.kind in _LOUD else "text"
        x = axis.x(mark.at_s)
        shapes.append(Rect(x - 1.0, top - 6.0, 2.0, 12.0, paint, printable(mark.text)))
    return top + 14.0


def _lanes(
    shapes: list[Shape], story: Story, axis: _Axis, paints: Mapping[str, str], y: float
) -> float:
    """Draw the lanes of each consumer, and return where they end."""
    evictions = story.evictions_by_lease()
    by_name: dict[str, list[LeaseStory]] = {name: [] for name in story.consumers}
    for lease in story.leases:
        by_name[lease.consumer].append(lease)
    drawn, top, seen = 0, y, set[tuple[float, bool, int]]()
    for at, (name, leases) in enumerate(by_name.items()):
        lanes = _packed(leases) or [[]]  # a program without a lease has its name there
        if drawn and drawn + len(lanes) > LANES_MAX:
            told = f"and {len(by_name) - at} more consumers"
            shapes.append(Label(LEFT - 8.0, y + 14.0, told, "end", paint="faint"))
            y += LANE
            break
        shapes.append(Rect(10.0, y + 5.0, 10.0, 10.0, paints.get(name, "c0")))
        shapes.append(Label(26.0, y + 14.0, _short(name)))
        for mine in lanes:
            for lease in mine:
                spans = _spans(lease, evictions.get(lease.lease_id, ()), story.end_s)
                shapes += _bars(lease, spans, axis, y, seen)
            y += LANE
            drawn += 1
    ends = [Path(((x, top), (x, y)), "grid") for x, _ in axis.ticks()]
    shapes[:0] = ends
    return y


def _packed(leases: Sequence[LeaseStory]) -> list[list[LeaseStory]]:
    """Return leases in as few lanes as let none lie on another."""
    lanes: list[list[LeaseStory]] = []
    free_from: list[float] = []
    for lease in sorted(leases, key=lambda lease: _extent(lease)[0]):
        begin, end = _extent(lease)
        for at, free in enumerate(free_from):
            if free <= begin:
                lanes[at].append(lease)
                free_from[at] = end
                break
        else:
            lanes.append([lease])
            free_from.append(end)
    return lanes


def _extent(lease: LeaseStory) -> tuple[float, float]:
    spans = [*lease.states, *lease.uses]
    return min(span.begin_s for span in spans), max(span.end_s for span in spans)


def _spans(
    lease: LeaseStory, evictions: Sequence[EvictionStory], end_s: float
) -> list[tuple[str, Span]]:
    """Return the intervals of a lease by paint; phases of evictions take the place of states."""
    phases = [phase for one in evictions for phase in one.phases(end_s)]
    found: list[tuple[str, Span]] = []
    for span in lease.states:
        paint = _OF_STATE.get(span.name, span.name)
        during = any(
            one.begin_s <= span.begin_s and span.end_s <= one.end_s + 1e-6 for one in phases
        )
        if span.name not in _OF_STATE or not during:
            found.append((paint, span))
    return [*found, *((phase.name, phase) for phase in phases)]


def _bars(
    lease: LeaseStory,
    spans: Iterable[tuple[str, Span]],
    axis: _Axis,
    y: float,
    seen: set[tuple[float, bool, int]],
) -> Iterable[Shape]:
    uses = [("use", span) for span in lease.uses]
    for paint, span in [*spans, *uses]:
        x, end = axis.x(span.begin_s), axis.x(span.end_s)
        if end - x < THIN:
            key = (y, paint == "use", int(x))
            if key in seen:
                continue
            seen.add(key)
        top, height = (y + 12.0, 5.0) if paint == "use" else (y + 3.0, LANE - 6.0)
        yield Rect(x, top, max(THIN, end - x), height, paint, _told(lease, span))


def _told(lease: LeaseStory, span: Span) -> str:
    took = duration(span.end_s - span.begin_s)
    going = ", goes on" if span.going else ""
    note = f": {span.note}" if span.note else ""
    return printable(f"{lease.consumer} ({lease.lease_id}) {span.name}, {took}{going}{note}")


def _short(text: str) -> str:
    shown = printable(text)
    return shown if len(shown) <= LABEL_CHARS else shown[: LABEL_CHARS - 1] + "…"
