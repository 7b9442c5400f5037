"""`vramctl calibrate`: measure what a model, or any program, needs on a GPU, as an entry of the
footprint file.

Beside a running arbiter it holds an exclusive lease of the GPU: no other model is resident
meanwhile, and its own sidecar or program is charged to that lease. A request of a robot goes first:
a revoke ends the calibration, and nothing is written.
"""

import argparse
import asyncio
import contextlib
import json
import os
import re
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from vram_arbiter.clients._protocol.records import Eviction
from vram_arbiter.clients.calibration import entry as entries
from vram_arbiter.clients.calibration.basis import Pace
from vram_arbiter.clients.calibration.gpu import Gpu, open_gpu
from vram_arbiter.clients.calibration.measure import (
    Asked,
    Measured,
    measure_model,
    measure_program,
)
from vram_arbiter.clients.cli import arguments, text
from vram_arbiter.clients.cli.replies import OK
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.configs import configs_folder, shipped
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.defaults import NAME_MAX_CHARS
from vram_arbiter.schemas.errors import (
    ArbiterUnreachable,
    CalibrationFailed,
    ConfigError,
    VramError,
)
from vram_arbiter.schemas.manifest import ManifestError, RSkillManifest, load_manifest
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec
from vram_arbiter.schemas.yamltext import read_yaml

DESCRIPTIONS = {
    "calibrate": "Measure what a model needs on a GPU: vramctl calibrate MANIFEST loads it in a "
    "sidecar of its own, asks it, unloads it and ends it; vramctl calibrate -- COMMAND observes "
    "any program from its start to its end. Prints the figures and the entry for "
    "models/footprints.yaml, with a margin of 2 % (at most 48 MiB). Holds an exclusive lease of "
    "the GPU meanwhile, and ends when a request of a higher priority needs it."
}
PRIORITY = 40
"""As `vramctl run`: a robot's models go first."""
RATE_MIN_HZ = 20.0
PATIENCE_S = 1.0
KEY = re.compile(r"[^/\s]+/[^/\s]+")
FIGURES = (
    ("context", "an empty context, which no unload gives back"),
    ("load_peak", "the most while it loads"),
    ("steady", "resident before the first request; of a program, the median of its last quarter"),
    ("inference_peak", "the most while it answers; of a program, in its last quarter"),
    ("retained", "left after an unload"),
    ("freed", "given back by the unload, or by the program's end"),
    ("after_exit", "left after the end of its processes"),
)


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    add = parser.add_argument
    add("manifest", nargs="?", metavar="MANIFEST", help="rskill.yaml, or a shipped skill's name")
    add(
        "--device",
        metavar="fake:FOLDER|cuda[:N]",
        help="default: fake:$VRAM_FAKE_GPU if set, else cuda, the first GPU",
    )
    add(
        "--requests",
        type=arguments.count(0, 10_000),
        default=20,
        metavar="N",
        help="requests to the model; 0: no inference peak (default: %(default)s)",
    )
    add(
        "--pictures",
        type=Path,
        metavar="DIR",
        help="PNG and JPEG files for the requests (default: noise)",
    )
    add("--prompt", help="task, question or objects of the requests (default: the manifest's)")
    add(
        "--seconds",
        type=arguments.at_least(1.0),
        metavar="S",
        help="end COMMAND after this time, for a server (default: it ends by itself)",
    )
    add(
        "--name",
        type=arguments.name,
        metavar="[OWNER/]NAME",
        help="key of COMMAND's entry (default: PROGRAM); without an owner it is local/NAME",
    )
    add(
        "--rate",
        type=arguments.at_least(RATE_MIN_HZ, 1000.0),
        default=50.0,
        metavar="HZ",
        help="readings of the GPU a second (default: %(default)s)",
    )
    add(
        "--rest",
        type=arguments.at_least(0.05, 60.0),
        default=2.0,
        metavar="S",
        help="bytes are at rest when unchanged for this long (default: %(default)s)",
    )
    add("--write", type=Path, metavar="FILE", help="write the entry to this footprint file")
    add("--configs", type=Path, metavar="DIR", help="folder of shipped skills and models")
    add(
        "--allow-noncommercial",
        action="store_true",
        help="measure a model whose license does not allow commercial use",
    )
    add("--no-arbiter", action="store_true", help="measure without a lease, if no arbiter runs")
    add(
        "--wait",
        type=arguments.at_least(0.0),
        metavar="SECONDS",
        help="give up waiting for the lease after this time (default: never)",
    )
    arguments.add_json(parser)
    arguments.add_endpoint(parser)


