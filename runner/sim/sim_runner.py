"""`SimRunner`: the control loop on a simulated world. One environment step per tick, a reset tick before each episode.

Everything here runs on the control thread (MuJoCo's rendering contexts belong to it). It gives the world to at most one skill,
holds when there is none, and knows no sockets, goals' clients or arbiter, and no make of simulator.

A run of n episodes has n reset ticks: the last episode ends the run by itself, nothing is reset for an episode that nobody plays. One that
is broken off (`deactivate`, an environment that fails) is no episode: the next reset tick begins it again, with its own seed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

from pydantic import ValidationError

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.control.loop import Applied, Decision
from vram_arbiter.runner.control.skill_runner import SkillRunner
from vram_arbiter.runner.goals.frames import Snapshot
from vram_arbiter.runner.protocols import (
    DeadlinePolicy,
    Goal,
    SafetyGate,
    SkillEnded,
    Stepped,
    Transition,
)
from vram_arbiter.runner.recording.video import Recorder
from vram_arbiter.runner.sim.environment import Environment, EnvStep
from vram_arbiter.runner.sim.episodes import Episode, EpisodeView
from vram_arbiter.schemas.control import ControlMode
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
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame, TickResult

log = logging.getLogger(__name__)

STILL_AFTER_TICKS = 20  # without a skill nothing moves: the video repeats its last picture
IDLE_S = 0.001
FRAME_REUSE_S = 0.1  # observation cameras are rendered on demand, at most at 10 Hz


class SimRunner(SkillRunner):
    """`seed + i` seeds episode i. `episodes` None goes on until it is stopped (the live runner). An episode ends when its world says so,
    after `max_steps` steps (truncated), and with `ends_with_skill` when its skill does (truncated, too: the world itself was not done).

    `policy(env, seed)` plays every episode from its reset tick on, instead of goals; its first error (`policy_error`) ends the run.
    `cameras` None takes those of the environment. A goal is over with its episode: done where the environment says success, failed otherwise.
    """

    def __init__(
        self,
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
        policy: Callable[[Environment, int], Stepped] | None = None,
        recorder: Recorder | None = None,
        video_camera: str = "overview",
        video_every: int = 3,
    ) -> None:
        super().__init__(rate_hz=rate_hz, deadline_policy=deadline_policy, clock=clock)
        self._make_env = make_env
        self._cameras = cameras or ()
        self._cameras_given = cameras is not None
        self._seed = seed
        self._episodes_wanted = episodes
        self._max_steps = max_steps
        self._ends_with_skill = ends_with_skill or policy is not None
        self._policy = policy
        self.policy_error: VramError | None = None
        self.failure: EnvironmentFailed | None = None  # by which the last episode was broken off
        self.recorder = recorder  # may be set while running
        self._video_camera = video_camera
        self._video_every = video_every
        self._video_picture: Any = None
        self._env: Environment | None = None
        self._idle_ticks = 0
        self._reset_due = True
        self._next_seed: int | None = None
        self._had_skill = False  # in this episode
        self._snapshots: dict[str, Snapshot] = {}
        self._rendered_in: dict[
            str, int
        ] = {}  # the tick of the last picture that a request has cost, by camera
        self._shown: Mapping[str, float] | None = (
            None  # by a world that is no robot, before this tick's step
        )
        self._view = EpisodeView()

    # -- life --------------------------------------------------------------------------------------------------------
    def activate(self) -> None:
        if self._env is None:
            self._env = self._make_env()
            self._reset_due = True

    def deactivate(self) -> None:
        self._end(SkillEnded({}, InternalError("the runner is stopping")))
        if self._env is not None:
            self._env.close()
            self._env = None

    @property
    def env(self) -> Environment:
        if self._env is None:
            raise InternalError("the simulator is not active")
        return self._env

    @property
    def episodes(self) -> list[Episode]:
        """The finished ones, of a long run the last ten thousand."""
        return list(self._view.finished)

    def begin_episode(self, seed: int) -> None:
        """Control thread: the next tick resets the world, and every later reset does, to this seed. What is open is no episode."""
        self._next_seed = seed
        self._reset_due = True

    def begin_skill(self, skill: Stepped, goal: Goal, on_end: Callable[[SkillEnded], None]) -> None:
        """As its base, and for whatever can be stepped. Raises GoalRejected for a skill that wants cameras which this world has not."""
        if missing := [camera for camera in skill.cameras if camera not in self._cameras]:
            raise GoalRejected(
                f"{skill.key} looks through {', '.join(missing)}; here there is {', '.join(self._cameras) or 'no camera'}",
                hint="cameras are renamed in the skill's `image_preprocessing.aliases`, or in the environment's file",
            )
        self._give(skill, goal, on_end)
        self._had_skill = True

    def _play_policy(self, seed: int) -> None:
        if self._policy is None:
            return
        player = self._policy(self.env, seed)
        name = player.key.rskill_id
        span = tracing.begin(telemetry.SPAN_EPISODE, attributes={telemetry.ATTR_SKILL: name})
        with tracing.inside(span):
            goal = Goal(f"seed-{seed}", name, traceparent=tracing.traceparent())

        def ended(end: SkillEnded) -> None:
            span.set_attribute(
                telemetry.ATTR_OUTCOME, "ok" if end.error is None else end.error.code
            )
            span.end()
            self._policy_ended(end)

        try:
            self.begin_skill(player, goal, ended)
        except BaseException:
            span.end()
            raise

    def _policy_ended(self, ended: SkillEnded) -> None:
        if ended.error is not None and "episode" not in ended.data and not self._stopping:
            self.policy_error = self.policy_error or ended.error
            self.request_stop()

    # -- pictures -----------------------------------------------------------------------------------------------------
    def camera_names(self) -> tuple[str, ...]:
        """Observation cameras, the default one first."""
        return self._cameras

    def snapshot(self, camera: str, max_age_s: float) -> Snapshot:
        """Control thread: a picture no older than `max_age_s`, rendered now unless a recent one is at hand. Once a tick and camera: no crowd
        of requests for pictures makes a tick long, and the world stands still within one."""
        known = self._snapshots.get(camera)
        newest_ns = self.clock.now_ns() - int(min(max_age_s, FRAME_REUSE_S) * 1e9)
        if known is not None and (
            known.stamp_ns >= newest_ns or self._rendered_in.get(camera) == self.tick_idx
        ):
            return known
        self._rendered_in[camera] = self.tick_idx
        return self._render(camera)

    def _render(self, camera: str) -> Snapshot:
        rgb = self.env.render(camera)
        snapshot = Snapshot(camera, rgb, self.clock.now_ns(), self.env.camera_model(camera))
        self._snapshots[camera] = snapshot
        return snapshot

    # -- one tick -----------------------------------------------------------------------------------------------------
    def _take_posted(self) -> None:
        if not self._reset_due:  # nobody meets a scene that does not stand yet
            super()._take_posted()

    def _finished(self) -> bool:
        enough = self._episodes_wanted is not None and self._view.count >= self._episodes_wanted
        return super()._finished() or enough

    def tick(self) -> TickResult:
        result = super().tick()
        self._view.add(result)
        if self.period_s is None and result.step_idx is None and result.terminated is False:
            self.clock.sleep_s(
                IDLE_S
            )  # a world that stands still is not looked at as fast as possible
        return result

    def _success(self) -> bool | None:
        """In a world that judges at all, an episode without a word of success is none."""
        said = [episode.success for episode in self._view.finished]
        return all(said) if any(success is not None for success in said) else None

    def _metadata(self) -> dict[str, Any]:
        return {**super()._metadata(), "seed": self._seed, "episodes": self._view.count}

    def _decide(self, tick_idx: int) -> Decision:
        """1. reset tick? 2. posted work 3. cameras 4. world state 5. the skill 6. safety."""
        if self._reset_due:  # 1
            return Decision(reset=True)
        self._take_posted_after_stop()  # 2
        started_s = self.clock.now_s()
        active = self._active
        frames: dict[str, SensorFrame] | None = None
        try:
            if active is not None and (self._follows or active.skill.wants_frames()):  # 3
                cameras = dict.fromkeys(
                    (*active.skill.cameras, *(self._cameras if self._follows else ()))
                )
                with tracing.span(telemetry.SPAN_SENSORS):
                    frames = {
                        camera: self._sensor_frame(self._render(camera)) for camera in cameras
                    }
                    self._shown = self.env.shown() if self._follows else None
        except EnvironmentFailed as error:
            self._broken_off(error)
            return Decision()
        sensed_s = self.clock.now_s()
        try:
            with tracing.span(telemetry.SPAN_WORLD):
                world = self.env.observe(self.clock.now_ns(), frames)  # 4
        except ValidationError as error:  # a state that is not finite: nobody may act on it
            self.world = None
            self._end(
                SkillEnded(
                    {}, InternalError(f"the robot's state is invalid: {error.errors()[0]['msg']}")
                )
            )
            return Decision(safety_violations=("the robot's state is invalid",))
        self.world = world
        decision = Decision(
            sensors_ms=(sensed_s - started_s) * 1e3,
            world_state_ms=(self.clock.now_s() - sensed_s) * 1e3,
        )
        if active is not None:
            self._ask_skill(active, world, decision)  # 5, 6
        return decision

    def _targets_now(self) -> Mapping[str, float]:
        return self.env.targets

    def _transition(self) -> Transition | None:
        return None if self._shown is None else Transition(self._shown, dict(self.env.acted))

    def _base_told(self, decision: Decision) -> tuple[float, float, float] | None:
        if self.world is None or self.world.base_pose is None:
            return None
        action = decision.action
        if action is None or action.control_mode is not ControlMode.BODY_TWIST:
            return (0.0, 0.0, 0.0)  # a base that is told nothing stands still
        vx, vy, _, _, _, wz = action.rows[0]
        return (vx, vy, wz)

    def _gate_of(self, skill: Stepped) -> SafetyGate:
        return self.env.gate(skill)

    def _apply(self, decision: Decision) -> Applied:
        if decision.reset:
            return self._reset()
        if self._reset_due:  # broken off while it was looked at
            return Applied(action_applied=False, episode_idx=self.episode_idx)
        before = self._view.steps
        try:
            step = self.env.step(decision.action)
        except EnvironmentFailed as error:
            return self._broken_off(error)
        steps = before + step.moved
        self._idle_ticks = 0 if self._active is not None else self._idle_ticks + 1
        truncated = step.truncated or (self._max_steps is not None and steps >= self._max_steps)
        played_out = step.terminated or truncated
        truncated |= self._ends_with_skill and self._had_skill and self._active is None
        applied = Applied(
            action_applied=decision.action is not None,
            step_idx=before if step.moved else None,
            episode_idx=self.episode_idx,
            reward=step.reward,
            terminated=step.terminated,
            truncated=truncated and not step.terminated,
            success=step.success and (played_out or not truncated or not step.unearned),
        )
        over = bool(applied.terminated or applied.truncated)
        if step.moved:  # where time stood still there is nothing new to see
            self._record(closing=over)
        if over:
            self._end_with_episode(steps, step, truncated=bool(applied.truncated))
            self._reset_due = True
        return applied

    @property
    def episode_idx(self) -> int:
        """Of the episode that is open, or begins next."""
        return self._view.count

    def _reset(self) -> Applied:
        """What was in the world before belongs to nobody any more. Raises EnvironmentFailed, which ends the run: no world, no ticks."""
        self._reset_due = self._had_skill = False
        self.failure = None
        self._snapshots.clear()
        self._video_picture = None
        seed = self._seed + self.episode_idx if self._next_seed is None else self._next_seed
        self.env.reset(seed)
        if not self._cameras_given:
            self._cameras = self.env.cameras
        for camera in self._cameras:  # a first picture takes a second: rendering contexts, shaders
            self._render(camera)
        self._play_policy(seed)
        return Applied(action_applied=False, episode_idx=self.episode_idx)

    def _broken_off(self, error: EnvironmentFailed) -> Applied:
        """The episode never happened; its seed is played again. Raises when nobody had the world: then it fails by itself, every time."""
        log.error("episode %d is broken off: %s", self.episode_idx, error)
        self.world, self.failure = None, error
        if not self._had_skill:
            raise error
        self._end(SkillEnded({}, error))
        if self._policy is not None:  # also one that was done in this very tick
            self.policy_error = self.policy_error or error
            self.request_stop()
        self._reset_due = True
        return Applied(action_applied=False, episode_idx=self.episode_idx)

    def _end_with_episode(self, steps: int, step: EnvStep, *, truncated: bool) -> None:
        """A skill that still has the world loses it. That nobody judges is no success."""
        if self._active is None:
            return
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
                f"the episode is over after {steps} steps, and nobody says whether that is a success",
                hint="the environment's file can say what a success is (`success`)",
            )
        elif not step.success and truncated:
            problem = f"the episode was cut off after {steps} steps without success"
            error = LimitExceeded(problem, details={"limit": "episode"})
        elif not step.success:
            error = ModelError(f"the episode ended after {steps} steps without success")
        self._end(SkillEnded(story, error))

    def _record(self, *, closing: bool) -> None:
        recorder = self.recorder
        if recorder is None or (self.tick_idx % self._video_every and not closing):
            return
        if self._video_picture is None or self._idle_ticks < STILL_AFTER_TICKS:
            try:
                self._video_picture = self.env.render(self._video_camera)
            except (
                EnvironmentFailed,
                KeyError,
            ) as error:  # the episode goes on; KeyError: there is no such camera
                log.error("no more pictures for the video: %s", error)
                self.recorder = None
                return
        recorder.submit(self._video_picture, (*self.caption, self.env.clock_text))

    def _sensor_frame(self, taken: Snapshot) -> SensorFrame:
        height, width = taken.rgb.shape[:2]
        return SensorFrame(
            sensor_id=taken.camera,
            stamp_monotonic_ns=taken.stamp_ns,
            stamp_wall_ns=self.clock.wall_ns(),
            encoding=FrameEncoding.RGB8,
            width=int(width),
            height=int(height),
            data=taken.rgb.tobytes(),
        )
