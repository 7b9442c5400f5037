"""Evaluation of a trained scene VLM on held-out frames.

It uses the checkpoint through chat template and `generate`, as any user; it must not know the
training.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from training import questions
from training.common import Report, median_ms, share
from training.datasets import Frame
from vram_arbiter.schemas.plain import JsonObject

GRASPED = ("held", "holds another of its color", "holds another", "empty")
WHOLE = ("what is held", "list")  # here the whole answer has to be right, not its yes or no


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

        prompt = questions.as_prompt(self.processor, question)
        with Image.open(image) as picture:
            rgb = picture.convert("RGB")
        inputs = self.processor(text=[prompt], images=[rgb], return_tensors="pt")
        with torch.inference_mode():
            output = self.model.generate(**inputs, max_new_tokens=max_new_tokens, do_sample=False)
        answer = output[0, inputs["input_ids"].shape[1] :]
        return str(self.processor.decode(answer, skip_special_tokens=True)).strip()


class Answer(NamedTuple):
    """One answer: the group of its question, and whether it is right, and right in every word."""

    group: str
    right: bool
    exact: bool


def questions_about(
    rng: random.Random, frame: Frame, names: Sequence[str]
) -> list[tuple[str, tuple[str, str]]]:
    """Return group, question and true answer for each question about a frame.

    Every frame is asked whether its target is grasped: the held object (`held`), another one while
    an object is held (`holds another`, of its color where the scene has one), a present one while
    the gripper is empty (`empty`); then what is held and what shows.
    """
    pairs: list[tuple[str, tuple[str, str]]] = []
    others = [name for name in frame.present if name != frame.held]
    if frame.held is None:
        pairs.append(("empty", questions.grasped(rng, rng.choice(others), None)))
    else:
        pairs.append(("held", questions.grasped(rng, frame.held, frame.held)))
        same = [name for name in others if name.split()[0] == frame.held.split()[0]]
        other = rng.choice(same or questions.alike(frame.held, others) or others)
        group = "holds another of its color" if same else "holds another"
        pairs.append((group, questions.grasped(rng, other, frame.held)))
    pairs.append(("what is held", questions.holding(rng, frame.held)))
    clear = [name for name in names if name not in frame.hidden]
    pairs.append(("in view?", questions.present(rng, rng.choice(clear), frame.visible)))
    if not frame.hidden:
        pairs.append(("list", questions.listing(rng, frame.visible)))
    return pairs


def evaluate(
    asker: Asker, frames: Sequence[Frame], names: Sequence[str], seed: int
) -> list[Answer]:
    """Ask about every frame; wrong answers about the grasp are shown on stderr."""
    rng = random.Random(f"evaluate-{seed}")
    answers = []
    for frame in frames:
        for group, (question, truth) in questions_about(rng, frame, names):
            answer = asker.ask(frame.image, question)
            exact = answer == truth
            right = exact if group in WHOLE else answer.split(",")[0] == truth.split(",")[0]
            answers.append(Answer(group, right, exact))
            if group in GRASPED and not right:
                print(f"{frame.image}: {question} {answer!r}, not {truth!r}", file=sys.stderr)
    return answers


def report(
    folder: Path, frames: Sequence[Frame], names: Sequence[str], seed: int, figures: JsonObject
) -> Report:
    """Judge the checkpoint in a folder on frames: a row over grasps, then one for each group."""
    asker = Asker(folder)
    answers = evaluate(asker, frames, names, seed)
    groups = {"grasped? (all)": [answer for answer in answers if answer.group in GRASPED]}
    for group in (*GRASPED, "what is held", "in view?", "list"):
        name = f"grasped? {group}" if group in GRASPED else group
        groups[name] = [answer for answer in answers if answer.group == group]
    rows = [
        {
            "question": name,
            "asked": len(some),
            "right": share(answer.right for answer in some),
            "exact": share(answer.exact for answer in some),
        }
        for name, some in groups.items()
    ]
    question = "Has the robot gripper grasped the red cube?"
    ms = median_ms(lambda: asker.ask(frames[0].image, question), times=9)
    return Report({**figures, "test_frames": len(frames), "inference_ms": ms}, rows)
