"""A simulated world for the control loop: one environment step per tick, resets between episodes.

An episode that is broken off by `close` does not count: the next reset tick begins it again with
its own seed. Must not know sockets, clients of goals or the arbiter. MuJoCo's rendering contexts
belong to the control thread; all calls are made on it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from vram_arbiter.runner.control.clock import Clock, SystemClock
from vram_arbiter.runner.control.loop import ControlLoop
from vram_arbiter.runner.control.robot import Applied, Sensed
from vram_arbiter.runner.protocols import (
    GoalData,
    SafetyGate,
    SkillEnded,
    Stepped,
)
from vram_arbiter.runner.sensors.pictures import Snapshot, rgb_frame
from vram_arbiter.runner.sim.arm_env import ArmEnvironment
from vram_arbiter.runner.sim.video import VideoRecorder
from vram_arbiter.schemas.errors import (
    GoalRejected,
    InternalError,
    LimitExceeded,
    VramError,
)
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.world import Action, SensorFrame, WorldState

log = logging.getLogger(__name__)

STILL_AFTER_TICKS = 20  # without a skill nothing moves: the video repeats its last picture
FRAME_REUSE_S = 0.1  # observation cameras are rendered on demand, at most at 10 Hz
VIDEO_EVERY = 3  # ticks: ten pictures a second at 30 Hz
OVERVIEW = "overview"  # a camera for people; where a scene has none, another one


class SimRobot:
    """Implements `control.robot.Robot` on our scene.

    Args: `seed + i` seeds episode i. An episode ends when its judge says so, after `max_steps`
    steps (truncated), and with `ends_with_skill` when its skill ends (truncated, too: the world
    itself was not done).
    """

    def __init__(
        self,
        env: ArmEnvironment,
        *,
        seed: int = 0,
        clock: Clock,
        max_steps: int | None = None,
        ends_with_skill: bool = False,
    ) -> None:
        self.env = env
        self.world: WorldState | None = None
        self.reset_due = True
        self.episode_idx = 0  # of the episode that is open, or begins next
        self.video = EpisodeVideo(env)
        self._seed = seed
        self._next_seed: int | None = None
        self._clock = clock
        self._max_steps = max_steps
        self._ends_with_skill = ends_with_skill
        self._had_skill = False  # in this episode
        self._steps = 0  # of this episode
        self._ticks = 0
        self._snapshots: dict[str, Snapshot] = {}
        self._rendered_in: dict[str, int] = {}  # tick of the last picture on request, by camera

    # -- life
    def open(self, stopping: threading.Event) -> None:
        self.reset_due = True

    def close(self) -> None:
        self.env.arm.close()

    # -- episodes
    @property
    def _episode_seed(self) -> int:
        return self._seed + self.episode_idx if self._next_seed is None else self._next_seed

    def begin_episode(self, seed: int | None) -> int:
        """Reset the world in the next tick, to `seed` (and in every later reset) or again to its
        own; return the seed. An open episode does not count.
        """
        self._next_seed = self._next_seed if seed is None else seed
        self.reset_due = True
        return self._episode_seed

    def reset(self) -> Applied:
        """Prepare the next episode.

        Raises EnvironmentFailed, which ends the run: without a world there are no ticks.
        """
        self.reset_due = self._had_skill = False
        self._steps = 0
        self._snapshots.clear()
        self.env.reset(self._episode_seed)
        for camera in self.env.cameras:  # a first picture takes a second: contexts, shaders
            self._render(camera)
        return Applied(episode_idx=self.episode_idx)

    # -- safety
    def admit(self, skill: Stepped) -> SafetyGate:
        """Return the gate for whatever can be stepped; otherwise as `Robot.admit`."""
        if missing := [camera for camera in skill.cameras if camera not in self.env.cameras]:
            raise GoalRejected(
                f"{skill.key} needs the cameras {', '.join(missing)};"
                f" here there is {', '.join(self.env.cameras) or 'no camera'}",
                hint="cameras are renamed in the skill's `image_preprocessing.aliases`",
            )
        gate = self.env.gate(skill)
        self._had_skill = True
        return gate

    def stop(self) -> None:
        """Hold: a simulated motor stands still as soon as its skill has ended."""

    # -- one tick
    def sense(self, skill: Stepped | None, *, followed: bool) -> Sensed:
        """Render what the skill or the recorder wants to see, and observe the state."""
        self._ticks += 1
        started_s = self._clock.now_s()
        frames = self._frames(skill, followed)
        sensed_s = self._clock.now_s()
        try:
            with tracing.span(telemetry.SPAN_WORLD):
                self.world = self.env.observe(self._clock.now_ns(), frames)
        except ValidationError as error:  # a state that is not finite must not be acted on
            self.world = None
            problem = "the robot's state is invalid"
            failure = InternalError(f"{problem}: {error.errors()[0]['msg']}")
            return Sensed(ended=SkillEnded({}, failure), problem=problem)
        return Sensed(
            sensors_ms=(sensed_s - started_s) * 1e3,
            world_state_ms=(self._clock.now_s() - sensed_s) * 1e3,
        )

    def _frames(self, skill: Stepped | None, followed: bool) -> dict[str, SensorFrame] | None:
        if skill is None or not (followed or skill.wants_frames()):
            return None
        with tracing.span(telemetry.SPAN_SENSORS):
            wanted = self.env.cameras if followed else skill.cameras
            frames = {}
            for camera in wanted:
                taken = self._render(camera)
                now_ns = self._clock.wall_ns()
                frames[camera] = rgb_frame(camera, taken.rgb, taken.stamp_ns, now_ns)
            return frames

    def apply(self, action: Action | None, *, skill_active: bool) -> Applied:
        """Step the world. Raises EnvironmentFailed, which ends the run."""
        self.env.step(action)
        step, self._steps = self._steps, self._steps + 1
        over = self.env.over
        played_out = self._max_steps is not None and self._steps >= self._max_steps
        left = self._ends_with_skill and self._had_skill and not skill_active
        truncated = not over and (played_out or left)
        self.reset_due = over or truncated
        applied = Applied(
            action_applied=action is not None,
            step_idx=step,
            episode_idx=self.episode_idx,
            terminated=over,
            truncated=truncated,
            success=self.env.success,
            ended=self._end_with_episode() if self.reset_due and skill_active else None,
        )
        self.episode_idx += self.reset_due
        return applied

    def _end_with_episode(self) -> SkillEnded:
        """Return how a goal ends that loses its world."""
        success = self.env.success
        story = {"episode": self.episode_idx, "steps": self._steps, "success": success}
        error: VramError | None = None
        if not success:
            problem = f"the episode was cut off after {self._steps} steps without success"
            error = LimitExceeded(problem, details={"limit": "episode"})
        return SkillEnded(story, error)

    # -- for recordings and reports
    def targets(self) -> Mapping[str, float]:
        return self.env.sent()

    def facts(self) -> GoalData:
        return {"seed": self._seed, "episodes": self.episode_idx}

    # -- cameras
    def camera_names(self) -> tuple[str, ...]:
        return self.env.cameras

    def snapshot(self, camera: str, max_age_s: float) -> Snapshot:
        """Return a picture no older than `max_age_s`, rendered unless a recent one is at hand.

        At most one picture is rendered per tick and camera: a crowd of requests must not make a
        tick long, and the world stands still within one.
        """
        known = self._snapshots.get(camera)
        newest_ns = self._clock.now_ns() - int(min(max_age_s, FRAME_REUSE_S) * 1e9)
        if known is not None and (
            known.stamp_ns >= newest_ns or self._rendered_in.get(camera) == self._ticks
        ):
            return known
        self._rendered_in[camera] = self._ticks
        return self._render(camera)

    def _render(self, camera: str) -> Snapshot:
        arm = self.env.arm
        rgb = arm.render(camera)
        snapshot = Snapshot(camera, rgb, self._clock.now_ns(), arm.camera_model(camera))
        self._snapshots[camera] = snapshot
        return snapshot


class EpisodeVideo:
    """Films a simulated robot with one of its cameras; `recorder` may be set while it runs."""

    def __init__(self, env: ArmEnvironment) -> None:
        self.recorder: VideoRecorder | None = None
        self._arm = env.arm
        self._picture: Any = None
        self._idle_ticks = 0
        self._reset_tick = 0

    @property
    def camera(self) -> str:
        known = self._arm.config.cameras
        return OVERVIEW if OVERVIEW in known else next(iter(known))

    def show(
        self, applied: Applied, *, tick_idx: int, skill_active: bool, caption: tuple[str, ...]
    ) -> None:
        """Hand a picture of the stepped world to the recorder."""
        if applied.terminated is None:  # a reset
            self._picture, self._reset_tick = None, tick_idx
            return
        self._idle_ticks = 0 if skill_active else self._idle_ticks + 1
        closing = applied.terminated or applied.truncated
        if self.recorder is None or not (
            closing or (tick_idx - self._reset_tick) % VIDEO_EVERY == 0
        ):
            return
        if self._picture is None or self._idle_ticks < STILL_AFTER_TICKS:
            self._picture = self._arm.render(self.camera)
        self.recorder.submit(self._picture, (*caption, f"t = {self._arm.time_s:.1f} s"))


SimRunner = ControlLoop[SimRobot]


def sim_runner(
    env: ArmEnvironment,
    *,
    seed: int = 0,
    rate_hz: float = 30.0,
    clock: Clock | None = None,
    max_steps: int | None = None,
    ends_with_skill: bool = False,
) -> SimRunner:
    """Compose a control loop on a simulated world. Args: as for `SimRobot` and `ControlLoop`."""
    clock = clock or SystemClock()
    robot = SimRobot(
        env, seed=seed, clock=clock, max_steps=max_steps, ends_with_skill=ends_with_skill
    )
    return ControlLoop(robot, rate_hz=rate_hz, clock=clock, video=robot.video)
