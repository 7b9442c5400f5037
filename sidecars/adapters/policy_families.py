"""Policy families that a sidecar serves: types of checkpoints, packages, precisions, queues.

A family is listed here once its actions were compared with lerobot's own, one by one
(`tests/sidecars/adapters/test_policy_families.py`). Must not import torch or lerobot: `--check`
reads this table where neither is installed.
"""

import importlib.util
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from vram_arbiter.schemas.errors import ConfigError, ModelError, UnsupportedQuantization
from vram_arbiter.schemas.manifest import ModelFamily, RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Dtype
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.extras import EXTRA_OF, not_installed
from vram_arbiter.sidecars.quantization import nf4_of
from vram_arbiter.sidecars.weights import ProcessorFiles

_FLOATS: Final = frozenset({Dtype.FP32, Dtype.BF16, Dtype.FP16})
_OWN_FLOATS: Final = frozenset({Dtype.FP32, Dtype.BF16})
_BF16: Final = frozenset({Dtype.BF16})  # its code computes in nothing else
_CONSENT_HINT: Final = "read that code, then write trust_remote_code: true in quantization.extra"
_OWN_STEPS: Final = ("lerobot.", "vram_arbiter.")

_NOT_COMPARED: Final[Mapping[str, JsonMap]] = {
    "groot": {"use_relative_actions": True},  # each row needs the state that its chunk began with
    "molmoact2": {"inference_action_mode": "discrete", "enable_lora_vlm": True},
    "lingbot_va": {"camera_layout": "robotwin_tshape"},
    "wall_x": {"prediction_mode": "fast"},  # its tokenizer of actions is Python code of the hub
}
"""Settings of a type's configuration that are refused."""
_WHY_NOT: Final[Mapping[ModelFamily | None, str]] = {
    ModelFamily.FASTWAM: "its image encoder is in no checkpoint: lerobot reads it, in whatever "
    "revision, from a hub repository whose name is fixed in its code",
}
"""lerobot's types that are not in `FAMILIES`."""


@dataclass(frozen=True, slots=True)
class Family:
    """What serving a family takes.

    `types` are the `type` values of its checkpoints, `packages` the modules that its code imports
    beyond torch, transformers and lerobot. `queues` marks a policy that keeps observations between
    calls or gives one action a call: it answers through `select_action`, never through
    `predict_action_chunk`. `precisions` are the number formats that its code runs in. `camera` is
    the only name of an image that its code finds. `remote_code`: what of it is Python files of a
    hub repository. `dtype_field` is the field of its configuration that names the number format, if
    it has one, and `casts` marks code that casts unasked; layers of either may stay float32.
    `pads` marks processors that widen vectors before they normalize them.
    `replays` marks a policy that computes with encoders of a folder of their own, and that needs
    the observation after each of its actions.
    """

    types: tuple[str, ...]
    packages: tuple[str, ...] = ()
    queues: bool = False
    precisions: frozenset[Dtype] = _FLOATS
    camera: str | None = None
    remote_code: str | None = None
    dtype_field: str | None = None
    casts: bool = False
    pads: bool = False
    replays: bool = False


FAMILIES: Final[Mapping[ModelFamily, Family]] = {
    ModelFamily.ACT: Family(("act", "compact_act")),
    ModelFamily.DIFFUSION: Family(("diffusion",), ("diffusers",), queues=True),
    ModelFamily.VQBET: Family(("vqbet",), queues=True),
    ModelFamily.TDMPC: Family(("tdmpc",), queues=True, camera="observation.image"),
    ModelFamily.MULTI_TASK_DIT: Family(("multi_task_dit",), ("diffusers",), queues=True),
    ModelFamily.GAUSSIAN_ACTOR: Family(("gaussian_actor",), queues=True),
    ModelFamily.SMOLVLA: Family(("smolvla",), ("num2words",)),
    ModelFamily.PI0: Family(("pi0",), precisions=_OWN_FLOATS, dtype_field="dtype"),
    ModelFamily.PI05: Family(("pi05",), precisions=_OWN_FLOATS, dtype_field="dtype"),
    ModelFamily.PI0_FAST: Family(
        ("pi0_fast",),
        ("scipy",),
        precisions=_OWN_FLOATS,
        remote_code="action tokenizer",
        dtype_field="dtype",
    ),
    ModelFamily.EO1: Family(("eo1",), precisions=_OWN_FLOATS, dtype_field="dtype"),
    ModelFamily.EVO1: Family(("evo1",), pads=True),
    ModelFamily.XVLA: Family(("xvla",), precisions=_OWN_FLOATS, dtype_field="dtype"),
    ModelFamily.VLA_JEPA: Family(
        ("vla_jepa",), ("diffusers",), precisions=_BF16, dtype_field="torch_dtype"
    ),
    ModelFamily.MOLMOACT2: Family(
        ("molmoact2",), ("scipy",), precisions=_OWN_FLOATS, dtype_field="model_dtype"
    ),
    ModelFamily.GR00T: Family(
        ("groot",), ("diffusers", "tree"), precisions=_OWN_FLOATS, remote_code="backbone"
    ),
    ModelFamily.LINGBOT_VA: Family(
        ("lingbot_va",),
        ("diffusers",),
        queues=True,
        precisions=_OWN_FLOATS,
        dtype_field="dtype",
        replays=True,
    ),
    ModelFamily.WALL_X: Family(
        ("wall_x",), ("peft", "torchdiffeq", "qwen_vl_utils"), precisions=_BF16, casts=True
    ),
}


