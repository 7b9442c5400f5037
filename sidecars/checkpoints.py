"""Complete checkpoints: load a model only from a checkpoint that holds all of it.

Every parameter and persistent buffer has to be there in its shape, and nothing else. The libraries'
own loaders fill gaps with random numbers and go on: such a model answers, and a robot moves on the
answers. On the device `meta` the model is built without bytes and compared, which is what
`vram-sidecar --check` does.
"""

import contextlib
import copy
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.sidecars.packed_weights import PackedHeader, install, packed_in, read_packed
from vram_arbiter.sidecars.quantization import Nf4, load_bitsandbytes, settle
from vram_arbiter.sidecars.weights import (
    Weights,
    fitting,
    from_pretrained,
    quantization_config,
    safetensors_files,
)

if TYPE_CHECKING:
    from torch import Tensor

META = "meta"
NAMES_SHOWN = 4
_KINDS: Final = {
    "missing": "missing from it",
    "foreign": "unknown to the model",
    "misshapen": "of another shape",
    "broken": "with NaN or infinity",
}
_REMOTE_CODE = ("trust_remote_code", "code_revision")


@dataclass(slots=True)
class Differences:
    """Differences between a model and its checkpoint, by the model's names."""

    missing: set[str] = field(default_factory=set)
    foreign: set[str] = field(default_factory=set)
    misshapen: dict[str, str] = field(default_factory=dict)
    broken: set[str] = field(default_factory=set)

    def refuse(self, source: str) -> None:
        """Raise ModelError if there are any, with counts and the first names."""
        found = {kind: sorted(getattr(self, kind)) for kind in _KINDS}
        parts = [
            f"{len(names)} {_KINDS[kind]} ({_first(map(self._shown, names))})"
            for kind, names in found.items()
            if names
        ]
        if parts:
            raise ModelError(
                f"{source} does not hold this model: of the parameters {', '.join(parts)}",
                hint="get the whole checkpoint, of the class that its config names",
                details={kind: len(names) for kind, names in found.items()},
            )

    def _shown(self, name: str) -> str:
        return f"{name} {self.misshapen[name]}" if name in self.misshapen else name


def load_transformers(cls: Any, weights: Weights, *, nf4: Nf4 | None = None, **options: Any) -> Any:
    """Call `cls.from_pretrained` of transformers with `weights.model_options`.

    transformers knows which names are renamed, tied or known leftovers, so its own account of the
    load is compared. It gives none of quantized layers: a quantized model is first compared on
    `meta`, without bytes. Layers that the checkpoint holds quantized stay as they are.

    Raises: ModelError if the checkpoint does not fit the class or does not hold the whole model,
    ConfigError or UnsupportedQuantization if it cannot be quantized as asked.
    """
    if nf4 is None:
        return _compared(cls, weights, options)
    on_meta = options | {"device_map": {"": META}}
    if quantization_config(weights) is not None:
        outline, options["config"] = _packed_outline(cls, weights, nf4, on_meta)
    else:
        outline = _compared(cls, weights, on_meta)
        options["quantization_config"] = nf4.for_transformers(nf4.chosen(outline))
    if options["device_map"] == {"": META}:
        return outline
    del outline
    load_bitsandbytes()
    model = _compared(cls, weights, options)
    settle(model)
    return model


def _packed_outline(
    cls: Any, weights: Weights, nf4: Nf4, options: Mapping[str, Any]
) -> tuple[Any, Any]:
    """Compare a quantized checkpoint with its model on `meta`, by its headers alone.

    Return the model, and a configuration by which transformers takes as quantized just the layers
    that the checkpoint holds quantized: transformers 4 and 5 read the skip list in its own
    differently. Raises: ModelError.
    """
    import torch
    from transformers import AutoConfig

    remote = {key: options[key] for key in _REMOTE_CODE if key in options}
    config = from_pretrained(AutoConfig, weights, **remote)
    plain = copy.deepcopy(config)
    del plain.quantization_config
    with fitting(cls, weights):
        header = read_packed(safetensors_files(weights))
        with torch.device(META):
            kind = type(cls.from_config(plain, **remote)) if hasattr(cls, "from_config") else cls
        model, account = kind.from_pretrained(
            None,
            config=plain,
            state_dict=header.tensors,
            output_loading_info=True,
            ignore_mismatched_sizes=True,
            **{key: value for key, value in options.items() if key not in remote},
        )
    found = _differences(account)
    found.missing |= header.missing
    found.misshapen |= header.misshapen
    found.refuse(weights.source)
    with fitting(cls, weights):
        chosen = [_loaded_as(name, model).removesuffix(".weight") for name in header.quantized]
    others = [name for name in chosen if type(model.get_submodule(name)) is not torch.nn.Linear]
    if others:
        raise ModelError(
            f"{weights.source}: {_first(others)} are quantized and no linear layers",
            hint="use the checkpoint before quantization",
        )
    config.quantization_config = nf4.for_transformers(chosen).to_dict() | {
        "bnb_4bit_quant_storage": config.quantization_config["bnb_4bit_quant_storage"]
    }
    return model.eval(), config


def _loaded_as(name: str, model: Any) -> str:
    """Return the model's name of a checkpoint's parameter, by transformers' renaming."""
    from transformers.core_model_loading import WeightRenaming, rename_source_key

    renamings = [
        entry for entry in model._weight_conversions or () if isinstance(entry, WeightRenaming)
    ]
    found, _ = rename_source_key(
        name, renamings, [], model.base_model_prefix, model.state_dict(keep_vars=True)
    )
    return str(found)


