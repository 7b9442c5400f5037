"""`vramctl selftest`: rows of `clients.selftest`, on the machine's GPU or on a simulated one."""

import argparse
import asyncio
import logging
from pathlib import Path
from typing import Final

from vram_arbiter.clients.calibration.gpu import Gpu
from vram_arbiter.clients.cli import arguments, files, terminal
from vram_arbiter.clients.cli.doctor.machine import ask_nvml
from vram_arbiter.clients.cli.replies import NO, OK
from vram_arbiter.clients.selftest import report
from vram_arbiter.clients.selftest.bed import READING_S, answered_within
from vram_arbiter.clients.selftest.rows import ROWS
from vram_arbiter.clients.selftest.run import Outcome, Trial, selftest
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes

DESCRIPTIONS = {
    "selftest": "Prove on this machine's GPU what the product claims of GPUs: lags, contexts, "
    "copies, evictions, kills, and small models, with a private daemon. Without an NVIDIA driver "
    "the rows that can run on a simulated GPU do. Refuses a GPU that a running arbiter leases: "
    "stop that, or name another GPU. Touches no process but its own children, and leaves the GPU "
    "as it was. Exits 0 if all rows that ran passed, 1 if one missed its limit or failed."
}
AUTO, FAKE = "auto", "fake"
NO_DRIVER: Final = ("NVMLError_LibraryNotFound", "NVMLError_DriverNotLoaded")
MEMORY_MIN_BYTES: Final = 768 * MIB
"""A context and the weights beside it."""


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    add = parser.add_argument
    add(
        "--gpu", type=_gpu, default=AUTO, metavar="auto|fake|N",
        help="number of a GPU, or a simulated one (default: the first GPU, else fake)",
    )  # fmt: skip
    add(
        "--memory", type=_memory, default=GIB, metavar="SIZE",
        help="most bytes on the GPU at a time (default: 1GiB)",
    )  # fmt: skip
    add(
        "--within", type=arguments.at_least(1.0), default=120.0, metavar="S",
        help="rows that have not begun by then are skipped (default: %(default)g)",
    )  # fmt: skip
    names = [row.id for row in ROWS]
    add("--row", action="append", choices=names, help="this row alone; may be repeated")
    add("--json", type=_file, metavar="FILE", help="write the results as JSON")
    add("--report", type=_file, metavar="FILE", help="write them as Markdown, for an issue")


def run(args: argparse.Namespace) -> int:
    logging.getLogger("vram_arbiter.clients").setLevel(logging.ERROR)  # a row kills the daemon
    results = asyncio.run(_run(args))
    return OK if all(one.verdict in ("pass", "skipped") for one in results) else NO


async def _run(args: argparse.Namespace) -> list[Outcome]:
    index, why = await _index(args.gpu)
    simulated, gpus, results = index is None, list[Gpu](), list[Outcome]()

    def begun(gpu: Gpu) -> None:
        gpus.append(gpu)
        print(printable(f"{gpu.name}, {gpu.driver}, at most {format_bytes(args.memory)} of it"))
        if simulated:
            print(printable(f"{report.SIMULATED} ({why})"), flush=True)

    def tell(result: Outcome) -> None:
        results.append(result)
        line = report.line_of(result, simulated=simulated)
        print("\n".join(terminal.folded(line, 4, terminal.columns())), flush=True)

    rows = [row for row in ROWS if args.row is None or row.id in args.row]
    await selftest(Trial(index, args.memory, args.within, rows), begun, tell)
    told = report.told(gpus[0], results, simulated=simulated)
    print(told["summary"])
    for place, written in ((args.json, report.as_json), (args.report, report.as_markdown)):
        if place is not None:
            files.replace(place, written(told))
    return results


async def _index(gpu: str) -> tuple[int | None, str]:
    """Return the number of the GPU; None: a simulated one, and why. Raises ConfigError for a GPU
    without memory of its own, ProbeFailed where the driver hangs."""
    if gpu == FAKE:
        return None, "--gpu fake"
    nvml = await answered_within(READING_S, ask_nvml)
    if gpu == AUTO and nvml.error in NO_DRIVER:
        return None, nvml.problem
    if nvml.without_memory:
        raise ConfigError(
            "this GPU uses the machine's memory, of which no row can tell its own part",
            hint="vramctl selftest --gpu fake; vramctl doctor examines the machine",
        )
    return 0 if gpu == AUTO else int(gpu), ""


def _gpu(written: str) -> str:
    if written not in (AUTO, FAKE) and not written.isdecimal():
        raise argparse.ArgumentTypeError(f"expected auto, fake or a number, got {written!r}")
    return written


def _memory(written: str) -> int:
    size = arguments.size(written)
    if size < MEMORY_MIN_BYTES:
        raise argparse.ArgumentTypeError(
            f"expected at least {format_bytes(MEMORY_MIN_BYTES)}: a context and weights beside it"
        )
    return size


def _file(written: str) -> Path:
    place = Path(written)
    if not place.parent.is_dir():
        raise argparse.ArgumentTypeError(f"not a folder: {place.parent}")
    return place
