"""`vram-runner frame --out FILE`: save the newest picture of a running runner's camera."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Literal

from vram_arbiter.clients.cli.arguments import positive
from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.client import add_client_flags, client_of, note
from vram_arbiter.schemas.errors import ConfigError

ENCODINGS: dict[str, Literal["jpeg", "png"]] = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner frame`."""
    frame = commands.add_parser(
        "frame", help="save the newest picture of a running runner's camera"
    )
    frame.add_argument("camera", nargs="?", default="", help="default: the runner's first one")
    frame.add_argument("--out", type=Path, required=True, help="a .jpg or .png file")
    frame.add_argument("--max-age-ms", type=positive, default=500.0, help="default %(default)g")
    add_client_flags(frame)
    return frame


async def run(args: argparse.Namespace) -> int:
    """Write the picture. Raises ConfigError for the file, and what the client raises."""
    if (encoding := ENCODINGS.get(args.out.suffix.lower())) is None:
        raise ConfigError(f"--out {args.out}: expected a name that ends in .jpg or .png")
    check_output("--out", args.out)
    async with client_of(args) as client:
        taken = await client.frame(args.camera, args.max_age_ms, encoding=encoding)
    args.out.write_bytes(taken["data"])
    size = f"{taken['width']} × {taken['height']}"
    note(f"{taken['camera']}: {size}, {taken['age_ms']:.0f} ms old, in {args.out}")
    return 0
