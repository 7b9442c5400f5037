"""What the commands of `vram-runner` share: where the arbiter, the sidecars and the skills are, and how a signal ends a command."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.clients.net.server import check_free
from vram_arbiter.runner.control.loop import ControlLoop
from vram_arbiter.runner.control.robot import Robot
from vram_arbiter.runner.goals import frames
from vram_arbiter.schemas import estop
from vram_arbiter.schemas.errors import ArbiterUnreachable, ConfigError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest

if TYPE_CHECKING:
    from vram_arbiter.runner.recording.recorder import DatasetRecorder

log = logging.getLogger("runner")

AS_FAST_AS_POSSIBLE_HZ = 30.0  # simulated rate when nothing is paced


def positive(text: str) -> float:
    """An argument that must be a positive number of seconds."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not positive")
    return value


def positive_int(text: str) -> int:
    """An argument that counts something."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not 1 or more")
    return value


def share(text: str) -> float:
    """An argument from 0 to 1."""
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text} is not between 0 and 1")
    return value


def not_negative(text: str) -> float:
    """An argument that must be 0 or more."""
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not 0 or more")
    return value


def add_trace_flag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--trace-ticks", type=share, default=1.0, metavar="RATIO",
        help="share of a goal's ticks that telemetry records, beyond those up to its first action; goals are recorded always",
    )  # fmt: skip


def add_serving_flags(parser: argparse.ArgumentParser) -> None:
    """Flags of every command that serves goals."""
    parser.add_argument(
        "--skills",
        type=Path,
        nargs="+",
        action="extend",
        help="rskill.yaml files or folders of them",
    )
    parser.add_argument(
        "--endpoint", help="where goals are served; default ipc://RUNTIME/runner.sock"
    )
    parser.add_argument("--arbiter", help="the arbiter's endpoint")
    parser.add_argument("--no-arbiter", action="store_true", help="nobody arbitrates: mark no uses")
    parser.add_argument(
        "--sidecar", action="append", default=[], metavar="RSKILL=ENDPOINT",
        help="where a policy's sidecar is; default ipc://RUNTIME/NAME.sock, NAME being what follows the first - of the skill's name",
    )  # fmt: skip
    parser.add_argument(
        "--realtime", action=argparse.BooleanOptionalAction, default=True,
        help="run the control loop before ordinary programs (SCHED_FIFO, or a lower nice value) where the machine allows it",
    )  # fmt: skip
    add_trace_flag(parser)
    parser.add_argument("--max-seconds", type=positive, help="stop by itself after so many seconds")


def sidecars_given(flags: list[str]) -> dict[str, str]:
    """`RSKILL=ENDPOINT` flags as a map. Raises ConfigError."""
    pairs = [flag.partition("=") for flag in flags]
    if wrong := [
        flag for flag, (name, _, where) in zip(flags, pairs, strict=True) if not name or not where
    ]:
        raise ConfigError(f"--sidecar {wrong[0]} is not of the form RSKILL=ENDPOINT")
    return {name: where for name, _, where in pairs}


def check_sidecars(given: Mapping[str, str], manifests: Iterable[RSkillManifest]) -> None:
    """An address for a skill that is not installed is a typing error; its skill would be looked for elsewhere. Raises ConfigError."""
    installed = [manifest.name for manifest in manifests if manifest.kind is Kind.VLA]
    for name in given:
        if name not in installed:
            raise ConfigError(
                f"--sidecar {name}: no such policy is installed",
                hint=f"there is {', '.join(installed) or 'none'}",
            )


def check_endpoint(endpoint: str) -> None:
    """Before a world begins or a robot has power: where no goal and no emergency stop can be served nothing may move. Raises ConfigError,
    AlreadyRunning."""
    check_free(endpoint)
    estop.path_of(endpoint)


def warm_up() -> None:
    """The first picture would otherwise wait for OpenCV's import."""
    import cv2
    import numpy as np

    cv2.setNumThreads(1)
    frames.encode(np.zeros((8, 8, 3), dtype=np.uint8), "png")


async def connect_arbiter(endpoint: str | None, stack: contextlib.AsyncExitStack) -> Any:
    """A plain client of the arbiter. A robot does not start half-safe: an arbiter that is missing is an error, said at once."""
    from vram_arbiter.clients.client import AsyncClient

    try:
        return await stack.enter_async_context(AsyncClient("runner", endpoint=endpoint))
    except ArbiterUnreachable as error:
        raise ArbiterUnreachable(
            error.message,
            hint="start `vram-arbiter` first, or run with --no-arbiter",
            details=error.details,
        ) from error


async def record_into[R: Robot](
    folder: Path,
    runner: ControlLoop[R],
    rate_hz: float,
    robot: str,
    stack: contextlib.AsyncExitStack,
) -> DatasetRecorder:
    """Record the runner's goals, from before its control thread starts until after it has ended. `rate_hz` 0: as fast as possible.

    Raises ConfigError for a folder or a rate that nothing can be recorded with, AlreadyRunning when somebody else records there.
    """
    from vram_arbiter.runner.recording.recorder import DatasetRecorder

    recorder = DatasetRecorder(
        folder,
        rate_hz=rate_hz or AS_FAST_AS_POSSIBLE_HZ,
        cameras=runner.camera_names,
        robot=robot,
        patient=rate_hz == 0,
    )
    log.info("starting the dataset's writer")
    try:
        await asyncio.to_thread(recorder.start)
    except asyncio.CancelledError:
        recorder.abort()  # else the thread goes on waiting
        raise
    stack.push_async_callback(asyncio.to_thread, recorder.close)
    runner.follow(recorder, save_dir=str(recorder.root))
    return recorder


def default_skills() -> Path:
    """Folder of the shipped manifests. Raises ConfigError where there is none."""
    folder = configs_folder(os.environ) / "rskills"
    if not folder.is_dir():
        raise ConfigError(
            f"no skills in {folder}", hint="name some with --skills, or set VRAM_ARBITER_CONFIGS"
        )
    return folder


def install_signals(stopping: asyncio.Event) -> None:
    """The first SIGTERM or SIGINT ends in order (the video is finished); a second one ends at once."""
    loop = asyncio.get_running_loop()

    def stop(number: signal.Signals) -> None:
        log.info("%s: ending", number.name)
        loop.remove_signal_handler(number)
        stopping.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop, number)
