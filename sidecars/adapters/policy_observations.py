"""Observations as they come over the wire, made into what lerobot's preprocessor takes."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.io_contracts import ImagePreprocessing
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.images import decode

if TYPE_CHECKING:
    from lerobot.configs import PolicyFeature
    from numpy.typing import NDArray
    from torch import Tensor

IMAGE_PREFIX = "observation.images."
STATE, ACTION = "observation.state", "action"
EMPTY_CAMERA = IMAGE_PREFIX + "empty_camera_"
"""Cameras that a checkpoint pads for itself; no robot has them."""
_COMPARE: Final = "`vram-sidecar --check` compares the manifest with the checkpoint"


type Batch = dict[str, "Tensor | str"]
"""One observation as lerobot's processors take it: tensors, and the task in words."""


class Observations:
    """Reader of observations.

    `features` are the checkpoint's inputs, `rules` the manifest's picture rules, and `steps_max`
    the length of the policy's history.
    """

    def __init__(
        self,
        features: "Mapping[str, PolicyFeature]",
        rules: ImagePreprocessing | None,
        steps_max: int,
    ) -> None:
        self._features = {
            name: feature for name, feature in features.items() if not _is_padded(name)
        }
        self._rules = rules
        self._steps_max = steps_max

    def read(self, observation: JsonMap) -> list[Batch]:
        """Return the consecutive control steps of an observation, oldest first; most have one.

        Raises BadRequest naming what is missing or has the wrong shape.
        """
        task = _task(observation.get("task"))
        given = {self._feature_name(name): (name, value) for name, value in observation.items()}
        values: dict[str, list[Any]] = {}
        for feature, spec in self._features.items():
            if feature not in given:
                raise BadRequest(
                    f"the observation lacks {feature}", hint=f"it has {sorted(observation)}"
                )
            name, value = given[feature]
            if spec.type.value == "VISUAL":
                values[feature] = [self._image(name, step) for step in _pictures(value)]
            else:
                values[feature] = _vectors(name, value, spec.shape)
        lengths = {feature: len(steps) for feature, steps in values.items()}
        count = max(lengths.values(), default=1)
        if not 1 <= count <= self._steps_max or min(lengths.values(), default=1) != count:
            raise BadRequest(
                f"the observation's steps are {lengths}; this policy takes up to "
                f"{self._steps_max}, of all inputs alike",
                hint="send the last observation, or the last steps oldest first",
            )
        return [
            {"task": task, **{feature: steps[index] for feature, steps in values.items()}}
            for index in range(count)
        ]

    def _feature_name(self, name: str) -> str:
        """Return the checkpoint's name of an input: the manifest maps the robot's camera names."""
        if not name.startswith(IMAGE_PREFIX):
            return name
        camera = name.removeprefix(IMAGE_PREFIX)
        aliases = self._rules.aliases if self._rules is not None else {}
        return _input_of(aliases.get(camera, camera), self._rules, self._features)

    def _image(self, name: str, value: Any) -> Any:
        """Convert uint8 HWC to float (3, H, W) in 0..1, turned and resized as in training."""
        import numpy as np
        import torch

        pixels = pixels_of(name, value)
        rules = self._rules
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


def misfits(
    manifest: RSkillManifest,
    inputs: "Mapping[str, PolicyFeature]",
    outputs: "Mapping[str, PolicyFeature]",
) -> list[str]:
    """Return where a manifest contradicts its checkpoint, which the first goal would fail on."""
    keys = [one.vla_feature_key for one in manifest.sensors_required if one.modality == "rgb"]
    named = {
        _input_of(key.rpartition(".")[2], manifest.image_preprocessing, inputs)
        for key in keys
        if key
    }
    found = [
        f"the checkpoint reads {name}, sensors_required names {', '.join(sorted(named)) or 'none'}"
        for name, feature in inputs.items()
        if feature.type.value == "VISUAL" and not _is_padded(name) and name not in named
    ]
    for field, contract, feature in (
        ("state_contract.dim", manifest.state_contract, inputs.get(STATE)),
        ("action_contract.dim", manifest.action_contract, outputs.get(ACTION)),
    ):
        stated = None if contract is None else contract.dim
        if stated is not None and feature is not None and (stated,) != tuple(feature.shape):
            found.append(f"{field} is {stated}, the checkpoint has {feature.shape[0]} numbers")
    return found


def _input_of(
    camera: str, rules: ImagePreprocessing | None, inputs: "Mapping[str, PolicyFeature]"
) -> str:
    """Return the checkpoint's input of a policy's camera. Checkpoints of one camera may have it
    beside the state, as `observation.image`."""
    name = (IMAGE_PREFIX + "{cam}" if rules is None else rules.input_template).format(cam=camera)
    lone = f"observation.{camera}"
    return lone if name not in inputs and lone in inputs else name


def _is_padded(name: str) -> bool:
    return name.startswith(EMPTY_CAMERA)


def observation_of(call: EndpointCall) -> JsonMap:
    """Return the observation of a `get_action`. Raises BadRequest."""
    observation = (call.data or {}).get("observation")
    if not isinstance(observation, Mapping):
        raise BadRequest(
            "get_action needs data.observation, a map",
            hint='{"endpoint": "get_action", "data": {"observation": {…}}}',
        )
    return observation


def pixels_of(name: str, value: Any) -> "NDArray[Any]":
    """Return a picture, uint8 (H, W, 3), decoded from PNG or JPEG. Raises BadRequest."""
    import numpy as np

    if isinstance(value, bytes):
        return np.asarray(decode(value))
    if getattr(value, "dtype", None) == np.uint8 and value.ndim == 3 and value.shape[2] == 3:
        return value
    raise BadRequest(
        f"{name} must be uint8 (H, W, 3), PNG or JPEG, not {_shape(value)}",
        hint="send the camera's picture",
    )


def numbers_of(name: str, value: Any, hint: str) -> "NDArray[Any]":
    """Return finite numbers as float32. Raises BadRequest."""
    import numpy as np

    try:
        numbers = np.array(value, dtype=np.float32)
    except (TypeError, ValueError):
        raise BadRequest(f"{name} must be numbers, not {_shape(value)}", hint=hint) from None
    if not np.isfinite(numbers).all():
        raise BadRequest(
            f"{name} has numbers that are not finite",
            hint="a stale or missing sensor must stop the goal",
        )
    return numbers


def _pictures(value: Any) -> list[Any]:
    """Return the pictures of a camera, one a step; a lone picture is one step."""
    if isinstance(value, list | tuple):
        return list(value)
    return list(value) if getattr(value, "ndim", 0) == 4 else [value]


def _vectors(name: str, value: Any, shape: tuple[int, ...]) -> list[Any]:
    """Return the vectors of an input, one a step. Raises BadRequest."""
    import numpy as np
    import torch

    numbers = numbers_of(name, value, f"of shape {tuple(shape)}; {_COMPARE}")
    steps = numbers if numbers.ndim == len(shape) + 1 else numbers[None]
    if steps.shape[1:] != tuple(shape) or not len(steps):
        raise BadRequest(
            f"{name} must have shape {tuple(shape)}, not {numbers.shape}", hint=_COMPARE
        )
    return [torch.from_numpy(np.ascontiguousarray(step)) for step in steps]


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
