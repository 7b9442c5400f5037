"""PushT and ALOHA of the field, played by `lerobot-eval` under this runner with a checkpoint that
is trained here. Nightly: ALOHA's pictures of 640 × 480 take seconds of a core."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.runner.__main__ import main

pytestmark = [pytest.mark.heavy, pytest.mark.nightly, pytest.mark.timeout(900)]
ROOT = Path(__file__).parents[3]
STEPS, CHUNK = 24, 4
TRAINED_STEPS = 10


@dataclass(frozen=True)
class World:
    """An environment of the field as its policies see it."""

    package: str
    env_id: str
    picture: str


WORLDS: Mapping[str, World] = {
    "pusht": World("gym_pusht", "gym_pusht/PushT-v0", "observation.image"),
    "aloha": World("gym_aloha", "gym_aloha/AlohaTransferCube-v0", "observation.images.top"),
}


def demonstration(world: World) -> dict[str, Any]:
    """Play an episode of slowly changing actions; return what a policy saw, and what it did.

    Pictures are (steps, 3, height, width) in [0, 1].
    """
    import gymnasium
    import numpy as np
    import torch

    env = gymnasium.make(world.env_id, obs_type="pixels_agent_pos")
    space: Any = env.action_space
    seen, _ = env.reset(seed=0)
    space.seed(0)
    towards, action = space.sample(), space.sample()
    pictures, states, actions = [], [], []
    for _ in range(STEPS):
        picture = seen["pixels"] if "top" not in seen["pixels"] else seen["pixels"]["top"]
        pictures.append(np.ascontiguousarray(picture).transpose(2, 0, 1) / np.float32(255))
        states.append(seen["agent_pos"])
        action = (0.9 * action + 0.1 * towards).astype(space.dtype)
        actions.append(action)
        seen, *_ = env.step(action)
    env.close()
    return {
        world.picture: torch.tensor(np.stack(pictures), dtype=torch.float32),
        "observation.state": torch.tensor(np.stack(states), dtype=torch.float32),
        "action": torch.tensor(np.stack(actions), dtype=torch.float32),
    }


def train(folder: Path, world: World, shown: dict[str, Any]) -> tuple[float, float]:
    """Train a small ACT on a demonstration, and save it as lerobot does. Return its first and its
    last loss."""
    import torch
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    torch.manual_seed(0)
    states, actions = shown["observation.state"], shown["action"]
    config = ACTConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, tuple(states.shape[1:])),
            world.picture: PolicyFeature(FeatureType.VISUAL, tuple(shown[world.picture].shape[1:])),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, tuple(actions.shape[1:]))},
        device="cpu", dim_model=32, n_heads=2, dim_feedforward=32, n_encoder_layers=1,
        use_vae=False, dropout=0.0, chunk_size=CHUNK, n_action_steps=CHUNK,
        pretrained_backbone_weights=None,
    )  # fmt: skip
    stats = {
        key: {"mean": value.mean(0), "std": value.std(0) + 1e-3}
        for key, value in (("observation.state", states), ("action", actions))
    }
    stats[world.picture] = {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.5)}
    policy = ACTPolicy(config)
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3)
    starts = range(0, STEPS - CHUNK, 5)
    batch = {key: value[list(starts)] for key, value in shown.items()}
    batch["action"] = torch.stack([actions[at : at + CHUNK] for at in starts])
    batch["action_is_pad"] = torch.zeros(len(starts), CHUNK, dtype=torch.bool)
    losses = []
    for _ in range(TRAINED_STEPS):
        loss, _ = policy.forward(before(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    policy.save_pretrained(folder)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    return losses[0], losses[-1]


@pytest.mark.parametrize("name", WORLDS)
def test_a_checkpoint_trained_here_plays_a_world_of_the_field(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    world = WORLDS[name]
    pytest.importorskip("lerobot.policies", reason="needs the sidecars extra")
    pytest.importorskip(world.package, reason="needs the group worlds")
    checkpoint = tmp_path / "models" / name
    first, last = train(checkpoint, world, demonstration(world))
    assert last < 0.9 * first
    grab = (ROOT / "configs/rskills/so101-grab/rskill.yaml").read_text(encoding="utf-8")
    manifest = tmp_path / "rskill.yaml"
    weights = f"local://models/{name}"
    manifest.write_text(grab.replace("local://models/so101-grab", weights), encoding="utf-8")
    monkeypatch.setenv("VRAM_ARBITER_CONFIGS", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # lerobot leaves a file there
    argv = [
        *("benchmark", "--env", name, "--skill", "vram-arbiter/so101-grab", "--no-arbiter"),
        *("--skills", str(manifest), "--episodes", "2", "--out", str(tmp_path / "out"), "--"),
        *("--policy.device=cpu", "--env.episode_length=10"),
        *("--eval.batch_size=1", "--eval.use_async_envs=false"),
    ]
    code = main(argv)
    out, said = capfd.readouterr()
    assert code == 0, said[-3000:]
    written = json.loads((tmp_path / "out/benchmark.json").read_text(encoding="utf-8"))
    (cell,) = written["cells"]
    assert (cell["world"], cell["judged"], cell["complete"]) == (name, 2, True)
    assert "0/2 = " in out, "ten steps solve nothing"
