"""Robot policies through lerobot's classes and processors: observation in, chunk of actions out."""

import importlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from vram_arbiter.schemas.errors import BadRequest, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.adapters.base import ModelCall
from vram_arbiter.sidecars.checkpoints import load_lerobot, need_statistics
from vram_arbiter.sidecars.images import decode
from vram_arbiter.sidecars.weights import Weights, model_type, read_config

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

IMAGE_PREFIX = "observation.images."
_OWN_POLICIES = (
    "vram_arbiter.sidecars.models.compact_act",
)  # own policy types, by lerobot's naming convention


type Batch = dict[str, "Tensor | str"]
"""One observation as lerobot's processors take it: tensors, and the task in words."""


class PolicyAdapter:
    """The endpoints `get_action` and `reset`.

    A checkpoint brings its own pre- and postprocessor, so units are the checkpoint's. Observation:
    `observation.state` (D,), `observation.images.CAMERA` uint8 (H, W, 3) RGB or PNG/JPEG bytes,
    `task` text; a leading dimension of 1 is accepted. Camera names go through the manifest's
    `image_preprocessing.aliases`. Answer: `action` float32 (T, D).
    """

    kind: Literal["vla"] = "vla"
    ops = frozenset({"get_action", "reset"})

    def __init__(self, manifest: RSkillManifest, weights: Weights) -> None:
        self._manifest = manifest
        self._weights = weights
        self._config: Any = None
        self._policy_class: Any = None
        self._policy: Any = None
        self._before: Any = None
        self._after: Any = None

    @property
    def modules(self) -> tuple[str, ...]:
        kind = model_type(self._weights, "type")
        own = f"lerobot.policies.{kind}.modeling_{kind}"
        return ("torch", "lerobot.policies.factory", own, *_OWN_POLICIES)

    def prepare(self) -> None:
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class

        for package in _OWN_POLICIES:
            importlib.import_module(package)  # registers itself
        self._config = read_config(PreTrainedConfig, self._weights)
        self._policy_class = get_policy_class(self._config.type)

    def load(self, device: str) -> None:
        self._config.device = device
        self._config.pretrained_path = self._weights.source
        self._policy = load_lerobot(self._policy_class, self._weights, self._config)
        self._make_processors("cpu")
        need_statistics(self._before, self._config.input_features, self._weights.source)
        need_statistics(self._after, self._config.output_features, self._weights.source)

    @property
    def networks(self) -> Sequence[Any]:
        return (self._policy,)

    def place(self, device: str) -> None:
        self._config.device = device
        self._policy.to(device)
        self._make_processors(device)

    def _make_processors(self, device: str) -> None:
        from lerobot.policies.factory import make_pre_post_processors

        try:
            self._before, self._after = make_pre_post_processors(
                self._config,
                pretrained_path=self._weights.source,
                pretrained_revision=self._weights.revision,
                preprocessor_overrides={"device_processor": {"device": device}},
            )
        except (OSError, ValueError, KeyError, ImportError) as error:
            raise ModelError(
                f"{self._weights.source}: its processors cannot be read: {type(error).__name__}: "
                f"{error}",
                hint="check that the checkpoint is complete",
            ) from error

    def run(self, call: ModelCall) -> Message:
        assert isinstance(call, EndpointCall)
        if call.endpoint == "reset":
            self._policy.reset()
            return {"ok": True}
        observation = (call.data or {}).get("observation")
        if not isinstance(observation, Mapping):
            raise BadRequest(
                "get_action needs data.observation, a map",
                hint='{"endpoint": "get_action", "data": {"observation": {…}}}',
            )
        return {"action": self._act(self._batch(observation))}

    def _act(self, batch: Batch) -> "NDArray[Any]":
        import torch

        with torch.inference_mode():
            chunk = self._policy.predict_action_chunk(self._before(batch))
            steps = [
                self._after(chunk[:, step]) for step in range(chunk.shape[1])
            ]  # postprocessors take (B, D), as lerobot's own server does
        actions = torch.stack([step[0] for step in steps]).to(torch.float32).cpu()
        if not bool(torch.isfinite(actions).all()):
            raise ModelError(
                "the policy's actions are not finite numbers", hint="nothing was sent to the robot"
            )
        rows: NDArray[Any] = actions.numpy()
        return rows

    def _batch(self, observation: JsonMap) -> Batch:
        """Return the observation as lerobot's preprocessor takes it.

        Raises BadRequest naming what is missing or has the wrong shape.
        """
        batch: Batch = {"task": _task(observation.get("task"))}
        given = {self._feature_name(name): (name, value) for name, value in observation.items()}
        for feature, spec in self._config.input_features.items():
            if feature not in given:
                raise BadRequest(
                    f"the observation lacks {feature}", hint=f"it has {sorted(observation)}"
                )
            name, value = given[feature]
            visual = spec.type.value == "VISUAL"
            batch[feature] = (
                self._image(name, value) if visual else _vector(name, value, spec.shape)
            )
        return batch

    def _feature_name(self, name: str) -> str:
        """Return the checkpoint's name of an input: the manifest maps the robot's camera names."""
        rules = self._manifest.image_preprocessing
        if rules is None or not name.startswith(IMAGE_PREFIX):
            return name
        camera = name.removeprefix(IMAGE_PREFIX)
        return rules.input_template.format(cam=rules.aliases.get(camera, camera))

    def _image(self, name: str, value: Any) -> Any:
        """Convert uint8 HWC to float (3, H, W) in 0..1, turned and resized as in training."""
        import numpy as np
        import torch

        pixels = np.asarray(decode(value)) if isinstance(value, bytes) else value
        if isinstance(pixels, np.ndarray) and pixels.ndim == 4 and len(pixels) == 1:
            pixels = pixels[0]
        if (
            not isinstance(pixels, np.ndarray)
            or pixels.dtype != np.uint8
            or pixels.ndim != 3
            or pixels.shape[2] != 3
        ):
            raise BadRequest(f"{name} must be uint8 (H, W, 3) or PNG bytes, not {_shape(pixels)}")
        rules = self._manifest.image_preprocessing
        if rules is not None and rules.flip_180:
            pixels = pixels[::-1, ::-1]
        if rules is not None and rules.flip_vertical:
            pixels = pixels[::-1]
        image = torch.tensor(np.ascontiguousarray(pixels)).permute(2, 0, 1).to(torch.float32) / 255
        if rules is not None and rules.resize_width and rules.resize_height:
            size = (rules.resize_height, rules.resize_width)
            image = torch.nn.functional.interpolate(
                image[None], size=size, mode="bilinear", antialias=True
            )[0]
        return image


def _vector(name: str, value: Any, shape: tuple[int, ...]) -> Any:
    import numpy as np
    import torch

    try:
        numbers = np.asarray(value, dtype=np.float32)
    except (TypeError, ValueError):
        raise BadRequest(
            f"{name} must be numbers of shape {tuple(shape)}, not {_shape(value)}"
        ) from None
    if numbers.ndim == len(shape) + 1 and len(numbers) == 1:
        numbers = numbers[0]
    if numbers.shape != tuple(shape):
        raise BadRequest(f"{name} must have shape {tuple(shape)}, not {numbers.shape}")
    if not np.isfinite(numbers).all():
        raise BadRequest(
            f"{name} has numbers that are not finite",
            hint="a stale or missing sensor must stop the goal",
        )
    return torch.from_numpy(np.ascontiguousarray(numbers))


def _task(value: Any) -> str:
    if isinstance(value, list | tuple) and len(value) == 1:
        value = value[0]
    if value is None:
        return ""
    if not isinstance(value, str):
        raise BadRequest("task must be a text", hint=f"not {type(value).__name__}")
    return value


def _shape(value: Any) -> str:
    return f"{value.dtype} {value.shape}" if hasattr(value, "dtype") else type(value).__name__
