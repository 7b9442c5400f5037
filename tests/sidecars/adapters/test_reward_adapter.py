"""Reward models behind lerobot's own factory: the shipped one, judged on the simulator's own
pictures, and one that knows lerobot's bare question."""

import dataclasses
import io
import math
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from tests.support.paths import CONFIGS
from vram_arbiter.schemas.errors import BadRequest, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest, load_manifest
from vram_arbiter.schemas.sidecar import ScoreOp
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.adapters.reward import RewardAdapter
from vram_arbiter.sidecars.weights import Weights, resolve

pytestmark = pytest.mark.heavy

SKILL = CONFIGS / "rskills/so101-progress/rskill.yaml"
TASK = "grab the red cube"


@pytest.fixture(scope="module")
def shipped_adapter() -> RewardAdapter:
    manifest = load_manifest(SKILL)
    adapter = make_adapter(manifest, resolve(str(manifest.weights_uri), CONFIGS))
    assert isinstance(adapter, RewardAdapter)
    adapter.prepare()
    adapter.load("cpu")
    return adapter


def as_png(rgb: Any) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(rgb).save(stream, "PNG")
    return stream.getvalue()


def score(adapter: RewardAdapter, *images: bytes, task: str = TASK) -> dict[str, Any]:
    return adapter.run(ScoreOp(op="score", task=task, images=list(images)))


def test_a_grab_makes_progress_and_only_for_the_thing_it_grabs(
    shipped_adapter: RewardAdapter,
) -> None:
    """A scene that the training never saw; the pictures are what the runner would serve."""
    import random

    from tests.support.tabletop import photo, run_expert
    from vram_arbiter.runner.sim.env import SimEnv
    from vram_arbiter.runner.sim.expert import GrabExpert
    from vram_arbiter.runner.sim.tasks import stand_before

    with SimEnv() as env:
        env.reset(4711, names=("red cube", "blue ball", "green cylinder"))
        stand_before(env, "red cube", random.Random(0), error_m=0.0)
        before = photo(env, "wrist")
        assert run_expert(env, GrabExpert(env, "red cube"))
        after = photo(env, "wrist")
    right = score(shipped_adapter, before, after)
    assert right["success"][0] < 0.5 < right["success"][1]
    assert right["progress"][1] > right["progress"][0] + 0.3
    wrong = score(shipped_adapter, before, after, task="pick up the blue ball, please")
    assert wrong["success"][1] < 0.5, "what is held is not what was asked for"
    assert wrong["progress"][1] < right["progress"][1] - 0.3


def test_both_ways_to_send_pictures_are_judged_alike(shipped_adapter: RewardAdapter) -> None:
    """The field's raw BGR pictures, and PNGs."""
    import numpy as np

    rgb = np.random.default_rng(0).integers(0, 255, (2, 72, 96, 3), dtype=np.uint8)
    raw = ScoreOp(
        op="score",
        task=TASK,
        frames=rgb[..., ::-1].tobytes(),
        n=2,
        width=96,
        height=72,
        num_bins=10,
    )
    assert shipped_adapter.run(raw) == score(shipped_adapter, *map(as_png, rgb))
    shipped_adapter.load("cpu")
    assert shipped_adapter.run(raw) == score(shipped_adapter, *map(as_png, rgb)), (
        "the same after a reload"
    )


@pytest.mark.parametrize(
    "task", ["", "  ", "tidy the room", "grab the cube", "put the red cube on the blue ball"]
)
def test_a_task_that_it_cannot_read_is_refused_and_not_guessed(
    shipped_adapter: RewardAdapter, png: Any, task: str
) -> None:
    with pytest.raises(BadRequest, match="task"):
        score(shipped_adapter, png(96, 72), task=task)


def test_pictures_that_do_not_go_together_are_refused(
    shipped_adapter: RewardAdapter, png: Any
) -> None:
    """Regression: 32 small files made the sidecar decode 1.6 GB before it added up their sizes."""
    with pytest.raises(BadRequest, match="different sizes: 80 x 60, 96 x 72"):
        score(shipped_adapter, png(96, 72), png(80, 60))
    with pytest.raises(BadRequest, match="cannot be decoded"):
        score(shipped_adapter, b"no picture at all")
    with pytest.raises(BadRequest, match="pixels"):
        score(shipped_adapter, *[png(4000, 4000)] * 2)
    with pytest.raises(BadRequest, match="pixels"):
        # looked at no further than their headers
        score(shipped_adapter, *[png(4000, 4000)[:100]] * 2)


