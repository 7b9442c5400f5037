"""Runner's end of a learned policy (`vla`) that lives in its own sidecar process.

A goal: `load` (the sidecar acquires its lease and returns lease and token) → mark one use on that
lease for the whole goal, so that it is not evicted mid-step → arm to the start pose → `reset` →
chunks, played in order → use ended. If the lease is lost in between, the goal fails with that error
and the robot holds. Must not know robot models: joints, cameras and limits come from manifest and
world state.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import importlib
import logging
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.runner.protocols import (
    Act,
    Done,
    Goal,
    Hold,
    Joint,
    RobotDescription,
    StepOutcome,
)
from vram_arbiter.runner.sensors.pictures import as_rgb
from vram_arbiter.runner.skills.actions import ActionPlan, Stepper, Twist, plan_actions
from vram_arbiter.runner.skills.actions import needs_frames as actions_need_frames
from vram_arbiter.runner.skills.base import SkillBase
from vram_arbiter.runner.skills.chunks import ChunkPlayer, Played, Row
from vram_arbiter.runner.skills.kinematics import ArmModel
from vram_arbiter.runner.skills.motion import JointRamp, bounded, is_at, joint_positions
from vram_arbiter.runner.skills.states import StatePlan, plan_state
from vram_arbiter.runner.skills.states import needs_frames as state_needs_frames
from vram_arbiter.schemas.control import JOINT_MODES, ControlMode
from vram_arbiter.schemas.errors import (
    BadState,
    ConfigError,
    Evicted,
    FrameStale,
    LeaseExpired,
    LeaseLost,
    LeaseRevoking,
    ModelError,
    NotResident,
    StaleToken,
    UnknownLease,
    UnknownOp,
    VramError,
    WaitTimeout,
)
from vram_arbiter.schemas.manifest import ManifestError, RSkillManifest
from vram_arbiter.schemas.manifest.problems import Problem
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.sidecar import LoadResult
from vram_arbiter.schemas.world import Action, SensorFrame, WorldState

log = logging.getLogger(__name__)

LOAD_TRIES_MAX = 20
RETRY_S = 0.2
WITHDRAW_S = 3.0  # to take a load back; then the goal ends all the same
CHUNK_TIMEOUT_S = 30.0  # a policy that needs longer for one chunk is gone
LOCKSTEP_WAIT_S = 2.0  # how long one tick of a simulator waits with its world
ROLLOUT_S = 5.0  # of motion, unless the manifest says otherwise
STEP_SHARE = 0.98  # of the longest step: rounding must not reach the gate
STILL_WINDOW = (
    20  # steps over which targets that move less than STILL_RAD mean that the policy has ended
)
STILL_RAD = 0.01
STILL_FROM = 0.5  # share of the rollout before which standing still is just waiting
STATE_KEY, TASK_KEY, IMAGES_PREFIX = "observation.state", "task", "observation.images."
ACTION_KEY = "action"

# The lease went between `load` and the use: load again. Anything else is the goal's failure.
_AGAIN = (
    LeaseRevoking,
    StaleToken,
    UnknownLease,
    LeaseLost,
    LeaseExpired,
    Evicted,
    NotResident,
    BadState,
)


class Use(Protocol):
    """A busy interval on the sidecar's lease (`clients.lease.ForeignUse`)."""

    lost: VramError | None

    async def end(self) -> None: ...


class Arbiter(Protocol):
    """What is needed of `clients.client.AsyncClient`."""

    async def begin_use(self, lease_id: str, token: Sequence[int], label: str = "") -> Use: ...


class View(BaseModel):
    """Crop in fractions of the picture (x0, y0, x1, y1) and the size it is averaged down to."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    crop: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    size_px: tuple[int, int] | None = None


class Rollout(BaseModel):
    """Part of `policy_extras` that the runner reads; other keys belong to the sidecar's adapter."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    rollout_steps: int | None = Field(
        default=None, ge=1, le=100_000
    )  # None: latency_budget.max_execution_s
    stop_when_still: bool = True
    views: dict[str, View] = Field(default_factory=dict)
    prefetch_at: int = Field(default=0, ge=0, le=1000)
    targets_lead: bool = (
        False  # its targets are set points far ahead of the arm: a robot goes there step by step
    )


