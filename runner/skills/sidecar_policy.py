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
import logging
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.runner.protocols import Act, Done, Goal, Hold, StepOutcome
from vram_arbiter.runner.sensors.pictures import as_rgb
from vram_arbiter.runner.skills.base import SkillBase
from vram_arbiter.runner.skills.chunks import ChunkPlayer, Row
from vram_arbiter.runner.skills.motion import JointRamp, bounded, is_at, joint_positions
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import (
    BadState,
    Evicted,
    FrameStale,
    LeaseExpired,
    LeaseLost,
    LeaseRevoking,
    ManifestInvalid,
    ModelError,
    NotResident,
    StaleToken,
    UnknownLease,
    UnknownOp,
    VramError,
    WaitTimeout,
)
from vram_arbiter.schemas.manifest import RSkillManifest
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
    """Map from a manifest's features to this robot: cameras, joint order, start pose (rad)."""

    cameras: Mapping[str, str]
    joints: tuple[str, ...]
    start_pose: Mapping[str, float] | None  # None: it begins where the robot stands
    degrees: bool
    steps_per_chunk: int | None
    rollout: Rollout
    rollout_s: float


def wire_up(
    manifest: RSkillManifest, joints: tuple[str, ...], rest: Mapping[str, float] | None
) -> Wiring:
    """Read the manifest. Raises ManifestInvalid without inputs, or if it does not fit the
    joints.
    """
    aliases = manifest.image_preprocessing.aliases if manifest.image_preprocessing else {}
    robot_name = {model: robot for robot, model in aliases.items()}
    cameras: dict[str, str] = {}
    for sensor in manifest.sensors_required:
        if sensor.modality == "rgb" and sensor.vla_feature_key:
            name = sensor.vla_feature_key.rpartition(".")[2]
            camera = robot_name.get(name, name)
            cameras[camera] = (
                IMAGES_PREFIX + camera
            )  # the sidecar renames it to what the checkpoint calls it
    if not cameras:
        raise ManifestInvalid(
            f"{manifest.name} names no camera",
            hint=f"give a sensor of modality rgb a vla_feature_key {IMAGES_PREFIX}…",
        )
    dim = manifest.action_contract.dim if manifest.action_contract else None
    if dim is not None and dim != len(joints):
        raise ManifestInvalid(f"{manifest.name} commands {dim} joints, the robot has {len(joints)}")
    degrees = bool(manifest.action_contract and manifest.action_contract.joint_units == "degrees")
    start = rest
    if manifest.starting_pose is not None:
        if len(manifest.starting_pose) != len(joints):
            raise ManifestInvalid(f"{manifest.name}: starting_pose must give {len(joints)} joints")
        start = dict(zip(joints, manifest.starting_pose, strict=True))
    try:
        rollout = Rollout.model_validate(manifest.policy_extras)
    except ValidationError as error:
        raise ManifestInvalid(
            f"{manifest.name}: policy_extras: {error.errors()[0]['msg']}"
        ) from error
    rollout_s = manifest.latency_budget.max_execution_s or ROLLOUT_S
    return Wiring(cameras, joints, start, degrees, manifest.n_action_steps, rollout, rollout_s)


class SidecarPolicy(SkillBase):
    """`arbiter` None: the sidecar loads at once.

    `wait_s` > 0 lets a simulated world wait for chunks.

    `speeds_rad_s`, by joint, limits a step to what one period allows. The safety gate would rightly
    withhold larger leaps; they are intended only where the manifest says so (`targets_lead`). None
    sends the policy's targets as they are. Steps begin at the motors' last targets (`sent`, rad by
    joint): a command may be dropped for being late, or shortened by the gate.
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
        self._longest = (
            tuple(STEP_SHARE * speeds_rad_s[name] * period_s for name in wiring.joints)
            if speeds_rad_s is not None
            else None
        )
        self._sent = sent
        self._commanded: Row | None = None
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
        measured = joint_positions(world, self._wiring.joints)
        if not self._running:
            if not self._at_start(measured):
                return Act(self._action(tuple(self._target.values()), world))
            self._running = True
            return Hold("at the start pose")
        if player.played >= self._steps or self._stands_still(player):
            return Done({"steps": player.played, "chunks": player.chunks})
        observation = self._observation(world, measured) if player.wants_observation() else None
        played = player.next_row(observation)
        if played is None:
            return Hold("the policy thinks")
        self._recent.append(played.row)
        self.fraction = player.played / self._steps
        action = self._action(self._step_towards(played.row, measured), world)
        return Act(action, chunk_index=played.chunk, prefetched=played.prefetched)

    def _at_start(self, measured: Mapping[str, float]) -> bool:
        """Return whether the arm is at the start pose; set the next target when not."""
        if self._wiring.start_pose is None:
            return True
        goal = {name: self._wiring.start_pose[name] for name in self._wiring.joints}
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

        values = [measured[name] for name in self._wiring.joints]
        if self._wiring.degrees:
            values = [math.degrees(value) for value in values]
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
        """Return rows of joint targets in rad.

        Raises ModelError for a wrong shape or infinite numbers.
        """
        import numpy as np

        if ACTION_KEY not in answer:
            raise ModelError(f"the policy answered {sorted(answer)}, no {ACTION_KEY!r}")
        try:
            actions = np.asarray(answer[ACTION_KEY], dtype=float)
        except (TypeError, ValueError) as error:
            raise ModelError(f"the policy's actions are no numbers: {error}") from error
        if actions.ndim == 3 and actions.shape[0] == 1:
            actions = actions[0]
        if actions.ndim != 2 or actions.shape[1] != len(self._wiring.joints):
            raise ModelError(
                f"actions of shape {actions.shape}; (steps, {len(self._wiring.joints)}) is expected"
            )
        if not np.isfinite(actions).all():
            raise ModelError(
                "the policy commands numbers that are not finite", hint="its weights are broken"
            )
        if self._wiring.degrees:
            actions = np.radians(actions)
        return [tuple(map(float, row)) for row in actions[: self._wiring.steps_per_chunk]]

    def _action(self, row: Row, world: WorldState) -> Action:
        return Action(
            control_mode=ControlMode.JOINT_POSITION,
            joint_targets=(row,),
            joint_names=self._wiring.joints,
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