# -- a reward model that somebody else registers
@pytest.fixture(scope="module")
def mean_red() -> Any:
    """lerobot's plug-in convention, with `compute_reward` alone: how red the newest picture is,
    times `gain`."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.configs.rewards import RewardModelConfig
    from lerobot.rewards.pretrained import PreTrainedRewardModel

    @RewardModelConfig.register_subclass("mean_red")
    @dataclasses.dataclass
    class MeanRedConfig(RewardModelConfig):
        gain: float = 1.0

        def __post_init__(self) -> None:
            super().__post_init__()
            self.input_features = {
                "observation.images.top": PolicyFeature(FeatureType.VISUAL, (3, 8, 8))
            }

    class MeanRedRewardModel(PreTrainedRewardModel):
        config_class, name = MeanRedConfig, "mean_red"

        def __init__(self, config: MeanRedConfig, **_: Any) -> None:
            super().__init__(config)
            self.gain = torch.nn.Parameter(torch.tensor(config.gain))

        def compute_reward(self, batch: Any) -> Any:
            return batch["observation.images.top"][:, -1, 0].mean((1, 2)) * self.gain

    modules = {
        "configuration_mean_red": {},
        "modeling_mean_red": {"MeanRedRewardModel": MeanRedRewardModel},
        "processor_mean_red": {"make_mean_red_pre_post_processors": lambda config,
        dataset_stats=None: (lambda batch: batch, None)},
    }  # fmt: skip
    for name, content in modules.items():
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(content)
    MeanRedConfig.__module__ = "configuration_mean_red"
    yield lambda folder, gain: MeanRedRewardModel(
        MeanRedConfig(gain=gain, device="cpu")
    ).save_pretrained(folder)
    for name in modules:
        del sys.modules[name]


def reward_manifest(**block: Any) -> RSkillManifest:
    return RSkillManifest.model_validate(
        {
            "name": "lab/red", "version": "1.0.0", "kind": "reward", "embodiment_tags": ["any"],
            "chunk_size": 1, "description": "d",
            "latency_budget": {"per_chunk_ms": 1}, "actions": ["monitor"],
            "weights_uri": "local://models/x",
            "reward": {"frame_window_s": 8, "target_fps": 1, **block},
        }
    )  # fmt: skip


@pytest.mark.parametrize(
    ("gain", "block", "said"),
    [
        (1.0, {}, 200 / 255),
        (5.0, {}, 1.0),
        (2.0, {"progress_range": (-1, 3)}, (2 * 200 / 255 + 1) / 4),
    ],
)
def test_any_reward_model_of_lerobots_is_asked_its_own_question(
    mean_red: Any, tmp_path: Path, png: Any, gain: float, block: dict[str, Any], said: float
) -> None:
    mean_red(tmp_path, gain)
    adapter = RewardAdapter(
        reward_manifest(instruction_required=False, success_threshold=0.7, **block),
        Weights(str(tmp_path), local=True),
    )
    adapter.prepare()
    adapter.load("cpu")
    reply = score(adapter, png(8, 8, (0, 0, 0)), png(8, 8, (200, 0, 0)), task="")
    assert reply["progress"] == [pytest.approx(said, abs=1e-5)]
    assert reply["success"] == [], "it says nothing of success, so nothing is said"
    assert reply["success_threshold"] == 0.7


def test_a_number_that_is_none_is_no_opinion(mean_red: Any, tmp_path: Path, png: Any) -> None:
    mean_red(tmp_path, 1.0)
    adapter = RewardAdapter(reward_manifest(), Weights(str(tmp_path), local=True))
    adapter.prepare()
    adapter.load("cpu")
    adapter.networks[0].gain.data.fill_(math.nan)
    with pytest.raises(ModelError, match="progress is not a number"):
        score(adapter, png(8, 8))
