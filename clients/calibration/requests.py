"""Representative requests for a model of each kind: pictures from a folder or of noise."""

import random
import struct
import zlib
from collections.abc import Callable, Coroutine, Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.perception import DetectorClient, RewardClient, SceneVlmClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Modality
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.extras import need

SIDE = 1024
"""Pixels of a picture's sides: the longest side that detector and scene VLM look at by default."""
REWARD_PICTURES = 8
POLICY_SIDE = 480
"""Pixels of a camera's sides where the manifest does not say."""
_TYPES = (".png", ".jpg", ".jpeg")
_CLIENTS: dict[Kind, type[SidecarClient]] = {
    Kind.DETECTOR: DetectorClient,
    Kind.VLM: SceneVlmClient,
    Kind.REWARD: RewardClient,
    Kind.VLA: PolicyClient,
}

type Ask = Callable[[], Coroutine[Any, Any, object]]


def client_type(manifest: RSkillManifest) -> type[SidecarClient]:
    """Return the client of a model's kind. Raises ConfigError for one that no sidecar serves."""
    if manifest.kind not in _CLIENTS:
        raise ConfigError(
            f"{manifest.name} is of kind {manifest.kind.value}, which no sidecar serves",
            hint="give the manifest of a detector, vlm, reward or vla skill",
        )
    return _CLIENTS[manifest.kind]


def asking(
    client: SidecarClient, manifest: RSkillManifest, pictures: Path | None, prompt: str | None
) -> Ask:
    """Return what makes one request at each call. `prompt`: the task, the question or what is to be
    found, else the manifest's. Raises ConfigError."""
    task = prompt or manifest.default_prompt or manifest.description
    if isinstance(client, PolicyClient):
        if pictures is not None:
            raise ConfigError(
                "--pictures is for detectors, scene VLMs and reward models",
                hint="leave it out: a policy is asked with noise of its cameras' sizes",
            )
        observation = observation_of(manifest, task)
        policy = client
        return lambda: policy.get_action(observation)
    shown = cycle(_pictures(pictures))
    match client:
        case DetectorClient() as detector:
            labels = manifest.detector.labels if manifest.detector else ()
            query = prompt or ", ".join(labels) or "object"
            return lambda: detector.detect(next(shown), query)
        case RewardClient() as reward:
            return lambda: reward.score(_several(shown), task)
        case SceneVlmClient() as vlm:
            question = prompt or "Describe everything in the picture."
            return lambda: vlm.query(next(shown), question)
    raise AssertionError(f"no request is known for {type(client).__name__}")


def observation_of(manifest: RSkillManifest, task: str) -> Message:
    """Return an observation as the manifest describes it: noise for the cameras, the starting pose
    or zeros for the joints. Raises ConfigError."""
    need(f"a request to {manifest.name}", "numpy", extra="sidecars")
    import numpy as np

    rng = np.random.default_rng(0)
    width = manifest.state_contract.dim if manifest.state_contract else None
    pose = manifest.starting_pose or (0.0,) * (width or 0)
    observation: Message = {"task": task}
    if pose:
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


def _pictures(folder: Path | None) -> Sequence[bytes]:
    if folder is None:
        return [noise_png()]
    try:
        found = sorted(path for path in folder.iterdir() if path.suffix.lower() in _TYPES)
        pictures = [path.read_bytes() for path in found]
    except OSError as error:
        raise ConfigError(
            f"--pictures {folder} cannot be read: {error.strerror}",
            hint="name a folder of JPEG or PNG files",
        ) from error
    if not pictures:
        raise ConfigError(f"--pictures {folder} holds no picture", hint="expected .png or .jpg")
    return pictures


def _several(shown: Iterator[bytes]) -> list[bytes]:
    return [next(shown) for _ in range(REWARD_PICTURES)]
