"""Evaluation of a trained detector on held-out frames, and its model card.

It uses the checkpoint through its processor, as any user; it must not know the training.
"""

from __future__ import annotations

import dataclasses
import random
import time
from collections.abc import Sequence
from typing import Any, Final

from vram_arbiter.sidecars.training import queries
from vram_arbiter.sidecars.training.common import Frame


def area(box: Sequence[float]) -> float:
    """Return the center of a box (x0, y0, x1, y1)."""
    return float((box[2] - box[0]) * (box[3] - box[1]))


def corners(boxes: Any) -> Any:
    """Convert (n, 4) boxes of center and size to corners."""
    import torch

    return torch.cat([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], dim=1)


@dataclasses.dataclass(slots=True)
class Trial:
    """One (frame, query): the expected object, and the best box with its score."""

    stage: str
    known: bool
    truth: tuple[float, float, float, float] | None
    score: float
    box: tuple[float, float, float, float]

    def right_place(self) -> bool:
        """Whether the best box is on the object: IoU of 0.4 or centers within 8 pixels."""
        if self.truth is None:
            return False
        a, b = self.truth, self.box
        wide = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
        high = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
        union = area(a) + area(b) - wide * high
        return wide * high >= 0.4 * union or self.centre_error_px() <= 8.0

    def centre_error_px(self) -> float:
        """Distance of the box centers in pixels of the frame."""
        assert self.truth is not None
        a, b = self.truth, self.box
        return float(
            ((a[0] + a[2] - b[0] - b[2]) ** 2 + (a[1] + a[3] - b[1] - b[3]) ** 2) ** 0.5 / 2
        )


def run_trials(processor: Any, model: Any, frames: Sequence[Frame], seed: int) -> list[Trial]:
    """Ask every frame for all names, in random words, and for objects that exist nowhere.

    A query's scores do not depend on the queries beside it, so one call asks them all.
    """
    import torch
    from PIL import Image

    rng = random.Random(f"evaluate-{seed}")
    colours = sorted({name.split(" ")[0] for frame in frames for name in frame.present})
    shapes = sorted({name.split(" ")[1] for frame in frames for name in frame.present})
    trials: list[Trial] = []
    for frame in frames:
        asked = [
            q
            for q in queries.sample_queries(rng, colours, shapes, 4)
            if q.known == (q.shape is not None)
        ]
        asked += [
            queries.Query(f"{rng.choice(colours)} {thing}", None, None, known=False)
            for thing in rng.sample(queries.UNTAUGHT_THINGS, 2)
        ]
        with Image.open(frame.image) as image:
            rgb = image.convert("RGB")
        inputs = processor(text=[[query.text for query in asked]], images=rgb, return_tensors="pt")
        with torch.inference_mode():
            outputs = model(**inputs)
        scores, best = outputs.logits[0].sigmoid().max(dim=0)
        scale = torch.tensor([rgb.width, rgb.height, rgb.width, rgb.height])
        boxes = corners(outputs.pred_boxes[0][best]) * scale
        for query, score, box in zip(asked, scores.tolist(), boxes.tolist(), strict=True):
            if query.known and query.colour is None:
                continue
            hits = [seen for seen in frame.objects if query.matches(seen.colour, seen.shape)]
            if hits and not hits[0].clear:
                continue
            trials.append(
                Trial(frame.stage, query.known, hits[0].box if hits else None, score, tuple(box))
            )
    return trials