def family_of(manifest: RSkillManifest) -> Family:
    """Return the manifest's family.

    Raises: ConfigError for a family that is not served, or that runs code of the hub without the
    manifest's consent.
    """
    name = manifest.model_family
    family = FAMILIES.get(name) if name is not None else None
    if name is None or family is None:
        raise ConfigError(
            f"{manifest.name}: model_family {name.value if name else None!r} is not served"
            + (f": {why}" if (why := _WHY_NOT.get(name)) else ""),
            hint=f"sidecars serve {', '.join(sorted(FAMILIES))}",
        )
    if family.remote_code and not _consents(manifest):
        raise ConfigError(
            f"{manifest.name}: the {family.remote_code} of model_family {name} is Python code of "
            "the hub",
            hint=_CONSENT_HINT,
        )
    return family


def _consents(manifest: RSkillManifest) -> bool:
    return manifest.quantization.extra.get("trust_remote_code") is True


def need_packages(manifest: RSkillManifest) -> None:
    """Raise ConfigError that names every package of the manifest's family that is not installed."""
    family = FAMILIES.get(manifest.model_family) if manifest.model_family else None
    missing = [
        name
        for name in (family.packages if family else ())
        if importlib.util.find_spec(name) is None
    ]
    if missing:
        extra = EXTRA_OF[missing[0]]
        raise not_installed(f"a policy of family {manifest.model_family}", missing, extra)


def computing_type(manifest: RSkillManifest, family: Family) -> Dtype:
    """Return the number format that the policy computes in.

    Raises: UnsupportedQuantization if the family's code does not run in it.
    """
    nf4 = nf4_of(manifest)
    if nf4 is not None and family.replays:  # its code casts numbers to the type of its weights
        raise UnsupportedQuantization(
            f"{manifest.name}: a policy of family {manifest.model_family} is not quantized",
            hint=f"use {' or '.join(sorted(family.precisions))}",
        )
    dtype = manifest.quantization.dtype if nf4 is None else nf4.computes_in
    if dtype not in family.precisions:
        raise UnsupportedQuantization(
            f"{manifest.name}: a policy of family {manifest.model_family} does not compute in "
            f"{dtype}",
            hint=f"use {' or '.join(sorted(family.precisions))}",
            details={"dtype": dtype.value, "supported": sorted(family.precisions)},
        )
    return dtype


def need_type(manifest: RSkillManifest, family: Family, config: Any, source: str) -> None:
    """Raise ModelError if a checkpoint's configuration is not one that the family's code can run.

    `config` is lerobot's `PreTrainedConfig`.
    """
    if config.type not in family.types:
        raise ModelError(
            f"{source} is a policy of type {config.type!r}, but {manifest.name} names model_family "
            f"{manifest.model_family}, whose checkpoints are of type {' or '.join(family.types)}",
            hint="correct model_family or weights_uri in the manifest",
        )
    if config.use_peft:
        raise ModelError(
            f"{source} is a PEFT adapter, not a whole policy",
            hint="merge it into its base policy and save that",
        )
    if config.type == "gaussian_actor" and config.vision_encoder_name and not _consents(manifest):
        raise ModelError(
            f"{source}: its image encoder {config.vision_encoder_name} is Python code of the hub",
            hint=_CONSENT_HINT,
        )
    for field, value in _NOT_COMPARED.get(config.type, {}).items():
        if getattr(config, field) == value:
            raise ModelError(
                f"{source}: a {config.type} with {field}: {value} is not served",
                hint="its actions were not compared with lerobot's",
            )
    cameras = sorted(config.image_features)
    if family.camera and cameras and cameras != [family.camera]:
        raise ModelError(
            f"{source} names its cameras {', '.join(cameras)}; lerobot's {config.type} finds only "
            f"{family.camera}",
            hint="rename the input in the checkpoint's config.json and processors",
        )


def need_own_steps(manifest: RSkillManifest, files: ProcessorFiles) -> None:
    """Raise ModelError if a processor names code that is neither lerobot's nor ours.

    lerobot imports and calls any class that a processor's file names, such as `subprocess.Popen`.
    """
    if _consents(manifest):
        return
    for name in (files.preprocessor, files.postprocessor):
        path = Path(files.source) / name
        try:
            steps = [dict(step) for step in json.loads(path.read_text(encoding="utf-8"))["steps"]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ModelError(
                f"{path}: its processors cannot be read: {type(error).__name__}: {error}",
                hint="check that the checkpoint is complete",
            ) from error
        for step in steps:
            called = str(step.get("class", ""))
            options = step.get("config") or {}
            if (called and not called.startswith(_OWN_STEPS)) or options.get("trust_remote_code"):
                raise ModelError(
                    f"{path} runs other code than lerobot's: "
                    f"{called or step.get('registry_name')} {options}",
                    hint=_CONSENT_HINT,
                )
