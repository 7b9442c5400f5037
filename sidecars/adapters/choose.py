"""Choice of the adapter for a manifest's model."""

from collections.abc import Callable, Mapping
from typing import Final

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import DetectorEngine, Runtime
from vram_arbiter.sidecars.adapters.base import ModelAdapter, has_model
from vram_arbiter.sidecars.adapters.detector import ZERO_SHOT_LOADER, DetectorAdapter
from vram_arbiter.sidecars.adapters.gpu_passthrough import ADAPTER as PASSTHROUGH
from vram_arbiter.sidecars.adapters.gpu_passthrough import GpuPassthroughAdapter
from vram_arbiter.sidecars.adapters.locate_anything import LOADER, LocateAnythingAdapter
from vram_arbiter.sidecars.adapters.onnx_detector import OnnxDetectorAdapter
from vram_arbiter.sidecars.adapters.policy import PolicyAdapter
from vram_arbiter.sidecars.adapters.reward import RewardAdapter
from vram_arbiter.sidecars.adapters.scene_vlm import SceneVlmAdapter
from vram_arbiter.sidecars.adapters.scripted_pick import ADAPTER as SCRIPTED_PICK
from vram_arbiter.sidecars.adapters.scripted_pick import ScriptedPickAdapter
from vram_arbiter.sidecars.weights import Weights

ONNX: Final = frozenset({Runtime.ONNX, Runtime.TENSORRT})
"""Runtimes of exported models."""
_ADAPTERS: Final[Mapping[Kind, Callable[[RSkillManifest, Weights], ModelAdapter]]] = {
    Kind.VLM: SceneVlmAdapter,
    Kind.VLA: PolicyAdapter,
    Kind.REWARD: RewardAdapter,
}
_WITHOUT_MODEL: Final[Mapping[str, Callable[[RSkillManifest], ModelAdapter]]] = {
    PASSTHROUGH: GpuPassthroughAdapter,
    SCRIPTED_PICK: ScriptedPickAdapter,
}
"""By `policy_extras.adapter`."""


def make_adapter(manifest: RSkillManifest, weights: Weights) -> ModelAdapter:
    """Return the adapter of a manifest.

    Raises ConfigError for kinds, engines and runtimes that no sidecar serves.
    """
    exported = manifest.kind is Kind.DETECTOR and manifest.runtime in ONNX
    if manifest.runtime is not Runtime.PYTORCH and not exported:
        raise ConfigError(
            f"{manifest.name}: runtime {manifest.runtime.value!r} is not served",
            hint="sidecars run pytorch, and detectors also as onnx or tensorrt",
        )
    if manifest.kind is Kind.DETECTOR:
        engine = manifest.detector.engine if manifest.detector else None
        served = DetectorEngine.RTDETR_ONNX if exported else DetectorEngine.ZEROSHOT_HF
        if engine not in (None, served):
            raise ConfigError(
                f"{manifest.name}: detector engine {engine} is not served by {manifest.runtime}",
                hint=f"use engine {served}",
            )
        if exported:
            return OnnxDetectorAdapter(manifest, weights)
        loader = manifest.quantization.extra.get("loader")
        if loader == LOADER:
            return LocateAnythingAdapter(manifest, weights)
        if loader not in (None, ZERO_SHOT_LOADER):
            raise ConfigError(
                f"{manifest.name}: quantization.extra.loader {loader!r} is not served",
                hint=f"write {ZERO_SHOT_LOADER}, or {LOADER} for LocateAnything",
            )
        return DetectorAdapter(manifest, weights)
    if manifest.kind is Kind.VLA and not has_model(manifest):
        name = str(manifest.policy_extras["adapter"])
        if name not in _WITHOUT_MODEL:
            raise ConfigError(
                f"{manifest.name}: policy_extras.adapter {name!r} is not served",
                hint=f"use {' or '.join(_WITHOUT_MODEL)}, or leave it out for a model",
            )
        return _WITHOUT_MODEL[name](manifest)
    if adapter := _ADAPTERS.get(manifest.kind):
        return adapter(manifest, weights)
    raise ConfigError(
        f"{manifest.name}: kind {manifest.kind.value!r} is not served",
        hint="sidecars serve detector, vlm, vla and reward",
    )