@dataclass(frozen=True, slots=True)
class Target:
    """What is measured: `key` of its entry, and the manifest of a model."""

    key: str
    manifest: RSkillManifest | None
    rskill: Path | None = None


def run(args: argparse.Namespace) -> int:
    if bool(args.manifest) == bool(args.program):
        args.parser.error("expected either MANIFEST or `-- COMMAND`")
    configs = args.configs or configs_folder(os.environ)
    target = _target(args, configs)
    if args.write is not None:
        check_writable(args.write, target)
    gpu = open_gpu(args.device)
    pace = Pace(args.rate, args.rest)

    async def work() -> Measured:
        if target.manifest is None:
            return await measure_program(gpu, pace, args.program, args.seconds, _say)
        words = ["--rskill", str(target.rskill), "--configs", str(configs)]
        if args.allow_noncommercial:
            words.append("--allow-noncommercial")
        if not gpu.device.startswith("fake:"):
            words += ["--footprint", "0B,0B,0B"]  # its own bytes, without ballast
        asked = Asked(args.requests, args.pictures, args.prompt)
        return await measure_model(gpu, pace, target.manifest, words, asked, _say)

    try:
        measured = asyncio.run(_in_peace(args, gpu, target.key, work))
    except asyncio.CancelledError:  # by SIGTERM
        return 128 + signal.SIGTERM
    source = source_of(gpu, measured, datetime.now(UTC))
    entry = entries.entry_of(measured.figures, source)
    if args.write is not None:
        entries.write(args.write, target.key, entry)
    _print(args, gpu, target, measured, entry)
    return OK


def _target(args: argparse.Namespace, configs: Path) -> Target:
    if args.program:
        key = args.name or re.sub(r"\s", "-", printable(Path(args.program[0]).name))
        key = key if "/" in key else f"local/{key}"
        if not KEY.fullmatch(key):
            args.parser.error(f"--name: expected NAME or OWNER/NAME without spaces, got {key!r}")
        return Target(key, None)
    if args.name or args.seconds:
        args.parser.error("--name and --seconds belong to `-- COMMAND`")
    rskill = shipped(Path(args.manifest), "rskills", configs)
    try:
        manifest = load_manifest(rskill)
    except ManifestError as error:
        raise ConfigError(str(error)) from error
    return Target(f"{manifest.name}/{manifest.quantization.dtype}", manifest, rskill)


def check_writable(path: Path, target: Target) -> None:
    """Raise ConfigError before anything is measured, where the entry could not be written."""
    if not path.parent.is_dir():
        raise ConfigError(f"--write {path}: {path.parent} is not a directory")
    if not path.exists():
        return
    found = read_yaml(path).data
    keys = {target.key, target.key.rpartition("/")[0]} if target.manifest else {target.key}
    for key in keys:
        old = found.get(key) if isinstance(found, dict) else None
        if isinstance(old, dict) and old.get("stands_for"):
            raise ConfigError(
                f"--write {path}: {key} stands for {old['stands_for']}: its bytes are another "
                "model's",
                hint=f"calibrate {old['stands_for']}, or write to another file",
            )
    entries.merged(path.read_text(), str(path), target.key, {"source": "a trial"})


def source_of(gpu: Gpu, measured: Measured, now: datetime) -> str:
    """Return the origin of the figures in words."""
    how = (
        "bytes of its processes"
        if measured.basis.listed
        else "growth of the used bytes, as the driver lists none by process"
    )
    asked = f", {measured.requests} requests" if measured.requests else ""
    return (
        f"measured {now:%Y-%m-%d} on {gpu.name} (driver {gpu.driver}), {how}, "
        f"{measured.rate_hz:.0f} readings/s{asked}, margin 2 % up to 48 MiB"
    )


