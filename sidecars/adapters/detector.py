"""Open-vocabulary detection through transformers' zero-shot classes.

These are OWL-ViT, OWLv2, Grounding DINO and OmDet-Turbo.
"""

import math
import re
from collections.abc import Sequence
from typing import Any, Literal

from vram_arbiter.clients.sidecar.field import NORM
from vram_arbiter.schemas.errors import BadRequest, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import QUERIES_MAX, DetectionResult, DetectOp
from vram_arbiter.sidecars.adapters.base import ModelCall, OneNetwork
from vram_arbiter.sidecars.adapters.inputs import picture_of, processed, to_model
from vram_arbiter.sidecars.checkpoints import load_transformers
from vram_arbiter.sidecars.images import sizes
from vram_arbiter.sidecars.weights import (
    Weights,
    from_pretrained,
    model_options,
    transformers_modules,
)

ZERO_SHOT_LOADER = "transformers.AutoModelForZeroShotObjectDetection"
_ANSWERS = {"logits", "pred_boxes", "decoder_class_logits", "decoder_coord_logits"}
_SEPARATOR = re.compile(r"\s*(?:</c>|,|\s\.(?:\s|$))\s*")  # the field joins its labels by </c>
_ENDS_IN_A_DOT = re.compile(r"[^\s.]\.\s*$")  # as Grounding DINO's own texts do

type _Found = tuple[list[float], list[str], list[list[float]]]
"""Scores, texts and boxes (x0, y0, x1, y1 in pixels), as long as each other."""


class DetectorAdapter(OneNetwork):
    """The op `detect`: texts and a picture in, boxes in the picture's pixels out. Deterministic."""

    kind: Literal["detector"] = "detector"
    ops = frozenset({"detect"})

    def __init__(self, manifest: RSkillManifest, weights: Weights) -> None:
        assert manifest.detector is not None, "the kind requires the block"
        self._manifest = manifest
        self._contract = manifest.detector
        self._weights = weights
        self._processor: Any = None

    @property
    def modules(self) -> tuple[str, ...]:
        return transformers_modules(self._weights)

    def prepare(self) -> None:
        from transformers import (
            MODEL_FOR_ZERO_SHOT_OBJECT_DETECTION_MAPPING,
            AutoConfig,
            AutoProcessor,
        )

        _name_backbones_offline()
        self._processor = from_pretrained(AutoProcessor, self._weights)
        config = from_pretrained(AutoConfig, self._weights)
        # imports the model's code, which saves seconds under the lease
        MODEL_FOR_ZERO_SHOT_OBJECT_DETECTION_MAPPING.get(type(config), None)

    def load(self, device: str) -> None:
        from transformers import AutoModelForZeroShotObjectDetection

        options = model_options(self._manifest, self._weights, device)
        self._model = load_transformers(
            AutoModelForZeroShotObjectDetection, self._weights, **options
        )

    def run(self, call: ModelCall) -> Message:
        assert isinstance(call, DetectOp)
        labels = split_query(call.query)
        picture, shrunk = picture_of(call, self._contract)
        width, height = picture.size
        threshold = (
            self._contract.score_threshold if call.score_threshold is None else call.score_threshold
        )
        found = self._detect(shrunk, labels, threshold, (height, width))
        return detected(found, picture.size)

    def _detect(
        self, picture: Any, labels: list[str], threshold: float, size: tuple[int, int]
    ) -> list[DetectionResult]:
        import torch

        self._refuse_long(labels)
        self._refuse_size(picture)
        model = self._model
        # Grounding DINO scores tokens, the others score texts. Its processor would join the texts
        # just so, but not those with a dot.
        grounds = hasattr(model.config, "max_text_len")
        text = ". ".join(labels).lower() + "." if grounds else labels
        inputs = to_model(
            processed(self._processor, [picture], images=picture, text=[text], truncation=True),
            model,
        )
        spans = self._spans(inputs["input_ids"][0].tolist(), labels) if grounds else None
        # It also makes float32 of its own between layers of 16 bits; autocast joins them.
        mixed = spans is not None and model.dtype in (torch.float16, torch.bfloat16)
        with (
            torch.inference_mode(),
            torch.autocast(model.device.type, model.dtype, enabled=mixed),
        ):
            outputs = model(**inputs)
        for name in _ANSWERS & outputs.keys():
            if outputs[name].isnan().any():  # no score of it is above a threshold
                raise ModelError(
                    "the detector's answer is not a number",
                    hint="check its weights, or run it in a wider number format, e.g. bf16",
                )
            outputs[name] = outputs[name].float()
        scores, names, boxes = (
            self._classified(outputs, labels, threshold, size)
            if spans is None
            else _grounded(outputs, spans, labels, size)
        )
        found = [
            detection(name, score, box, size)
            for score, name, box in zip(scores, names, boxes, strict=True)
            if score > threshold
        ]
        return [one for one in found if one is not None]

    def _refuse_long(self, labels: list[str]) -> None:
        """Raise BadRequest for a text that the model would read only in part."""
        tokenizer = self._processor.tokenizer
        for label, tokens in zip(labels, tokenizer(labels)["input_ids"], strict=True):
            if len(tokens) > tokenizer.model_max_length:
                raise BadRequest(
                    f"{label[:40]!r} has {len(tokens)} tokens; this model reads "
                    f"{tokenizer.model_max_length}",
                    hint="describe the object in fewer words",
                )

    def _refuse_size(self, picture: Any) -> None:
        """Raise BadRequest for a picture that the processor passes on and the model cannot read."""
        reader = self._processor.image_processor
        size = dict(reader.size)
        needed = size.get("width", picture.width), size.get("height", picture.height)
        if not reader.do_resize and picture.size != needed:
            raise BadRequest(
                f"a picture of {sizes([picture])}; this model reads {needed[0]} x {needed[1]}, and "
                "its processor resizes none",
                hint="send a picture of that size, and a max_side no lower",
            )

    def _classified(
        self, outputs: Any, labels: list[str], threshold: float, size: tuple[int, int]
    ) -> _Found:
        """Read the answer of a model that scores each box for each text (OWL, OmDet-Turbo)."""
        (result,) = self._processor.post_process_grounded_object_detection(
            outputs, text_labels=[labels], target_sizes=[size], threshold=threshold
        )
        return result["scores"].tolist(), result["text_labels"], result["boxes"].tolist()

    def _spans(self, tokens: list[int], labels: list[str]) -> list[slice]:
        """Return where each text lies among the tokens. Raises BadRequest for too much text."""
        spans, at = [], 0
        for label in labels:
            own = self._processor.tokenizer(label.lower(), add_special_tokens=False)["input_ids"]
            if not own:
                raise BadRequest(
                    f"{label[:40]!r} has no characters that this model reads",
                    hint="describe the object in words",
                )
            while at < len(tokens) and tokens[at : at + len(own)] != own:
                at += 1
            spans.append(slice(at, at + len(own)))
            at += len(own)
        limit = self._model.config.max_text_len
        if at > len(tokens) or len(tokens) > limit:  # a text is cut off, or is there in part
            raise BadRequest(
                f"{len(labels)} objects have {len(tokens)} tokens; this model reads {limit}",
                hint="ask for fewer objects in one request",
            )
        return spans


