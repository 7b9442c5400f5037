"""Plays seeds of one world with one skill or policy.

The world runs on one worker thread and ticks only while a contestant has it: no time passes while a
model loads, so that the same seed is the same episode on any machine, whichever seeds came before.
Must not know the command line or files other than videos.
"""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from vram_arbiter.runner.benchmark.outcomes import SeedOutcome, file_name
from vram_arbiter.runner.protocols import Goal, GoalParams, Skill, SkillEnded
from vram_arbiter.runner.sim.config import CONTROL_HZ
from vram_arbiter.runner.sim.robot import VIDEO_EVERY, SimRunner
from vram_arbiter.runner.sim.video import VideoRecorder
from vram_arbiter.schemas.errors import LimitExceeded, ModelError, VramError
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

log = logging.getLogger(__name__)

Told = tuple[str, GoalParams]
"""Prompt and parameters of a goal."""


class Player:
    """`async with player: outcome = await player.play(seed)`, one seed after the other.

    `runner` ticks at its own rate; its episodes end with their skill. `told` returns the goal of an
    episode, on the worker thread. `episode_s` bounds an episode on the wall clock (a contestant
    that never acts, a world that hangs between two steps).
    """

    def __init__(
        self,
        runner: SimRunner,
        skill: Skill,
        *,
        world: str,
        told: Callable[[], Told] = lambda: ("", {}),
        videos: Path | None = None,
        episode_s: float = 600.0,
    ) -> None:
        self.runner = runner
        self._skill = skill
        self._world, self._told = world, told
        self._videos = videos
        self._episode_s = episode_s
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="player")

    async def __aenter__(self) -> Self:
        """Raises what the runner's start raises; later errors are an episode's."""
        await self._on_thread(self.runner.activate)
        return self

    async def __aexit__(self, *_: object) -> None:
        """Release the skill."""
        try:
            await self._on_thread(self.runner.deactivate)
            await _quietly(self._skill.release())
        finally:
            self._thread.shutdown()

    async def play(self, seed: int) -> SeedOutcome:
        began_s, name = time.monotonic(), self._skill.key.rskill_id
        recorder = self._recorder_of(seed)
        try:
            with tracing.span(telemetry.SPAN_EPISODE, attributes={telemetry.ATTR_SKILL: name}):
                traceparent = tracing.traceparent()
                trace_id = tracing.log_ids().get("trace_id")
                prompt, params = await self._on_thread(lambda: self._reset(seed))
                goal = Goal(
                    f"seed-{seed}", name, prompt=prompt, params=params, traceparent=traceparent
                )
                self.runner.caption = tuple(filter(None, (f"{name}, seed {seed}", prompt)))
                try:
                    await self._skill.start(goal)
                    played = await self._on_thread(lambda: self._episode(goal, seed, recorder))
                finally:
                    await _quietly(self._skill.finish())
        except VramError as error:
            played = SeedOutcome(seed, None, error=error.code, message=str(error))
        finally:
            self.runner.robot.video.recorder = None
            if recorder is not None:
                await asyncio.to_thread(recorder.close)
        return replace(
            played,
            seconds=round(time.monotonic() - began_s, 3),
            video=None if recorder is None else self._keep(recorder, seed),
            trace_id=trace_id,
        )

    # -- worker thread
    def _reset(self, seed: int) -> Told:
        self.runner.robot.begin_episode(seed)
        self.runner.tick()
        return self._told()

    def _episode(self, goal: Goal, seed: int, recorder: VideoRecorder | None) -> SeedOutcome:
        """Tick until the episode is over."""
        runner, robot, ended = self.runner, self.runner.robot, list[SkillEnded]()
        robot.video.recorder = recorder
        number, ends_s = robot.episode_idx, time.monotonic() + self._episode_s
        runner.begin_skill(self._skill, goal, ended.append)
        steps = 0
        with runner.paced() as wait:
            try:
                while robot.episode_idx == number:  # a skill that ends, ends the episode
                    if time.monotonic() > ends_s:
                        raise LimitExceeded(
                            f"the episode is not over after {self._episode_s:.0f} s",
                            details={"limit": "episode_seconds"},
                        )
                    tick = runner.tick()
                    steps += 1
                    wait()
            except VramError:
                runner.end_skill()
                raise
        error = ended[0].error if "episode" not in ended[0].data else None
        if error is not None and not isinstance(error, ModelError | LimitExceeded):
            raise error  # the episode may not even be one
        return SeedOutcome(
            seed,
            False if error is not None else tick.success,
            steps=steps,
            standing_steps=ended[0].data.get("standing_steps", 0),
            truncated=bool(tick.truncated),
            error=error.code if error is not None else "",
            message=str(error) if error is not None else "",
        )

    # -- helpers
    async def _on_thread[T](self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)

    # -- video
    def _recorder_of(self, seed: int) -> VideoRecorder | None:
        """Film into a file of this episode alone: another process may play the same seed."""
        if self._videos is None:
            return None
        path = self._videos / f".{secrets.token_hex(4)}.{self._video_name(seed)}"
        return VideoRecorder(path, fps=CONTROL_HZ / VIDEO_EVERY, wait=True)

    def _keep(self, recorder: VideoRecorder, seed: int) -> str | None:
        """Give a video its name once it is whole: a result names no other."""
        if not recorder.written or recorder.error:
            recorder.path.unlink(missing_ok=True)
            return None
        named = recorder.path.with_name(self._video_name(seed))
        os.replace(recorder.path, named)
        return f"{named.parent.name}/{named.name}"

    def _video_name(self, seed: int) -> str:
        return f"{file_name(self._world)}_{file_name(self._skill.key.rskill_id)}_{seed}.mp4"


async def _quietly(work: Any) -> None:
    try:
        await work
    except VramError as error:  # the verdict is what it is
        log.warning("the contestant did not leave cleanly: %s", error)
