"""A story as PNG, by matplotlib: bytes of each GPU, and one row or more for each consumer."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from vram_arbiter.clients.cli.timeline.story import GpuStory, LeaseStory, Story
from vram_arbiter.clients.cli.timeline.trace import steps_of
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.printable import printable

WIDTH, CHART, ROW, EDGE = 11.0, 2.4, 0.24, 1.2  # inches
ROWS_MAX = 40
"""Rows that are drawn; the consumers beyond are counted."""
LABEL_CHARS = 20
_COLORS: Final = (
    "#3d7ea6", "#d1495b", "#5b8c5a", "#d9952f", "#8a63a8", "#3f9c98", "#a8703a", "#b85f8c",
)  # fmt: skip
"""Of consumers; more consumers share them."""
_PAINTS: Final = {
    "queued": "#f2c14e", "loading": "#7fb7d9", "held": "#a9b8a2", "in use": "#2f5d34",
    "revoke": "#e8a0bf", "quiesce": "#c86fa0", "unload": "#8f4fa8", "verify": "#4b3f8f",
    "standby": "#d6d6d6", "parked": "#b9c6d6",
}  # fmt: skip
_RED: Final = "#c00000"


def write(file: Path, story: Story, title: str = "") -> None:
    """Draw a story. Raises ConfigError without matplotlib, OSError where it cannot be written."""
    need("a timeline as .png (.json needs no package)", "matplotlib", extra="runner")
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = _rows(story)
    heights = [*(CHART for _ in story.gpus), ROW * (len(rows) + 1)]
    with mpl.rc_context({"text.parse_math": False, "font.size": 8.0}):
        size = (WIDTH, sum(heights) + EDGE)
        figure = Figure(figsize=size, dpi=130.0, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        *charts, lanes = figure.subplots(
            len(heights), 1, sharex=True, squeeze=False, height_ratios=heights
        )[:, 0]
        # by name: two pictures of the same consumers have the same colors
        names = sorted(story.consumers)
        colors = {name: _COLORS[at % len(_COLORS)] for at, name in enumerate(names)}
        for gpu, axes in zip(story.gpus, charts, strict=True):
            _chart(axes, story, gpu, colors)
        _lanes(lanes, story, rows)
        lanes.set_xlim(0.0, max(0.1, story.end_s - story.begin_s))
        began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(story.begin_s))
        lanes.set_xlabel("\n".join([f"seconds since {began}", *map(printable, story.notices)]))
        figure.suptitle(printable(title or "GPU memory by consumer"))
        canvas.print_png(str(file))


# -- bytes of one GPU
def _chart(axes: Any, story: Story, gpu: GpuStory, colors: Mapping[str, str]) -> None:
    begin, end = story.begin_s, story.end_s - story.begin_s
    bytes_by_name = story.bytes_by_name(gpu)
    steps = [(at - begin, values) for at, values in steps_of(bytes_by_name)]
    if steps:
        steps.append((end, steps[-1][1]))
        bands = [[values[name] / GIB for _, values in steps] for name in bytes_by_name]
        paints = [colors.get(name, _COLORS[0]) for name in bytes_by_name]
        drawn = axes.stackplot([at for at, _ in steps], *bands, colors=paints, step="post")
        axes.legend(drawn, [_short(name) for name in bytes_by_name], loc="upper left")
    if gpu.measured:
        used = [count / GIB for _, count in gpu.measured]
        times = [at - begin for at, _ in gpu.measured]
        axes.step([*times, end], [*used, used[-1]], where="post", color="#111111", lw=1.2)
    for span in gpu.pressure:
        axes.axvspan(span.begin_s - begin, span.end_s - begin, color="#f6d5d5", zorder=-1)
    for level, style in ((gpu.capacity_bytes, "-"), (gpu.capacity_bytes - gpu.reserve_bytes, ":")):
        if gpu.capacity_bytes:
            axes.axhline(level / GIB, color="#1c1c1e", lw=0.8, ls=style)
    _evicted(axes, story, gpu)
    here = [mark for mark in story.marks if mark.gpu in (gpu.gpu, None)]
    oom = [mark.at_s - begin for mark in here if mark.kind == "oom"]
    axes.plot(oom, [gpu.capacity_bytes / GIB] * len(oom), "x", color=_RED, mew=2.5)
    axes.set_ylim(bottom=0.0)
    axes.margins(y=0.2)
    axes.set_ylabel("GiB")
    what = "bytes of its processes" if gpu.held else "charged bytes"
    axes.set_title(printable(f"{gpu.title}, {what}"), loc="left")


def _evicted(axes: Any, story: Story, gpu: GpuStory) -> None:
    """Draw when holders were revoked; a name where there is room for it."""
    room, free_from = (story.end_s - story.begin_s) / 60, -1.0
    for one in story.evictions:
        at_s = one.asked_s - story.begin_s
        if one.gpu not in (gpu.gpu, None) or at_s < 0:
            continue
        axes.axvline(at_s, color="#5c6066", lw=0.7, ls="--")
        if at_s >= free_from:
            label, free_from = _short(f"evict {one.consumer}"), at_s + room
            axes.annotate(
                label, (at_s, 0.98), xycoords=("data", "axes fraction"), rotation=90.0,
                ha="right", va="top", color="#5c6066",
            )  # fmt: skip


# -- rows
type _Row = tuple[str, list[LeaseStory]]


def _rows(story: Story) -> list[_Row]:
    """Return the leases of each consumer in as few rows as let none lie on another."""
    rows: list[_Row] = []
    for name in story.consumers:
        mine: list[_Row] = []
        leases = [lease for lease in story.leases if lease.consumer == name]
        for lease in sorted(leases, key=_extent):
            begin, _ = _extent(lease)
            free = (row for _, row in mine if _extent(row[-1])[1] <= begin)
            row = next(free, None)
            if row is None:
                mine.append((_short(name), [lease]))
            else:
                row.append(lease)
        rows += mine or [(_short(name), [])]  # a program without a lease has its name there
    if len(rows) > ROWS_MAX:
        rows[ROWS_MAX:] = [(f"and {len(rows) - ROWS_MAX} more", [])]
    return rows


def _extent(lease: LeaseStory) -> tuple[float, float]:
    spans = [*lease.states, *lease.uses]
    ends = [*(span.end_s for span in spans), *(at_s for at_s, _ in lease.charges)]
    return min([*(span.begin_s for span in spans), *ends]), max(ends)


def _lanes(axes: Any, story: Story, rows: Sequence[_Row]) -> None:
    for at, (_, leases) in enumerate(rows):
        states = [span for lease in leases for span in lease.states]
        uses = [span for lease in leases for span in lease.uses]
        for spans, bottom, height in ((states, at - 0.35, 0.7), (uses, at + 0.1, 0.25)):
            paints = [_PAINTS[span.name if spans is states else "in use"] for span in spans]
            ranges = [(span.begin_s - story.begin_s, span.end_s - span.begin_s) for span in spans]
            axes.broken_barh(ranges, (bottom, height), facecolors=paints, edgecolors=paints, lw=0.4)
    for mark in story.marks:
        axes.vlines(mark.at_s - story.begin_s, -1.3, -0.7, color="#1c1c1e", lw=1.5)
    axes.set_yticks([-1, *range(len(rows))], ["moments", *(name for name, _ in rows)])
    axes.set_ylim(len(rows) - 0.4, -1.6)
    for name, paint in _PAINTS.items():
        axes.bar(0.0, 0.0, color=paint, label=name)
    axes.figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=10)


def _short(text: str) -> str:
    shown = printable(text)
    return shown if len(shown) <= LABEL_CHARS else shown[: LABEL_CHARS - 1] + "…"
