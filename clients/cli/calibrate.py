"""`vramctl calibrate`: `vramctl run` with a record. It measures what a model, or any program, needs
on a GPU, as an entry of the footprint file.

Beside a running arbiter the program has an exclusive lease of the whole GPU: no other model is
resident meanwhile. A request of a robot goes first: it ends the program.
"""

import argparse
import asyncio
import json
import os
import re
import signal
import sys
import tempfile
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from vram_arbiter.clients.calibration import entry as entries
from vram_arbiter.clients.calibration import model
from vram_arbiter.clients.calibration.gpu import Gpu, open_gpu
from vram_arbiter.clients.calibration.record import Figures, Record
from vram_arbiter.clients.cli import arguments, text
from vram_arbiter.clients.cli import run as runs
from vram_arbiter.clients.cli.replies import OK
from vram_arbiter.clients.configs import configs_folder, shipped
from vram_arbiter.clients.foreign.run_spec import RunSpec
from vram_arbiter.clients.net.request import ask
from vram_arbiter.schemas.defaults import NAME_MAX_CHARS
from vram_arbiter.schemas.errors import CalibrationFailed, ConfigError, from_wire
from vram_arbiter.schemas.manifest import ManifestError, load_manifest
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.schemas.wire.requests import Status

DESCRIPTIONS = {
    "calibrate": "Measure what a model needs on a GPU: vramctl calibrate MANIFEST loads it in a "
    "sidecar of its own, asks it, unloads it and ends it; vramctl calibrate -- COMMAND observes "
    "any program from its start to its end. Prints the figures and the entry for "
    "models/footprints.yaml, with a margin of 2 % (at most 48 MiB). Holds an exclusive lease of "
    "the GPU meanwhile, and ends when a request of a higher priority needs it."
}
SIDECAR: Final = (sys.executable, "-m", "vram_arbiter.sidecars")
MODEL: Final = (sys.executable, "-m", "vram_arbiter.clients.calibration.model")
RATE_MIN_HZ: Final = 20.0
GRACE_S: Final = 10.0
KEY: Final = re.compile(r"[^/\s]+/[^/\s]+")
FIGURES: Final = {
    "context": "an empty context, which no unload gives back",
    "load_peak": "the most while it loads",
    "steady": "resident before the first request; of a program, the median of its last quarter",
    "inference_peak": "the most while it answers; of a program, in its last quarter",
    "retained": "left after an unload",
    "freed": "given back by the unload, or by the program's end",
    "after_exit": "left after the end of its processes",
}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    add = parser.add_argument
    add("manifest", nargs="?", metavar="MANIFEST", help="rskill.yaml, or a shipped skill's name")
    add(
        "--device", metavar="fake:FOLDER|cuda[:N]",
        help="default: fake:$VRAM_FAKE_GPU if set, else cuda, the first GPU",
    )  # fmt: skip
    add(
        "--requests", type=arguments.count(0, 10_000), default=20, metavar="N",
        help="requests to the model; 0: no inference peak (default: %(default)s)",
    )  # fmt: skip
    add(
        "--seconds", type=arguments.at_least(1.0), metavar="S",
        help="end COMMAND after this time, for a server (default: it ends by itself)",
    )  # fmt: skip
    add(
        "--name", type=arguments.name, metavar="[OWNER/]NAME",
        help="key of COMMAND's entry (default: PROGRAM); without an owner it is local/NAME",
    )  # fmt: skip
    add(
        "--rate", type=arguments.at_least(RATE_MIN_HZ, 1000.0), default=50.0, metavar="HZ",
        help="readings of the GPU a second (default: %(default)s)",
    )  # fmt: skip
    add(
        "--rest", type=arguments.at_least(0.05, 60.0), default=2.0, metavar="S",
        help="bytes are at rest when unchanged for this long (default: %(default)s)",
    )  # fmt: skip
    add(
        "--allow-noncommercial", action="store_true",
        help="measure a model whose license does not allow commercial use",
    )  # fmt: skip
    add("--no-arbiter", action="store_true", help="measure without a lease, if no arbiter runs")
    add(
        "--wait", type=arguments.at_least(0.0), metavar="SECONDS",
        help="give up waiting for the lease after this time (default: never)",
    )  # fmt: skip
    arguments.add_json(parser)
    arguments.add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    if bool(args.manifest) == bool(args.program):
        args.parser.error("expected either MANIFEST or `-- COMMAND`")
    configs = configs_folder(os.environ)
    rskill = shipped(Path(args.manifest), "rskills", configs) if args.manifest else None
    key = _key_of_program(args) if rskill is None else _key_of_model(args, rskill)
    gpu = open_gpu(args.device)
    record, command = Record(gpu, args.rate, args.rest), list(args.program)
    with tempfile.TemporaryDirectory(prefix="vc") as folder:
        marks = Path(folder) / "marks.json"
        if rskill is not None:
            command = [*MODEL, json.dumps(asdict(_plan(args, gpu, rskill, configs, marks)))]
        code = asyncio.run(_measure(args, record, command, f"vramctl calibrate {key}"))
        told = json.loads(marks.read_text()) if marks.exists() else {}
    if code in (runs.NOT_FOUND, runs.NOT_STARTED):
        return int(code)
    figures = None if code else record.figures(told)
    if figures is None:
        ended_by = {128 + one: one.name for one in signal.Signals}
        how = ended_by.get(code, f"exit code {code}")
        raise CalibrationFailed(
            f"{key} ended with {how}" if code else f"no bytes of {key} were seen on {gpu.name}",
            hint="let it run to its end, or use --seconds"
            if code
            else "does it run on the CPU, or on another GPU? see --device",
            details={"exit_code": code},
        )
    requests = args.requests if rskill is not None else 0
    entry = entries.entry_of(figures, source_of(record, requests, datetime.now(UTC)))
    _print(args, record, key, figures, entry)
    return OK


