"""Success rate of one skill or policy over seeds of a world.

The world runs on one worker thread and ticks only while a contestant has it: no time passes while a
model loads, so that the same seed is the same episode on any machine. Must not know the command
line or files other than videos.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any, Final

from vram_arbiter.runner.protocols import Goal, GoalParams, Skill, SkillEnded
from vram_arbiter.runner.sim.config import CONTROL_HZ
from vram_arbiter.runner.sim.robot import VIDEO_EVERY, SimRunner
from vram_arbiter.runner.sim.video import VideoRecorder
from vram_arbiter.schemas.errors import Cancelled, LimitExceeded, ModelError, VramError
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

log = logging.getLogger(__name__)

ERRORS_IN_A_ROW_MAX: Final = 3  # a missing sidecar will not be there for the next seed either

Told = tuple[str, GoalParams]
"""Prompt and parameters of a goal."""


def wilson(successes: int, of: int) -> tuple[float, float] | None:
    """Return Wilson's 95 % interval of a success rate; None without episodes.

    It is sensible for few episodes, and for zero or all successes.
    """
    if of == 0:
        return None
    from scipy.stats import binomtest

    interval = binomtest(successes, of).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


@dataclass(frozen=True, slots=True)
class SeedOutcome:
    """Outcome of one seed. `success` None: `error` tells why there is no verdict.

    An error of the contestant while it plays (`model_error`) is a failure; any other error (a
    missing sidecar, an environment that raised) is not a verdict.
    """

    seed: int
    success: bool | None
    steps: int = 0
    truncated: bool = False
    error: str = ""
    message: str = ""
    seconds: float = 0.0
    standing_steps: int = 0  # of `steps`: in the middle of the motion, without an action
    video: str | None = None
    trace_id: str | None = None  # of its span; None without telemetry


@dataclass(slots=True)
class Cell:
    """All episodes of one contestant in one world. `complete` False: stopped, or abandoned
    (`why`).
    """

    world: str
    contestant: str
    task: str | None
    revision: str = ""
    episodes: list[SeedOutcome] = field(default_factory=list)
    complete: bool = False
    why: str = ""

    def summary(self) -> JsonObject:
        """Sums, as they go into the report."""
        ran = [played for played in self.episodes if played.success is not None]
        stepped = [played for played in ran if played.steps]  # lerobot-eval does not tell them
        successes = sum(played.success is True for played in ran)
        return {
            "world": self.world,
            "contestant": self.contestant,
            "revision": self.revision,
            "task": self.task,
            "complete": self.complete,
            "why": self.why,
            "played": len(self.episodes),
            "judged": len(ran),
            "successes": successes,
            "errors": len(self.episodes) - len(ran),
            "success_rate": successes / len(ran) if ran else None,
            "interval_95": wilson(successes, len(ran)),
            "mean_steps": fmean(one.steps for one in stepped) if stepped else None,
            "mean_standing_steps": fmean(one.standing_steps for one in stepped)
            if stepped
            else None,
        }


class Benchmark:
    """`runner` ticks at its own rate; its episodes end with their skill.

    `told` returns the goal of an episode, on the worker thread. `episode_s` bounds an episode on
    the wall clock (a contestant that never acts, a world that hangs between two steps).
    """

    def __init__(
        self,
        runner: SimRunner,
        *,
        world: str,
        task: str | None = None,
        told: Callable[[], Told] = lambda: ("", {}),
        videos: Path | None = None,
        episode_s: float = 600.0,
    ) -> None:
        self.runner = runner
        self._world, self._task, self._told = world, task, told
        self._videos = videos
        self._episode_s = episode_s
        self._stopping = asyncio.Event()

    def stop(self) -> None:
        """Event loop: end after the present tick; what was played stays."""
        self._stopping.set()
        self.runner.request_stop()

    async def run(self, skill: Skill, seeds: Iterable[int]) -> Cell:
        """Play the seeds, then release the skill. Raises what the runner's start raises; later
        errors are an episode's.
        """
        cell = Cell(self._world, skill.key.rskill_id, self._task, skill.key.revision)
        with ThreadPoolExecutor(1, thread_name_prefix="benchmark") as worker:
            await self._on(worker, self.runner.activate)
            try:
                cell.why = await self._play(worker, cell, skill, seeds)
                cell.complete = not cell.why
                return cell
            finally:
                await self._on(worker, self.runner.deactivate)
                await _quietly(skill.release())

    async def _play(
        self, worker: ThreadPoolExecutor, cell: Cell, skill: Skill, seeds: Iterable[int]
    ) -> str:
        """Return why not all seeds were played; empty: they were."""
        for seed in seeds:
            stopped = self._stopping.is_set()
            if stopped or (played := await self._episode_of(worker, skill, seed)) is None:
                return "stopped"
            cell.episodes.append(played)
            log.info("%s, %s, seed %d: %s", cell.world, cell.contestant, seed, _verdict(played))
            last = cell.episodes[-ERRORS_IN_A_ROW_MAX:]
            if len(last) == ERRORS_IN_A_ROW_MAX and all(one.success is None for one in last):
                return f"given up after {len(last)} errors in a row: {played.message}"
        return ""

    async def _episode_of(
        self, worker: ThreadPoolExecutor, skill: Skill, seed: int
    ) -> SeedOutcome | None:
        """None: stopped in its middle."""
        began_s, name = time.monotonic(), skill.key.rskill_id
        recorder = self._recorder_of(name, seed)
        try:
            with tracing.span(telemetry.SPAN_EPISODE, attributes={telemetry.ATTR_SKILL: name}):
                traceparent = tracing.traceparent()
                trace_id = tracing.log_ids().get("trace_id")
                prompt, params = await self._on(worker, lambda: self._reset(seed))
                goal = Goal(
                    f"seed-{seed}", name, prompt=prompt, params=params, traceparent=traceparent
                )
                self.runner.caption = tuple(filter(None, (f"{name}, seed {seed}", prompt)))
                try:
                    await self._unless_stopped(skill.start(goal))
                    played = await self._on(
                        worker, lambda: self._episode(skill, goal, seed, recorder)
                    )
                finally:
                    await _quietly(skill.finish())
        except Cancelled:
            return None
        except VramError as error:
            played = SeedOutcome(seed, None, error=error.code, message=str(error))
        finally:
            self.runner.robot.video.recorder = None
            if recorder is not None:
                await asyncio.to_thread(recorder.close)
        seen = recorder is not None and recorder.written and not recorder.error
        return replace(
            played,
            seconds=round(time.monotonic() - began_s, 3),
            video=str(recorder.path) if recorder is not None and seen else None,
            trace_id=trace_id,
        )

    # -- worker thread
    def _reset(self, seed: int) -> Told:
        self.runner.robot.begin_episode(seed)
        self.runner.tick()
        return self._told()

    def _episode(
        self, skill: Skill, goal: Goal, seed: int, recorder: VideoRecorder | None
    ) -> SeedOutcome:
        """Tick until the episode is over. Raises Cancelled when the benchmark is stopped."""
        runner, robot, ended = self.runner, self.runner.robot, list[SkillEnded]()
        robot.video.recorder = recorder
        number, ends_s = robot.episode_idx, time.monotonic() + self._episode_s
        runner.begin_skill(skill, goal, ended.append)
        steps = 0
        with runner.paced() as wait:
            try:
                while robot.episode_idx == number:  # a skill that ends, ends the episode
                    if self._stopping.is_set() or time.monotonic() > ends_s:
                        raise self._cut_off()
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

    def _cut_off(self) -> VramError:
        if self._stopping.is_set():
            return Cancelled("the benchmark is to stop")
        problem = f"the episode is not over after {self._episode_s:.0f} s"
        return LimitExceeded(problem, details={"limit": "episode_seconds"})

    # -- helpers
    async def _on[T](self, worker: ThreadPoolExecutor, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(worker, work)

    async def _unless_stopped(self, work: Any) -> None:
        """Await, but raise Cancelled when the benchmark is stopped meanwhile."""
        task, stopping = asyncio.ensure_future(work), asyncio.ensure_future(self._stopping.wait())
        try:
            await asyncio.wait([task, stopping], return_when=asyncio.FIRST_COMPLETED)
            if not task.done():
                raise Cancelled("the benchmark is to stop")
            task.result()
        finally:
            for one in (task, stopping):
                one.cancel()
            await asyncio.gather(task, stopping, return_exceptions=True)

    def _recorder_of(self, contestant: str, seed: int) -> VideoRecorder | None:
        if self._videos is None:
            return None
        name = f"{file_name(self._world)}_{file_name(contestant)}_{seed}.mp4"
        return VideoRecorder(self._videos / name, fps=CONTROL_HZ / VIDEO_EVERY, wait=True)


def file_name(text: str) -> str:
    """Return a file name for any text."""
    return re.sub(r"[^A-Za-z0-9.-]+", "-", text).strip("-.")


def _verdict(played: SeedOutcome) -> str:
    word = {True: "success", False: "failure", None: "error"}[played.success]
    return f"{word} after {played.steps} steps" + (f" ({played.message})" if played.message else "")


async def _quietly(work: Any) -> None:
    try:
        await work
    except VramError as error:  # the verdict is what it is
        log.warning("the contestant did not leave cleanly: %s", error)
