"""Success rate of one contestant (an installed skill or a policy) over seeds of a world.

The world runs on one worker thread and ticks only while a contestant has it: no time passes while a
model loads, so that the same seed is the same episode on any machine. Must not know the command
line or files other than videos.
"""

from __future__ import annotations

import asyncio
import logging
import math
import re
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Protocol, TypedDict

from vram_arbiter.runner.protocols import Goal, GoalParams, Skill, SkillEnded, Stepped
from vram_arbiter.runner.recording.video import VideoRecorder
from vram_arbiter.runner.sim.environment import Environment
from vram_arbiter.runner.sim.policies import Policy
from vram_arbiter.runner.sim.robot import SimRunner
from vram_arbiter.schemas.errors import Cancelled, LimitExceeded, ModelError, VramError
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing

log = logging.getLogger(__name__)

Z_95: Final = 1.959964  # the normal distribution's 97.5 % point
ERRORS_IN_A_ROW_MAX: Final = (
    3  # a sidecar that is not there will not be there for the next seed either
)
VIDEO_HZ: Final = 30.0

Told = tuple[str, GoalParams]
"""Prompt and parameters of a goal."""


def wilson(successes: int, of: int) -> tuple[float, float] | None:
    """Return Wilson's 95 % interval of a success rate; None without episodes.

    It is sensible for few episodes, and for zero or all successes.
    """
    if of == 0:
        return None
    share, square = successes / of, Z_95**2
    middle = share + square / (2 * of)
    half = Z_95 * math.sqrt(share * (1 - share) / of + square / (4 * of * of))
    return max(0.0, (middle - half) / (1 + square / of)), min(
        1.0, (middle + half) / (1 + square / of)
    )


def mean(values: Sequence[float]) -> float | None:
    """Return the mean; None without values."""
    return sum(values) / len(values) if values else None


@dataclass(frozen=True, slots=True)
class SeedOutcome:
    """Outcome of one seed. `success` None: the world does not judge, or `error` tells why not.

    An error of the contestant while it plays (`model_error`) is a failure where the world judges;
    any other error (a missing sidecar, an environment that raised) is not a verdict.
    """

    seed: int
    success: bool | None
    steps: int = 0
    total_reward: float | None = None
    truncated: bool = False
    error: str = ""
    message: str = ""
    failed: bool = False  # by an error of the contestant's own
    seconds: float = 0.0
    standing_steps: int = 0  # of `steps`: in the middle of the motion, without an action
    video: str | None = None
    trace_id: str | None = None  # of its span; None without telemetry

    @property
    def unjudged_error(self) -> bool:
        return bool(self.error) and self.success is None


class CellSummary(TypedDict):
    """Sums of a cell in the report."""

    world: str
    contestant: str
    revision: str
    task: str | None
    complete: bool
    why: str
    played: int
    judged: int
    successes: int
    errors: int
    success_rate: float | None
    interval_95: tuple[float, float] | None
    mean_steps: float | None
    mean_standing_steps: float | None
    mean_reward: float | None


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

    @property
    def judged(self) -> int:
        return sum(played.success is not None for played in self.episodes)

    @property
    def successes(self) -> int:
        return sum(played.success is True for played in self.episodes)

    @property
    def errors(self) -> int:
        return sum(played.unjudged_error for played in self.episodes)

    @property
    def success_rate(self) -> float | None:
        return self.successes / self.judged if self.judged else None

    def add(self, played: SeedOutcome) -> None:
        """Add an outcome.

        In a world that judges, a contestant's own error is a failure, also before the world's first
        verdict; and so is an episode without a verdict: some worlds report successes only.
        """
        self.episodes.append(played)
        if self.judged:
            self.episodes = [
                replace(one, success=False)
                if one.success is None and (one.failed or not one.error)
                else one
                for one in self.episodes
            ]

    def summary(self) -> CellSummary:
        """Sums, as they go into the report."""
        rewards = [
            played.total_reward for played in self.episodes if played.total_reward is not None
        ]
        ran = [played for played in self.episodes if not played.unjudged_error]
        return {
            "world": self.world,
            "contestant": self.contestant,
            "revision": self.revision,
            "task": self.task,
            "complete": self.complete,
            "why": self.why,
            "played": len(self.episodes),
            "judged": self.judged,
            "successes": self.successes,
            "errors": self.errors,
            "success_rate": self.success_rate,
            "interval_95": wilson(self.successes, self.judged),
            "mean_steps": mean([one.steps for one in ran]),
            "mean_standing_steps": mean([one.standing_steps for one in ran]),
            "mean_reward": mean(rewards),
        }


