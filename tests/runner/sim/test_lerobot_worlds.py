"""Worlds of the field, played by `lerobot-eval` under this runner and a lease, with a checkpoint
that is trained here.

Nightly: their pictures take seconds of a core. PushT and ALOHA are played in `.venv`; LIBERO
and a scene of our own in it need an older MuJoCo than the runner, and `make nightly` plays them in
`.venv-worlds`.
"""

import importlib.util
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.support.paths import ROOT
from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient
from vram_arbiter.runner.__main__ import main

pytestmark = [pytest.mark.heavy, pytest.mark.nightly, pytest.mark.timeout(1800)]
STEPS, CHUNK = 24, 4
TRAINED_STEPS = 10


@dataclass(frozen=True)
class World:
    """An environment of lerobot: its type, the package that has it, and its options."""

    env: str
    package: str
    picture: str
    options: Mapping[str, Any] = field(default_factory=dict)
    plugin: str = ""

    def flags(self) -> list[str]:
        """Return the flags of `lerobot-eval` for this world."""
        plugin = [f"--env.discover_packages_path={self.plugin}"] if self.plugin else []
        return plugin + [f"--env.{key}={json.dumps(value)}" for key, value in self.options.items()]


TOP, IMAGE, LIBERO = "observation.images.top", "observation.image", "observation.images.image"
SMALL = {"observation_height": 128, "observation_width": 128}
WORLDS: Mapping[str, World] = {
    "pusht": World("pusht", "gym_pusht", IMAGE, {"episode_length": 10}),
    "aloha": World("aloha", "gym_aloha", TOP, {"episode_length": 10}),
    "libero": World(
        "libero", "libero", LIBERO,
        SMALL | {"task": "libero_goal", "task_ids": [7], "episode_length": 10},
    ),
    "libero, a scene of our own": World(
        "libero", "libero", LIBERO,
        SMALL | {"task": "own_scene", "init_states": False, "episode_length": 10},
        plugin="tests.runner.libero_scene",
    ),
}  # fmt: skip


@pytest.fixture
def libero_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LIBERO's file of paths, which its first import would ask for on the terminal."""
    found = importlib.util.find_spec("libero")
    if found is None or not found.submodule_search_locations:
        return
    root = Path(next(iter(found.submodule_search_locations))) / "libero"
    paths = {"benchmark_root": "", "bddl_files": "bddl_files", "init_states": "init_files"}
    paths |= {"datasets": "datasets", "assets": "assets"}
    text = json.dumps({key: str(root / name) for key, name in paths.items()})
    (tmp_path / "config.yaml").write_text(text, encoding="utf-8")
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))


def demonstration(world: World) -> dict[str, Any]:
    """Play slowly changing actions; return what a policy saw, and what it did.

    Pictures are (steps, 3, height, width) in [0, 1].
    """
    import torch
    from lerobot.configs.parser import load_plugin
    from lerobot.envs.factory import make_env, make_env_config
    from lerobot.envs.utils import preprocess_observation

    if world.plugin:
        load_plugin(world.plugin)
    config = make_env_config(world.env, **world.options)
    ((env,),) = (tasks.values() for tasks in make_env(config, n_envs=1).values())
    before, _ = config.get_env_processors()
    seen, _ = env.reset(seed=[0])
    env.action_space.seed(0)
    towards, action = env.action_space.sample(), env.action_space.sample()
    rows: list[dict[str, Any]] = []
    for _ in range(STEPS):
        observation = before(preprocess_observation(seen))
        action = (0.9 * action + 0.1 * towards).astype(action.dtype)
        row = {key: observation[key] for key in (world.picture, "observation.state")}
        rows.append(row | {"action": torch.from_numpy(action.copy())})
        seen, *_ = env.step(action)
    env.close()
    return {key: torch.cat([row[key] for row in rows]).float() for key in rows[0]}


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
def test_a_trained_checkpoint_plays_a_world_of_the_field(
    name: str,
    tmp_path: Path,
    libero_paths: None,
    arbiter_daemon: ArbiterProcess,
    connect: Callable[..., WireClient],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    world = WORLDS[name]
    pytest.importorskip("lerobot.policies", reason="needs the sidecars extra")
    pytest.importorskip(world.package, reason="needs the group of its world: .ci/setup")
    first, last = train(tmp_path / "models/small", world, demonstration(world))
    assert last < 0.9 * first
    grab = (ROOT / "configs/rskills/so101-grab/rskill.yaml").read_text(encoding="utf-8")
    manifest = tmp_path / "rskill.yaml"
    weights = "local://models/small"
    manifest.write_text(grab.replace("local://models/so101-grab", weights), encoding="utf-8")
    monkeypatch.setenv("VRAM_ARBITER_CONFIGS", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # lerobot leaves a file there
    argv = [
        *("benchmark", "--env", world.env, "--skill", "vram-arbiter/so101-grab"),
        *("--arbiter", arbiter_daemon.endpoint, "--skills", str(manifest)),
        *("--episodes", "1", "--out", str(tmp_path / "out"), "--", *world.flags()),
        *("--policy.device=cpu", "--eval.batch_size=1", "--eval.use_async_envs=false"),
    ]
    code = main(argv)
    out, said = capfd.readouterr()
    assert code == 0, said[-3000:]
    written = json.loads((tmp_path / "out/benchmark.json").read_text(encoding="utf-8"))
    (cell,) = written["cells"]
    assert (cell["world"], cell["judged"], cell["complete"]) == (world.env, 1, True)
    assert "0/1 = " in out, "its few steps solve nothing"
    events = connect().hello().ask("history")["events"]
    kinds = [event["kind"] for event in events if event.get("consumer") == "lerobot-eval"]
    assert "granted" in kinds
    assert "ended" in kinds or "released" in kinds
