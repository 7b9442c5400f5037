"""Open-vocabulary detection through transformers' zero-shot classes.

These are OWL-ViT, OWLv2, Grounding DINO and OmDet-Turbo.
"""

import inspect
import math
import re
from collections.abc import Sequence
from typing import Any, Literal

from vram_arbiter.schemas.errors import BadRequest, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import QUERIES_MAX, DetectionResult, DetectOp
from vram_arbiter.sidecars.adapters.base import ModelCall
from vram_arbiter.sidecars.checkpoints import load_transformers
from vram_arbiter.sidecars.images import decode, within
from vram_arbiter.sidecars.weights import (
    Weights,
    from_pretrained,
    model_options,
    transformers_modules,
)

NORM = 1000  # the field's grounding answers give boxes in thousandths of the image
_SEPARATOR = re.compile(r"\s*(?:</c>|,|\s\.(?:\s|$))\s*")  # the field joins its labels by </c>


class DetectorAdapter:
    """The op `detect`: texts and a picture in, boxes in the picture's pixels out. Deterministic."""

    kind: Literal["detector"] = "detector"
    ops = frozenset({"detect"})

    def __init__(self, manifest: RSkillManifest, weights: Weights) -> None:
        assert manifest.detector is not None, "the kind requires the block"
        self._manifest = manifest
        self._contract = manifest.detector
        self._weights = weights
        self._processor: Any = None
        self._model: Any = None

    @property
    def modules(self) -> tuple[str, ...]:
        return transformers_modules(self._weights)

    def prepare(self) -> None:
        from transformers import (
            MODEL_FOR_ZERO_SHOT_OBJECT_DETECTION_MAPPING,
            AutoConfig,
            AutoProcessor,
        )

        self._processor = from_pretrained(AutoProcessor, self._weights)
        config = from_pretrained(AutoConfig, self._weights)
        MODEL_FOR_ZERO_SHOT_OBJECT_DETECTION_MAPPING.get(
            type(config), None
        )  # imports the model's code, which saves seconds under the lease

    def load(self, device: str) -> None:
        from transformers import AutoModelForZeroShotObjectDetection

        options = model_options(self._manifest, self._weights, device)
        self._model = load_transformers(
            AutoModelForZeroShotObjectDetection, self._weights, **options
        )

    @property
    def networks(self) -> Sequence[Any]:
        return (self._model,)

    def place(self, device: str) -> None:
        self._model.to(device)

    def run(self, call: ModelCall) -> Message:
        assert isinstance(call, DetectOp)
        labels = split_query(call.query)
        picture = decode(call.image)
        width, height = picture.size
        shrunk = within(picture, min(call.max_side, self._contract.max_side or call.max_side))
        threshold = (
            self._contract.score_threshold if call.score_threshold is None else call.score_threshold
        )
        found = self._detect(shrunk, labels, threshold, (height, width))
        return {
            "ok": True,
            "answer": grounding_answer(found, width, height),
            "norm": NORM,
            "detections": found,
        }

    def _detect(
        self, picture: Any, labels: list[str], threshold: float, size: tuple[int, int]
    ) -> list[DetectionResult]:
        import torch

        inputs = self._processor(
            images=picture, text=[labels], truncation=True, return_tensors="pt"
        ).to(self._model.device)
        with torch.inference_mode():
            outputs = self._model(**inputs)
        post_process = self._processor.post_process_grounded_object_detection
        known = inspect.signature(post_process).parameters
        options = {
            "text_labels": [labels],
            "input_ids": inputs.get("input_ids"),
            "target_sizes": [size],
            "threshold": threshold,
        }
        (result,) = post_process(
            outputs, **{name: value for name, value in options.items() if name in known}
        )
        names = result.get("text_labels") or [labels[int(index)] for index in result["labels"]]
        found = [
            _detection(str(name), float(score), box.tolist(), size)
            for name, score, box in zip(names, result["scores"], result["boxes"], strict=True)
        ]
        return sorted((one for one in found if one is not None), key=lambda one: -one["score"])


def split_query(query: str | Sequence[str]) -> list[str]:
    """Return the texts of `red cube</c>blue ball`, `red cube . blue ball` or `red cube, blue ball`,
    or of a list of such, without doubles.

    Raises: BadRequest for none or too many.
    """
    queries = [query] if isinstance(query, str) else query
    parts = [part for one in queries for part in _SEPARATOR.split(one)]
    labels = [part.strip().rstrip(".").strip() for part in parts]
    labels = list(dict.fromkeys(label for label in labels if label))
    if not labels or len(labels) > QUERIES_MAX:
        raise BadRequest(
            f"expected a query of 1 to {QUERIES_MAX} objects, got {len(labels)}",
            hint="separate them by </c>, ' . ' or commas",
        )
    return labels


def grounding_answer(found: list[DetectionResult], width: int, height: int) -> str:
    """Return the field's format, in thousandths: `<ref>label</ref><box><x1><y1><x2><y2></box>`
    each."""
    parts = []
    for one in found:
        x0, y0, x1, y1 = one["box"]
        corners = (x0 / width, y0 / height, x1 / width, y1 / height)
        numbers = "".join(f"<{min(NORM, max(0, round(corner * NORM)))}>" for corner in corners)
        parts.append(f"<ref>{one['label']}</ref><box>{numbers}</box>")
    return "".join(parts)


def _detection(
    label: str, score: float, box: list[float], size: tuple[int, int]
) -> DetectionResult | None:
    """Clip a box to the picture; None if nothing is left of it.

    Raises ModelError for values that are not numbers: clipping would put the picture's edge there.
    """
    if not all(map(math.isfinite, (score, *box))):
        raise ModelError("the detector's box is not a number", hint="check its weights")
    height, width = size
    x0, x1 = (min(float(width), max(0.0, x)) for x in (box[0], box[2]))
    y0, y1 = (min(float(height), max(0.0, y)) for y in (box[1], box[3]))
    if x1 <= x0 or y1 <= y0:
        return None
    return {"label": label, "score": score, "box": [x0, y0, x1, y1]}
