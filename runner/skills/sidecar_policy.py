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
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.lease import AsyncForeignUse
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.runner.protocols import (
    Act,
    ChunkStart,
    Done,
    Goal,
    Hold,
    StepOutcome,
)
from vram_arbiter.runner.sensors.pictures import as_rgb
from vram_arbiter.runner.skills.actions import Stepper
from vram_arbiter.runner.skills.base import SkillBase
from vram_arbiter.runner.skills.chunks import ChunkPlayer, Played, Row
from vram_arbiter.runner.skills.model_phase import PHASE_S, model_phase
from vram_arbiter.runner.skills.motion import JointRamp, action_of, is_at, joint_positions
from vram_arbiter.runner.skills.wiring import STATE, TASK, View, Wiring
from vram_arbiter.schemas.errors import (
    BadState,
    Evicted,
    FrameStale,
    LeaseExpired,
    LeaseLost,
    LeaseRevoking,
    ModelError,
    NotResident,
    SidecarUnavailable,
    StaleToken,
    UnknownLease,
    UnknownOp,
    VramError,
    WaitTimeout,
)
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.sidecar import LoadResult, RealTimeChunking
from vram_arbiter.schemas.world import SensorFrame, WorldState

log = logging.getLogger(__name__)

LOAD_TRIES_MAX = 20
RETRY_S = 0.2
WITHDRAW_S = 3.0  # to take a load back; then the goal ends all the same
HUNG_AFTER = 5.0  # times the manifest's time for a chunk: a policy that needs longer hangs …
HUNG_MIN_S = 2.0  # … but a busy machine may take so long for any
HUNG_FIRST_MIN_S = 10.0  # for a goal's first chunk, after which the model is warm
HUNG_WAITING_MIN_S = 30.0  # where a simulated world waits: no time passes for its robot
LOCKSTEP_WAIT_S = 2.0  # how long one tick of a simulator waits with its world
STEP_SHARE = 0.98  # of the longest step: rounding must not reach the gate
STILL_WINDOW = (
    20  # steps over which targets that move less than STILL_RAD mean that the policy has ended
)
STILL_RAD = 0.01
STILL_FROM = 0.5  # share of the rollout before which standing still is just waiting
ACTION_KEY, CONFIDENCE_KEY = "action", "confidence"

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


