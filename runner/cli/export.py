"""`vram-runner export --dataset DIR --out FILE.rrd`: a recording for the Rerun viewer."""

from __future__ import annotations

import argparse
import asyncio
from pathlib import Path

from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.extras import need


def add_parser(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner export`."""
    export = commands.add_parser("export", help="write a recording as a file for the Rerun viewer")
    export.add_argument("--dataset", type=Path, required=True, help="folder of the recording")
    export.add_argument("--out", type=Path, required=True, help="a .rrd file")
    export.add_argument("--episode", type=int, help="only this one")
    return export


async def run(args: argparse.Namespace) -> int:
    """Write the file.

    Raises ConfigError for the dataset, the file or missing packages, BadRequest for the episode.
    """
    if args.out.suffix != ".rrd":
        raise ConfigError(f"--out {args.out}: expected a name that ends in .rrd")
    check_output("--out", args.out)
    need("the export", "rerun", "cv2", extra="viz")
    need("the export", "pyarrow", "av", extra="dataset")
    from vram_arbiter.runner.display.export import export

    frames = await asyncio.to_thread(export, args.dataset, args.out, args.episode)
    print(f"{frames} frames in {args.out}: open it with `rerun {args.out}`")
    return 0
