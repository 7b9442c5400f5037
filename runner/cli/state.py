"""`vram-runner state`: show what a running runner sees and does."""

from __future__ import annotations

import argparse

from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.client import add_client_flags, client_of, show, show_json
from vram_arbiter.schemas.plain import Message


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner state`."""
    state = commands.add_parser("state", help="show what a running runner sees and does")
    state.add_argument("--json", action="store_true", help="all of it, for programs")
    add_client_flags(state)
    return state


async def run(args: argparse.Namespace) -> int:
    """Print the state. Raises what the client raises."""
    async with client_of(args) as client:
        answer = await client.state()
    if args.json:
        show_json(answer)
    else:
        show(as_text(answer))
    return 0


def as_text(answer: Message) -> str:
    """Format a state for people, one line per fact."""
    goal = f"{answer['goal']}: {answer['rskill_id']}, {answer['phase']}"
    lines = [
        ("goal", goal if answer["goal"] else "none"),
        ("resident", answer["resident"] or "no skill"),
        ("loop", f"{answer['rate_hz']:g} Hz, {answer['ticks']} ticks,"
         f" {answer['deadline_misses']} late"),
        ("cameras", ", ".join(answer["cameras"]) or "none"),
    ]  # fmt: skip
    if answer["estop"] is not None:
        lines.append(("ESTOP", answer["estop"]))
    if (world := answer["world"]) is not None:
        joints = world["joint_state"]
        lines += [
            ("joint", f"{name} {value:+.4f} rad")
            for name, value in zip(joints["name"], joints["position"], strict=True)
        ]
        lines += [(state, name) for name, state in world["diagnostics"].items() if state != "ok"]
        if (pose := world["base_pose"]) is not None:
            lines.append(("base", ", ".join(f"{value:+.3f}" for value in pose["xyz"]) + " m"))
    return "\n".join(f"{label:<9} {text}" for label, text in lines)
