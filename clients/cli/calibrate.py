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
import sys
import tempfile
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from vram_arbiter.clients.calibration import entry as entries
from vram_arbiter.clients.calibration import model
from vram_arbiter.clients.calibration.gpu import Gpu, open_gpu
from vram_arbiter.clients.calibration.record import Record
from vram_arbiter.clients.cli import arguments
from vram_arbiter.clients.cli import run as runs
from vram_arbiter.clients.cli.replies import OK
from vram_arbiter.clients.configs import configs_folder, shipped
from vram_arbiter.clients.foreign.run_spec import RunSpec
from vram_arbiter.clients.net.request import ask, checked
from vram_arbiter.schemas.defaults import NAME_MAX_CHARS
from vram_arbiter.schemas.errors import CalibrationFailed, ConfigError
from vram_arbiter.schemas.manifest import ManifestError, load_manifest
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.wire.requests import Status

DESCRIPTIONS = {
    "calibrate": "Measure what a model needs on a GPU: vramctl calibrate MANIFEST loads it in a "
    "sidecar of its own, asks it, unloads it and ends it; vramctl calibrate -- COMMAND observes "
    "any program from its start to its end. Prints the entry for models/footprints.yaml, with a "
    "margin of 2 % (at most 48 MiB). Holds an exclusive lease of the GPU meanwhile, and ends when "
    "a request of a higher priority needs it."
}
SIDECAR: Final = (sys.executable, "-m", "vram_arbiter.sidecars")
MODEL: Final = (sys.executable, "-m", "vram_arbiter.clients.calibration.model")


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
        "--allow-noncommercial", action="store_true",
        help="measure a model whose license does not allow commercial use",
    )  # fmt: skip
    arguments.add_json(parser)
    arguments.add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    if bool(args.manifest) == bool(args.program):
        args.parser.error("expected either MANIFEST or `-- COMMAND`")
    named = args.manifest and Path(args.manifest)
    rskill = shipped(named, "rskills", configs_folder(os.environ)) if named else None
    key = _key_of_program(args) if rskill is None else _key_of_model(args, rskill)
    gpu = open_gpu(args.device)
    record, command = Record(gpu), list(args.program)
    with tempfile.TemporaryDirectory(prefix="vc") as folder:
        marks = Path(folder) / "marks.json"
        if rskill is not None:
            command = [*MODEL, json.dumps(asdict(_plan(args, gpu, rskill, marks)))]
        spec = RunSpec(
            command, f"vramctl calibrate {key}"[:NAME_MAX_CHARS], _room(gpu, args.endpoint),
            gpu.uuid, runs.PRIORITY, None, True, "priority", 10.0, environ=gpu.environ,
            limit_s=args.seconds, record=record,
        )  # fmt: skip
        code = asyncio.run(runs.run_leased(spec, args.endpoint))
        told = json.loads(marks.read_text()) if marks.exists() else {}
    if code:
        raise CalibrationFailed(f"{key} ended with exit code {code}", hint="see --seconds")
    figures = record.figures(told)
    if figures is None:
        hint = "does it run on the CPU, or on another GPU? see --device"
        raise CalibrationFailed(f"no bytes of {key} were seen on {gpu.name}", hint=hint)
    source = source_of(record, args.requests if rskill else 0, datetime.now(UTC))
    entry = entries.entry_of(figures, source)
    if args.as_json:
        answer = {"key": key, "gpu": gpu.uuid, "bytes": asdict(figures), "entry": entry}
        print(json.dumps(answer, indent=2))
    else:
        print(entries.text_of(key, entry), end="")
    return OK


def _key_of_program(args: argparse.Namespace) -> str:
    key = args.name or re.sub(r"\s", "-", printable(Path(args.program[0]).name))
    key = key if "/" in key else f"local/{key}"
    if not re.fullmatch(r"[^/\s]+/[^/\s]+", key):
        args.parser.error(f"--name: expected NAME or OWNER/NAME without spaces, got {key!r}")
    return key


def _key_of_model(args: argparse.Namespace, rskill: Path) -> str:
    if args.name or args.seconds:
        args.parser.error("--name and --seconds belong to `-- COMMAND`")
    try:
        manifest = load_manifest(rskill)
    except ManifestError as error:
        raise ConfigError(str(error)) from error
    if manifest.kind not in model.ASKED:
        raise ConfigError(f"no sidecar serves {manifest.name}, a {manifest.kind.value}")
    return f"{manifest.name}/{manifest.quantization.dtype}"


def _plan(args: argparse.Namespace, gpu: Gpu, rskill: Path, marks: Path) -> model.Plan:
    sidecar = [
        *SIDECAR, "--name", "calibrate", "--no-arbiter", "--device", gpu.device,
        "--rskill", str(rskill), "--configs", str(configs_folder(os.environ)),
    ]  # fmt: skip
    if args.allow_noncommercial:
        sidecar.append("--allow-noncommercial")
    if not gpu.device.startswith("fake:"):
        sidecar += ["--footprint", "0B,0B,0B"]  # its own bytes, without ballast
    return model.Plan(str(rskill), sidecar, args.requests, str(marks))


def source_of(record: Record, requests: int, now: datetime) -> str:
    """Return the origin of the figures in words."""
    how = "" if record.listed else "growth of the used bytes, "
    asked = f"{requests} requests, " if requests else ""
    return (
        f"measured {now:%Y-%m-%d} on {record.gpu.name} (driver {record.gpu.driver}), {how}{asked}"
        "margin 2 % up to 48 MiB"
    )


def _room(gpu: Gpu, endpoint: str | None) -> int:
    """Return the bytes that a lease alone on the GPU can have now. Raises ConfigError, and what the
    arbiter answers."""
    for view in checked(ask(Status(), endpoint))["gpus"]:
        if view["gpu"] == gpu.uuid:
            kept = sum(process["residue_bytes"] or 0 for process in view["processes"])
            taken = view["reserve_bytes"] + view["stowaway_bytes"] + kept
            return int(max(1, view["capacity_bytes"] - taken))
    hint = "name one of its GPUs with --device"
    raise ConfigError(f"the arbiter does not lease {gpu.name} ({gpu.uuid})", hint=hint)
