"""Camera frames to the GPU and back, the arm at rest: a check of a machine without a model.

It moves nothing and invents nothing: a picture that is missing, of another shape or too small is
refused, and so is a state that is not finite numbers. It never computes on the CPU instead. On a
simulated GPU (`fake:FOLDER`) the bytes are simulated like every model's.
"""

from typing import Any, Literal

from vram_arbiter.schemas.errors import BadRequest, ConfigError, NoGpu
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Modality
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.adapters.base import ModelCall
from vram_arbiter.sidecars.adapters.policy_observations import (
    STATE,
    numbers_of,
    observation_of,
    pixels_of,
)

ADAPTER = "gpu_passthrough"


def is_passthrough(manifest: RSkillManifest) -> bool:
    """Return whether a manifest asks for it (`policy_extras.adapter`)."""
    return manifest.policy_extras.get("adapter") == ADAPTER


def need_gpu(manifest: RSkillManifest, device: str) -> None:
    """Raise NoGpu for `--device none`. A missing CUDA GPU is refused where the device is opened."""
    if is_passthrough(manifest) and device == "none":
        raise NoGpu(
            f"{manifest.name} takes frames through a GPU, and --device none has none",
            hint="use --device cuda, or fake:FOLDER for a simulated GPU",
        )


class GpuPassthroughAdapter:
    """The endpoint `get_action`.

    It answers `action` (1, D), the joints as they were at the first call since `reset`, and
    `confidence` (3,): the pictures' means of red, green and blue, 0..1.
    """

    kind: Literal["vla"] = "vla"
    ops = frozenset({"get_action", "reset"})

    def __init__(self, manifest: RSkillManifest) -> None:
        self._sizes = {
            sensor.vla_feature_key: (sensor.min_height or 1, sensor.min_width or 1)
            for sensor in manifest.sensors_required
            if sensor.modality is Modality.RGB and sensor.vla_feature_key
        }
        if not self._sizes:
            raise ConfigError(
                f"{manifest.name} names no camera",
                hint="give a sensor of modality rgb a vla_feature_key",
            )
        self._device: str | None = None
        self._pose: Any = None

    modules = ("torch",)

    def prepare(self) -> None:
        import torch  # noqa: F401  its import time belongs here

    networks = ()

    def load(self, device: str) -> None:
        pass

    def place(self, device: str) -> None:
        self._device = device

    def run(self, call: ModelCall) -> Message:
        """Check an observation. Raises BadRequest for one that is incomplete."""
        assert isinstance(call, EndpointCall)
        if call.endpoint == "reset":
            self._pose = None
            return {"ok": True}
        observation = observation_of(call)
        state = _state(observation)
        pictures = [_pixels(observation, name, *size) for name, size in self._sizes.items()]
        if self._pose is None or self._pose.shape != state.shape:
            self._pose = state
        return {"action": self._pose[None], "confidence": self._means(pictures)}

    def _means(self, pictures: list[Any]) -> Any:
        """Return the means by channel, float32, 0..1: of whole pictures, computed on the GPU and
        awaited."""
        import numpy as np
        import torch

        uploaded = [torch.from_numpy(np.array(pixels)).to(self._device) for pixels in pictures]
        # whole numbers: a mean in float32 may be above the brightest pixel
        by_picture = [one.sum(dim=(0, 1)) / (255 * one[..., 0].numel()) for one in uploaded]
        means = torch.stack(by_picture).mean(dim=0)
        torch.get_device_module(means.device).synchronize()
        return means.cpu().numpy()


def _value(observation: JsonMap, name: str) -> Any:
    if observation.get(name) is None:
        raise BadRequest(f"the observation lacks {name}", hint=f"it has {sorted(observation)}")
    return observation[name]


def _state(observation: JsonMap) -> Any:
    hint = "send the joints' positions in a row"
    state = numbers_of(STATE, _value(observation, STATE), hint)
    if state.ndim != 1 or not len(state):
        raise BadRequest(f"{STATE} must be a row, not of shape {state.shape}", hint=hint)
    return state


def _pixels(observation: JsonMap, name: str, height: int, width: int) -> Any:
    pixels = pixels_of(name, _value(observation, name))
    if pixels.shape[0] < height or pixels.shape[1] < width:
        raise BadRequest(
            f"{name} must be at least ({height}, {width}, 3), not {pixels.shape}",
            hint="send the camera's picture in its own size",
        )
    return pixels
