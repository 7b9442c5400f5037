"""The program that `vramctl calibrate MANIFEST` measures: it loads the manifest's model in a
sidecar of its own, asks it, unloads it and ends it.

`python -m vram_arbiter.clients.calibration.model PLAN`: a `Plan` as JSON. It writes marks, each the
monotonic time at which a phase ended, to the file that the plan names, and rests before them.
"""

import asyncio
import io
import json
import sys
import tempfile
import time
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.build import CLIENTS, served
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest, load_manifest
from vram_arbiter.schemas.manifest.vocabulary import Modality
from vram_arbiter.schemas.plain import Message

LOAD_S = 1800.0
"""A large model from a cold disk."""
SIDE, POLICY_SIDE, REWARD_PICTURES = 1024, 480, 8
"""Pixels of a picture's sides: the longest side that detector and scene VLM look at by default, and
that of a policy's camera where the manifest does not say; pictures of one question for a reward."""

type Ask = Callable[[Any, RSkillManifest], Coroutine[Any, Any, object]]


@dataclass(frozen=True, slots=True)
class Plan:
    """What is loaded and asked."""

    rskill: str
    sidecar: Sequence[str]  # its command
    requests: int
    marks: str
    rest_s: float = 2.0
    """Longer than drivers take to return memory (0.5 to 1.5 s)."""


async def run(plan: Plan) -> dict[str, float]:
    """Return the marks. Raises the sidecar's typed errors, SidecarUnavailable where it ends."""
    manifest = load_manifest(Path(plan.rskill))
    with tempfile.TemporaryDirectory(prefix="vc") as folder:
        endpoint = f"ipc://{folder}/calibrate.sock"
        client = CLIENTS[manifest.kind](endpoint, timeout_s=LOAD_S, connect_timeout_s=LOAD_S)
        async with served(client, plan.sidecar):
            return await _work(plan, client, manifest)


async def _work(plan: Plan, client: SidecarClient, manifest: RSkillManifest) -> dict[str, float]:
    marks = {"requests": float(plan.requests)}
    await client.load()
    await asyncio.sleep(plan.rest_s)
    marks["asked"] = time.monotonic()
    for _ in range(plan.requests):
        await ASKED[manifest.kind](client, manifest)
    await asyncio.sleep(0.1)  # a reading after the last answer
    marks["answered"] = time.monotonic()
    await client.unload()
    await asyncio.sleep(plan.rest_s)
    marks["unloaded"] = time.monotonic()
    return marks


def task_of(manifest: RSkillManifest) -> str:
    return manifest.default_prompt or manifest.description


def observation_of(manifest: RSkillManifest) -> Message:
    """Return an observation as the manifest describes it: noise for the cameras, the starting pose
    or zeros for the joints."""
    import numpy as np

    rng = np.random.default_rng(0)
    width = (manifest.state_contract and manifest.state_contract.dim) or 0
    observation: Message = {"task": task_of(manifest)}
    if pose := manifest.starting_pose or (0.0,) * width:
        observation["observation.state"] = np.array(pose, dtype=np.float32)
    for sensor in manifest.sensors_required:
        if sensor.modality is Modality.RGB and sensor.vla_feature_key:
            size = (sensor.min_height or POLICY_SIDE, sensor.min_width or POLICY_SIDE, 3)
            observation[sensor.vla_feature_key] = rng.integers(0, 256, size, dtype=np.uint8)
    return observation


def noise_png(side: int = SIDE) -> bytes:
    """Return a picture of gray noise. Noise has no large flat areas, so no model can skip it."""
    from PIL import Image

    picture = io.BytesIO()
    Image.effect_noise((side, side), 100.0).save(picture, "PNG")
    return picture.getvalue()


ASKED: Final[dict[Kind, Ask]] = {
    Kind.DETECTOR: lambda client, manifest: client.detect(
        noise_png(), ", ".join(manifest.detector.labels if manifest.detector else ()) or "cup"
    ),
    Kind.VLM: lambda client, manifest: client.query(noise_png(), "Describe it."),
    Kind.REWARD: lambda client, manifest: client.score(
        [noise_png()] * REWARD_PICTURES, task_of(manifest)
    ),
    Kind.VLA: lambda client, manifest: client.get_action(observation_of(manifest)),
}
"""One request to a kind's sidecar, with noise and the manifest's words."""


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
