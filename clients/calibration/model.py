"""The program that `vramctl calibrate MANIFEST` measures: it loads the manifest's model in a
sidecar of its own, asks it, unloads it and ends it.

`python -m vram_arbiter.clients.calibration.model PLAN`: a `Plan` as JSON. It writes marks, each the
monotonic time at which a phase ended, to the file that the plan names, and rests before them.
"""

import asyncio
import json
import random
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.perception import DetectorClient, RewardClient, SceneVlmClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.errors import ConfigError, SidecarUnavailable, VramError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest, load_manifest
from vram_arbiter.schemas.manifest.vocabulary import Modality
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.extras import need

LOAD_S = 1800.0
"""A large model from a cold disk."""
SIDE, POLICY_SIDE = 1024, 480
"""Pixels of a picture's sides: the longest side that detector and scene VLM look at by default, and
that of a policy's camera where the manifest does not say."""
REWARD_PICTURES = 8
CLIENTS: dict[Kind, type[SidecarClient]] = {
    Kind.DETECTOR: DetectorClient,
    Kind.VLM: SceneVlmClient,
    Kind.REWARD: RewardClient,
    Kind.VLA: PolicyClient,
}

type Ask = Callable[[], Coroutine[Any, Any, object]]


@dataclass(frozen=True, slots=True)
class Plan:
    """What is loaded and asked."""

    rskill: str
    sidecar: Sequence[str]  # its command
    requests: int
    rest_s: float
    marks: str


def check(manifest: RSkillManifest) -> None:
    """Raises ConfigError for a model that cannot be asked."""
    if manifest.kind not in CLIENTS:
        raise ConfigError(
            f"{manifest.name} is of kind {manifest.kind.value}, which no sidecar serves",
            hint="give the manifest of a detector, vlm, reward or vla skill",
        )
    if manifest.kind is Kind.VLA:
        need(f"a request to {manifest.name}", "numpy", extra="sidecars")


async def run(plan: Plan) -> dict[str, float]:
    """Return the marks. Raises the sidecar's typed errors, SidecarUnavailable where it ends."""
    with tempfile.TemporaryDirectory(prefix="vc") as folder:
        endpoint = f"ipc://{folder}/calibrate.sock"
        process = await asyncio.create_subprocess_exec(*plan.sidecar, "--endpoint", endpoint)
        working = asyncio.create_task(_work(plan, endpoint))
        try:
            ended = asyncio.create_task(process.wait())
            await asyncio.wait({working, ended}, return_when=asyncio.FIRST_COMPLETED)
            if not working.done():
                raise SidecarUnavailable(f"the sidecar ended with exit code {process.returncode}")
            return working.result()
        finally:
            working.cancel()
            if process.returncode is None:
                process.terminate()
            await process.wait()


async def _work(plan: Plan, endpoint: str) -> dict[str, float]:
    manifest, marks = load_manifest(Path(plan.rskill)), {"requests": float(plan.requests)}
    kind = CLIENTS[manifest.kind]
    async with kind(endpoint, timeout_s=LOAD_S, connect_timeout_s=LOAD_S) as client:
        ask = asking(client, manifest)
        await client.load()
        await asyncio.sleep(plan.rest_s)
        marks["asked"] = time.monotonic()
        for _ in range(plan.requests):
            await ask()
        await asyncio.sleep(0.1)  # a reading after the last answer
        marks["answered"] = time.monotonic()
        await client.unload()
        await asyncio.sleep(plan.rest_s)
        marks["unloaded"] = time.monotonic()
    return marks


def asking(client: SidecarClient, manifest: RSkillManifest) -> Ask:
    """Return what makes one request at each call, with noise and the manifest's words."""
    task = manifest.default_prompt or manifest.description
    if isinstance(client, PolicyClient):
        observation, policy = observation_of(manifest, task), client
        return lambda: policy.get_action(observation)
    shown = noise_png()
    match client:
        case DetectorClient() as detector:
            labels = manifest.detector.labels if manifest.detector else ()
            return lambda: detector.detect(shown, ", ".join(labels) or "object")
        case RewardClient() as reward:
            return lambda: reward.score([shown] * REWARD_PICTURES, task)
        case SceneVlmClient() as vlm:
            return lambda: vlm.query(shown, "Describe everything in the picture.")
    raise AssertionError(f"no request is known for {type(client).__name__}")


def observation_of(manifest: RSkillManifest, task: str) -> Message:
    """Return an observation as the manifest describes it: noise for the cameras, the starting pose
    or zeros for the joints."""
    import numpy as np

    rng = np.random.default_rng(0)
    width = (manifest.state_contract and manifest.state_contract.dim) or 0
    observation: Message = {"task": task}
    if pose := manifest.starting_pose or (0.0,) * width:
        observation["observation.state"] = np.array(pose, dtype=np.float32)
    for sensor in manifest.sensors_required:
        if sensor.modality is Modality.RGB and sensor.vla_feature_key:
            size = (sensor.min_height or POLICY_SIDE, sensor.min_width or POLICY_SIDE, 3)
            observation[sensor.vla_feature_key] = rng.integers(0, 256, size, dtype=np.uint8)
    return observation


def noise_png(side: int = SIDE) -> bytes:
    """Return a picture of gray noise. Noise has no large flat areas, so no model can skip it."""
    pixels = random.Random(0).randbytes(side * side)
    rows = b"".join(b"\0" + pixels[at : at + side] for at in range(0, len(pixels), side))
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows, 1)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )


def main() -> int:
    plan = Plan(**json.loads(sys.argv[1]))
    try:
        Path(plan.marks).write_text(json.dumps(asyncio.run(run(plan))))
    except VramError as error:
        print(f"vramctl calibrate: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
