"""`SimRunner`: the control loop on the simulator. One environment step per tick, a reset tick before each episode.

Everything here runs on the control thread (MuJoCo's rendering contexts belong to it). It gives the arm to at most one skill,
holds the pose when there is none, and knows no sockets, goals' clients or arbiter.

A run of n episodes has n reset ticks: the last episode ends the run by itself, nothing is reset for an episode that nobody plays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from pydantic import ValidationError

from runner.clock import Clock
from runner.frames import Snapshot
from runner.loop import Applied, Decision
from runner.protocols import DeadlinePolicy, SkillEnded
from runner.recorder import Recorder
from runner.safety import Envelope
from runner.skill_runner import SkillRunner
from schemas import telemetry, tracing
from schemas.control import ControlMode
from schemas.errors import InternalError
from schemas.world import Action, CameraModel, FrameEncoding, JointState, Pose, SensorFrame, WorldState

STILL_AFTER_TICKS = 20  # without a skill nothing moves: the video repeats its last picture
FRAME_REUSE_S = 0.1  # observation cameras are rendered on demand, at most at 10 Hz


class Environment(Protocol):
    """What the loop needs of a simulator (`runner.sim.env.SimEnv`)."""

    def reset(self, seed: int) -> None: ...

    def step(
        self, arm_target: Mapping[str, float] | None, base_velocity: tuple[float, float, float] | None = None
    ) -> None: ...

    @property
    def time_s(self) -> float: ...

    def joint_state(self) -> dict[str, float]: ...

    def joint_velocity(self) -> dict[str, float]: ...

    def joint_limits(self) -> dict[str, tuple[float, float]]: ...

    def base_pose(self) -> tuple[float, float, float]: ...

    def render(self, camera: str) -> Any: ...

    def camera_model(self, camera: str) -> CameraModel: ...

    def close(self) -> None: ...


@dataclass(slots=True)
class Episode:
    """One finished episode of a batch run."""

    index: int
    steps: int
    success: bool | None
    truncated: bool


class SimRunner(SkillRunner):
    """`seed + i` seeds episode i. `episodes` None plays one endless episode (the live runner). `judge` ends an episode when it
    returns True; `max_steps` truncates it."""

    def __init__(
        self,
        make_env: Callable[[], Environment],
        *,
        cameras: tuple[str, ...],
        seed: int = 0,
        rate_hz: float = 30.0,
        deadline_policy: DeadlinePolicy = DeadlinePolicy.WARN,
        clock: Clock | None = None,
        episodes: int | None = None,
        max_steps: int | None = None,
        judge: Callable[[Environment], bool] | None = None,
        recorder: Recorder | None = None,
        video_camera: str = "overview",
        video_every: int = 3,
    ) -> None:
        super().__init__(rate_hz=rate_hz, deadline_policy=deadline_policy, clock=clock)
        self._make_env = make_env
        self._cameras = cameras
        self._seed = seed
        self._episodes_wanted = episodes
        self._max_steps = max_steps
        self._judge = judge
        self.recorder = recorder  # may be set while running
        self._video_camera = video_camera
        self._video_every = video_every
        self._video_picture: Any = None
        self._env: Environment | None = None
        self._envelope: Envelope | None = None
        self._targets: dict[str, float] = {}  # last joint targets, rad
        self._idle_ticks = 0
        self._reset_due = True
        self._episode_idx = 0
        self._step_idx = 0
        self._snapshots: dict[str, Snapshot] = {}
        self.episodes: list[Episode] = []

    # -- life --------------------------------------------------------------------------------------------------------
    def activate(self) -> None:
        if self._env is None:
            self._env = self._make_env()

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

    # -- pictures -----------------------------------------------------------------------------------------------------
    def camera_names(self) -> tuple[str, ...]:
        """Observation cameras, the default one first."""
        return self._cameras

    def snapshot(self, camera: str, max_age_s: float) -> Snapshot:
        """Control thread: a picture no older than `max_age_s`, rendered now unless a recent one is at hand."""
        known = self._snapshots.get(camera)
        newest_ns = self.clock.now_ns() - int(min(max_age_s, FRAME_REUSE_S) * 1e9)
        if known is not None and known.stamp_ns >= newest_ns:
            return known
        return self._render(camera)

    def _render(self, camera: str) -> Snapshot:
        rgb = self.env.render(camera)
        snapshot = Snapshot(camera, rgb, self.clock.now_ns(), self.env.camera_model(camera))
        self._snapshots[camera] = snapshot
        return snapshot

    # -- one tick -----------------------------------------------------------------------------------------------------
    def _finished(self) -> bool:
        played = len(self.episodes)
        return super()._finished() or (self._episodes_wanted is not None and played >= self._episodes_wanted)

    def _success(self) -> bool | None:
        judged = [episode.success for episode in self.episodes if episode.success is not None]
        return all(judged) if judged else None

    def _metadata(self) -> dict[str, Any]:
        finished = len(self.episodes)
        return {**super()._metadata(), "seed": self._seed, "episodes": finished}

    def _decide(self, tick_idx: int) -> Decision:
        """1. reset tick? 2. posted work 3. cameras 4. world state 5. the skill 6. safety."""
        if self._reset_due:  # 1
            return Decision(reset=True)
        self._mailbox.run_pending()  # 2
        started_s = self.clock.now_s()
        active = self._active
        frames: dict[str, SensorFrame] | None = None
        if active is not None and active.skill.wants_frames():  # 3
            with tracing.span(telemetry.SPAN_SENSORS):
                frames = {camera: self._sensor_frame(self._render(camera)) for camera in active.skill.cameras}
        sensed_s = self.clock.now_s()
        try:
            with tracing.span(telemetry.SPAN_WORLD):
                world = self._world(frames)  # 4
        except ValidationError as error:  # a state that is not finite: nobody may act on it
            self.world = None
            self._end(
                SkillEnded({}, InternalError(f"the robot's state is invalid: {error.errors()[0]['msg']}"))
            )
            return Decision(safety_violations=("the robot's state is invalid",))
        self.world = world
        decision = Decision(
            sensors_ms=(sensed_s - started_s) * 1e3, world_state_ms=(self.clock.now_s() - sensed_s) * 1e3
        )
        if active is not None:
            self._ask_skill(active, world, decision)  # 5, 6
        return decision

    def _safety_gate(self) -> Envelope:
        if self._envelope is None:
            self._envelope = Envelope(self.env.joint_limits())
        return self._envelope

    def _apply(self, decision: Decision) -> Applied:
        if decision.reset:
            self._reset_due = False
            self._step_idx = 0
            self._snapshots.clear()
            self.env.reset(self._seed + self._episode_idx)
            self._envelope = Envelope(self.env.joint_limits())
            self._targets = self.env.joint_state()
            for camera in self._cameras:  # a first picture takes a second: rendering contexts, shaders
                self._render(camera)
            return Applied(action_applied=False, episode_idx=self._episode_idx)
        arm, base = _commands(decision.action)
        if (
            arm is not None
        ):  # joints that an action leaves out keep their last target: a closed gripper stays closed
            self._targets.update(arm)
        self.env.step(dict(self._targets) if arm is not None else None, base)
        self._step_idx += 1
        self._idle_ticks = 0 if self._active is not None else self._idle_ticks + 1
        terminated = self._judge is not None and self._judge(self.env)
        truncated = not terminated and self._max_steps is not None and self._step_idx >= self._max_steps
        applied = Applied(
            action_applied=decision.action is not None,
            step_idx=self._step_idx,
            episode_idx=self._episode_idx,
            terminated=terminated,
            truncated=truncated,
        )
        self._record(closing=terminated or truncated)
        if terminated or truncated:
            self.episodes.append(
                Episode(self._episode_idx, self._step_idx, terminated if self._judge else None, truncated)
            )
            self._episode_idx += 1
            self._reset_due = True
        return applied

    def _record(self, *, closing: bool) -> None:
        recorder = self.recorder
        if recorder is None or (self.tick_idx % self._video_every and not closing):
            return
        if self._video_picture is None or self._idle_ticks < STILL_AFTER_TICKS:
            self._video_picture = self.env.render(self._video_camera)
        recorder.submit(self._video_picture, (*self.caption, f"t = {self.env.time_s:.1f} s"))

    # -- observation ----------------------------------------------------------------------------------------------------
    def _world(self, frames: dict[str, SensorFrame] | None) -> WorldState:
        stamp_ns = self.clock.now_ns()
        positions, velocities = self.env.joint_state(), self.env.joint_velocity()
        x, y, yaw = self.env.base_pose()
        return WorldState(
            stamp_ns=stamp_ns,
            joint_state=JointState(
                name=tuple(positions),
                position=tuple(positions.values()),
                velocity=tuple(velocities[name] for name in positions),
                stamp_ns=stamp_ns,
            ),
            base_pose=Pose(
                xyz=(x, y, 0.0), quat_xyzw=(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)), frame_id="map"
            ),
            image_frames=frames,
        )

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


def _commands(action: Action | None) -> tuple[dict[str, float] | None, tuple[float, float, float] | None]:
    """Arm target by joint name and base velocity of an action; (None, None) holds."""
    if action is None:
        return None, None
    if action.control_mode is ControlMode.BODY_TWIST:
        twist = action.rows[0]
        return None, (twist[0], twist[1], twist[5])
    names = action.joint_names
    if names is None:
        raise InternalError("a joint action reached the simulator without joint names")
    return dict(zip(names, action.rows[0], strict=True)), None