def merged(cells: Sequence[Cell]) -> Cell:
    """Return the cells of one contestant in worlds of one kind as one, its episodes by seed."""
    first = cells[0]
    whole = Cell(first.world, first.contestant, first.task, first.revision)
    for played in sorted((one for cell in cells for one in cell.episodes), key=lambda o: o.seed):
        whole.add(played)
    whole.complete = all(cell.complete for cell in cells)
    whole.why = next((cell.why for cell in cells if cell.why), "")
    return whole


class Contestant(Protocol):
    """A player. `begin` on the event loop, before each episode; `player` on the worker thread."""

    name: str
    revision: str

    async def begin(self, goal: Goal) -> None: ...

    def player(self, env: Environment, seed: int) -> Stepped: ...

    async def finish(self) -> None: ...

    async def release(self) -> None: ...


class SkillContestant:
    """An installed skill, started anew for every episode as a goal would start it."""

    def __init__(self, skill: Skill) -> None:
        self.name, self.revision = skill.key.rskill_id, skill.key.revision
        self._skill = skill

    async def begin(self, goal: Goal) -> None:
        await self._skill.start(goal)

    def player(self, env: Environment, seed: int) -> Stepped:
        return self._skill

    async def finish(self) -> None:
        await self._skill.finish()

    async def release(self) -> None:
        await self._skill.release()


