"""A policy skill between a small real sidecar and an arbiter that gives uses."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any

from tests.runner.small_robots import robot_of
from tests.support.serving import answering
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.clients.sidecar import npy
from vram_arbiter.runner.protocols import Act, Done, StepOutcome
from vram_arbiter.runner.skills.makers import client_of
from vram_arbiter.runner.skills.sidecar_policy import SidecarPolicy
from vram_arbiter.runner.skills.wiring import Wiring, wire_up
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.world import FrameEncoding, JointState, SensorFrame, WorldState

JOINTS = ("a", "b")
REST = {"a": 0.0, "b": 0.5}
MANIFEST = """
name: "test/arm-grab"
version: "1.0.0"
kind: vla
model_family: act
embodiment_tags: [custom]
embodiment_extra:
  sensors: [{modality: rgb, count: 1}]
  actuators: [{kind: joint_position, n_dof: 2, control_mode_semantics: {mode: absolute}}]
sensors_required:
  - {modality: rgb, vla_feature_key: observation.images.front}
actuators_required:
  - {kind: joint_position, n_dof: 2, vla_action_key: action,
     control_mode_semantics: {mode: absolute}}
weights_uri: "local://models/none"
chunk_size: 3
latency_budget: {per_chunk_ms: 100.0, max_execution_s: 20.0}
min_vram_gb: {fp32: 1.0}
description: "A policy of this test."
actions: [grasp]
action_contract: {dim: 2}
policy_extras: {rollout_steps: 7, stop_when_still: false}
"""


class Sidecar:
    """Speaks the endpoint family. Chunk n is [(n, 0), (n, 1), (n, 2)] / 100."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.tokens: list[Any] = []
        self.observations: list[Any] = []
        self.guidance: list[Any] = []  # "rtc" of each request for actions
        self.whole: list[bool] = []  # whether each asked for the whole chunk
        self.requests: list[Message] = []  # for actions
        self.begun: Message = {}  # what it says of an episode
        self.answer: Message = {}  # what it says beside actions
        self.serial = 1
        self.action: Any = None
        self.confidence: list[Any] = []  # of the next chunks
        self.error: VramError | None = None
        self.load_error: VramError | None = None
        self.arbitrated = True
        self.state = "resident"
        self.consumer: str | None = None  # its name at the arbiter
        self.wanted = False  # somebody waits for the model
        self.late_s = 0.0  # how long it lets a ping wait
        self.loads: asyncio.Event | None = None  # set once a load has come, which is never answered
        self.hangs = False  # it answers no request for actions

    @asynccontextmanager
    async def served(self, endpoint: str) -> AsyncIterator[None]:
        self.server = RouterServer(endpoint, lambda error: {"ok": False, "error": str(error)})
        async with answering(self.server, self.handle):
            yield

    async def handle(self, peer: Peer, message: Message) -> None:
        import numpy as np

        endpoint = message["endpoint"]
        if endpoint != "ping":
            self.calls.append(endpoint)
            self.tokens.append(message.get("token"))
        if endpoint == "load" and self.loads is not None:
            self.loads.set()
            return
        if endpoint == "get_action" and self.hangs:
            return
        error = self.load_error if endpoint == "load" else self.error
        if endpoint in ("load", "get_action") and error is not None:
            reply: Message = {
                "ok": False,
                "error": str(error),
                **{k: v for k, v in error.to_wire().items() if k == "code"},
            }
            self.load_error = None
        elif endpoint == "load":
            lease = f"L1-{self.serial}" if self.arbitrated else None
            reply = {
                "ok": True,
                "lease_id": lease,
                "token": [1, self.serial] if lease else None,
                "loaded": True,
            }
        elif endpoint == "get_action":
            self.requests.append(message)
            self.observations.append(npy.unpack(message["data"]["observation"]))
            self.guidance.append(message.get("rtc"))
            self.whole.append(message.get("whole_chunk", False))
            number = len(self.observations) - 1
            action = np.array([[number, i] for i in range(3)], dtype=np.float32) / 100
            reply = {"action": npy.pack(self.action if self.action is not None else action)}
            reply |= self.answer
            if self.confidence:
                reply["confidence"] = npy.pack(self.confidence.pop(0))
        elif endpoint == "ping":
            await asyncio.sleep(self.late_s)
            reply = {
                "ok": True,
                "model": "m",
                "revision": "",
                "kind": "vla",
                "rskill": "test/arm-grab",
                "pid": 1,
                "boot_id": "b",
                "state": self.state,
            }
            if self.wanted:
                reply["wanted"] = True
            if self.consumer is not None:
                reply["consumer"] = self.consumer
        else:
            reply = {"ok": True} | (self.begun if endpoint == "reset" else {})
        if "id" in message:
            reply["re"] = message["id"]
        await self.server.send(peer, reply)


