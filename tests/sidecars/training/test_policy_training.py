"""The policy trainer's code path in seconds: recorded arrays in, a checkpoint that lerobot's own
factory loads out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from vram_arbiter.sidecars.training.policy import (
    BadDemonstrations,
    load_demonstrations,
    load_stats,
    main,
    train,
)
from vram_arbiter.sidecars.weights import Weights, read_config

if TYPE_CHECKING:
    import numpy as np

pytestmark = pytest.mark.heavy

JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
CHECKPOINT = Path(__file__).parents[3] / "configs" / "models" / "so101-grab"


def write_demonstrations(folder: Path, episodes: int = 4, length: int = 25) -> None:
    """Episodes in which a bright spot stands where the first joint has to go."""
    import numpy as np

    rng = np.random.default_rng(0)
    sizes = {"front": (96, 96), "wrist": (96, 80)}
    steps = episodes * length
    place = np.repeat(rng.uniform(-0.5, 0.5, episodes), length)
    state = rng.normal(0, 0.2, (steps, 6)).astype(np.float32)
    action = state.copy()
    action[:, 0] = place
    for camera, (width, height) in sizes.items():
        images = np.full((steps, height, width, 3), 60, np.uint8)
        for step in range(steps):
            column = int((place[step] + 0.5) * (width - 12))
            images[step, 30:42, column : column + 12] = (220, 30, 30)
        np.save(folder / f"{camera}.npy", images)
    point = np.stack([np.full(steps, 0.3), place / 10, np.full(steps, 0.21)], axis=1).astype(
        np.float32
    )
    for key, values in (("state", state), ("action", action), ("point", point)):
        np.save(folder / f"{key}.npy", values)
    np.save(folder / "episode_length.npy", np.full(episodes, length))
    views = {
        "front": {
            "crop": [0.45, 0.2, 0.85, 0.7333333333],
            "size_px": [96, 96],
            "camera_px": [480, 360],
        },
        "wrist": {"crop": [0.1, 0.0, 1.0, 1.0], "size_px": [96, 80], "camera_px": [320, 240]},
    }
    info = {
        "format": "grab-demonstrations/1",
        "fps": 30,
        "joints": JOINTS,
        "units": "rad",
        "seed": 0,
        "views": views,
    }
    (folder / "info.json").write_text(json.dumps(info))


def act(folder: Path, chunk_of: int) -> np.ndarray:
    """One chunk from a checkpoint, loaded as any lerobot checkpoint is."""
    import torch
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    import vram_arbiter.sidecars.models.compact_act  # noqa: F401  # registers the policy type

    config = read_config(PreTrainedConfig, Weights(str(folder), local=True))
    config.device = "cpu"
    policy = get_policy_class(config.type).from_pretrained(folder, config=config)
    before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    generator = torch.Generator().manual_seed(1)
    observation = {
        "observation.images.front": torch.rand(3, 360, 480, generator=generator),
        "observation.images.wrist": torch.rand(3, 240, 320, generator=generator),
        "observation.state": torch.tensor([0.0, -1.2, 1.05, 1.35, 0.0, 0.6]),
    }
    policy.reset()
    chunk = after(policy.predict_action_chunk(before(observation)))
    assert chunk.shape == (1, chunk_of, 6)
    assert torch.isfinite(chunk).all()
    first = after(policy.select_action(before(observation)))
    assert torch.allclose(first, chunk[:, 0], atol=1e-5)
    return chunk.numpy()


def test_smoke_training_writes_a_checkpoint_that_the_factory_loads(tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    data.mkdir()
    write_demonstrations(data)
    assert main(["--data", str(data), "--out", str(out), "--smoke", "--threads", "1"]) == 0
    assert {p.name for p in out.iterdir()} >= {
        "config.json",
        "model.safetensors",
        "policy_preprocessor.json",
        "policy_postprocessor.json",
    }
    act(out, 12)


def test_the_loss_falls_and_the_seed_decides(tmp_path: Path) -> None:
    import torch

    write_demonstrations(tmp_path)
    torch.set_num_threads(1)
    data = load_demonstrations(tmp_path)

    def run(steps: int, out: str) -> dict[str, float]:
        return train(data, tmp_path / out, steps=steps, batch_size=16, seed=3, action_steps=6)

    few, many = run(2, "few"), run(60, "many")
    assert many["action"] < 0.8 * few["action"]
    run(2, "again")
    weights = [(tmp_path / name / "model.safetensors").read_bytes() for name in ("few", "again")]
    assert weights[0] == weights[1]


def test_going_on_from_a_checkpoint_keeps_its_normalisation(tmp_path: Path) -> None:
    import numpy as np
    import torch

    first, second, started, went_on = (
        tmp_path / name for name in ("first", "second", "started", "went_on")
    )
    for folder in (first, second):
        folder.mkdir()
        write_demonstrations(folder)
    np.save(second / "state.npy", np.load(second / "state.npy") * 3)
    data = load_demonstrations(first, second)
    assert len(data.state) == 200
    assert data.episode_end.max() == 200
    train(load_demonstrations(first), started, steps=2, batch_size=8, seed=0, action_steps=6)
    train(data, went_on, steps=2, batch_size=8, seed=0, action_steps=6, init=started)
    before, after = load_stats(started), load_stats(went_on)
    assert all(torch.equal(before[k][w], after[k][w]) for k in before for w in ("mean", "std"))


def test_a_folder_without_demonstrations_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import numpy as np

    assert main(["--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "info.json is missing" in capsys.readouterr().err
    write_demonstrations(tmp_path)
    np.save(tmp_path / "state.npy", np.zeros((3, 6), np.float32))
    with pytest.raises(BadDemonstrations, match="state"):
        load_demonstrations(tmp_path)


def test_the_shipped_checkpoint_is_small_and_loads() -> None:
    import numpy as np

    assert sum(p.stat().st_size for p in CHECKPOINT.iterdir()) < 5_000_000
    assert np.abs(act(CHECKPOINT, 12)).max() < 3.5