class PolicyContestant:
    """A policy without a model."""

    revision = ""

    def __init__(self, policy: Policy) -> None:
        self.name = policy.name
        self._policy = policy

    async def begin(self, goal: Goal) -> None: ...

    def player(self, env: Environment, seed: int) -> Stepped:
        return self._policy.play(env, seed)

    async def finish(self) -> None: ...

    async def release(self) -> None: ...


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
        video_every: int = 1,
        episode_s: float = 600.0,
    ) -> None:
        self.runner = runner
        self._world, self._task, self._told = world, task, told
        self._videos, self._video_every = videos, video_every
        self._episode_s = episode_s
        self._stopping = asyncio.Event()

    def stop(self) -> None:
        """Event loop: end after the present tick; what was played stays."""
        self._stopping.set()
        self.runner.request_stop()

    async def run(self, contestant: Contestant, seeds: Iterable[int]) -> Cell:
        """Play the seeds, then release the contestant. Raises as `play`."""
        try:
            return await self.play(contestant, seeds)
        finally:
            await release(contestant)

    async def play(self, contestant: Contestant, seeds: Iterable[int]) -> Cell:
        """Play the seeds. Raises what making the world raises; later errors are an episode's."""
        cell = Cell(self._world, contestant.name, self._task, contestant.revision)
        with ThreadPoolExecutor(1, thread_name_prefix="benchmark") as worker:
            await self._on(worker, self.runner.activate)
            try:
                for seed in seeds:
                    stopped = self._stopping.is_set()
                    played = None if stopped else await self._episode_of(worker, contestant, seed)
                    if played is None:
                        cell.why = "stopped"
                        return cell
                    cell.add(played)
                    log.info(
                        "%s, %s, seed %d: %s", cell.world, cell.contestant, seed, _verdict(played)
                    )
                    last = cell.episodes[-ERRORS_IN_A_ROW_MAX:]
                    if len(last) == ERRORS_IN_A_ROW_MAX and all(one.unjudged_error for one in last):
                        cell.why = f"given up after {len(last)} errors in a row: {played.message}"
                        return cell
                cell.complete = True
                return cell
            finally:
                await self._on(worker, self.runner.deactivate)

    async def _episode_of(
        self, worker: ThreadPoolExecutor, contestant: Contestant, seed: int
    ) -> SeedOutcome | None:
        """None: stopped in its middle."""
        began_s = time.monotonic()
        path = self._video_of(contestant.name, seed)
        recorder = trace_id = None
        if path is not None:
            recorder = VideoRecorder(path, fps=VIDEO_HZ / self._video_every, wait=True)
        attributes = {telemetry.ATTR_SKILL: contestant.name}
        try:
            with tracing.span(telemetry.SPAN_EPISODE, attributes=attributes):
                traceparent = tracing.traceparent()
                trace_id = tracing.log_ids().get("trace_id")
                prompt, params = await self._on(worker, lambda: self._reset(seed))
                goal = Goal(
                    f"seed-{seed}",
                    contestant.name,
                    prompt=prompt,
                    params=params,
                    traceparent=traceparent,
                )
                self.runner.caption = (
                    f"{contestant.name}, seed {seed}",
                    *([prompt] if prompt else []),
                )
                try:
                    await self._unless_stopped(contestant.begin(goal))
                    played = await self._on(
                        worker, lambda: self._episode(contestant, goal, seed, recorder)
                    )
                finally:
                    await _quietly(contestant.finish())
        except Cancelled:
            return None
        except VramError as error:
            played = SeedOutcome(seed, None, error=error.code, message=str(error))
        finally:
            self.runner.robot.video.recorder = None
            if recorder is not None:
                await asyncio.to_thread(recorder.close)
        if played is None:
            return None
        video = (
            str(path) if recorder is not None and recorder.written and not recorder.error else None
        )
        seconds = round(time.monotonic() - began_s, 3)
        return replace(played, seconds=seconds, video=video, trace_id=trace_id)

    # -- worker thread
    def _reset(self, seed: int) -> Told:
        self.runner.robot.begin_episode(seed)
        self.runner.tick()
        return self._told()

    def _episode(
        self, contestant: Contestant, goal: Goal, seed: int, recorder: VideoRecorder | None
    ) -> SeedOutcome | None:
        """Ticks until the episode is over."""
        runner, robot, ended = self.runner, self.runner.robot, list[SkillEnded]()
        robot.video.recorder = recorder
        number, ends_s = robot.episode_idx, time.monotonic() + self._episode_s
        runner.begin_skill(contestant.player(robot.env, seed), goal, ended.append)
        with runner.paced() as wait:
            # a skill that ends, ends the episode in the same tick
            while robot.episode_idx == number and not ended:
                if self._stopping.is_set():
                    runner.end_skill()
                    return None
                if time.monotonic() > ends_s:
                    runner.end_skill()
                    raise LimitExceeded(
                        f"the episode is not over after {self._episode_s:.0f} s",
                        details={"limit": "episode_seconds"},
                    )
                runner.tick()
                wait()
        error = ended[0].error if ended and "episode" not in ended[0].data else None
        if error is not None and not isinstance(error, ModelError | LimitExceeded):
            raise error  # the episode may not even be one
        if robot.failure is not None:  # in the tick in which the contestant was done
            raise robot.failure
        episode = robot.episodes[-1]
        return SeedOutcome(
            seed,
            False if error is not None and episode.success is not None else episode.success,
            steps=episode.steps,
            standing_steps=ended[0].data.get("standing_steps", 0) if ended else 0,
            total_reward=episode.total_reward,
            truncated=episode.truncated,
            error=error.code if error is not None else "",
            message=str(error) if error is not None else "",
            failed=error is not None,
        )

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

    def _video_of(self, contestant: str, seed: int) -> Path | None:
        if self._videos is None:
            return None
        return self._videos / f"{file_name(self._world)}_{file_name(contestant)}_{seed}.mp4"


def file_name(text: str) -> str:
    """Return a file name for any text."""
    return re.sub(r"[^A-Za-z0-9.-]+", "-", text).strip("-.")


def _verdict(played: SeedOutcome) -> str:
    word = {True: "success", False: "failure", None: "error" if played.error else "not judged"}[
        played.success
    ]
    return f"{word} after {played.steps} steps" + (f" ({played.message})" if played.message else "")


async def release(contestant: Contestant) -> None:
    """Release a contestant; a failure is logged, and its verdict is what it is."""
    await _quietly(contestant.release())


async def _quietly(work: Any) -> None:
    try:
        await work
    except VramError as error:  # the verdict is what it is
        log.warning("the contestant did not leave cleanly: %s", error)