class SidecarPolicy(SkillBase):
    """`arbiter` None: the sidecar loads at once.

    `wait_s` > 0 lets a simulated world wait for chunks; `latency_steps` is how many of its control
    steps a chunk takes there (`chunks.ChunkPlayer`).

    `speeds_rad_s`, by joint, limits the way to the start pose and a policy's steps to what one
    period allows. The safety gate would rightly withhold larger leaps; absolute targets of arm
    joints are approached only where the manifest says that they lead (`targets_lead`), and else
    sent as they are. Steps begin at the motors' last targets (`sent`, rad by joint): a command may
    be dropped for being late, or shortened by the gate.
    """

    holds_gpu = True

    def __init__(
        self,
        manifest: RSkillManifest,
        wiring: Wiring,
        client: PolicyClient,
        arbiter: AsyncClient | None,
        *,
        period_s: float,
        wait_s: float = 0.0,
        latency_steps: int | None = None,
        speeds_rad_s: Mapping[str, float] | None = None,
        sent: Callable[[], Mapping[str, float]] | None = None,
    ) -> None:
        super().__init__(manifest)
        longest = {name: STEP_SHARE * v * period_s for name, v in (speeds_rad_s or {}).items()}
        self._longest_steps = longest
        self._read = wiring.robot.joint_names
        self._stepper = Stepper(
            wiring.actions,
            wiring.robot,
            wiring.model,
            period_s=period_s,
            longest=longest,
            leading=wiring.rollout.targets_lead,
        )
        self._sent = sent
        self._commanded: Mapping[str, float] = {}  # by joint; empty: nothing yet
        self.cameras = tuple(wiring.cameras)
        self._wiring = wiring
        self._client = client
        self._arbiter = arbiter
        self._period_s = period_s
        self._wait_s = wait_s
        self._latency_steps = latency_steps
        self._steps = wiring.rollout.rollout_steps or max(1, round(wiring.rollout_s / period_s))
        self._loop: asyncio.AbstractEventLoop | None = None
        self._use: AsyncForeignUse | None = None
        self._token: tuple[int, ...] | None = None
        self._loaded = False
        self._task = ""
        self._traceparent: str | None = None
        self._ramp: JointRamp | None = None
        self._running = False
        self._player: ChunkPlayer | None = None
        self._recent: deque[Row] = deque(maxlen=STILL_WINDOW)
        self._seen: deque[Message] = deque(maxlen=1)  # the policy's history
        self._latency_s = 0.0  # of the newest chunk that was answered
        self._answered: float | None = None  # its confidence; None: the policy has none
        self._confidence: float | None = None  # of the chunk that plays
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
        begun = await self._client.reset({TASK: self._task}, token=self._token)
        rollout = self._wiring.rollout
        self._ramp, self._running, self._commanded = None, goal.from_here, {}
        self._confidence = None
        self._recent.clear()
        self._seen = deque(maxlen=_count(begun, "n_obs_steps") or rollout.n_obs_steps or 1)
        # of this goal: a late request without a token would load the model anew
        token = self._token
        self._player = ChunkPlayer(
            lambda observation: self._request(observation, token),
            prefetch_at=rollout.prefetch_at,
            keep=self._wiring.steps_per_chunk or _count(begun, "n_action_steps"),
            wait_s=self._wait_s,
            latency_steps=self._latency_steps,
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
        following = asyncio.create_task(self._follow_phase(), name="phase")
        try:
            loaded = await self._client.load(timeout_s=goal.deadline_s or None)
        except (
            asyncio.CancelledError,
            WaitTimeout,
        ):  # a policy on standby is called back behind its request
            with contextlib.suppress(VramError, TimeoutError):
                async with asyncio.timeout(WITHDRAW_S):
                    if (await self._client.ping(timeout_s=WITHDRAW_S)).get("wanted"):
                        await self._client.unload()
            raise
        finally:
            following.cancel()
        self.phase = ""
        return loaded

    async def _follow_phase(self) -> None:
        """Keep `phase` up to date."""
        while True:
            with contextlib.suppress(VramError):  # the load itself says what is wrong
                self.phase = await model_phase(self._client, self._arbiter)
            await asyncio.sleep(PHASE_S)

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

    async def _fetch(
        self,
        observation: JsonMap,
        token: tuple[int, ...] | None,
        rtc: RealTimeChunking | None,
        limit_s: float,
    ) -> list[Row]:
        """Request a chunk; the tick that asked is the span's parent, or the goal if it is not
        recorded.
        """
        parent = None if tracing.recorded() else self._traceparent
        with tracing.span(telemetry.SPAN_CHUNK, parent, {telemetry.ATTR_SKILL: self.key.rskill_id}):
            asked_s = time.monotonic()
            try:
                async with asyncio.timeout(limit_s):
                    answer = await self._client.get_action(
                        observation,
                        rtc=rtc,
                        whole_chunk=self._wiring.rollout.prefetch_at > 0,
                        token=token,
                    )
            except TimeoutError:
                raise SidecarUnavailable(
                    f"{self.key} hangs: no chunk within {limit_s:g} s, {self._budget()}",
                    hint="see the sidecar's log; a slow policy needs a larger "
                    "latency_budget.per_chunk_ms",
                    details={"limit_s": limit_s, "endpoint": self._client.endpoint},
                ) from None
            self._latency_s = time.monotonic() - asked_s
            labels = {telemetry.ATTR_SKILL: self.key.rskill_id}
            meters.measure(telemetry.METRIC_CHUNK, self._latency_s, labels)
            self._answered = _confidence(answer)
            return self._rows(answer)

    def _budget(self) -> str:
        budget_ms = self.manifest.latency_budget.per_chunk_ms
        return f"{HUNG_AFTER:g} times its latency_budget.per_chunk_ms of {budget_ms:g} or more"

    def _limit_s(self, *, first: bool) -> float:
        """Return the time after which a policy that has not answered hangs."""
        budget = self.manifest.latency_budget
        budget_ms = budget.per_chunk_ms + (budget.warmup_ms or 0.0 if first else 0.0)
        least_s = HUNG_FIRST_MIN_S if first else HUNG_MIN_S
        if self._wait_s:
            least_s = max(least_s, HUNG_WAITING_MIN_S)
        return max(least_s, HUNG_AFTER * budget_ms / 1e3)

    # -- control thread
    def wants_frames(self) -> bool:
        return (
            self._running
            and self._player is not None
            and self._player.wants_observation(self._ahead)
        )

    @property
    def _ahead(self) -> int:
        """Control steps before a request of which the policy sees the observations, too."""
        return (self._seen.maxlen or 1) - 1

    def _step(self, world: WorldState) -> StepOutcome:
        player = self._player
        if player is None:
            raise BadState(f"{self.key} was stepped without a goal")
        if self._use is not None and self._use.lost is not None:
            raise self._use.lost
        if not self._client.connected:
            raise SidecarUnavailable(
                f"contact to {self._client.endpoint} was lost within the goal",
                hint="the next goal starts or finds the sidecar again; see its log",
                details={"endpoint": self._client.endpoint},
            )
        measured = joint_positions(world, self._read)
        if not self._running:
            if not self._at_start(measured):
                return Act(action_of(self._target, world.stamp_ns))
            self._running = True
            return Hold("at the start pose")
        if player.played >= self._steps or self._stands_still(player):
            return self._done(player)
        if player.wants_observation(self._ahead):
            self._see(self._observation(world, measured))
        played = player.next_row(self._history() if player.wants_observation() else None)
        if played is None:
            return Hold("the policy thinks", standing=player.played > 0)
        self.fraction = player.played / self._steps
        return self._stepped(player, played, measured, world)

    def _chunk_start(self, played: Played) -> ChunkStart | None:
        if not played.first:
            return None
        budget_s = self.manifest.latency_budget.per_chunk_ms / 1e3
        return ChunkStart(self._latency_s, played.prefetched, self._latency_s > budget_s)

    def _stepped(
        self,
        player: ChunkPlayer,
        played: Played,
        measured: Mapping[str, float],
        world: WorldState,
    ) -> StepOutcome:
        """Return what a row comes to from here."""
        if played.first:
            self._confidence = self._answered
        start = dict(measured)
        if self._commanded:
            start.update(self._sent() if self._sent is not None else self._commanded)
        step = self._stepper.step(played.row, start)
        if step.terminated:
            return self._done(player, terminated=True)
        if step.withheld:
            return Hold(step.problem, withheld=True)
        targets = {name: step.targets.get(name, start[name]) for name in self._wiring.joints}
        self._commanded = targets
        driving = step.twist is not None and any(abs(v) > STILL_RAD for v in step.twist)
        if driving:
            self._recent.clear()
        else:
            self._recent.append(tuple(targets.values()))
        return Act(
            action_of(
                targets,
                world.stamp_ns,
                step.twist,
                1.0 if self._confidence is None else self._confidence,
            ),
            chunk_index=played.chunk,
            chunk=self._chunk_start(played),
            problem=step.problem,
        )

    def _done(self, player: ChunkPlayer, **more: bool) -> Done:
        told = {} if self._confidence is None else {CONFIDENCE_KEY: self._confidence}
        return Done({"steps": player.played, "chunks": player.chunks, **told, **more})

    def _at_start(self, measured: Mapping[str, float]) -> bool:
        """Return whether the arm is at the start pose; set the next target when not."""
        if not self._wiring.start_pose:
            return True
        start = self._wiring.start_pose
        goal = {name: start[name] for name in self._read if name in start}
        if self._ramp is None:
            if is_at(measured, goal):
                return True
            self._ramp = JointRamp(
                measured, goal, period_s=self._period_s, longest=self._longest_steps
            )
        if self._ramp.done(measured):
            return True
        self._target = self._ramp.next_target()
        return False

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
            STATE: np.asarray(values, dtype=np.float32),
            TASK: self._task,
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

    def _see(self, observation: Message) -> None:
        """Add a control step to the history; the first one of a goal fills it, as in lerobot."""
        self._seen.extend([observation] * (1 if self._seen else self._ahead + 1))

    def _history(self) -> Message:
        """Return the last observations as one: with several, arrays have a leading dimension, of
        control steps with the oldest first.
        """
        import numpy as np

        steps = list(self._seen)
        if len(steps) == 1:
            return steps[0]
        return {
            name: value if name == TASK else np.stack([step[name] for step in steps])
            for name, value in steps[-1].items()
        }

    def _request(
        self, observation: Any, token: tuple[int, ...] | None
    ) -> concurrent.futures.Future[Sequence[Row]]:
        if self._loop is None:
            raise BadState(f"{self.key} has no event loop")
        first = self._player is None or self._player.chunks == 0
        limit_s = self._limit_s(first=first)
        fetch = self._fetch(observation, token, self._real_time(), limit_s)
        return asyncio.run_coroutine_threadsafe(fetch, self._loop)

    def _real_time(self) -> RealTimeChunking | None:
        """Return what the chunks so far say about the next steps; None: nothing, or not asked."""
        told, player = self._wiring.rollout.rtc, self._player
        if told is None or player is None:
            return None
        rows = player.left_over(told.execution_horizon)
        if not rows:
            return None
        return RealTimeChunking(
            left_over=self._wiring.actions.numbers(rows),
            inference_delay=player.delay,
            execution_horizon=told.execution_horizon,
        )

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
        return self._wiring.actions.rows(actions)


def _count(begun: JsonMap, name: str) -> int | None:
    """Return what a sidecar says of an episode; None: a server of the field, which does not."""
    found = begun.get(name)
    return found if isinstance(found, int) and found > 0 else None


def _confidence(answer: JsonMap) -> float | None:
    """Return the mean of an answer's `confidence`, which may be by channel; None without one.

    Raises ModelError for numbers outside of 0..1.
    """
    import numpy as np

    if (told := answer.get(CONFIDENCE_KEY)) is None:
        return None
    try:
        values = np.asarray(told, dtype=float)
    except (TypeError, ValueError) as error:
        raise ModelError(f"the policy's confidence is not a number: {error}") from error
    if not values.size or not ((values >= 0) & (values <= 1)).all():
        raise ModelError(f"the policy's confidence must be 0 to 1, not {told!r:.80}")
    return float(values.mean())


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
