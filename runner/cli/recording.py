"""The recording of a command: its flags, its recorder and its check."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vram_arbiter.runner.cli.common import AS_FAST_AS_POSSIBLE_HZ
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.protocols import InferenceRunner
from vram_arbiter.runner.robots.units import LerobotUnits
from vram_arbiter.schemas.errors import ConfigError, FrameStale, InternalError, ModelError

if TYPE_CHECKING:
    from vram_arbiter.runner.recording.recorder import DatasetRecorder
    from vram_arbiter.runner.sim.robot import SimRunner

log = logging.getLogger("runner")

SAMPLE_TRIES = 100  # ticks of a world that is being set up


def add_record_flags(parser: argparse.ArgumentParser, what: str) -> None:
    parser.add_argument(
        "--record", type=Path, metavar="DIR",
        help=f"write {what} as an episode of the LeRobotDataset in this folder, which is new or has"
        " an earlier recording",
    )  # fmt: skip
    parser.add_argument(
        "--record-format", choices=("full", "lerobot"), default="full",
        help="columns of the dataset: all, or those of lerobot-record with its names and units",
    )  # fmt: skip


async def record_sim(
    args: argparse.Namespace,
    runner: SimRunner,
    rate_hz: float,
    on_lost: Callable[[], None],
    stack: contextlib.AsyncExitStack,
    *,
    robot: str,
    strict: bool = False,
) -> DatasetRecorder | None:
    """Record a simulated robot as the flags ask for, see `record_into`; None: they do not."""
    if args.record is None:
        if args.record_format != "full":
            raise ConfigError("--record-format is for --record DIR")
        return None
    from vram_arbiter.runner.robots.so101 import lerobot_units_of

    described = runner.robot.env.robot
    units = lerobot_units_of(described) if args.record_format == "lerobot" else None
    if args.record_format == "lerobot" and units is None:
        raise ConfigError(f"--record-format lerobot: lerobot has no units of a {described.name}")
    return await record_into(
        args.record, runner, on_lost, stack, rate_hz, robot, units, strict=strict
    )


async def record_into(
    folder: Path,
    runner: InferenceRunner,
    on_lost: Callable[[], None],
    stack: contextlib.AsyncExitStack,
    rate_hz: float,
    robot: str,
    lerobot: LerobotUnits | None,
    *,
    strict: bool = False,
) -> DatasetRecorder:
    """Record the runner's goals, from before its control thread starts until after it has ended.

    Args: `rate_hz` 0 records as fast as possible; `lerobot`: by lerobot's names and units, with its
    columns only; `strict`: it is played for the recording alone. `on_lost` is called on the event
    loop when nothing more can be recorded, or after the first loss of a strict recording. Raises
    ConfigError for a folder, a rate or a dataset that does not fit, AlreadyRunning when another
    program records there.
    """
    from vram_arbiter.runner.recording.recorder import DatasetRecorder

    loop = asyncio.get_running_loop()

    def lost() -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended, and with it the session
            loop.call_soon_threadsafe(on_lost)

    recorder = DatasetRecorder(
        folder,
        rate_hz=rate_hz or AS_FAST_AS_POSSIBLE_HZ,
        cameras=runner.camera_names(),
        robot=robot,
        lerobot=lerobot,
        patient=rate_hz == 0,
        strict=strict,
        on_lost=lost,
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


async def check_recording(recorder: DatasetRecorder, control: ControlThread) -> None:
    """Compare the robot's columns with an existing dataset, before a goal is taken.

    Raises ConfigError that says what differs, or why nothing could be recorded.
    """
    from vram_arbiter.runner.recording.sample import sample_of

    for _ in range(SAMPLE_TRIES):
        try:
            sample: Any = await control.call(lambda: sample_of(control.runner))
        except (FrameStale, ModelError) as error:
            hint = "choose an encoding with colors for this camera, or leave it out"
            raise ConfigError(f"nothing could be recorded: {error.message}", hint=hint) from error
        if sample is not None:
            await asyncio.to_thread(recorder.check, sample)
            return
    raise InternalError(f"the robot showed no state in {SAMPLE_TRIES} ticks")


async def conclude_recording(recorder: DatasetRecorder | None) -> None:
    """Raise what was lost for good."""
    if recorder is not None and recorder.lost is not None:
        raise recorder.lost