class Leased(Sidecar):
    """Its model has a lease at the server's arbiter."""

    lease: AsyncLease

    async def handle(self, peer: Peer, message: Message) -> None:
        if message["endpoint"] == "load":
            told = {"lease_id": self.lease.lease_id, "token": list(self.lease.token)}
            await self.server.send(peer, {"re": message["id"], "ok": True, "loaded": True, **told})
        else:
            await super().handle(peer, message)


class Use:
    def __init__(self) -> None:
        self.lost: VramError | None = None
        self.ended = 0

    async def end(self) -> None:
        self.ended += 1


class Arbiter:
    """Gives uses, after the refusals it was told to give."""

    def __init__(self, *refusals: VramError) -> None:
        self.refusals = list(refusals)
        self.asked: list[tuple[str, tuple[int, ...], str]] = []
        self.uses: list[Use] = []

    async def begin_use(self, lease_id: str, token: Sequence[int], label: str = "") -> Use:
        self.asked.append((lease_id, tuple(token), label))
        if self.refusals:
            raise self.refusals.pop(0)
        self.uses.append(Use())
        return self.uses[-1]

    async def why(self, consumer: str) -> WhyReply:
        return WhyReply(consumer, ())


class Bench:
    """A policy skill wired to the sidecar and the arbiter above."""

    def __init__(
        self, manifest: RSkillManifest, endpoint: str, arbiter: Arbiter | None, **options: Any
    ) -> None:
        self.sidecar, self.arbiter = Sidecar(), arbiter
        options.setdefault("wait_s", 60.0)
        wiring: Wiring = wire_up(manifest, robot_of(*JOINTS), REST)
        self.client = client_of(wiring.rollout, endpoint, timeout_s=60.0)
        self.skill = SidecarPolicy(
            manifest, wiring, self.client, arbiter, period_s=1 / 30, **options
        )
        self.position = dict(REST)
        self.played: list[tuple[float, ...]] = []

    def world(self, frames: bool = True, **changes: Any) -> WorldState:
        frame = SensorFrame(
            sensor_id="front",
            stamp_monotonic_ns=1,
            stamp_wall_ns=1,
            encoding=FrameEncoding.RGB8,
            width=4,
            height=2,
            data=bytes(range(24)),
        )
        fields: dict[str, Any] = {
            "stamp_ns": 1,
            "joint_state": JointState(
                name=tuple(self.position), position=tuple(self.position.values()), stamp_ns=1
            ),
            "image_frames": {"front": frame} if frames else None,
        }
        return WorldState(**(fields | changes))

    async def step(self, **changes: Any) -> StepOutcome:
        """On another thread, as in the runner: the event loop must be free to fetch."""
        frames = self.skill.wants_frames()
        outcome = await asyncio.to_thread(self.skill.step, self.world(frames, **changes))
        if isinstance(outcome, Act):
            self.position.update(zip(JOINTS, outcome.action.rows[0], strict=True))
            self.played.append(outcome.action.rows[0])
        return outcome

    async def play(self) -> tuple[list[tuple[float, ...]], Done]:
        rows = []
        for _ in range(300):
            outcome = await self.step()
            if isinstance(outcome, Done):
                return rows, outcome
            if isinstance(outcome, Act):
                rows.append(outcome.action.rows[0])
        raise AssertionError("the rollout did not end")