def choose_threshold(trials: Sequence[Trial]) -> float:
    """Return the score that loses least: misses plus false alarms, both as rates."""

    def cost(threshold: float) -> float:
        found = rates(trials, threshold)
        return (1.0 - found["found"]) + found["false_alarm"]

    steps = [round(0.05 * n, 2) for n in range(2, 17)]
    least = min(cost(t) for t in steps)
    good = [t for t in steps if cost(t) <= least + 0.001]
    return good[len(good) // 2]


def rates(trials: Sequence[Trial], threshold: float) -> dict[str, float]:
    """Return found and false-alarm rates at a threshold, with their counts."""
    there = [t for t in trials if t.truth is not None]
    absent = [t for t in trials if t.truth is None and t.known]
    strange = [t for t in trials if not t.known]
    found = [t for t in there if t.score > threshold and t.right_place()]
    errors = sorted(t.centre_error_px() for t in found)
    return {
        "asked": len(there),
        "found": round(len(found) / max(1, len(there)), 4),
        "centre_error_px_p95": round(errors[int(0.95 * (len(errors) - 1))], 2) if errors else -1.0,
        "absent": len(absent),
        "false_alarm": round(sum(t.score > threshold for t in absent) / max(1, len(absent)), 4),
        "strange": len(strange),
        "strange_alarm": round(sum(t.score > threshold for t in strange) / max(1, len(strange)), 4),
    }


def inference_ms(processor: Any, model: Any, frame: Frame) -> float:
    """Return median milliseconds of one query on one image, pre- and post-processing included."""
    import torch
    from PIL import Image

    with Image.open(frame.image) as image:
        rgb = image.convert("RGB")
    times: list[float] = []
    for _ in range(15):
        began = time.perf_counter()
        inputs = processor(text=[["red cube"]], images=rgb, return_tensors="pt")
        with torch.inference_mode():
            outputs = model(**inputs)
        processor.post_process_grounded_object_detection(
            outputs,
            threshold=0.3,
            target_sizes=[(rgb.height, rgb.width)],
            text_labels=[["red cube"]],
        )
        times.append(1000 * (time.perf_counter() - began))
    return round(sorted(times)[len(times) // 2], 1)


CARD: Final = """---
license: apache-2.0
library_name: transformers
pipeline_tag: zero-shot-object-detection
---
# so101-detector

The demo's open-vocabulary detector: an OwlViT of {parameters} parameters, trained from scratch on
frames of the simulated tabletop by `python -m vram_arbiter.sidecars.training.detector`, without
pretrained weights.
It stands in for a production detector, is read by `AutoProcessor` /
`AutoModelForZeroShotObjectDetection` like one, and knows colored cubes, balls and cylinders only.

- Camera `{camera}`; the processor scales frames to {image_px} x {image_px}.
- Recommended `score_threshold`: {threshold}.
- Query with free text (`red cube`, `a photo of a blue ball`, `green object`).
  Several boxes may lie on one object: take the best.
- Data: `python -m vram_arbiter.runner.sim.training.dataset scenes --count 8000 --seed 1`;
  {train_frames} frames to train, {test_frames} held out by scene.
- Training: seed {seed}, {steps} steps of {batch}, {train_s} s on {threads} thread(s), bfloat16
  autocast; checkpoint float32, {bytes} bytes.
- One query on one image: {inference_ms} ms on one core, pre- and post-processing included.

Held out, at the threshold, which was chosen on these same frames.

- *found*: the best box above it has IoU >= 0.4 or its center within 8 px.
- *false alarm*: any box above it for a (color, shape) that the scene lacks.
- *strange*: the same for words that training never saw.
- Objects with fewer than {min_pixels} visible pixels are not asked for.

| frames | asked | found | center error p95 (px) | absent asked | false alarm | strange asked | strange alarm |
| --- | --- | --- | --- | --- | --- | --- | --- |
{rows}
"""


def card_rows(trials: Sequence[Trial], threshold: float) -> str:
    """Return one table row over everything, then one per stage of the episode."""
    rows = []
    for stage in ("all", *sorted({t.stage for t in trials})):
        r = rates([t for t in trials if stage in ("all", t.stage)], threshold)
        rows.append(
            f"| {stage} | {r['asked']} | {r['found']:.2%} | {r['centre_error_px_p95']} | "
            f"{r['absent']} | "
            f"{r['false_alarm']:.2%} | {r['strange']} | {r['strange_alarm']:.2%} |"
        )
    return "\n".join(rows)