def _compared(cls: Any, weights: Weights, options: Mapping[str, Any]) -> Any:
    """Load, and raise ModelError for what transformers filled, dropped or cut."""
    if weights.local and (Path(weights.source) / "adapter_config.json").is_file():
        # transformers adds it unasked, but only where PEFT is installed
        raise ModelError(
            f"{weights.source} holds a PEFT adapter beside a model",
            hint="merge it into its base model and save that",
        )
    model, account = from_pretrained(
        cls, weights, output_loading_info=True, ignore_mismatched_sizes=True, **options
    )
    try:
        _differences(account).refuse(weights.source)
    except ModelError:
        del model  # the error is kept for `ping`, and this frame with it
        raise
    return model.eval()


def _differences(account: JsonMap) -> Differences:
    return Differences(
        missing=set(account["missing_keys"]),
        foreign=set(account["unexpected_keys"]),
        misshapen={
            name: f"{tuple(has)}, not {tuple(needs)}"
            for name, has, needs in account["mismatched_keys"]
        },
    )


def load_lerobot(cls: Any, weights: Weights, config: Any, nf4: Nf4 | None = None) -> Any:
    """Call `cls.from_pretrained` of lerobot onto `config.device`.

    With `nf4`, a checkpoint may hold quantized weights: they stay as they are.

    lerobot's loaders differ from policy to policy: they rename, drop, and some swallow what they
    could not read. All of them end in the policy's own `load_state_dict`, so that is where the
    checkpoint is compared; a loader that never gets there has read nothing.

    Raises: ModelError if the checkpoint does not fit the class or does not hold the whole model.
    """
    record = _Record(weights.source, nf4)
    try:
        return _load_recorded(cls, weights, config, record)
    except ModelError:
        if config.device != META or record.conclusive:
            raise
    config.device = "cpu"  # not every class can be built without bytes
    try:
        return _load_recorded(cls, weights, config, _Record(weights.source, nf4))
    finally:
        config.device = META


def _load_recorded(cls: Any, weights: Weights, config: Any, record: "_Record") -> Any:
    try:
        model = from_pretrained(
            _recording(cls, record, config.device == META), weights, config=config
        )
    except ModelError:
        record.refuse(unless_copied=False)  # the reason, where the loader's message is vague
        raise
    try:
        record.refuse(unless_copied=True)
    except ModelError:
        del model
        raise
    model.__class__ = cls
    return model.eval()


class _Record:
    """Record of what `load_state_dict` was given while one model was loaded."""

    def __init__(self, source: str, nf4: Nf4 | None) -> None:
        self.nf4 = nf4
        self._source = source
        self._found = Differences()
        self._loaded: set[str] = set()
        self._compared = False
        self.copied = False
        self.built = False

    @property
    def conclusive(self) -> bool:
        """Note a failed load, which concerns the checkpoint and not only building without bytes."""
        return self.built and (not self._compared or self._found != Differences())

    def compare(
        self,
        own: "Mapping[str, Tensor]",
        header: PackedHeader,
        state_dict: "Mapping[str, Tensor]",
    ) -> None:
        """Compare a state dict before it is copied.

        Raises ModelError for defects that no further part of the checkpoint can repair.
        """
        self._compared = True
        self._found.misshapen |= header.misshapen
        self._found.broken |= {
            name for name, values in state_dict.items() if _is_broken(values, own.get(name))
        }
        for name, tensor in header.tensors.items():
            if name not in own:
                self._found.foreign.add(name)
            elif tensor.shape != own[name].shape:
                self._found.misshapen[name] = f"{tuple(tensor.shape)}, not {tuple(own[name].shape)}"
            else:
                self._loaded.add(name)
        here = self._loaded | (own.keys() & self._found.misshapen)
        tied = {_identity(own[name]) for name in here}
        self._found.missing = {
            name for name, tensor in own.items() if _identity(tensor) not in tied
        } | header.missing
        if self._found.foreign or self._found.misshapen or self._found.broken:
            self.refuse(unless_copied=False)

    def refuse(self, *, unless_copied: bool) -> None:
        """Raise ModelError for differences, and `unless_copied` where nothing was loaded."""
        self._found.refuse(self._source)
        if unless_copied and not self.copied:
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
            with torch.device(META) if without_bytes else contextlib.nullcontext(), _silence():
                super().__init__(*arguments, **options)
            record.built = True

        def load_state_dict(
            self, state_dict: "Mapping[str, Tensor]", *arguments: Any, **options: Any
        ) -> Any:
            nf4 = record.nf4
            header = PackedHeader(dict(state_dict)) if nf4 is None else packed_in(state_dict)
            record.compare(self.state_dict(keep_vars=True), header, state_dict)
            if nf4 is not None:
                state_dict = install(self, state_dict, header, nf4)
            with _silence():
                result = super().load_state_dict(state_dict, *arguments, **options)
            record.copied = True
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


def _is_broken(values: "Tensor", own: "Tensor | None") -> bool:
    """Return whether a weight has NaN or infinity, or a buffer NaN: masks hold infinity."""
    import torch

    if not values.is_floating_point() or not values.numel() or values.device.type == META:
        return False
    low, high = torch.aminmax(values)  # one pass, and NaN stays NaN
    if own is None or isinstance(own, torch.nn.Parameter):
        return not bool(low.isfinite() & high.isfinite())
    return bool(low.isnan())


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
