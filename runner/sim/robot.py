"""A simulated world for the control loop: one environment step per tick, resets between episodes.

A run of n episodes has n reset ticks: the last episode ends the run by itself. An episode that is
broken off (by `close` or by an environment that fails) does not count: the next reset tick begins
it again with its own seed. Must not know sockets, clients of goals, the arbiter or any make of
simulator. MuJoCo's rendering contexts belong to the control thread; all calls are made on it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from pydantic import ValidationError

from vram_arbiter.runner.control.clock import Clock, SystemClock
from vram_arbiter.runner.control.loop import ControlLoop
from vram_arbiter.runner.control.robot import Applied, Sensed
from vram_arbiter.runner.protocols import (
    DeadlinePolicy,
    Goal,
    GoalData,
    SafetyGate,
    SkillEnded,
    Stepped,
    Transition,
)
from vram_arbiter.runner.recording.video import VideoRecorder
from vram_arbiter.runner.sensors.pictures import Snapshot
from vram_arbiter.runner.sim.environment import Environment, EnvStep
from vram_arbiter.runner.sim.episodes import Episode, EpisodeView
from vram_arbiter.schemas.errors import (
    EnvironmentFailed,
    GoalRejected,
    InternalError,
    LimitExceeded,
    ModelError,
    VramError,
)
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.world import Action, FrameEncoding, SensorFrame, TickResult, WorldState

log = logging.getLogger(__name__)

STILL_AFTER_TICKS = 20  # without a skill nothing moves: the video repeats its last picture
IDLE_S = 0.001
FRAME_REUSE_S = 0.1  # observation cameras are rendered on demand, at most at 10 Hz

MakePolicy = Callable[[Environment, int], Stepped]
"""Player of one episode, from the environment and its seed."""


class EpisodePlayer(Protocol):
    """Plays every episode by itself, instead of goals."""

    error: VramError | None  # the first one

    def begin(self, env: Environment, seed: int) -> None:
        """Begin to play an episode whose scene stands."""
        ...

    def broken_off(self, error: VramError) -> None:
        """Note that the environment failed."""
        ...


class SimRobot:
    """Implements `control.robot.Robot` on an `Environment`.

    Args: `seed + i` seeds episode i. `episodes` None continues until the run is stopped. An episode
    ends when its world says so, after `max_steps` steps (truncated), and with `ends_with_skill`
    when its skill ends (truncated, too: the world itself was not done). `cameras` None takes those
    of the environment.
    """

    def __init__(
        self,
        make_env: Callable[[], Environment],
        *,
        cameras: tuple[str, ...] | None = None,
        seed: int = 0,
        clock: Clock,
        as_fast_as_possible: bool = False,
        episodes: int | None = None,
        max_steps: int | None = None,
        ends_with_skill: bool = False,
        video_camera: str = "overview",
        video_every: int = 3,
    ) -> None:
        self.world: WorldState | None = None
        self.reset_due = True
        self.failure: EnvironmentFailed | None = None  # that broke off the last episode
        self.player: EpisodePlayer | None = None  # set it before the first tick
        self.video = EpisodeVideo(self, camera=video_camera, every=video_every)
        self._make_env = make_env
        self._env: Environment | None = None
        self._cameras = cameras or ()
        self._cameras_given = cameras is not None
        self._seed = seed
        self._next_seed: int | None = None
        self._clock = clock
        self._as_fast_as_possible = as_fast_as_possible
        self._episodes_wanted = episodes
        self._max_steps = max_steps
        self._ends_with_skill = ends_with_skill
        self._had_skill = False  # in this episode
        self._view = EpisodeView()
        self._ticks = 0
        self._snapshots: dict[str, Snapshot] = {}
        self._rendered_in: dict[str, int] = {}  # tick of the last picture on request, by camera
        self._shown: Mapping[str, float] | None = None  # by a world that is not a robot

    # -- life
    def open(self, stopping: threading.Event) -> None:
        if self._env is None:
            self._env = self._make_env()
            self.reset_due = True

    def close(self) -> None:
        if self._env is not None:
            self._env.close()
            self._env = None

    @property
    def env(self) -> Environment:
        if self._env is None:
            raise InternalError("the simulator is not active")
        return self._env

    @property
    def finished(self) -> bool:
        return self._episodes_wanted is not None and self._view.count >= self._episodes_wanted

    # -- episodes
    @property
    def episodes(self) -> list[Episode]:
        """The finished episodes, at most the last ten thousand."""
        return list(self._view.finished)

    @property
    def episode_idx(self) -> int:
        """Index of the episode that is open, or begins next."""
        return self._view.count

    @property
    def policy_error(self) -> VramError | None:
        """First error of the policy that plays the episodes; it ended the run."""
        return None if self.player is None else self.player.error

    @property
    def _episode_seed(self) -> int:
        return self._seed + self.episode_idx if self._next_seed is None else self._next_seed

    def begin_episode(self, seed: int) -> None:
        """Reset the world in the next tick and in every later reset to this seed.

        An open episode does not count.
        """
        self._next_seed = seed
        self.reset_due = True

    def begin_episode_of(self, seed: int | None) -> int:
        """Reset the world in the next tick, to `seed` or again to its own; return the seed."""
        if seed is not None:
            self.begin_episode(seed)
        self.reset_due = True
        return self._episode_seed

    def reset(self) -> Applied:
        """Prepare the next episode.

        Raises EnvironmentFailed, which ends the run: without a world there are no ticks.
        """
        self.reset_due = self._had_skill = False
        self.failure = None
        self._snapshots.clear()
        seed = self._episode_seed
        self.env.reset(seed)
        if not self._cameras_given:
            self._cameras = self.env.cameras
        for camera in self._cameras:  # a first picture takes a second: rendering contexts, shaders
            self._render(camera)
        if self.player is not None:
            self.player.begin(self.env, seed)
        return Applied(episode_idx=self.episode_idx)

    def _break_off(self, error: EnvironmentFailed) -> SkillEnded:
        """Discard the open episode; its seed is played again.

        Raises `error` if no skill acted: then it would repeat itself in every episode.
        """
        log.error("episode %d is broken off: %s", self.episode_idx, error)
        self.world, self.failure = None, error
        if not self._had_skill:
            raise error
        if self.player is not None:  # also if it ended in this very tick
            self.player.broken_off(error)
        self.reset_due = True
        return SkillEnded({}, error)

    # -- safety
    def admit(self, skill: Stepped) -> SafetyGate:
        """Return the gate for whatever can be stepped; otherwise as `Robot.admit`."""
        if missing := [camera for camera in skill.cameras if camera not in self._cameras]:
            raise GoalRejected(
                f"{skill.key} needs the cameras {', '.join(missing)};"
                f" here there is {', '.join(self._cameras) or 'no camera'}",
                hint="cameras are renamed in the skill's `image_preprocessing.aliases`,"
                " or in the environment's file",
            )
        gate = self.env.gate(skill)
        self._had_skill = True
        return gate

    def stop(self) -> None:
        """Hold: a simulated motor stands still as soon as its skill has ended."""

    # -- one tick
    def sense(self, skill: Stepped | None, *, followed: bool) -> Sensed:
        """Render what the skill or the recorder wants to see, and observe the state."""
        started_s = self._clock.now_s()
        try:
            frames = self._frames(skill, followed)
        except EnvironmentFailed as error:
            return Sensed(ended=self._break_off(error))
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
        wanted = dict.fromkeys((*skill.cameras, *(self._cameras if followed else ())))
        with tracing.span(telemetry.SPAN_SENSORS):
            frames = {camera: self._sensor_frame(self._render(camera)) for camera in wanted}
            self._shown = self.env.shown() if followed else None
        return frames

    def apply(self, action: Action | None, *, skill_active: bool) -> Applied:
        if self.reset_due:  # broken off while it was looked at
            return Applied(episode_idx=self.episode_idx)
        before = self._view.steps
        try:
            step = self.env.step(action)
        except EnvironmentFailed as error:
            return Applied(episode_idx=self.episode_idx, ended=self._break_off(error))
        steps = before + step.moved
        truncated = step.truncated or (self._max_steps is not None and steps >= self._max_steps)
        played_out = step.terminated or truncated
        truncated |= self._ends_with_skill and self._had_skill and not skill_active
        truncated = truncated and not step.terminated
        over = step.terminated or truncated
        self.reset_due = over
        ended = self._end_with_episode(steps, step, truncated) if over and skill_active else None
        return Applied(
            action_applied=action is not None,
            step_idx=before if step.moved else None,
            episode_idx=self.episode_idx,
            reward=step.reward,
            terminated=step.terminated,
            truncated=truncated,
            success=step.success and (played_out or not over or not step.unearned),
            ended=ended,
        )

    def _end_with_episode(self, steps: int, step: EnvStep, truncated: bool) -> SkillEnded:
        """Return how a goal ends that loses its world. Without a verdict it is not a success."""
        reward = self._view.total_reward
        if step.reward is not None:
            reward = (reward or 0.0) + step.reward
        story = {
            "episode": self.episode_idx,
            "steps": steps,
            "total_reward": reward,
            "success": step.success,
        }
        error: VramError | None = None
        if step.success is None:
            error = ModelError(
                f"the episode is over after {steps} steps,"
                " and the environment does not say whether that is a success",
                hint="the environment's file can say what a success is (`success`)",
            )
        elif not step.success and truncated:
            problem = f"the episode was cut off after {steps} steps without success"
            error = LimitExceeded(problem, details={"limit": "episode"})
        elif not step.success:
            error = ModelError(f"the episode ended after {steps} steps without success")
        return SkillEnded(story, error)

    def ticked(self, result: TickResult) -> None:
        """Add the tick to its episode."""
        self._ticks += 1
        self._view.add(result)
        stands_still = result.step_idx is None and result.terminated is False
        if self._as_fast_as_possible and stands_still:
            self._clock.sleep_s(IDLE_S)  # a world that waits for an action needs no full core

    # -- for recordings and reports
    def targets(self) -> Mapping[str, float]:
        return self.env.targets

    def transition(self) -> Transition | None:
        return None if self._shown is None else Transition(self._shown, dict(self.env.acted))

    def success(self) -> bool | None:
        """Return whether all episodes succeeded; in a world that judges, silence is a failure."""
        verdicts = [episode.success for episode in self._view.finished]
        return all(verdicts) if any(verdict is not None for verdict in verdicts) else None

    def facts(self) -> GoalData:
        return {"seed": self._seed, "episodes": self._view.count}

    # -- cameras
    def camera_names(self) -> tuple[str, ...]:
        return self._cameras

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
        rgb = self.env.render(camera)
        snapshot = Snapshot(camera, rgb, self._clock.now_ns(), self.env.camera_model(camera))
        self._snapshots[camera] = snapshot
        return snapshot

    def _sensor_frame(self, taken: Snapshot) -> SensorFrame:
        height, width = taken.rgb.shape[:2]
        return SensorFrame(
            sensor_id=taken.camera,
            stamp_monotonic_ns=taken.stamp_ns,
            stamp_wall_ns=self._clock.wall_ns(),
            encoding=FrameEncoding.RGB8,
            width=int(width),
            height=int(height),
            data=taken.rgb.tobytes(),
        )


class EpisodeVideo:
    """Films a simulated robot with one of its cameras; `recorder` may be set while it runs."""

    def __init__(self, robot: SimRobot, *, camera: str, every: int) -> None:
        self.recorder: VideoRecorder | None = None
        self._robot = robot
        self._camera = camera
        self._every = every  # ticks
        self._picture: Any = None
        self._idle_ticks = 0

    def show(
        self, applied: Applied, *, tick_idx: int, skill_active: bool, caption: tuple[str, ...]
    ) -> None:
        """Hand a picture of the stepped world to the recorder."""
        if applied.terminated is None:  # a reset, or an episode that was broken off
            self._picture = None
            return
        self._idle_ticks = 0 if skill_active else self._idle_ticks + 1
        closing = bool(applied.terminated or applied.truncated)
        due = closing or tick_idx % self._every == 0
        recorder = self.recorder
        if recorder is None or not due or applied.step_idx is None:  # time may stand still
            return
        env = self._robot.env
        if self._picture is None or self._idle_ticks < STILL_AFTER_TICKS:
            try:
                self._picture = env.render(self._camera)
            except (EnvironmentFailed, KeyError) as error:  # KeyError: the camera does not exist
                log.error("no more pictures for the video: %s", error)
                self.recorder = None
                return
        recorder.submit(self._picture, (*caption, env.clock_text))


class PolicyEpisodes:
    """Plays every episode with a policy, as a goal of its own. The first error ends the run."""

    def __init__(self, loop: SimRunner, make: MakePolicy, told: Callable[[], str]) -> None:
        self.error: VramError | None = None
        self._loop = loop
        self._make = make
        self._told = told

    def begin(self, env: Environment, seed: int) -> None:
        player = self._make(env, seed)
        name = player.key.rskill_id
        span = tracing.begin(telemetry.SPAN_EPISODE, attributes={telemetry.ATTR_SKILL: name})
        with tracing.inside(span):
            words = self._told()
            goal = Goal(f"seed-{seed}", name, prompt=words, traceparent=tracing.traceparent())

        def ended(end: SkillEnded) -> None:
            outcome = "ok" if end.error is None else end.error.code
            span.set_attribute(telemetry.ATTR_OUTCOME, outcome)
            span.end()
            self._ended(end)

        try:
            self._loop.begin_skill(player, goal, ended)
        except BaseException:
            span.end()
            raise

    def broken_off(self, error: VramError) -> None:
        self.error = self.error or error
        self._loop.request_stop()

    def _ended(self, ended: SkillEnded) -> None:
        if ended.error is not None and "episode" not in ended.data and not self._loop.stopping:
            self.broken_off(ended.error)


SimRunner = ControlLoop[SimRobot]


def sim_runner(
    make_env: Callable[[], Environment],
    *,
    cameras: tuple[str, ...] | None = None,
    seed: int = 0,
    rate_hz: float = 30.0,
    deadline_policy: DeadlinePolicy = DeadlinePolicy.WARN,
    clock: Clock | None = None,
    episodes: int | None = None,
    max_steps: int | None = None,
    ends_with_skill: bool = False,
    policy: MakePolicy | None = None,
    told: Callable[[], str] = lambda: "",
    recorder: VideoRecorder | None = None,
    video_camera: str = "overview",
    video_every: int = 3,
) -> SimRunner:
    """Compose a control loop on a simulated world.

    Args: as for `SimRobot`, `EpisodeVideo` and `ControlLoop`; `policy(env, seed)` plays every
    episode from its reset tick on, instead of goals; `told()` is that episode's task in words.
    """
    clock = clock or SystemClock()
    robot = SimRobot(
        make_env,
        cameras=cameras,
        seed=seed,
        as_fast_as_possible=rate_hz == 0,
        clock=clock,
        episodes=episodes,
        max_steps=max_steps,
        ends_with_skill=ends_with_skill or policy is not None,
        video_camera=video_camera,
        video_every=video_every,
    )
    robot.video.recorder = recorder
    loop = ControlLoop(
        robot, rate_hz=rate_hz, deadline_policy=deadline_policy, clock=clock, video=robot.video
    )
    if policy is not None:
        robot.player = PolicyEpisodes(loop, policy, told)
    return loop
