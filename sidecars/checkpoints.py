"""Complete checkpoints: load a model only from a checkpoint that holds all of it.

Every parameter and persistent buffer has to be there in its shape, and nothing else. The libraries'
own loaders fill gaps with random numbers and go on: such a model answers, and a robot moves on the
answers. On the device `meta` the model is built without bytes and compared, which is what
`vram-sidecar --check` does.
"""

import contextlib
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.sidecars.weights import Weights, from_pretrained, is_quantized

if TYPE_CHECKING:
    from lerobot.configs import PolicyFeature
    from torch import Tensor

META = "meta"
NAMES_SHOWN = 4


@dataclass(slots=True)
class Differences:
    """Differences between a model and its checkpoint, by the model's names."""

    missing: set[str] = field(default_factory=set)
    foreign: set[str] = field(default_factory=set)
    misshapen: dict[str, str] = field(default_factory=dict)

    def refuse(self, source: str) -> None:
        """Raise ModelError if there are any, with counts and the first names."""
        kinds = {
            "missing from it": sorted(self.missing),
            "unknown to the model": sorted(self.foreign),
            "of another shape": [
                f"{name} {shapes}" for name, shapes in sorted(self.misshapen.items())
            ],
        }
        parts = [f"{len(names)} {kind} ({_first(names)})" for kind, names in kinds.items() if names]
        if parts:
            raise ModelError(
                f"{source} does not hold this model: of the parameters {', '.join(parts)}",
                hint="get the whole checkpoint, of the class that its config names",
                details={
                    "missing": len(self.missing),
                    "foreign": len(self.foreign),
                    "misshapen": len(self.misshapen),
                },
            )


def load_transformers(cls: Any, weights: Weights, **options: Any) -> Any:
    """Call `cls.from_pretrained` of transformers.

    transformers knows which names are renamed, tied, quantized or known leftovers, so its own
    account of the load is compared.

    Raises: ModelError if the checkpoint does not fit the class or does not hold the whole model.
    """
    if options.get("device_map") == {"": META} and is_quantized(weights):
        options["device_map"] = {"": "cpu"}  # the statistics of a quantized weight are in its bytes
    model, account = from_pretrained(
        cls, weights, output_loading_info=True, ignore_mismatched_sizes=True, **options
    )
    found = Differences(
        missing=set(account["missing_keys"]),
        foreign=set(account["unexpected_keys"]),
        misshapen={
            name: f"{tuple(has)}, not {tuple(needs)}"
            for name, has, needs in account["mismatched_keys"]
        },
    )
    try:
        found.refuse(weights.source)
    except ModelError:
        del model  # the error is kept for `ping`, and this frame with it
        raise
    return model.eval()


def load_lerobot(cls: Any, weights: Weights, config: Any) -> Any:
    """Call `cls.from_pretrained` of lerobot onto `config.device`.

    lerobot's loaders differ from policy to policy: they rename, drop, and some swallow what they
    could not read. All of them end in the policy's own `load_state_dict`, so that is where the
    checkpoint is compared; a loader that never gets there has read nothing.

    Raises: ModelError if the checkpoint does not fit the class or does not hold the whole model.
    """
    record = _Record(weights.source)
    try:
        return _load_recorded(cls, weights, config, record)
    except ModelError:
        if config.device != META or record.conclusive:
            raise
    config.device = "cpu"  # not every class can be built without bytes
    try:
        return _load_recorded(cls, weights, config, _Record(weights.source))
    finally:
        config.device = META


def _load_recorded(cls: Any, weights: Weights, config: Any, record: "_Record") -> Any:
    try:
        model = from_pretrained(
            _recording(cls, record, config.device == META), weights, config=config
        )
    except ModelError:
        record.refuse_differences()  # the reason, where the loader's own message is vague
        raise
    try:
        record.refuse()
    except ModelError:
        del model
        raise
    model.__class__ = cls
    return model.eval()