@dataclass(frozen=True, slots=True)
class Wiring:
    """Map from a manifest's features to this robot: cameras, joints, start pose (rad), and what
    its vectors mean. `model` where a contract speaks of frames.
    """

    cameras: Mapping[str, str]
    robot: RobotDescription
    start_pose: Mapping[str, float] | None  # None: it begins where the robot stands
    actions: ActionPlan
    state: StatePlan
    model: ArmModel | None
    steps_per_chunk: int | None
    rollout: Rollout
    rollout_s: float

    @property
    def joints(self) -> tuple[str, ...]:
        """Return the joints that are commanded, in the order of their targets."""
        return self.actions.joints

    @property
    def stepwise(self) -> bool:
        """Return whether rows are approached, or are steps themselves."""
        return self.rollout.targets_lead or not self.actions.direct


def wire_up(
    manifest: RSkillManifest,
    robot: RobotDescription | tuple[str, ...],
    rest: Mapping[str, float] | None,
) -> Wiring:
    """Read the manifest. `robot` may be its joints' names alone.

    Raises ManifestError with a finding for each part that this robot cannot do or tell.
    """
    if isinstance(robot, tuple):
        robot = RobotDescription(
            "this world", tuple(Joint(name, -math.inf, math.inf, math.inf) for name in robot), {}
        )
    problems: list[Problem] = []
    cameras = _cameras(manifest)
    if not cameras:
        problems.append(
            Problem(
                ("sensors_required",),
                f"names no camera: give a sensor of modality rgb a vla_feature_key {IMAGES_PREFIX}…",
            )
        )
    order, found = _joint_order(manifest, robot)
    model, lost = _model(manifest, robot)
    problems += found
    problems += lost
    actions, found = plan_actions(manifest, robot, order, model)
    state, others = plan_state(manifest, robot, order, model)
    if not lost:  # else all of them say the same
        problems += [*found, *others]
    start = rest
    if manifest.starting_pose is not None:
        if len(manifest.starting_pose) != len(order):
            problems.append(Problem(("starting_pose",), f"must give {len(order)} joints"))
        else:
            start = dict(zip(order, manifest.starting_pose, strict=True))
    rollout = Rollout()
    try:
        rollout = Rollout.model_validate(manifest.policy_extras)
    except ValidationError as error:
        problems.append(Problem(("policy_extras",), error.errors()[0]["msg"]))
    if problems:
        raise ManifestError(manifest.name, problems)
    rollout_s = manifest.latency_budget.max_execution_s or ROLLOUT_S
    return Wiring(
        cameras,
        robot,
        start,
        actions,
        state,
        model,
        manifest.n_action_steps,
        rollout,
        rollout_s,
    )


def _cameras(manifest: RSkillManifest) -> dict[str, str]:
    """Return the key of each of the robot's cameras: the sidecar renames it to what the checkpoint
    calls it.
    """
    aliases = manifest.image_preprocessing.aliases if manifest.image_preprocessing else {}
    robot_name = {model: robot for robot, model in aliases.items()}
    cameras = {}
    for sensor in manifest.sensors_required:
        if sensor.modality == "rgb" and sensor.vla_feature_key:
            name = sensor.vla_feature_key.rpartition(".")[2]
            camera = robot_name.get(name, name)
            cameras[camera] = IMAGES_PREFIX + camera
    return cameras


def _joint_order(
    manifest: RSkillManifest, robot: RobotDescription
) -> tuple[tuple[str, ...], list[Problem]]:
    """Return the joints in the policy's order, the robot's where the manifest gives none."""
    for index, actuator in enumerate(manifest.actuators_required):
        order = actuator.control_mode_semantics.joint_order
        if order is None or actuator.kind not in JOINT_MODES:
            continue
        path = ("actuators_required", index, "control_mode_semantics", "joint_order")
        if set(order) <= set(robot.joint_names) and len(set(order)) == len(order):
            return order, []
        return robot.joint_names, [
            Problem(
                path,
                f"moves {', '.join(order)}; the robot has {', '.join(robot.joint_names)}",
            )
        ]
    return robot.joint_names, []


