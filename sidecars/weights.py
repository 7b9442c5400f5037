"""Source of weights, and the one call that loads them: hub id and local folder alike.

`local://models/x` is CONFIGS/models/x; `hf://owner/repo[@revision]` is a repository of the hub.
Must not know devices' bytes or leases.
"""

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from traceback import walk_tb
from typing import Any, Final

from vram_arbiter.clients.configs import CONFIGS_VARIABLE
from vram_arbiter.schemas.errors import ConfigError, ModelError, VramError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.sidecars.quantization import check_checkpoint, nf4_of, torch_type

CONFIG_FILE: Final = "config.json"
POLICY_FILES: Final = ["*.json", "*.safetensors", "*.model", "*.txt"]
"""What a policy's repository holds of use: weights, processors, tokenizers."""
ONNX_FILES: Final = ["*.onnx", "*.onnx_data", "*.onnx.data"]


@dataclass(frozen=True, slots=True)
class ProcessorFiles:
    """A policy's pre- and postprocessor: two file names in `source`, at `revision` of a hub
    repository."""

    source: str
    revision: str | None
    preprocessor: str
    postprocessor: str


@dataclass(frozen=True, slots=True)
class Weights:
    """Source of weights; `source` is what `from_pretrained` takes: a folder or `owner/repo`.

    `processors` are the manifest's; None: the ones beside the weights, under lerobot's names.
    """

    source: str
    revision: str | None = None
    local: bool = False
    processors: ProcessorFiles | None = None
    own_code: bool = False  # the checkpoint's own Python files may be run


def resolve(uri: str, configs: Path) -> Weights:
    """Parse a manifest's `weights_uri`.

    Raises ConfigError if it leads nowhere or out of the configs folder.
    """
    scheme, _, rest = uri.partition("://")
    if scheme == "hf":
        source, _, revision = rest.partition("@")
        return Weights(source, revision or None)
    folder = (configs / rest).resolve()
    if scheme != "local" or not folder.is_relative_to(configs.resolve()):
        raise ConfigError(
            f"weights_uri {uri!r} is not a source of weights",
            hint="write hf://OWNER/REPO or local://models/NAME",
        )
    if not folder.is_dir():
        raise ConfigError(
            f"no weights in {folder}",
            hint=f"{uri} is looked up below {configs}; see {CONFIGS_VARIABLE}",
        )
    return Weights(str(folder), local=True)


def with_processors(weights: Weights, manifest: RSkillManifest, configs: Path) -> Weights:
    """Return `weights` with the processors that the manifest names, if it names any.

    Raises: ConfigError if a file is not there, or if the two lie in different places: lerobot
    makes both from one checkpoint, because they share state.
    """
    if manifest.processors is None:
        return weights
    before, name_before = _file(manifest.processors.preprocessor_uri, configs)
    after, name_after = _file(manifest.processors.postprocessor_uri, configs)
    if before != after:
        raise ConfigError(
            f"{manifest.name}: preprocessor_uri and postprocessor_uri lead to {before.source} and "
            f"{after.source}",
            hint="name two files of one checkpoint",
        )
    revision = before.revision
    if before.source == weights.source and revision is None:
        revision = weights.revision  # processors of other weights would be in other units
    return replace(
        weights, processors=ProcessorFiles(before.source, revision, name_before, name_after)
    )


def _file(uri: str, configs: Path) -> tuple[Weights, str]:
    """Parse the URI of a file. Raises ConfigError."""
    scheme, _, rest = uri.partition("://")
    if scheme == "hf":
        owner, repository, name = rest.split("/", 2)
        return resolve(f"hf://{owner}/{repository}", configs), name
    folder, _, name = rest.rpartition("/")
    place = resolve(f"{scheme}://{folder}", configs)
    if not (Path(place.source) / name).is_file():
        raise ConfigError(f"no file {Path(place.source) / name}", hint=f"{uri} names it")
    return place, name


def model_type(weights: Weights, key: str) -> str:
    """Return a text of a local checkpoint's `config.json`, such as `model_type`; "" if it has none
    that a module could be named by."""
    try:
        found = json.loads((Path(weights.source) / CONFIG_FILE).read_text(encoding="utf-8"))
        named = found.get(key)
    except (OSError, ValueError, AttributeError):
        return ""
    return named if isinstance(named, str) and named.isidentifier() else ""


def transformers_modules(weights: Weights) -> tuple[str, ...]:
    """Return the modules of a transformers model."""
    kind = model_type(weights, "model_type")
    return ("torch", "transformers", "PIL.Image", f"transformers.models.{kind}.modeling_{kind}")


def fetched(weights: Weights, patterns: Sequence[str] = POLICY_FILES) -> Weights:
    """Return the local folder of weights and processors, after downloading what is not here.
    `patterns`: the files of use.

    Some of lerobot's loaders drop the revision and read the newest one. Raises ModelError.
    """
    if not weights.local:
        weights = _in_folder(weights, _download(weights.source, weights.revision, patterns))
    files = weights.processors
    if files and not Path(files.source).is_dir():
        folder = _download(files.source, files.revision, patterns)
        weights = replace(weights, processors=replace(files, source=folder, revision=None))
    return weights


def _download(source: str, revision: str | None, patterns: Sequence[str]) -> str:
    from huggingface_hub import snapshot_download

    try:
        return str(snapshot_download(source, revision=revision, allow_patterns=list(patterns)))
    except Exception as error:
        raise ModelError(
            f"{source} cannot be fetched: {type(error).__name__}: {error}",
            hint="check its name, its revision and the network, or fetch it with `hf download`",
        ) from error


