"""Which adapter drives a manifest's model."""

from schemas.errors import ConfigError
from schemas.manifest import Kind, RSkillManifest
from schemas.manifest.vocabulary import DetectorEngine, Runtime
from sidecars.adapters.base import ModelAdapter
from sidecars.adapters.detector import DetectorAdapter
from sidecars.adapters.gpu_passthrough import GpuPassthroughAdapter, is_passthrough
from sidecars.adapters.policy import PolicyAdapter
from sidecars.adapters.reward import RewardAdapter
from sidecars.adapters.scene_vlm import SceneVlmAdapter
from sidecars.weights import Weights


def make_adapter(manifest: RSkillManifest, weights: Weights) -> ModelAdapter:
    """The adapter of a manifest. Raises ConfigError for kinds, engines and runtimes that no sidecar of ours serves."""
    if manifest.runtime is not Runtime.PYTORCH:
        raise ConfigError(
            f"{manifest.name}: runtime {manifest.runtime.value!r} is not served", hint="sidecars run pytorch"
        )
    if manifest.kind is Kind.DETECTOR:
        engine = manifest.detector.engine if manifest.detector else None
        if engine not in (None, DetectorEngine.ZEROSHOT_HF):
            raise ConfigError(
                f"{manifest.name}: detector engine {engine} is not served", hint="use engine zeroshot_hf"
            )
        return DetectorAdapter(manifest, weights)
    if manifest.kind is Kind.VLM:
        return SceneVlmAdapter(manifest, weights)
    if manifest.kind is Kind.VLA and is_passthrough(manifest):
        return GpuPassthroughAdapter(manifest)
    if manifest.kind is Kind.VLA:
        return PolicyAdapter(manifest, weights)
    if manifest.kind is Kind.REWARD:
        return RewardAdapter(manifest, weights)
    raise ConfigError(
        f"{manifest.name}: kind {manifest.kind.value!r} is not served",
        hint="sidecars serve detector, vlm, vla and reward",
    )
