"""The scene VLM's training script: true answers, its own image path against the library's, a smoke
run, the checkpoint."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.sidecars.training import common, questions, scene_vlm, scene_vlm_model
from vram_arbiter.sidecars.training.scene_vlm_report import Asker

SHIPPED = Path(__file__).parents[3] / "configs" / "models" / "so101-scene-vlm"
NAMES = ["blue ball", "blue cube", "red ball", "red cube"]


def draw_dataset(folder: Path, scenes: int) -> Path:
    """A gripper of two bars with or without something between them, labelled as the simulator's
    writer does."""
    from PIL import Image, ImageDraw

    rng = random.Random("drawn")
    (folder / "images").mkdir(parents=True)
    lines = []
    for scene in range(scenes):
        image = Image.new("RGB", (320, 240), (128, 128, 128))
        pen = ImageDraw.Draw(image)
        held = rng.choice([None, *NAMES])
        objects: list[dict[str, Any]] = []
        for name in NAMES[:3] if held is None else [held]:
            colour, shape = name.split()
            x, y = (180, 100) if held else (20 + 90 * len(objects), 10)
            (pen.ellipse if shape == "ball" else pen.rectangle)((x, y, x + 40, y + 40), fill=colour)
            box = (x, y, x + 40, y + 40)
            objects.append({"colour": colour, "shape": shape, "box": box, "pixels": 1300})
        away = next(name for name in NAMES[::-1] if name != held).split()
        objects.append({"colour": away[0], "shape": away[1], "box": None, "pixels": 0})
        pen.rectangle((100, 85, 230, 99), fill="black")
        pen.rectangle((100, 141, 230, 155), fill="black")
        file = f"images/{scene:03d}.png"
        image.save(folder / file)
        lines.append(
            {
                "file": file,
                "camera": "wrist",
                "seed": scene,
                "stage": "after",
                "objects": objects,
                "held": held,
            }
        )
    text = "\n".join(json.dumps(line) for line in lines)
    (folder / common.LABELS_FILE).write_text(text, encoding="utf-8")
    return folder


def test_answers_are_true_and_begin_with_yes_or_no() -> None:
    rng = random.Random(1)
    template = "Has the robot gripper grasped the {}?"
    assert (
        questions.grasped(rng, "red cube", "red cube", template)[1]
        == "Yes, the gripper holds the red cube."
    )
    assert (
        questions.grasped(rng, "red cube", "red ball", template)[1]
        == "No, the gripper holds the red ball."
    )
    assert questions.grasped(rng, "red cube", None, template)[1] == "No, the gripper is empty."
    assert questions.listing(rng, ["orange ball", "red cube"])[1] == "An orange ball, a red cube."
    assert questions.listing(rng, [])[1] == "No objects."
    for _ in range(40):
        question, answer = questions.holding(rng, None)
        assert answer.startswith("Yes") == (question in questions.EMPTY)


def test_balanced_repeats_the_rarer_kind() -> None:
    assert scene_vlm.balanced([1], [2, 3, 4]) == [1, 2, 1, 3, 1, 4]
    assert scene_vlm.balanced([], [2, 3]) == [2, 3]


@pytest.mark.heavy
def test_training_sees_the_patches_and_tokens_that_the_library_makes(tmp_path: Path) -> None:
    import numpy as np
    import torch
    from PIL import Image

    recipe = scene_vlm_model.SMOKE
    processor = scene_vlm_model.build_processor(tmp_path, recipe, NAMES)
    width, height = recipe.size_px
    picture = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    prompt = "<|vision_start|><|image_pad|><|vision_end|>"
    inputs = processor(text=[prompt], images=[Image.fromarray(picture)], return_tensors="pt")
    mine = scene_vlm_model.to_patches(
        torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255, recipe
    )
    assert torch.allclose(mine, inputs["pixel_values"], atol=1e-5)

    torch.manual_seed(0)
    model = scene_vlm_model.build_model(recipe, processor).eval()
    with torch.inference_mode():
        theirs = model.model.visual(
            mine, grid_thw=inputs["image_grid_thw"], return_dict=True
        ).pooler_output
        assert torch.allclose(
            scene_vlm_model.image_tokens(model, mine, recipe)[0], theirs, atol=1e-5
        )

    # a 4:3 frame of any camera comes out at exactly the trained grid
    for size in ((320, 240), (480, 360), (640, 480)):
        shrunk = processor.image_processor(Image.new("RGB", size), return_tensors="pt")
        assert shrunk["image_grid_thw"].tolist() == [[1, recipe.grid[1], recipe.grid[0]]]


@pytest.mark.heavy
def test_a_smoke_run_makes_a_checkpoint_that_answers_through_generate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = draw_dataset(tmp_path / "data", 16), tmp_path / "out"
    assert scene_vlm.main(["--data", str(data), "--out", str(out), "--smoke"]) == 0
    printed = capsys.readouterr().out
    figures = json.loads(printed[printed.rindex("\n{") :])
    assert figures["test_frames"] >= 1
    assert "Has the robot gripper grasped" in (out / "README.md").read_text(encoding="utf-8")
    assert type(Asker(out).model).__name__ == "Qwen3_5ForConditionalGeneration"


def test_a_folder_without_labels_ends_with_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert scene_vlm.main(["--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "labels.jsonl is missing" in capsys.readouterr().err


@pytest.mark.heavy
def test_the_shipped_checkpoint_tells_held_from_empty_and_from_another(tmp_path: Path) -> None:
    from PIL import Image

    from vram_arbiter.runner.sim.env import SimEnv
    from vram_arbiter.runner.sim.expert import GrabExpert
    from vram_arbiter.runner.sim.kinematics import ArmKinematics
    from vram_arbiter.runner.sim.tasks import stand_before

    asker = Asker(SHIPPED)
    image = tmp_path / "wrist.png"
    wrong: list[str] = []

    def expect(word: str, name: str, env: Any) -> None:
        Image.fromarray(env.render("wrist")).save(image)
        answer = asker.ask(image, f"Has the robot gripper grasped the {name}?")
        if not answer.startswith(word):
            wrong.append(f"{name}: {answer}")

    with SimEnv() as env:
        kinematics = ArmKinematics(env.config)
        for seed in range(900, 906):
            env.reset(seed)
            target, other = env.layout.objects[0].name, env.layout.objects[1].name
            stand_before(env, target, random.Random(seed))
            expect("No", target, env)
            expert = GrabExpert(env, kinematics, target)
            for _ in range(110):
                env.step(expert.act())
                if expert.done:
                    break
            assert env.held_object() == target, "the scripted expert failed: choose another seed"
            expect("Yes", target, env)
            expect("No", other, env)
    # 18 questions; the model card gives 98 % over all and 95 % while another thing of the same
    # colour is held
    assert len(wrong) <= 2, wrong