def _in_folder(weights: Weights, folder: str) -> Weights:
    """Return hub weights that lie in a local folder, with their processors if these lie there."""
    files = weights.processors
    if files and (files.source, files.revision) == (weights.source, weights.revision):
        files = replace(files, source=folder, revision=None)
    return replace(weights, source=folder, revision=None, local=True, processors=files)


def cached(weights: Weights) -> Weights | None:
    """Return the local folder of a hub repository in the hub's cache; None if never fetched."""
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        folder = Path(
            snapshot_download(weights.source, revision=weights.revision, local_files_only=True)
        )
    except LocalEntryNotFoundError:
        return None
    there = (*folder.glob("*.safetensors"), *folder.rglob("*.onnx"))
    return _in_folder(weights, str(folder)) if there else None


def from_pretrained(cls: Any, weights: Weights, **options: Any) -> Any:
    """Call `cls.from_pretrained` of any class of transformers or lerobot.

    Raises ModelError if the checkpoint does not fit the class.
    """
    if weights.local:
        options["local_files_only"] = True
    elif weights.revision:
        options["revision"] = weights.revision
    if cls.__module__.startswith("transformers."):
        options["trust_remote_code"] = weights.own_code  # unsaid, it asks at the terminal
    with fitting(cls, weights):
        return cls.from_pretrained(weights.source, **options)


@contextmanager
def fitting(cls: Any, weights: Weights) -> Iterator[None]:
    """Raise a library's failure to load as ModelError."""
    try:
        yield
    except VramError:
        raise
    except Exception as error:
        # torch's error, which says more than that the weights are bad
        if type(error).__name__ == "OutOfMemoryError":
            raise
        raise ModelError(
            f"{cls.__name__} cannot load {weights.source}: {reason(error)}",
            hint="check that it is complete and of the manifest's kind",
        ) from error


def read_config(cls: Any, weights: Weights) -> Any:
    """Return a checkpoint's configuration, decoded by a configuration class of lerobot.

    `cls.from_pretrained` does the same through a temporary file that it leaves behind. Raises
    ModelError.
    """
    import draccus

    with fitting(cls, weights):
        fields = _config_fields(weights)
        kind = cls.get_choice_class(fields.pop("type"))
        with draccus.config_type("json"):
            return draccus.decode(kind, fields)


def reason(error: BaseException) -> str:
    """Return a library's failure in words.

    Checkpoints name other repositories of the hub (tokenizers, backbones). The libraries say that
    one is not in the cache, but not which: it is an argument of theirs.
    """
    link: BaseException | None = error
    while link is not None and type(link).__name__ != "LocalEntryNotFoundError":
        link = link.__cause__ or link.__context__
    frames = [] if link is None else walk_tb(link.__traceback__)
    for asked in (frame.f_locals for frame, _ in frames):
        if name := asked.get("repo_id"):
            revision = asked.get("revision") or "main"
            at = "" if revision == "main" else f" --revision {revision}"
            return f"{name} is not in the hub's cache: `hf download {name}{at}` fetches it"
    return f"{type(error).__name__}: {error}"


def model_options(manifest: RSkillManifest, weights: Weights, device: str) -> Message:
    """Return `load_transformers`' options for a model in its manifest's precision.

    `device` is where the weights are put, `cpu` or `meta`; their precision does not depend on it.

    Raises: UnsupportedQuantization, ConfigError, and ModelError if the checkpoint's configuration
    cannot be read.
    """
    # shard by shard: a lower peak, and no thread that a fork would lose
    os.environ.setdefault("HF_DEACTIVATE_ASYNC_LOAD", "1")
    nf4 = nf4_of(manifest)
    check_checkpoint(manifest, quantization_config(weights))
    options: Message = {"device_map": {"": device}}
    if nf4 is None:
        return options | {"dtype": torch_type(manifest.quantization.dtype)}
    return options | {"dtype": nf4.compute_type, "nf4": nf4}


def quantization_config(weights: Weights) -> JsonMap | None:
    """Return how a checkpoint says that its weights are quantized; None if they are not.

    Raises: ModelError.
    """
    try:
        found: JsonMap | None = _config_fields(weights).get("quantization_config")
    except Exception as error:
        raise ModelError(
            f"{weights.source}: its {CONFIG_FILE} cannot be read: {type(error).__name__}: {error}",
            hint="check that the checkpoint is complete",
        ) from error
    return found


def safetensors_files(weights: Weights) -> list[Path]:
    """Return the files of a checkpoint's weights, fetched from the hub if need be. Raises
    ModelError."""
    folder = Path(fetched(weights).source)
    whole, index = folder / "model.safetensors", folder / "model.safetensors.index.json"
    if whole.is_file() or not index.is_file():
        return [whole]
    parts = json.loads(index.read_text(encoding="utf-8"))["weight_map"].values()
    return [folder / name for name in dict.fromkeys(parts)]


def _config_fields(weights: Weights) -> Message:
    """Return the checkpoint's `config.json`. Raises what the hub and JSON raise."""
    from huggingface_hub import hf_hub_download

    file = Path(weights.source) / CONFIG_FILE
    if not weights.local:
        file = Path(hf_hub_download(weights.source, CONFIG_FILE, revision=weights.revision))
    found: Message = json.loads(file.read_text(encoding="utf-8"))
    return found