def _grounded(outputs: Any, spans: list[slice], labels: list[str], size: tuple[int, int]) -> _Found:
    """Read the answer of a model that scores each box for each token (Grounding DINO).

    A box gets the text with the best token. The processor's own reading joins all tokens over a
    threshold, which may be half a text, or none.
    """
    import torch

    probabilities = outputs.logits[0].sigmoid()
    scores, best = torch.stack([probabilities[:, span].amax(dim=-1) for span in spans], dim=-1).max(
        dim=-1
    )
    x, y, width, height = outputs.pred_boxes[0].unbind(-1)
    corners = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
    boxes = torch.stack(corners, dim=-1) * torch.tensor([size[1], size[0]] * 2).to(x)
    return scores.tolist(), [labels[index] for index in best.tolist()], boxes.tolist()


def _name_backbones_offline() -> None:
    """Keep transformers from asking the hub whether the name of a backbone is a repository.

    It asks that of timm's names too, such as OmDet-Turbo's, at every load: without a network the
    model could not be loaded from the cache.
    """
    from transformers import backbone_utils

    backbone_utils.repo_exists = _is_repository


def _is_repository(name: str) -> bool:
    from huggingface_hub import repo_exists

    return "/" in name and repo_exists(name)


def split_query(query: str | Sequence[str]) -> list[str]:
    """Return the texts of `red cube</c>blue ball`, `red cube . blue ball`, `red cube, blue ball` or
    `red cube. blue ball.`, or of a list of such, without doubles.

    Raises: BadRequest for none or too many.
    """
    queries = [query] if isinstance(query, str) else query
    parts = [
        part
        for one in queries
        for text in (one.split(". ") if _ENDS_IN_A_DOT.search(one) else [one])
        for part in _SEPARATOR.split(text)
    ]
    labels = [part.strip().rstrip(".").strip() for part in parts]
    labels = list(dict.fromkeys(label for label in labels if label))
    if not labels or len(labels) > QUERIES_MAX:
        raise BadRequest(
            f"expected a query of 1 to {QUERIES_MAX} objects, got {len(labels)}",
            hint="separate them by </c>, ' . ' or commas, or end each with a dot",
        )
    return labels


def detected(found: list[DetectionResult], size: tuple[int, int]) -> Message:
    """Return the reply to `detect`, best first, for a picture of this width and height."""
    best = sorted(found, key=lambda one: -one["score"])
    answer = grounding_answer(best, *size)
    return {"ok": True, "answer": answer, "norm": NORM, "detections": best}


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


def detection(
    label: str, score: float, box: list[float], size: tuple[int, int]
) -> DetectionResult | None:
    """Clip a box to the picture (`size`: height, width); None if nothing is left of it.

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
