"""Evaluation of a trained detector on held-out frames.

It uses the checkpoint through its processor, as any user; it must not know the training.
"""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from training import queries
from training.common import Report, median_ms, share
from training.datasets import Frame, vocabulary
from vram_arbiter.schemas.plain import JsonObject

type Box = Sequence[float]
"""x0, y0, x1, y1."""


def area(box: Box) -> float:
    """Return the area of a box."""
    return (box[2] - box[0]) * (box[3] - box[1])


def corners(boxes: Any) -> Any:
    """Convert (n, 4) boxes of center and size to corners."""
    import torch

    return torch.cat([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], dim=1)


@dataclasses.dataclass(slots=True)
class Trial:
    """One (frame, query): the expected object's box, and the best box with its score."""

    stage: str
    known: bool
    truth: Box | None
    score: float
    box: Box

    def right_place(self) -> bool:
        """Whether the best box is on the object: IoU of 0.4 or centers within 8 pixels."""
        if self.truth is None:
            return False
        a, b = self.truth, self.box
        wide = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
        high = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
        union = area(a) + area(b) - wide * high
        return wide * high >= 0.4 * union or self.center_error_px() <= 8.0

    def center_error_px(self) -> float:
        """Distance of the box centers in pixels of the frame."""
        assert self.truth is not None
        a, b = self.truth, self.box
        across, down = a[0] + a[2] - b[0] - b[2], a[1] + a[3] - b[1] - b[3]
        return float((across**2 + down**2) ** 0.5 / 2)


class Detector:
    """The saved checkpoint, used as any hub model."""

    def __init__(self, folder: Path) -> None:
        from transformers import AutoModelForZeroShotObjectDetection, AutoProcessor

        kind = AutoModelForZeroShotObjectDetection
        self._processor = AutoProcessor.from_pretrained(folder, local_files_only=True)
        self._model = kind.from_pretrained(folder, local_files_only=True).eval()

    def look(self, image: Path, texts: Sequence[str]) -> list[tuple[float, list[float]]]:
        """Return score and box (pixels) of the best answer to each query.

        A query's scores do not depend on the queries beside it, so one call asks them all.
        """
        import torch
        from PIL import Image

        with Image.open(image) as opened:
            rgb = opened.convert("RGB")
        inputs = self._processor(text=[list(texts)], images=rgb, return_tensors="pt")
        with torch.inference_mode():
            outputs = self._model(**inputs)
        scores, best = outputs.logits[0].sigmoid().max(dim=0)
        scale = torch.tensor([rgb.width, rgb.height, rgb.width, rgb.height])
        boxes = corners(outputs.pred_boxes[0][best]) * scale
        return list(zip(scores.tolist(), boxes.tolist(), strict=True))


def run_trials(detector: Detector, frames: Sequence[Frame], seed: int) -> list[Trial]:
    """Ask every frame for all names, in random words, and for objects that exist nowhere."""
    rng = random.Random(f"evaluate-{seed}")
    _, words = vocabulary(frames)
    trials = []
    for frame in frames:
        asked = [
            query
            for query in queries.sample_queries(rng, *words, 4)
            if query.known == (query.shape is not None)
        ]
        asked += [
            queries.Query(f"{rng.choice(words[0])} {thing}", None, None, known=False)
            for thing in rng.sample(queries.UNTAUGHT_THINGS, 2)
        ]
        answers = detector.look(frame.image, [query.text for query in asked])
        for query, (score, box) in zip(asked, answers, strict=True):
            if query.known and query.color is None:
                continue
            hits = [seen for seen in frame.objects if query.matches(seen.name)]
            if hits and not hits[0].clear:
                continue
            truth = hits[0].box if hits else None
            trials.append(Trial(frame.stage, query.known, truth, score, box))
    return trials


def choose_threshold(trials: Sequence[Trial]) -> float:
    """Return the score that loses least: misses plus false alarms, both as rates."""
    cost = {}
    for threshold in (round(0.05 * n, 2) for n in range(2, 17)):
        found = rates(trials, threshold)
        cost[threshold] = 1.0 - found["found"] + found["false_alarm"]
    good = [threshold for threshold in cost if cost[threshold] <= min(cost.values()) + 0.001]
    return good[len(good) // 2]


def rates(trials: Sequence[Trial], threshold: float) -> dict[str, float]:
    """Return found and false-alarm rates at a threshold, with their counts."""
    there = [t for t in trials if t.truth is not None]
    absent = [t for t in trials if t.truth is None and t.known]
    strange = [t for t in trials if not t.known]
    found = [t for t in there if t.score > threshold and t.right_place()]
    errors = sorted(t.center_error_px() for t in found)
    return {
        "asked": len(there),
        "found": round(len(found) / max(1, len(there)), 4),
        "center_error_px_p95": round(errors[int(0.95 * (len(errors) - 1))], 2) if errors else -1.0,
        "absent": len(absent),
        "false_alarm": share(t.score > threshold for t in absent),
        "strange": len(strange),
        "strange_alarm": share(t.score > threshold for t in strange),
    }


def report(folder: Path, frames: Sequence[Frame], seed: int, figures: JsonObject) -> Report:
    """Judge the checkpoint in a folder on frames: a row over all, then one for each stage."""
    detector = Detector(folder)
    trials = run_trials(detector, frames, seed)
    threshold = choose_threshold(trials)
    stages = {"all": trials}
    for stage in sorted({t.stage for t in trials}):
        stages[stage] = [t for t in trials if t.stage == stage]
    rows = [{"frames": name, **rates(some, threshold)} for name, some in stages.items()]
    ms = median_ms(lambda: detector.look(frames[0].image, ["red cube"]))
    figures |= {"score_threshold": threshold, "test_frames": len(frames), "inference_ms": ms}
    return Report(figures, rows)