# -- the lease
async def _in_peace(
    args: argparse.Namespace, gpu: Gpu, key: str, work: Callable[[], Awaitable[Measured]]
) -> Measured:
    """Do the work under an exclusive lease; SIGTERM cancels it."""
    task = asyncio.current_task()
    assert task is not None, "asyncio.run made one"
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    if args.no_arbiter:
        return await work()
    name = f"vramctl calibrate {key}"[:NAME_MAX_CHARS]
    async with contextlib.AsyncExitStack() as stack:
        try:
            client = await stack.enter_async_context(AsyncClient(name, endpoint=args.endpoint))
        except ArbiterUnreachable as error:
            raise ArbiterUnreachable(
                error.message, hint="start it, or use --no-arbiter where none runs"
            ) from error
        left = await stack.enter_async_context(_exclusive(client, gpu, name, args.wait))
        working = asyncio.ensure_future(work())
        try:
            both: set[asyncio.Future[Any]] = {working, left}
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            if not working.done():
                raise CalibrationFailed(
                    f"the GPU is needed: {left.result()}",
                    hint="nothing was written; calibrate again while the robot is idle",
                )
            return working.result()
        finally:
            working.cancel()
            await asyncio.wait({working})  # its program has ended then


@contextlib.asynccontextmanager
async def _exclusive(
    client: AsyncClient, gpu: Gpu, name: str, wait_s: float | None
) -> AsyncIterator["asyncio.Future[str]"]:
    """Hold the whole GPU. Gives a future of the reason why the lease has to be left."""
    left: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    over = asyncio.Event()

    def leave(reason: str) -> None:
        if not left.done():
            left.set_result(reason)

    async def revoked(lease: AsyncLease, eviction: Eviction) -> None:
        leave(eviction.reason)

    async def lost(lease: AsyncLease, error: VramError) -> None:
        leave(str(error))

    room = await _room(client, gpu)
    spec = LeaseSpec(
        consumer=name,
        model_id=name,
        gpu=gpu.uuid,
        mode="exclusive",
        footprint=Footprint(load_peak_bytes=room, steady_bytes=room, residue_bytes=0),
        priority=PRIORITY,
    )
    acquiring = asyncio.ensure_future(
        client.acquire(spec, wait_s, unload=over.wait, on_revoke=revoked, on_lost=lost)
    )
    try:
        done, _ = await asyncio.wait({acquiring}, timeout=PATIENCE_S)
        if not done:
            for waiting in (await client.why(name)).leases:
                if waiting.state == "queued":
                    _say(f"waiting for the GPU: {waiting.text}")
        lease = await acquiring
    finally:
        acquiring.cancel()
    await lease.ready()
    try:
        async with lease.use("calibrate"):
            yield left
    finally:
        over.set()
        with contextlib.suppress(VramError):
            await lease.release()


async def _room(client: AsyncClient, gpu: Gpu) -> int:
    """Return the bytes that a lease alone on the GPU can have now. Raises ConfigError."""
    for view in (await client.status()).gpus:
        if view.gpu == gpu.uuid:
            kept = sum(process.residue_bytes or 0 for process in view.processes)
            return max(1, view.capacity_bytes - view.reserve_bytes - view.stowaway_bytes - kept)
    raise ConfigError(
        f"the arbiter does not lease {gpu.name} ({gpu.uuid})",
        hint="name one of its GPUs with --device, or use --no-arbiter",
    )


# -- output
def _print(
    args: argparse.Namespace, gpu: Gpu, target: Target, measured: Measured, entry: entries.Entry
) -> None:
    figures = {**asdict(measured.figures), "freed": measured.figures.freed}
    if args.as_json:
        answer = {
            "key": target.key,
            "gpu": {"uuid": gpu.uuid, "name": gpu.name, "driver": gpu.driver},
            "readings_per_s": round(measured.rate_hz, 1),
            "requests": measured.requests,
            "by_process": measured.basis.listed,
            "bytes": figures,
            "entry": dict(entry),
            "written": None if args.write is None else str(args.write),
        }
        print(json.dumps(answer, indent=2))
        return
    rows = [
        [name.replace("_", " "), format_bytes(count), what]
        for name, what in FIGURES
        if (count := figures[name]) is not None
    ]
    print("\n".join(text.table(["FIGURE", "BYTES", "MEANING"], rows)))
    print()
    print(entries.text_of(target.key, entry), end="")
    if args.write is not None:
        print(f"\nwritten to {args.write}")


def _say(said: str) -> None:
    print(f"vramctl calibrate: {printable(said)}", file=sys.stderr)
