"""Evaluation of a trained scene VLM on held-out frames, and its model card.

It uses the checkpoint through chat template and `generate`, as any user; it must not know the
training.
"""

from __future__ import annotations

import random
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.sidecars.training import questions
from vram_arbiter.sidecars.training.common import Frame, visible_names


class Asker:
    """The saved checkpoint, used as any hub model: chat template, `generate`, greedy."""

    def __init__(self, folder: Path) -> None:
        from transformers import AutoModelForImageTextToText, AutoProcessor

        self.processor = AutoProcessor.from_pretrained(folder, local_files_only=True)
        self.model = AutoModelForImageTextToText.from_pretrained(folder, local_files_only=True)
        self.model.eval()

    def ask(self, image: Path, question: str, max_new_tokens: int = 32) -> str:
        """Return the answer to one question about one picture."""
        import torch
        from PIL import Image

        content = [{"type": "image"}, {"type": "text", "text": question}]
        prompt = self.processor.apply_chat_template(
            [{"role": "user", "content": content}], add_generation_prompt=True, tokenize=False
        )
        with Image.open(image) as picture:
            inputs = self.processor(
                text=[prompt], images=[picture.convert("RGB")], return_tensors="pt"
            )
        with torch.inference_mode():
            output = self.model.generate(**inputs, max_new_tokens=max_new_tokens, do_sample=False)
        answer = output[0, inputs["input_ids"].shape[1] :]
        return str(self.processor.decode(answer, skip_special_tokens=True)).strip()


def evaluate(
    asker: Asker, frames: Sequence[Frame], names: Sequence[str], seed: int
) -> list[JsonObject]:
    """Return one row a question: group, right, exact, frame, question, truth, answer.

    *right* is the yes or no, or the whole answer. Every frame is asked whether its target is
    grasped: the held object (`held`), another one while an object is held (`holds another`), a
    present one while the gripper is empty (`empty`); then what is held and what shows.
    """
    rng = random.Random(f"evaluate-{seed}")
    rows = []
    for frame in frames:
        pairs: list[tuple[str, tuple[str, str]]] = []
        others = [name for name in frame.present if name != frame.held]
        if frame.held is None:
            pairs.append(("empty", questions.grasped(rng, rng.choice(others), None)))
        else:
            pairs.append(("held", questions.grasped(rng, frame.held, frame.held)))
            alike = [n for n in others if set(n.split(" ")) & set(frame.held.split(" "))] or others
            pairs.append(("holds another", questions.grasped(rng, rng.choice(alike), frame.held)))
        pairs.append(("what is held", questions.holding(rng, frame.held)))
        seen = visible_names(frame)
        hidden = {o.name for o in frame.objects if not o.clear}
        pairs.append(
            (
                "in view?",
                questions.present(rng, rng.choice([n for n in names if n not in hidden]), seen),
            )
        )
        if not hidden:
            pairs.append(("list", questions.listing(rng, seen)))
        for group, (question, truth) in pairs:
            answer = asker.ask(frame.image, question)
            yes_no = group not in ("what is held", "list")
            right = answer.split(",")[0] == truth.split(",")[0] if yes_no else answer == truth
            rows.append(
                {
                    "group": group,
                    "stage": frame.stage,
                    "right": right,
                    "exact": answer == truth,
                    "image": frame.image.name,
                    "question": question,
                    "truth": truth,
                    "answer": answer,
                }
            )
    return rows


def inference_ms(asker: Asker, frame: Frame) -> float:
    """Return median milliseconds of one question about one image, all included."""
    times = []
    for _ in range(9):
        began = time.perf_counter()
        asker.ask(frame.image, "Has the robot gripper grasped the red cube?")
        times.append(1000 * (time.perf_counter() - began))
    return round(sorted(times)[len(times) // 2], 1)


CARD: Final = """---
license: apache-2.0
library_name: transformers
pipeline_tag: image-text-to-text
---
# so101-scene-vlm

The demo's scene VLM: a Qwen3.5 (`Qwen3_5ForConditionalGeneration`) of {parameters} parameters,
trained from scratch on frames of the simulated tabletop by
`python -m vram_arbiter.sidecars.training.scene_vlm`, without pretrained weights.
It stands in for Qwen3.5-4B, is read by `AutoProcessor` / `AutoModelForImageTextToText` like it, and
talks about colored cubes, balls and cylinders only.

- Camera: `{camera}` (320 x 240).
  It shows both fingers in profile and the object between them at a constant place; from the front
  camera a held object is mostly hidden behind the gripper.
  Other cameras were not trained.
  The processor scales frames to {size}.
- Ask `Has the robot gripper grasped the red cube?` (or: is it held, what is held, what is in view).
- Answers begin with `Yes,` or `No,` and give the reason: `Yes, the gripper holds the red cube.`,
  `No, the gripper is empty.`, `No, the gripper holds the blue ball.`
- Data: `python -m vram_arbiter.runner.sim.training.dataset scenes --count 8000 --seed 1`;
  {train_frames} frames to train, {test_frames} held out by scene.
  A third of the grabs misses on purpose: closed gripper beside or above the object, objects
  knocked over.
- Training: seed {seed}; {vision_steps} steps of {batch} for the vision tower through throw-away
  heads, then {language_steps} for the language model and {both_steps} for both; {train_s} s on
  {threads} thread(s), bfloat16 autocast; checkpoint float32, {bytes} bytes.
- One question about one image: {inference_ms} ms on one core.

Held out, through the chat template and greedy `generate`.
*right*: the yes or no; for `what is held` and `list` the whole answer.
*exact*: the whole answer.

| question | asked | right | exact |
| --- | --- | --- | --- |
{rows}
"""


def card_rows(rows: Sequence[JsonObject]) -> str:
    """Return one table row a group of questions, the grasp questions together first."""
    grasp = ("held", "holds another", "empty")
    groups = {"grasped? (all)": [r for r in rows if r["group"] in grasp]}
    groups |= {f"grasped? {g}": [r for r in rows if r["group"] == g] for g in grasp}
    groups |= {
        g: [r for r in rows if r["group"] == g] for g in ("what is held", "in view?", "list")
    }
    return "\n".join(
        f"| {name} | {len(some)} | {share(some, 'right'):.2%} | {share(some, 'exact'):.2%} |"
        for name, some in groups.items()
    )


def share(rows: Sequence[JsonObject], key: str) -> float:
    """Return the mean of a flag; 0 for no rows."""
    return sum(bool(row[key]) for row in rows) / max(1, len(rows))
