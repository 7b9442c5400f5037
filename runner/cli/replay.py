"""`vram-runner replay --dataset DIR --frame N`: from a recorded frame to its tick and trace."""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path

from vram_arbiter.clients.cli.arguments import count
from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.recording.reader import Recorded, read_frame
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.printable import printable_lines

TRACE_URL_VARIABLE = "VRAM_TRACE_URL"
TRACE_FIELDS = ("{trace_id}", "{span_id}")


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner replay`."""
    replay = commands.add_parser("replay", help="show a recorded frame, its tick and its trace")
    replay.add_argument("--dataset", type=Path, required=True, help="folder of the recording")
    replay.add_argument(
        "--frame",
        type=count(0),
        required=True,
        help="number of the frame over all episodes, from 0 on",
    )
    replay.add_argument(
        "--episode", type=count(0), help="count frames from the beginning of this episode"
    )
    replay.add_argument("--json", action="store_true", help="all of it, for programs")
    replay.add_argument(
        "--trace-url",
        help=f"URL template of a trace, with {' and '.join(TRACE_FIELDS)};"
        f" default: {TRACE_URL_VARIABLE}",
    )
    return replay


async def run(args: argparse.Namespace) -> int:
    """Print one frame.

    Raises ConfigError for an unusable folder or URL, BadRequest for a missing frame.
    """
    template = trace_template(args.trace_url, os.environ)
    recorded = await asyncio.to_thread(read_frame, args.dataset, args.frame, args.episode)
    link = trace_link(recorded, template)
    if args.json:
        print(json.dumps({**dataclasses.asdict(recorded), "trace_url": link}))
    else:
        print(printable_lines(as_text(recorded, link)))
    return 0


def trace_template(given: str | None, environ: Mapping[str, str]) -> str | None:
    """Return the URL template of traces; None when none is configured. Raises ConfigError."""
    template = given or environ.get(TRACE_URL_VARIABLE) or None
    if template is not None and TRACE_FIELDS[0] not in template:
        raise ConfigError(
            f"{template!r} does not say where the trace's id belongs",
            hint="like http://localhost:16686/trace/{trace_id}?uiFind={span_id}",
        )
    return template


def trace_link(recorded: Recorded, template: str | None) -> str | None:
    """Return the trace's URL; None without a template or without a trace."""
    if template is None or not recorded.trace_id:
        return None
    return template.replace("{trace_id}", recorded.trace_id).replace("{span_id}", recorded.span_id)


def as_text(recorded: Recorded, link: str | None) -> str:
    """Format a frame for people, one line per fact."""
    goal, tick = recorded.goal, recorded.tick
    outcome = ": ".join(filter(None, (goal.get("status"), goal.get("message"))))
    outcome += f"; marked {goal['marked']}" if "marked" in goal else ""
    lines = [
        ("frame", f"{recorded.frame} of {recorded.root} ({recorded.robot})"),
        (
            "episode",
            f"{recorded.episode}, frame {recorded.frame_in_episode} at {recorded.at_s:.3f} s",
        ),
        ("task", recorded.task),
        ("goal", f"{goal['goal_id']}: {goal['skill']} {outcome}".rstrip()),
    ]
    if recorded.trace_id:
        kept = (
            ""
            if recorded.trace_sampled
            else " (not sampled: the collector has no span of this tick)"
        )
        lines.append(("trace", f"{recorded.trace_id} span {recorded.span_id}{kept}"))
    else:
        lines.append(("trace", "none: no telemetry was configured"))
    if link is not None:
        lines.append(("", link))
    chunk = "" if tick["chunk_index"] is None else f", row {tick['chunk_index']} of its chunk"
    said = [
        text
        for text, so in (
            ("nothing applied", not tick["action_applied"]),
            ("deadline missed", tick["deadline_missed"]),
            ("last of its episode", tick["done"]),
        )
        if so
    ]
    lines.append(("tick", ", ".join([f"{tick['index']}{chunk}", *said])))
    lines.append(
        ("times", ", ".join(f"{name} {ms:.2f} ms" for name, ms in recorded.timings_ms.items()))
    )
    if tick["violations"]:
        lines.append(("safety", tick["violations"]))
    lines += [
        ("joint", f"{name}: at {value:+.4f} rad, told {recorded.action[name]:+.4f}")
        for name, value in recorded.state.items()
    ]
    lines += [
        ("base", f"{what}: " + ", ".join(f"{name} {value:+.3f}" for name, value in values.items()))
        for what, values in recorded.base.items()
        if values
    ]
    lines += [
        ("camera", f"{name}: {where['path']} at {where['at_s']:.3f} s")
        for name, where in recorded.pictures.items()
    ]
    if not recorded.complete:
        lines.append(("note", "a recording into this folder is under way, or was cut off"))
    return "\n".join(f"{label:<8} {text}" for label, text in lines)
