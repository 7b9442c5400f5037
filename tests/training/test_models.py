"""The small networks as training sees them: tokens, labels on the patch grid, the image path."""

from pathlib import Path

import pytest

from tests.support.paths import CONFIGS
from training import detector, detector_model, policy, scene_vlm_model
from training.common import BadInput
from training.detector_report import Trial, choose_threshold, rates

NAMES = ["blue ball", "blue cube", "red ball", "red cube"]


def test_the_threshold_separates_found_from_absent() -> None:
    box = (10.0, 10.0, 30.0, 30.0)
    trials = [Trial("start", True, box, 0.8, box) for _ in range(10)]
    trials += [Trial("start", True, None, 0.3, box) for _ in range(10)]
    threshold = choose_threshold(trials)
    assert 0.3 <= threshold < 0.8
    assert rates(trials, threshold)["found"] == 1.0
    assert rates(trials, threshold)["false_alarm"] == 0.0
    far_off = Trial("start", True, box, 0.9, (60.0, 60.0, 80.0, 80.0))
    assert rates([far_off], threshold)["found"] == 0.0


@pytest.mark.heavy
def test_the_detectors_pad_token_is_zero_and_its_end_the_greatest(tmp_path: Path) -> None:
    """OWL masks queries that begin with 0, and reads the vector at the greatest id."""
    processor = detector_model.build_processor(tmp_path, 64, ["red", "cube", "cylinder"])
    tokenizer = processor.tokenizer
    ids = tokenizer("a red cube")["input_ids"]
    assert len(ids) == 5
    assert tokenizer.pad_token_id == 0
    assert ids[0] == tokenizer.bos_token_id != 0
    assert ids[-1] == max(tokenizer.get_vocab().values())
    assert len(tokenizer("gnu")["input_ids"]) == 5  # three letters between start and end


@pytest.mark.heavy
def test_the_patch_nearest_to_a_thing_owns_it() -> None:
    targets = detector.make_targets([[("red cube", (0.10, 0.10, 0.15, 0.15), True)], []], side=4)
    assert targets.owner[0].tolist() == [0] + [-1] * 15
    assert targets.owner[1].max() == -1
    assert targets.touched[0, :, 0].sum() == 1
    half_hidden = detector.make_targets([[("red cube", (0.0, 0.0, 0.5, 0.5), False)]], side=4)
    assert half_hidden.owner.max() == -1
    assert half_hidden.touched[0, :, 0].sum() == 4


@pytest.mark.heavy
def test_the_vlm_sees_the_patches_and_tokens_that_the_library_makes(tmp_path: Path) -> None:
    import numpy as np
    import torch
    from PIL import Image

    recipe = scene_vlm_model.SMOKE
    processor = scene_vlm_model.build_processor(tmp_path, recipe, NAMES)
    width, height = recipe.size_px
    picture = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    prompt = "<|vision_start|><|image_pad|><|vision_end|>"
    inputs = processor(text=[prompt], images=[Image.fromarray(picture)], return_tensors="pt")
    pixels = torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255
    mine = scene_vlm_model.to_patches(pixels, recipe)
    assert torch.allclose(mine, inputs["pixel_values"], atol=1e-5)

    torch.manual_seed(0)
    model = scene_vlm_model.build_model(recipe, processor).eval()
    with torch.inference_mode():
        library = model.model.visual(mine, grid_thw=inputs["image_grid_thw"], return_dict=True)
        tokens = scene_vlm_model.image_tokens(model, mine, recipe)[0]
        assert torch.allclose(tokens, library.pooler_output, atol=1e-5)

    # a 4:3 frame of any camera comes out at exactly the trained grid
    for size in ((320, 240), (480, 360), (640, 480)):
        shrunk = processor.image_processor(Image.new("RGB", size), return_tensors="pt")
        assert shrunk["image_grid_thw"].tolist() == [[1, recipe.grid[1], recipe.grid[0]]]


@pytest.mark.heavy
def test_a_policy_that_goes_on_keeps_its_normalization(tmp_path: Path) -> None:
    """Its weights depend on it."""
    stats = policy.load_stats(CONFIGS / "models/so101-grab")
    assert {key: sorted(found) for key, found in stats.items()} == {
        "observation.state": ["mean", "std"], "action": ["mean", "std"],
    }  # fmt: skip
    assert all(one.shape == (6,) for found in stats.values() for one in found.values())
    with pytest.raises(BadInput, match="no normalization"):
        policy.load_stats(tmp_path)