def need_statistics(pipeline: Any, features: "Mapping[str, PolicyFeature]", source: str) -> None:
    """Raise ModelError if a processor lacks the statistics of one of `features`.

    lerobot's processor then leaves the feature unchanged, in other units.
    """
    for step in pipeline.steps:
        if not hasattr(step, "norm_map"):
            continue
        known = {name.rpartition(".")[0] for name in step.state_dict()}
        modes = {kind.value: mode.value for kind, mode in step.norm_map.items()}
        lacking = [
            name
            for name, feature in features.items()
            if name in step.features
            and modes.get(feature.type.value, "IDENTITY") != "IDENTITY"
            and name not in known
        ]
        if lacking:
            raise ModelError(
                f"{source}: its {type(step).__name__} has no statistics of {_first(lacking)}",
                hint="get the whole checkpoint: values would be in other units than the robot's",
                details={"missing": len(lacking)},
            )


class _Record:
    """Record of what `load_state_dict` was given while one model was loaded."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._found = Differences()
        self._loaded: set[str] = set()
        self._compared = False
        self._copied = False
        self.built = False

    @property
    def conclusive(self) -> bool:
        """Note a failed load, which concerns the checkpoint and not only building without bytes."""
        return self.built and (not self._compared or self._found != Differences())

    def compare(self, own: "Mapping[str, Tensor]", given: "Mapping[str, Tensor]") -> None:
        """Compare a state dict before it is copied.

        Raises ModelError for defects that no further part of the checkpoint can repair.
        """
        self._compared = True
        for name, tensor in given.items():
            if name not in own:
                self._found.foreign.add(name)
            elif tensor.shape != own[name].shape:
                self._found.misshapen[name] = f"{tuple(tensor.shape)}, not {tuple(own[name].shape)}"
            else:
                self._loaded.add(name)
        tied = {_identity(own[name]) for name in self._loaded}
        self._found.missing = {
            name for name, tensor in own.items() if _identity(tensor) not in tied
        }
        if self._found.foreign or self._found.misshapen:
            self.refuse_differences()

    def copied(self) -> None:
        self._copied = True

    def refuse_differences(self) -> None:
        self._found.refuse(self._source)

    def refuse(self) -> None:
        """Raise ModelError unless everything was loaded."""
        self.refuse_differences()
        if not self._copied:
            raise ModelError(
                f"{self._source}: the loader read no weights from it",
                hint="check that model.safetensors is complete; the sidecar's log has the loader's "
                "messages",
            )


def _recording(cls: Any, record: _Record, without_bytes: bool) -> Any:
    """Return a subclass that records, and that builds its modules without bytes for `meta`."""
    import torch

    class Recording(cls):  # type: ignore[misc]
        def __init__(self, *arguments: Any, **options: Any) -> None:
            with torch.device(META) if without_bytes else contextlib.nullcontext():
                super().__init__(*arguments, **options)
            record.built = True

        def load_state_dict(
            self, state_dict: "Mapping[str, Tensor]", *arguments: Any, **options: Any
        ) -> Any:
            record.compare(self.state_dict(keep_vars=True), state_dict)
            with _silence():
                result = super().load_state_dict(state_dict, *arguments, **options)
            record.copied()
            return result

        @classmethod
        def _load_as_safetensor(cls, model: Any, file: str, device: str, strict: bool) -> Any:
            return super()._load_as_safetensor(
                model, file, "cpu" if without_bytes else device, strict
            )

    Recording.__name__ = cls.__name__
    return Recording


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Silence torch's warnings about copies to `meta` that do nothing, one per parameter."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is a no-op.*")
        yield


def _identity(tensor: Any) -> Any:
    """Return one key for tied parameters, which a checkpoint holds once.

    A tensor without bytes has no address of its own.
    """
    return (
        (tensor.data_ptr(), tensor.shape)
        if tensor.numel() and tensor.device.type != META
        else id(tensor)
    )


def _first(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:NAMES_SHOWN]) + (", …" if len(names) > NAMES_SHOWN else "")
