"""Policy families for tests: manifests, observations, answers, and lerobot's own loop."""

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from tests.sidecars.adapters import backbone_policies, policies
from tests.sidecars.adapters.policies import DIM, FRONT, ONLY_CAMERA, SIDE_PX, STATE, TASK, WRIST
from vram_arbiter.schemas.errors import ModelError, VramError
from vram_arbiter.schemas.manifest import ModelFamily, RSkillManifest, parse_manifest
from vram_arbiter.schemas.manifest.vocabulary import PROCESSOR_FAMILIES
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.adapters.policy import PolicyAdapter
from vram_arbiter.sidecars.adapters.policy_families import FAMILIES
from vram_arbiter.sidecars.weights import Weights, read_config

SAVERS = policies.SAVERS | backbone_policies.SAVERS
NAMES = tuple(SAVERS)
BY_DAY = ("act", "diffusion", "smolvla", "pi05")
"""A chunk, a history, a small and a large VLA: what each sweep plays in a usual run."""
SEED = 2  # most policies draw their actions


def swept(names: Iterable[str] = NAMES) -> list[Any]:
    """Return the parameters of a sweep: `make nightly` plays those that are not of BY_DAY."""
    return [
        pytest.param(name, marks=() if name in BY_DAY else pytest.mark.nightly) for name in names
    ]


def family_of(name: str) -> ModelFamily:
    return ModelFamily(name.split()[0])


def manifest_text(family: str, dtype: str = "fp32", more: str = "", extra: str = "") -> str:
    files = "{preprocessor_uri: local://x/a.json, postprocessor_uri: local://x/b.json}"
    processors = f"processors: {files}\n" if family in PROCESSOR_FAMILIES else ""
    return (
        "name: test/model\nversion: 0.1.0\nkind: vla\nembodiment_tags: [any]\nchunk_size: 1\n"
        "weights_uri: local://models/x\ndescription: a tiny model\nactions: [grasp]\n"
        f"latency_budget: {{per_chunk_ms: 100}}\nmodel_family: {family}\n"
        f"quantization: {{dtype: {dtype}, extra: {{trust_remote_code: true{extra}}}}}\n"
        "actuators_required:\n"
        "  - {kind: joint_position, control_mode_semantics: {mode: absolute}}\n"
        + (more or processors)
    )


def manifest_of(name: str, dtype: str | None = None, **fields: Any) -> RSkillManifest:
    supported = FAMILIES[family_of(name)].precisions if family_of(name) in FAMILIES else {"fp32"}
    found = parse_manifest(
        manifest_text(family_of(name), dtype or ("fp32" if "fp32" in supported else "bf16"))
    )
    return found.model_copy(update=fields)


def load_policy(
    name: str, weights: Weights, dtype: str | None = None, **fields: Any
) -> PolicyAdapter:
    adapter = prepared(manifest_of(name, dtype, **fields), weights)
    adapter.load("cpu")
    adapter.place("cpu")
    return adapter


def prepared(manifest: RSkillManifest, weights: Weights) -> PolicyAdapter:
    adapter = make_adapter(manifest, weights)
    assert isinstance(adapter, PolicyAdapter)
    adapter.prepare()
    return adapter


def copied(weights: Weights, folder: Path) -> Weights:
    """Return a copy of a checkpoint, to be damaged."""
    shutil.copytree(weights.source, folder)
    return Weights(str(folder), local=True)


def is_refused(adapter: PolicyAdapter, told: str, error: type[VramError] = ModelError) -> None:
    """Check that neither a load nor `--check` takes a checkpoint."""
    for device in ("cpu", "meta"):
        with pytest.raises(error, match=told):
            adapter.load(device)


def observations(count: int) -> list[dict[str, Any]]:
    import numpy as np

    random = np.random.default_rng(1)

    def picture() -> Any:
        return random.integers(0, 255, (SIDE_PX, SIDE_PX, 3), np.uint8)

    return [
        {
            STATE: random.normal(size=DIM).astype(np.float32),
            **{name: picture() for name in (FRONT, WRIST, ONLY_CAMERA)},
            "task": TASK,
        }
        for _ in range(count)
    ]


def ask(adapter: PolicyAdapter, observation: dict[str, Any], whole_chunk: bool = False) -> Any:
    call = EndpointCall(
        endpoint="get_action", data={"observation": observation}, whole_chunk=whole_chunk
    )
    return adapter.run(call)["action"]


def begin(adapter: PolicyAdapter) -> tuple[int, int]:
    """Begin an episode; return its control steps of an observation, and actions of an answer."""
    answer = adapter.run(EndpointCall(endpoint="reset"))
    return answer["n_obs_steps"], answer["n_action_steps"]


def history(steps: list[dict[str, Any]], at: int, length: int) -> dict[str, Any]:
    """Return the observation of control step `at` as the runner sends it."""
    return stacked([steps[max(0, place)] for place in range(at + 1 - length, at + 1)])


def answered_episode(adapter: PolicyAdapter, steps: list[dict[str, Any]]) -> Any:
    """Return the actions of one episode, played as they are answered."""
    import numpy as np
    import torch

    length, _ = begin(adapter)
    torch.manual_seed(SEED)
    actions: list[Any] = []
    while len(actions) < len(steps):
        answer = ask(adapter, history(steps, len(actions), length))
        assert answer.dtype == np.float32
        actions += list(answer)
    return np.stack(actions[: len(steps)])


def stacked(steps: list[dict[str, Any]]) -> dict[str, Any]:
    """Return consecutive observations as one with a leading dimension."""
    import numpy as np

    together = {
        name: np.stack([step[name] for step in steps]) for name in steps[0] if name != "task"
    }
    return together | {"task": TASK}


def lerobots_own(weights: Weights, steps: list[dict[str, Any]], **settings: Any) -> Any:
    """Return the actions of lerobot's loop, one a control step."""
    import numpy as np
    import torch
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot.utils.constants import OBS_IMAGES

    config = read_config(PreTrainedConfig, weights)
    config.device = "cpu"
    if hasattr(config, "pretrained_backbone_weights"):
        config.pretrained_backbone_weights = None  # no network here
    for field, value in settings.items():
        setattr(config, field, value)
    policy = get_policy_class(config.type).from_pretrained(weights.source, config=config)
    policy.eval()
    before, after = make_pre_post_processors(config, pretrained_path=weights.source)
    policy.reset()
    torch.manual_seed(SEED)
    rows = []
    for step in steps:
        batch: dict[str, Any] = {STATE: torch.from_numpy(step[STATE]), "task": TASK}
        for name in config.input_features:
            if name.startswith((OBS_IMAGES, ONLY_CAMERA)) and name in step:
                batch[name] = torch.from_numpy(step[name]).permute(2, 0, 1).float() / 255
        with torch.inference_mode():
            rows.append(after(policy.select_action(before(batch)))[0].numpy())
    return np.stack(rows)
