"""Arguments and parts that the commands of `vram-runner` share."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
import signal
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vram_arbiter.clients.cli.arguments import at_least
from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.clients.net.server import check_free
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.build import build, manifest_file
from vram_arbiter.runner.goals.catalogue import EXECUTABLE, sidecar_endpoint
from vram_arbiter.runner.sensors.pictures import encode
from vram_arbiter.schemas import estop
from vram_arbiter.schemas.errors import ArbiterUnreachable, ConfigError
from vram_arbiter.schemas.manifest import (
    LICENSE_FLAG,
    LICENSE_HELP,
    Kind,
    RSkillManifest,
    load_manifest,
)

if TYPE_CHECKING:
    pass

log = logging.getLogger("runner")

AS_FAST_AS_POSSIBLE_HZ = 30.0  # simulated rate when nothing is paced


def add_trace_flag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--trace-ticks", type=at_least(0.0, 1.0), default=1.0, metavar="RATIO",
        help="share of a goal's ticks that telemetry records after its first action;"
        " goals are always recorded",
    )  # fmt: skip


def add_license_flag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(LICENSE_FLAG, action="store_true", help=LICENSE_HELP)


def unlicensed(manifests: Iterable[RSkillManifest], *, allow_noncommercial: bool) -> dict[str, str]:
    """Return the skills whose license forbids running them, by name, with the reason."""
    found = {
        manifest.name: manifest.license_refusal(allow_noncommercial=allow_noncommercial)
        for manifest in manifests
        if manifest.kind in EXECUTABLE
    }
    return {name: why for name, why in found.items() if why}


def add_skill_flags(parser: argparse.ArgumentParser) -> None:
    """Flags of every command that executes skills."""
    parser.add_argument(
        "--skills", type=Path, nargs="+", action="extend",
        help="rskill.yaml files or folders of them",
    )  # fmt: skip
    parser.add_argument("--arbiter", help="the arbiter's endpoint")
    parser.add_argument(
        "--no-arbiter", action="store_true", help="run without an arbiter and leases"
    )
    parser.add_argument(
        "--sidecar", action="append", default=[], metavar="MANIFEST|RSKILL=ENDPOINT",
        help="a manifest to start the sidecar from (file, folder or shipped skill), or a skill's"
        " name and the address of its sidecar; default address ipc://RUNTIME/NAME.sock,"
        " where NAME is the part of the skill's name after the first -",
    )  # fmt: skip
    add_license_flag(parser)
    add_trace_flag(parser)


def add_serving_flags(parser: argparse.ArgumentParser) -> None:
    """Flags of every command that serves goals."""
    add_skill_flags(parser)
    parser.add_argument(
        "--endpoint", help="where goals are served; default ipc://RUNTIME/runner.sock"
    )
    parser.add_argument(
        "--realtime", action=argparse.BooleanOptionalAction, default=True,
        help="run the control loop before ordinary programs (SCHED_FIFO, or a lower nice value)"
        " if the machine allows it",
    )  # fmt: skip


def sidecars_given(flags: list[str]) -> dict[str, str]:
    """`--sidecar` as a map from skills to addresses. Raises ConfigError, ManifestError."""
    given = {}
    for flag in flags:
        name, equals, where = flag.partition("=")
        if not equals and (file := manifest_file(flag)) is not None:
            name = load_manifest(file).name
            where = sidecar_endpoint(name, {}, os.environ)
        if not name or not where:
            raise ConfigError(f"--sidecar {flag} is not of the form RSKILL=ENDPOINT")
        given[name] = where
    return given


async def start_sidecars(args: argparse.Namespace, stack: contextlib.AsyncExitStack) -> None:
    """Start the sidecars that are given as manifests and not served, until the stack ends. Raises
    what `build` raises.

    Called before signals are handled: one ends the program also while a sidecar starts.
    """
    arbiter, licensed = "none" if args.no_arbiter else args.arbiter, args.allow_noncommercial
    for file in (manifest_file(flag) for flag in args.sidecar if "=" not in flag):
        if file is not None:
            started = build(file, SidecarClient, arbiter=arbiter, allow_noncommercial=licensed)
            await stack.enter_async_context(started)


def check_sidecars(given: Mapping[str, str], manifests: Iterable[RSkillManifest]) -> None:
    """Raise ConfigError for the address of a skill that is not installed: it is a typing error."""
    served = (Kind.VLA, Kind.DETECTOR)
    installed = [manifest.name for manifest in manifests if manifest.kind in served]
    for name in given:
        if name not in installed:
            raise ConfigError(
                f"no such policy or detector is installed: {name}",
                hint=f"there is {', '.join(installed) or 'none'}",
            )


def check_endpoint(endpoint: str) -> None:
    """Raise ConfigError or AlreadyRunning where goals or emergency stops cannot be served.

    Checked before a world begins or a robot has power: without them nothing may move.
    """
    check_free(endpoint)
    estop.path_of(endpoint)


def warm_up() -> None:
    """Import and warm OpenCV before the first picture needs it."""
    import cv2
    import numpy as np

    cv2.setNumThreads(1)
    encode(np.zeros((8, 8, 3), dtype=np.uint8), "png")


async def connect_arbiter(endpoint: str | None, stack: contextlib.AsyncExitStack) -> Any:
    """Connect a plain client of the arbiter.

    Raises ArbiterUnreachable: a robot does not start half-safe.
    """
    from vram_arbiter.clients.client import AsyncClient

    try:
        return await stack.enter_async_context(AsyncClient("runner", endpoint=endpoint))
    except ArbiterUnreachable as error:
        raise ArbiterUnreachable(
            error.message,
            hint="start `vram-arbiter` first, or run with --no-arbiter",
            details=error.details,
        ) from error


async def lease_rendering(arbiter: Any, stack: contextlib.AsyncExitStack) -> None:
    """Lease what rendering takes of a GPU, before the first picture is rendered."""
    from vram_arbiter.runner.gpu_lease import RENDERER_BYTES, RENDERING, gpu_lease, rendering_gpu

    gpu = rendering_gpu(os.environ)
    await stack.enter_async_context(gpu_lease(arbiter, gpu, RENDERING, RENDERER_BYTES))


def default_skills() -> Path:
    """Folder of the shipped manifests. Raises ConfigError where there is none."""
    folder = configs_folder(os.environ) / "rskills"
    if not folder.is_dir():
        raise ConfigError(
            f"no skills in {folder}", hint="name some with --skills, or set VRAM_ARBITER_CONFIGS"
        )
    return folder


def announce(endpoint: str) -> None:
    """Say that clients may connect, on stderr: stdout is the run's result."""
    print(f"serving goals on {endpoint}", file=sys.stderr, flush=True)


def install_signals(stopping: asyncio.Event) -> None:
    """End in order on the first SIGTERM or SIGINT (the video is finished), at once on the
    second.
    """
    loop = asyncio.get_running_loop()

    def stop(number: signal.Signals) -> None:
        log.info("%s: ending", number.name)
        loop.remove_signal_handler(number)
        stopping.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop, number)
