"""Questions about a picture through transformers' image-text-to-text classes.

These are Qwen3.5 and others.
"""

from collections.abc import Sequence
from typing import Any, Literal

from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import QueryOp
from vram_arbiter.sidecars.adapters.base import ModelCall
from vram_arbiter.sidecars.checkpoints import load_transformers
from vram_arbiter.sidecars.images import decode, within
from vram_arbiter.sidecars.weights import (
    Weights,
    from_pretrained,
    model_options,
    transformers_modules,
)

ANSWER_MAX_S = (
    120.0  # limit of one answer, as by max_new_tokens: below the time that counts as stuck
)


class SceneVlmAdapter:
    """The op `query`: a picture and a question in, the answer out.

    Greedy, so the same question gets the same answer.
    """

    kind: Literal["vlm"] = "vlm"
    ops = frozenset({"query"})

    def __init__(self, manifest: RSkillManifest, weights: Weights) -> None:
        self._manifest = manifest
        self._weights = weights
        self._processor: Any = None
        self._model: Any = None

    @property
    def modules(self) -> tuple[str, ...]:
        return transformers_modules(self._weights)

    def prepare(self) -> None:
        from transformers import MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING, AutoConfig, AutoProcessor

        self._processor = from_pretrained(AutoProcessor, self._weights)
        config = from_pretrained(AutoConfig, self._weights)
        MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING.get(
            type(config), None
        )  # imports the model's code, which saves seconds under the lease

    def load(self, device: str) -> None:
        from transformers import AutoModelForImageTextToText

        options = model_options(self._manifest, self._weights, device)
        self._model = load_transformers(AutoModelForImageTextToText, self._weights, **options)

    @property
    def networks(self) -> Sequence[Any]:
        return (self._model,)

    def place(self, device: str) -> None:
        self._model.to(device)

    def run(self, call: ModelCall) -> Message:
        assert isinstance(call, QueryOp)
        picture = within(decode(call.image), call.max_side)
        return {"ok": True, "answer": self._answer(picture, call.question, call.max_new_tokens)}

    def _answer(self, picture: Any, question: str, max_new_tokens: int) -> str:
        import torch

        content = [{"type": "image"}, {"type": "text", "text": question}]
        prompt = self._processor.apply_chat_template(
            [{"role": "user", "content": content}],
            add_generation_prompt=True,
            tokenize=False,
            # for templates that know it; thinking would use up the tokens of the answer
            enable_thinking=False,
        )
        inputs = self._processor(text=[prompt], images=[picture], return_tensors="pt").to(
            self._model.device
        )
        with torch.inference_mode():
            output = self._model.generate(
                **inputs, max_new_tokens=max_new_tokens, do_sample=False, max_time=ANSWER_MAX_S
            )
        answer = output[0, inputs["input_ids"].shape[1] :]
        return after_thinking(self._processor.decode(answer, skip_special_tokens=True))


def after_thinking(text: str) -> str:
    """Return the answer proper: the text after the last `</think>`, if there is one."""
    return text.rpartition("</think>")[2].strip()
