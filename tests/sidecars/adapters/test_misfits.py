"""A manifest that was written by hand beside a checkpoint: what the first goal would fail on."""

from types import SimpleNamespace

from vram_arbiter.schemas.manifest.load import parse_manifest
from vram_arbiter.sidecars.adapters.policy_observations import misfits

TEXT = """name: lab/act-grab
version: 0.1.0
license: mit
kind: vla
model_family: act
embodiment_tags: [any]
sensors_required:
  - {modality: rgb, vla_feature_key: observation.images.top}
actuators_required: [{kind: joint_position, control_mode_semantics: {mode: absolute}}]
image_preprocessing: {aliases: {overview: top}, input_template: "observation.pixels.{cam}"}
state_contract: {dim: 6}
action_contract: {dim: 7}
weights_uri: local://train
chunk_size: 20
latency_budget: {per_chunk_ms: 400}
description: d
actions: [grasp]
"""


def feature(kind: str, *shape: int) -> SimpleNamespace:
    return SimpleNamespace(type=SimpleNamespace(value=kind), shape=shape)


def test_a_manifest_is_compared_with_the_checkpoint_that_it_names() -> None:
    manifest = parse_manifest(TEXT)
    inputs = {
        "observation.state": feature("STATE", 6),
        "observation.pixels.top": feature("VISUAL", 3, 48, 64),
        "observation.images.empty_camera_0": feature("VISUAL", 3, 48, 64),
    }
    assert misfits(manifest, inputs, {"action": feature("ACTION", 7)}) == []
    wrist = {**inputs, "observation.pixels.wrist": feature("VISUAL", 3, 48, 64)}
    assert misfits(manifest, wrist, {"action": feature("ACTION", 6)}) == [
        "the checkpoint reads observation.pixels.wrist, sensors_required names "
        "observation.pixels.top",
        "action_contract.dim is 7, the checkpoint has 6 numbers",
    ]
