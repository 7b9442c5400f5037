"""`vramctl selftest`: rows of `clients.selftest`, on the machine's GPU or on a simulated one."""

import argparse
import asyncio
import json
import logging
import time
from pathlib import Path
from typing import Final

from vram_arbiter.clients.cli import arguments, files, terminal
from vram_arbiter.clients.cli.replies import NO, OK
from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.clients.selftest import report
from vram_arbiter.clients.selftest.rows import LAST, ROWS
from vram_arbiter.clients.selftest.run import AUTO, FAKE, judged, made, opened
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes

DESCRIPTIONS = {
    "selftest": "Prove on this machine's GPU what the product claims of GPUs: lags, contexts, "
    "copies, evictions, kills, and small models, with a private daemon. Without an NVIDIA driver "
    "the rows that can run on a simulated GPU do. Refuses a GPU that a running arbiter leases: "
    "stop that, or name another GPU. Touches no process but its own children, and leaves the GPU "
    "as it was. Exits 0 if all rows that ran passed, 1 if one missed its limit or failed."
}
MEMORY_MIN_BYTES: Final = 768 * MIB
"""A context and the weights beside it."""


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    add = parser.add_argument
    add(
        "--gpu", type=_gpu, default=AUTO, metavar="auto|fake|N",
        help="number of a GPU, or a simulated one (default: the first GPU, else fake)",
    )  # fmt: skip
    add(
        "--memory", type=arguments.size, default=GIB, metavar="SIZE",
        help="most bytes on the GPU at a time (default: 1GiB)",
    )  # fmt: skip
    add(
        "--within", type=arguments.at_least(1.0), default=120.0, metavar="S",
        help="rows that have not begun by then are skipped (default: %(default)g)",
    )  # fmt: skip
    names = [row.id for row in ROWS]
    add("--row", action="append", choices=names, help="this row alone; may be repeated")
    add("--json", type=Path, metavar="FILE", help="write the results as JSON")
    add("--report", type=Path, metavar="FILE", help="write them as Markdown, for an issue")


def run(args: argparse.Namespace) -> int:
    logging.getLogger("vram_arbiter.clients").setLevel(logging.ERROR)  # a row kills the daemon
    return asyncio.run(_run(args))


async def _run(args: argparse.Namespace) -> int:
    deadline_s, outcomes = time.monotonic() + args.within, list[JsonMap]()
    rows = [row for row in ROWS if args.row is None or row.id in args.row]
    check_output("--json", args.json)
    check_output("--report", args.report)
    if args.memory < MEMORY_MIN_BYTES:
        raise ConfigError(f"--memory: expected at least {format_bytes(MEMORY_MIN_BYTES)}")
    gpu, why = await opened(args.gpu, args.memory)
    async with made(gpu, args.memory, {row.skill for row in rows} - {""}) as bed:
        about = f"{bed.gpu.name}, {bed.gpu.driver}, at most {format_bytes(args.memory)} of it"
        print(printable(about), flush=True)
        if bed.simulated:
            print(printable(f"{report.SIMULATED} ({why})"), flush=True)
        for row in (*rows, LAST):
            left_s = LAST.limit_s if row is LAST else deadline_s - time.monotonic()
            outcomes.append(await judged(row, bed, left_s))
            line = report.line_of(outcomes[-1], simulated=bed.simulated)
            print("\n".join(terminal.folded(line, 4, terminal.columns())), flush=True)
    told = report.told(bed.gpu, outcomes, simulated=bed.simulated)
    print(told["summary"])
    if args.json:
        files.replace(args.json, json.dumps(told, indent=2) + "\n")
    if args.report:
        files.replace(args.report, report.markdown(told))
    return OK if all(one["verdict"] in ("pass", "skipped") for one in outcomes) else NO


def _gpu(written: str) -> str:
    if written not in (AUTO, FAKE) and not written.isdecimal():
        raise argparse.ArgumentTypeError(f"expected auto, fake or a number, got {written!r}")
    return written
