"""A picture as one HTML file: inline SVG in dark and light, and its evictions and waits as tables.

The file has no script and loads nothing.
"""

from collections.abc import Iterable, Sequence
from html import escape
from math import isfinite

from vram_arbiter.clients.cli.text import duration
from vram_arbiter.clients.cli.timeline.paints import DARK, LIGHT
from vram_arbiter.clients.cli.timeline.shapes import Area, Label, Picture, Rect, Shape
from vram_arbiter.clients.cli.timeline.story import PHASES, Story
from vram_arbiter.schemas.runtime.printable import printable

ROWS_MAX = 500
"""Rows of a table; the rest is counted."""

_STYLE = """\
:root {{ color-scheme: light dark; {light} }}
@media (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}
body {{ font: 14px/1.45 system-ui, sans-serif; margin: 1rem auto; max-width: 72rem;
  padding: 0 1rem; background: var(--ground); color: var(--text); }}
svg {{ width: 100%; height: auto; font-family: system-ui, sans-serif; }}
table {{ border-collapse: collapse; margin: 0 0 1.5rem; }}
th, td {{ padding: .15rem .7rem .15rem 0; text-align: left; border-bottom: 1px solid var(--grid); }}
td.n, th.n {{ text-align: right; font-variant-numeric: tabular-nums; }}
.scroll {{ overflow-x: auto; }}
"""


def page(story: Story, picture: Picture) -> str:
    """Return the whole file."""
    style = _STYLE.format(light=_variables(LIGHT), dark=_variables(DARK))
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{_safe(picture.title)}</title>",
            f"<style>\n{style}</style></head><body><main>",
            *svg(picture),
            *_evictions(story),
            *_waits(story),
            "</main></body></html>",
            "",
        ]
    )


def svg(picture: Picture) -> Iterable[str]:
    """Yield the lines of the SVG element."""
    yield (
        f'<svg role="img" aria-labelledby="t d" viewBox="0 0 {picture.width:g} '
        f'{picture.height:g}" xmlns="http://www.w3.org/2000/svg">'
    )
    yield f'<title id="t">{_safe(picture.title)}</title>'
    yield f'<desc id="d">{_safe(picture.description)}</desc>'
    yield from map(_element, picture.shapes)
    yield "</svg>"


def _element(shape: Shape) -> str:
    paint = f"var(--{shape.paint})"
    if isinstance(shape, Label):
        return (
            f'<text x="{_n(shape.x)}" y="{_n(shape.y)}" font-size="{_n(shape.size)}" '
            f'text-anchor="{shape.anchor}" fill="{paint}">{_safe(shape.text)}</text>'
        )
    title = f"<title>{_safe(shape.title)}</title>" if shape.title else ""
    if isinstance(shape, Rect):
        return (
            f'<rect x="{_n(shape.x)}" y="{_n(shape.y)}" width="{_n(shape.width)}" '
            f'height="{_n(shape.height)}" fill="{paint}">{title}</rect>'
        )
    points = " ".join(f"{_n(x)},{_n(y)}" for x, y in shape.points)
    if isinstance(shape, Area):
        return f'<polygon points="{points}" fill="{paint}">{title}</polygon>'
    dashes = ' stroke-dasharray="4 4"' if shape.dashed else ""
    return (
        f'<polyline points="{points}" fill="none" stroke="{paint}" '
        f'stroke-width="{_n(shape.width)}"{dashes}>{title}</polyline>'
    )


def _evictions(story: Story) -> Iterable[str]:
    rows = []
    for one in story.evictions:
        took = {phase.name: phase for phase in one.phases(story.end_s)}
        cells = [_when(one.asked_s, story), one.consumer, one.wanted_by, one.reason]
        cells += [_seconds(took[name].end_s - took[name].begin_s) if name in took else "–"
                  for name in PHASES]  # fmt: skip
        rows.append([*cells, one.verdict or "under way"])
    heads = ["after", "evicted", "for", "why", *PHASES, "verdict"]
    yield from _table("Evictions", heads, rows, {0, 4, 5, 6, 7})


def _waits(story: Story) -> Iterable[str]:
    rows = [
        [
            _when(span.begin_s, story),
            lease.consumer,
            _seconds(span.end_s - span.begin_s) + (" so far" if span.going else ""),
            span.note,
        ]
        for lease in story.leases
        for span in lease.states
        if span.name == "queued"
    ]
    yield from _table("Waits", ["after", "consumer", "waited", "why at first"], rows, {0, 2})


def _table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], right: set[int]
) -> Iterable[str]:
    if not rows:
        return
    kinds = [' class="n"' if at in right else "" for at in range(len(heads))]
    head = "".join(
        f'<th scope="col"{kind}>{_safe(cell)}</th>' for kind, cell in zip(kinds, heads, strict=True)
    )
    yield f'<h2>{title}</h2><div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>'
    for row in rows[:ROWS_MAX]:
        cells = zip(kinds, row, strict=True)
        yield f"<tr>{''.join(f'<td{kind}>{_safe(cell)}</td>' for kind, cell in cells)}</tr>"
    yield "</tbody></table></div>"
    if len(rows) > ROWS_MAX:
        yield f"<p>and {len(rows) - ROWS_MAX} more</p>"


def _when(at_s: float, story: Story) -> str:
    after_s = at_s - story.begin_s
    return f"{after_s:.2f} s" if after_s >= 0 else "before"


def _seconds(seconds: float) -> str:
    return f"{seconds * 1e3:.0f} ms" if seconds < 1 else duration(seconds)


def _variables(paints: dict[str, str]) -> str:
    return " ".join(f"--{name}: {color};" for name, color in paints.items())


def _safe(text: str) -> str:
    return escape(printable(text))


def _n(value: float) -> str:
    assert isfinite(value)
    return f"{value:.2f}".rstrip("0").rstrip(".")
