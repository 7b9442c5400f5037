"""The recording of a serving command: its flags, its recorder, its check and its upload."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vram_arbiter.runner.cli.common import AS_FAST_AS_POSSIBLE_HZ
from vram_arbiter.runner.control.loop import ControlLoop
from vram_arbiter.runner.control.robot import Robot
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.robots.units import LerobotUnits
from vram_arbiter.schemas.errors import ConfigError, FrameStale, InternalError, ModelError

if TYPE_CHECKING:
    from vram_arbiter.runner.recording.recorder import DatasetRecorder

log = logging.getLogger("runner")

SAMPLE_TRIES = 100  # ticks of a world that is being set up


@dataclass(frozen=True, slots=True)
class Recording:
    """What is to be recorded, and into which folder.

    `rate_hz` 0 records as fast as possible. `joints` empty: not known before the first tick.
    `lerobot`: by lerobot's names and units, with its columns only. `strict` ends the session with
    the first episode that cannot be recorded.
    """

    folder: Path
    rate_hz: float
    robot: str
    joints: tuple[str, ...] = ()
    lerobot: LerobotUnits | None = None
    strict: bool = False


def add_push_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--push-to-hub", metavar="OWNER/NAME",
        help="upload the recorded dataset to this repository of the Hugging Face hub at the end",
    )  # fmt: skip
    parser.add_argument(
        "--push-private", action="store_true", help="make the hub's repository private"
    )


def lerobot_units_for(units: LerobotUnits | None, robot: str) -> LerobotUnits:
    """Return the units. Raises ConfigError for a robot that lerobot does not know."""
    if units is None:
        raise ConfigError(
            f"lerobot has no names and units for {robot}", hint="record it in the format `full`"
        )
    return units


async def record_into[R: Robot](
    what: Recording,
    runner: ControlLoop[R],
    on_lost: Callable[[], None],
    stack: contextlib.AsyncExitStack,
) -> DatasetRecorder:
    """Record the runner's goals, from before its control thread starts until after it has ended.

    `on_lost` is called on the event loop when nothing more can be recorded. Raises ConfigError for
    a folder, a rate or a dataset that does not fit, AlreadyRunning when another program records
    there.
    """
    from vram_arbiter.runner.recording.recorder import DatasetRecorder

    loop = asyncio.get_running_loop()

    def lost() -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended, and with it the session
            loop.call_soon_threadsafe(on_lost)

    recorder = DatasetRecorder(
        what.folder,
        rate_hz=what.rate_hz or AS_FAST_AS_POSSIBLE_HZ,
        cameras=runner.camera_names,
        robot=what.robot,
        joints=what.joints,
        lerobot=what.lerobot,
        patient=what.rate_hz == 0,
        strict=what.strict,
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


async def check_recording[R: Robot](
    recorder: DatasetRecorder, control: ControlThread, runner: ControlLoop[R]
) -> None:
    """Compare the robot's columns with an existing dataset, before a goal is taken.

    Raises ConfigError that says what differs, or why nothing could be recorded.
    """
    from vram_arbiter.runner.recording.sample import sample_of

    for _ in range(SAMPLE_TRIES):
        try:
            sample = await control.call(lambda: sample_of(runner))
        except (FrameStale, ModelError) as error:
            hint = "choose an encoding with colors for this camera, or leave it out"
            raise ConfigError(f"nothing could be recorded: {error.message}", hint=hint) from error
        if sample is not None:
            await asyncio.to_thread(recorder.check, sample)
            return
    raise InternalError(f"the robot showed no state in {SAMPLE_TRIES} ticks")


async def conclude_recording(recorder: DatasetRecorder | None, args: argparse.Namespace) -> None:
    """Upload the dataset if asked to, once the writer has ended. Raises what was lost for good."""
    if recorder is None:
        return
    if recorder.lost is not None:
        raise recorder.lost
    if args.push_to_hub is not None:
        from vram_arbiter.runner.recording.push import push

        log.info("pushing %s to %s", recorder.root, args.push_to_hub)
        episodes = await asyncio.to_thread(
            lambda: push(recorder.root, args.push_to_hub, private=args.push_private)
        )
        log.info("pushed %d episodes to %s", episodes, args.push_to_hub)
