"""The report of a benchmark as one HTML file, without scripts and without resources of others."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files
from string import Template
from urllib.parse import quote

from vram_arbiter.runner.benchmark.outcomes import Cell, SeedOutcome
from vram_arbiter.schemas.plain import JsonMap

SEED_COLUMNS = ("Seed", "Outcome", "Steps", "Standing", "Seconds", "Node", "Video", "Error")


def page(about: JsonMap, cells: Sequence[Cell]) -> str:
    """Return the page; `about` says what was played, by name."""
    template = files("vram_arbiter.runner.benchmark").joinpath("report.html").read_text("utf-8")
    said = " · ".join(f"{name}: {value}" for name, value in about.items() if value is not None)
    return Template(template).substitute(
        title=escape(", ".join(dict.fromkeys(cell.contestant for cell in cells))),
        about=escape(said),
        cells="\n".join(_cell(cell) for cell in cells),
        details="\n".join(_seeds(cell) for cell in cells),
    )


def words(cell: Cell) -> tuple[str, ...]:
    """Return a cell in words: world, contestant, success, its interval, steps, errors."""
    row = cell.summary()
    rate, interval, steps = row["success_rate"], row["interval_95"], row["mean_steps"]
    return (
        _world(cell),
        cell.contestant,
        "no verdict" if rate is None else f"{row['successes']}/{row['judged']} = {rate:.0%}",
        "" if interval is None else f"{interval[0]:.0%} to {interval[1]:.0%}",
        "" if steps is None else f"{steps:.1f}",
        f"{row['errors']}" + ("" if cell.complete else f"; not complete: {cell.why}"),
    )


def _cell(cell: Cell) -> str:
    world, contestant, rate, interval, steps, errors = map(escape, words(cell))
    return (
        f"<tr><td>{world}</td><td>{contestant}<br><small>{escape(cell.revision)}</small></td>"
        f"<td>{rate}, {interval}{_bar(cell.summary())}</td>"
        f'<td class="number">{steps}</td><td>{errors}</td></tr>'
    )


def _bar(row: JsonMap) -> str:
    """Draw the rate as a mark, and its interval as a bar behind it."""
    if row["interval_95"] is None:
        return ""
    low, high = (100 * bound for bound in row["interval_95"])
    return (
        f'<span class="track"><i style="left:{low:.1f}%;width:{high - low:.1f}%"></i>'
        f'<b style="left:calc({100 * row["success_rate"]:.1f}% - 1.5px)"></b></span>'
    )


def _seeds(cell: Cell) -> str:
    heads = "".join(f"<th>{name}</th>" for name in SEED_COLUMNS)
    rows = "\n".join(_seed(played) for played in cell.episodes)
    return (
        f"<details open><summary>{escape(_world(cell))}, {escape(cell.contestant)}</summary>\n"
        f"<table><thead><tr>{heads}</tr></thead><tbody>\n{rows}\n</tbody></table></details>"
    )


def _seed(played: SeedOutcome) -> str:
    video = "" if played.video is None else f'<a href="{quote(played.video)}">video</a>'
    told = ": ".join(filter(None, (played.error, played.message)))
    numbers = (played.steps, played.standing_steps, f"{played.seconds:.1f}")
    return (
        f'<tr><td class="number">{played.seed}</td>'
        f'<td class="{played.verdict}">{played.verdict}</td>'
        + "".join(f'<td class="number">{number}</td>' for number in numbers)
        + f"<td>{escape(played.node)}</td><td>{video}</td><td>{escape(told)}</td></tr>"
    )


def _world(cell: Cell) -> str:
    return cell.world + (f" ({cell.task})" if cell.task else "")
