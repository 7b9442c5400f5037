"""`vramctl timeline`: GPU memory over time on the terminal, as a picture or as a trace."""

import argparse
import json
import time
from pathlib import Path

from vram_arbiter.clients.cli import arguments, history
from vram_arbiter.clients.cli.replies import OK
from vram_arbiter.clients.cli.text import plural
from vram_arbiter.clients.cli.timeline import chart, collect
from vram_arbiter.clients.cli.timeline.collect import Range
from vram_arbiter.clients.cli.timeline.story import Story
from vram_arbiter.schemas.errors import ConfigError

DESCRIPTIONS = {
    "timeline": "Draw GPU bytes by consumer over time, with leases, waits, uses, evictions with "
    "their phases and pressure: on the terminal, as .png, or as .json that loads in Perfetto and "
    "chrome://tracing. From the daemon's history, or offline from an event log."
}
DEFAULT_LAST_S = 900.0
SUFFIXES = (".png", ".json")


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    parser.add_argument(
        "-o", "--out", type=Path, metavar="FILE.{png,json}",
        help="file to write; its suffix decides the format (default: lines on the terminal)",
    )  # fmt: skip
    parser.add_argument(
        "--event-log", type=Path, metavar="LOG",
        help="read this event log instead: a .jsonl file, or the state folder of a daemon",
    )  # fmt: skip
    part = parser.add_mutually_exclusive_group()
    part.add_argument(
        "--since", type=history.since, dest="since_wall_s", metavar="TIME",
        help="since 90s, 10m, 2h or 1d ago, 14:30, or '2026-11-21 14:30'",
    )  # fmt: skip
    part.add_argument(
        "--last", type=last, dest="last_s", metavar="TIME",
        help="only the last 90s, 10m, 2h or 1d (default: 15m of the history, all of an event log)",
    )  # fmt: skip
    arguments.add_endpoint(parser)


def last(written: str) -> float:
    """Argparse type: a length of time such as 10m."""
    ago = history.AGO.fullmatch(written.strip())
    if ago is None or not float(ago[1]):
        raise argparse.ArgumentTypeError(f"expected 90s, 10m, 2h or 1d, got {written!r}")
    return float(ago[1]) * history.UNITS[ago[2]]


def run(args: argparse.Namespace) -> int:
    """Draw. Raises ConfigError for a file that cannot be written, and what reading raises."""
    out: Path | None = args.out
    if out is not None and out.suffix not in SUFFIXES:
        args.parser.error(f"--out: expected a file that ends in {', '.join(SUFFIXES)}, got {out}")
    if args.event_log is not None:
        story = collect.from_log(args.event_log, Range(args.since_wall_s, args.last_s))
    else:
        neither = args.since_wall_s is None and args.last_s is None
        wanted = Range(args.since_wall_s, DEFAULT_LAST_S if neither else args.last_s)
        story = collect.from_history(wanted, args.endpoint)
    if out is None:
        print("\n".join(chart.lines(story)))
        return OK
    try:
        write(out, story)
    except OSError as error:
        problem = f"{out} cannot be written: {error.strerror}"
        raise ConfigError(problem, hint="name a file in a folder that you can write") from error
    began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(story.begin_s))
    leases, evictions = plural(len(story.leases), "lease"), plural(len(story.evictions), "eviction")
    print(f"{out}: {story.end_s - story.begin_s:.1f} s from {began}, {leases}, {evictions}")
    return OK


def write(out: Path, story: Story, title: str = "") -> None:
    """Write a story in the form that the file's ending says. Raises OSError, ConfigError."""
    if out.suffix == ".json":
        from vram_arbiter.clients.cli.timeline.trace import trace

        out.write_text(json.dumps(trace(story)) + "\n")
        return
    from vram_arbiter.clients.cli.timeline.png import write as write_png

    write_png(out, story, title)