def _key_of_program(args: argparse.Namespace) -> str:
    key = args.name or re.sub(r"\s", "-", printable(Path(args.program[0]).name))
    key = key if "/" in key else f"local/{key}"
    if not KEY.fullmatch(key):
        args.parser.error(f"--name: expected NAME or OWNER/NAME without spaces, got {key!r}")
    return key


def _key_of_model(args: argparse.Namespace, rskill: Path) -> str:
    if args.name or args.seconds:
        args.parser.error("--name and --seconds belong to `-- COMMAND`")
    try:
        manifest = load_manifest(rskill)
    except ManifestError as error:
        raise ConfigError(str(error)) from error
    model.check(manifest)
    return f"{manifest.name}/{manifest.quantization.dtype}"


def _plan(
    args: argparse.Namespace, gpu: Gpu, rskill: Path, configs: Path, marks: Path
) -> model.Plan:
    sidecar = [
        *SIDECAR, "--name", "calibrate", "--no-arbiter", "--device", gpu.device,
        "--rskill", str(rskill), "--configs", str(configs),
    ]  # fmt: skip
    if args.allow_noncommercial:
        sidecar.append("--allow-noncommercial")
    if not gpu.device.startswith("fake:"):
        sidecar += ["--footprint", "0B,0B,0B"]  # its own bytes, without ballast
    return model.Plan(str(rskill), sidecar, args.requests, args.rest, str(marks))


def source_of(record: Record, requests: int, now: datetime) -> str:
    """Return the origin of the figures in words."""
    how = "bytes of its processes"
    if not record.listed:
        how = "growth of the used bytes, as the driver lists none by process"
    asked = f", {requests} requests" if requests else ""
    return (
        f"measured {now:%Y-%m-%d} on {record.gpu.name} (driver {record.gpu.driver}), {how}, "
        f"{record.readings_hz:.0f} readings/s{asked}, margin 2 % up to 48 MiB"
    )


# -- the run
async def _measure(args: argparse.Namespace, record: Record, command: list[str], name: str) -> int:
    """Run the program under an exclusive lease of the whole GPU. Returns its exit code."""
    gpu, name = record.gpu, name[:NAME_MAX_CHARS]
    room = 1 if args.no_arbiter else _room(gpu, args.endpoint)
    spec = RunSpec(
        command, name, room, gpu.uuid, runs.PRIORITY, args.wait, True, "priority", GRACE_S,
        environ=gpu.environ, limit_s=args.seconds, record=record,
    )  # fmt: skip
    if args.no_arbiter:
        return await runs.run_alone(spec)
    return await runs.run_leased(spec, args.endpoint)


def _room(gpu: Gpu, endpoint: str | None) -> int:
    """Return the bytes that a lease alone on the GPU can have now. Raises ConfigError, and what the
    arbiter answers."""
    reply = ask(Status(), endpoint)
    if not reply.get("ok"):
        raise from_wire(reply["error"])
    for view in reply["gpus"]:
        if view["gpu"] == gpu.uuid:
            kept = sum(process["residue_bytes"] or 0 for process in view["processes"])
            taken = view["reserve_bytes"] + view["stowaway_bytes"] + kept
            return int(max(1, view["capacity_bytes"] - taken))
    raise ConfigError(
        f"the arbiter does not lease {gpu.name} ({gpu.uuid})",
        hint="name one of its GPUs with --device, or use --no-arbiter",
    )


# -- output
def _print(
    args: argparse.Namespace, record: Record, key: str, found: Figures, entry: entries.Entry
) -> None:
    figures, gpu = {**asdict(found), "freed": found.freed}, record.gpu
    if args.as_json:
        answer = {
            "key": key,
            "gpu": {"uuid": gpu.uuid, "name": gpu.name, "driver": gpu.driver},
            "readings_per_s": round(record.readings_hz, 1),
            "requests": args.requests if args.manifest else 0,
            "by_process": record.listed,
            "bytes": figures,
            "entry": dict(entry),
        }
        print(json.dumps(answer, indent=2))
        return
    rows = [
        [name.replace("_", " "), format_bytes(count), what]
        for name, what in FIGURES.items()
        if (count := figures[name]) is not None
    ]
    print("\n".join(text.table(["FIGURE", "BYTES", "MEANING"], rows)))
    print(f"\n{entries.text_of(key, entry)}", end="")