def _model(
    manifest: RSkillManifest, robot: RobotDescription
) -> tuple[ArmModel | None, list[Problem]]:
    """Return the robot's model if a contract speaks of frames and there is one."""
    solving = actions_need_frames(manifest)
    if not robot.model or not (solving or state_needs_frames(manifest.state_contract)):
        return None, []
    path = ("action_contract",) if solving else ("state_contract",)
    try:
        if solving:
            importlib.import_module("mink")
        return ArmModel(robot), []
    except ImportError:
        return None, [
            Problem(path, "cartesian commands need mink: pip install 'vram-arbiter[runner]'")
        ]
    except ConfigError as error:
        return None, [Problem(path, error.message)]


class SidecarPolicy(SkillBase):
    """`arbiter` None: the sidecar loads at once.

    `wait_s` > 0 lets a simulated world wait for chunks.

    `speeds_rad_s`, by joint, limits a step to what one period allows. The safety gate would rightly
    withhold larger leaps; of absolute targets they are intended only where the manifest says so
    (`targets_lead`). None sends the policy's targets as they are. Steps begin at the motors' last
    targets (`sent`, rad by joint): a command may be dropped for being late, or shortened by the
    gate.
    """

    holds_gpu = True

    def __init__(
        self,
        manifest: RSkillManifest,
        wiring: Wiring,
        client: PolicyClient,
        arbiter: Arbiter | None,
        *,
        period_s: float,
        wait_s: float = 0.0,
        revision: str = "",
        speeds_rad_s: Mapping[str, float] | None = None,
        sent: Callable[[], Mapping[str, float]] | None = None,
    ) -> None:
        super().__init__(manifest, revision=revision)
        longest = {name: STEP_SHARE * v * period_s for name, v in (speeds_rad_s or {}).items()}
        self._longest = tuple(longest[name] for name in wiring.joints) if longest else None
        self._read = wiring.robot.joint_names
        self._stepper = (
            None
            if wiring.actions.direct
            else Stepper(
                wiring.actions, wiring.robot, wiring.model, period_s=period_s, longest=longest
            )
        )
        self._sent = sent
        self._commanded: Row | None = None
        self._last: Mapping[str, float] = {}  # what was commanded last, by joint
        self.cameras = tuple(wiring.cameras)
        self._wiring = wiring
        self._client = client
        self._arbiter = arbiter
        self._period_s = period_s
        self._wait_s = wait_s
        self._steps = wiring.rollout.rollout_steps or max(1, round(wiring.rollout_s / period_s))
        self._loop: asyncio.AbstractEventLoop | None = None
        self._use: Use | None = None
        self._token: tuple[int, ...] | None = None
        self._loaded = False
        self._task = ""
        self._traceparent: str | None = None
        self._ramp: JointRamp | None = None
        self._running = False
        self._player: ChunkPlayer | None = None
        self._recent: deque[Row] = deque(maxlen=STILL_WINDOW)
        self._target: dict[str, float] = {}

    # -- event loop
    async def _start(self, goal: Goal) -> None:
        self._loop = asyncio.get_running_loop()
        self._traceparent = goal.traceparent
        self._task = goal.prompt or self.manifest.default_prompt or ""
        if not self._task:
            raise ModelError(
                f"{self.key} needs a prompt", hint="say what to do, e.g. `grab the red cube`"
            )
        await self._occupy(goal)
        await self._client.reset({TASK_KEY: self._task}, token=self._token)
        self._ramp, self._running, self._commanded = None, False, None
        self._recent.clear()
        # of this goal: a late request without a token would load the model anew
        token = self._token
        self._player = ChunkPlayer(
            lambda observation: self._request(observation, token),
            prefetch_at=self._wiring.rollout.prefetch_at,
            wait_s=self._wait_s,
        )

    async def _occupy(self, goal: Goal) -> None:
        """Resident and in use, both at once. The goal's deadline bounds how long this may take."""
        for attempt in range(1, LOAD_TRIES_MAX + 1):
            try:
                loaded = await self._load(goal)
                self._loaded = True
                lease_id, token = loaded["lease_id"], loaded["token"]
                self._token = tuple(token) if token is not None else None
                if self._arbiter is not None and lease_id is not None and self._token is not None:
                    self._use = await self._arbiter.begin_use(lease_id, self._token, goal.rskill_id)
                return
            except _AGAIN as error:
                if attempt == LOAD_TRIES_MAX:
                    raise
                log.info(
                    "%s was made to leave before the goal began (%s); loading again",
                    self.key,
                    error.code,
                )
                await asyncio.sleep(RETRY_S)

    async def _load(self, goal: Goal) -> LoadResult:
        """Take back the load of a goal that is over before the model is there: no eviction for
        it.
        """
        try:
            return await self._client.load(timeout_s=goal.deadline_s or None)
        except (
            asyncio.CancelledError,
            WaitTimeout,
        ):  # a policy on standby is called back behind its request
            with contextlib.suppress(VramError, TimeoutError):
                async with asyncio.timeout(WITHDRAW_S):
                    if (await self._client.ping(timeout_s=WITHDRAW_S)).get("wanted"):
                        await self._client.unload()
            raise

    async def _finish(self) -> None:
        player, self._player = self._player, None
        if player is not None:
            player.close()
        use, self._use = self._use, None
        self._token = None
        if use is not None:
            await use.end()

    async def _release(self) -> None:
        """Make the sidecar free its memory for another policy; skip a sidecar that never loaded for
        us.
        """
        try:
            if self._loaded:
                # a server of the field has no unload: the lease is that of `vramctl run`
                with contextlib.suppress(UnknownOp):
                    await self._client.unload()
        finally:
            await self._client.close()

    async def _fetch(self, observation: JsonMap, token: tuple[int, ...] | None) -> list[Row]:
        """Request a chunk; the tick that asked is the span's parent, or the goal if it is not
        recorded.
        """
        parent = None if tracing.recorded() else self._traceparent
        with tracing.span(telemetry.SPAN_CHUNK, parent, {telemetry.ATTR_SKILL: self.key.rskill_id}):
            answer = await self._client.get_action(
                observation, token=token, timeout_s=CHUNK_TIMEOUT_S
            )
            return self._rows(answer)

    # -- control thread
    def wants_frames(self) -> bool:
        return self._running and self._player is not None and self._player.wants_observation()

    def _step(self, world: WorldState) -> StepOutcome:
        player = self._player
        if player is None:
            raise BadState(f"{self.key} was stepped without a goal")
        if self._use is not None and self._use.lost is not None:
            raise self._use.lost
        measured = joint_positions(world, self._read)
        if not self._running:
            if not self._at_start(measured):
                return Act(_joint_action(self._target, None, world))
            self._running = True
            return Hold("at the start pose")
        if player.played >= self._steps or self._stands_still(player):
            return Done({"steps": player.played, "chunks": player.chunks})
        observation = self._observation(world, measured) if player.wants_observation() else None
        played = player.next_row(observation)
        if played is None:
            return Hold("the policy thinks")
        self.fraction = player.played / self._steps
        if self._stepper is not None:
            return self._stepped(self._stepper, played, measured, world)
        self._recent.append(played.row)
        row = self._step_towards(played.row, measured)
        action = Action(
            control_mode=ControlMode.JOINT_POSITION,
            joint_targets=(row,),
            joint_names=self._wiring.joints,
            stamp_ns=world.stamp_ns,
        )
        return Act(action, chunk_index=played.chunk, prefetched=played.prefetched)

    def _stepped(
        self, stepper: Stepper, played: Played, measured: Mapping[str, float], world: WorldState
    ) -> StepOutcome:
        """Return what a row that is not just joint targets comes to from here."""
        player = self._player
        start = dict(measured)
        if self._commanded is not None:
            start.update(self._sent() if self._sent is not None else self._last)
        step = stepper.step(played.row, start)
        if step.terminated:
            played_so_far = {"steps": player.played, "chunks": player.chunks} if player else {}
            return Done({**played_so_far, "terminated": True})
        if step.withheld:
            return Hold(step.problem, withheld=True)
        targets = {name: step.targets.get(name, start[name]) for name in self._wiring.joints}
        self._commanded = tuple(targets.values())
        self._last = targets
        driving = step.twist is not None and any(abs(v) > STILL_RAD for v in step.twist)
        if driving:
            self._recent.clear()
        else:
            self._recent.append(self._commanded)
        return Act(
            _joint_action(targets, step.twist, world),
            chunk_index=played.chunk,
            prefetched=played.prefetched,
            problem=step.problem,
        )

    def _at_start(self, measured: Mapping[str, float]) -> bool:
        """Return whether the arm is at the start pose; set the next target when not."""
        if not self._wiring.start_pose:
            return True
        start = self._wiring.start_pose
        goal = {name: start[name] for name in self._read if name in start}
        if self._ramp is None:
            if is_at(measured, goal):
                return True
            self._ramp = JointRamp(measured, goal, period_s=self._period_s)
        if self._ramp.done(measured):
            return True
        self._target = self._ramp.next_target()
        return False

    def _step_towards(self, row: Row, measured: Mapping[str, float]) -> Row:
        """Return the policy's targets, or as much of the way there as one period allows."""
        if self._longest is None:
            return row
        start = self._commanded or tuple(measured[name] for name in self._wiring.joints)
        if self._commanded is not None and self._sent is not None:
            sent = self._sent()
            start = tuple(sent.get(name, measured[name]) for name in self._wiring.joints)
        self._commanded = tuple(
            bounded(here, target, longest)
            for here, target, longest in zip(start, row, self._longest, strict=True)
        )
        return self._commanded

    def _stands_still(self, player: ChunkPlayer) -> bool:
        if not self._wiring.rollout.stop_when_still or player.played < STILL_FROM * self._steps:
            return False
        if len(self._recent) < STILL_WINDOW:
            return False
        return all(
            max(column) - min(column) < STILL_RAD for column in zip(*self._recent, strict=True)
        )

    def _observation(self, world: WorldState, measured: Mapping[str, float]) -> Message:
        import numpy as np

        values = self._wiring.state.vector(world, measured, self._wiring.model)
        observation: Message = {
            STATE_KEY: np.asarray(values, dtype=np.float32),
            TASK_KEY: self._task,
        }
        frames = world.image_frames or {}
        for camera, key in self._wiring.cameras.items():
            frame = frames.get(camera)
            if frame is None or frame.data is None or camera in world.stale:
                raise FrameStale(
                    f"no frame of camera {camera}", hint="nothing moves without a picture"
                )
            observation[key] = _picture(frame, self._wiring.rollout.views.get(camera))
        return observation

    def _request(
        self, observation: Any, token: tuple[int, ...] | None
    ) -> concurrent.futures.Future[Sequence[Row]]:
        if self._loop is None:
            raise BadState(f"{self.key} has no event loop")
        return asyncio.run_coroutine_threadsafe(self._fetch(observation, token), self._loop)

    def _rows(self, answer: JsonMap) -> list[Row]:
        """Return rows in m and rad.

        Raises ModelError for a wrong shape or infinite numbers.
        """
        import numpy as np

        if ACTION_KEY not in answer:
            raise ModelError(f"the policy answered {sorted(answer)}, no {ACTION_KEY!r}")
        try:
            actions = np.asarray(answer[ACTION_KEY], dtype=float)
        except (TypeError, ValueError) as error:
            raise ModelError(f"the policy's actions are no numbers: {error}") from error
        return self._wiring.actions.rows(actions, self._wiring.steps_per_chunk)


def _joint_action(targets: Mapping[str, float], twist: Twist | None, world: WorldState) -> Action:
    """Return an action of joint targets (rad), with a base's velocity, or of that alone."""
    driving = None if twist is None else (twist,)
    if not targets and driving is not None:
        return Action(
            control_mode=ControlMode.BODY_TWIST, body_twist=driving, stamp_ns=world.stamp_ns
        )
    return Action(
        control_mode=ControlMode.JOINT_POSITION,
        joint_targets=(tuple(targets.values()),),
        joint_names=tuple(targets),
        body_twist=driving,
        stamp_ns=world.stamp_ns,
    )


def _picture(frame: SensorFrame, view: View | None) -> Any:
    """RGB uint8, height × width × 3, cropped and averaged down as the policy was trained."""
    import numpy as np

    picture = as_rgb(frame)
    if view is None:
        return picture
    x0, y0, x1, y1 = view.crop
    picture = picture[
        round(y0 * frame.height) : round(y1 * frame.height),
        round(x0 * frame.width) : round(x1 * frame.width),
    ]
    if view.size_px is not None:
        import cv2

        picture = cv2.resize(picture, view.size_px, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(picture)
