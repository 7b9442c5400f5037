"""Questions about pictures and short videos through transformers' image-text-to-text classes.

These are Qwen2.5-VL, Qwen3-VL, Qwen3.5, LLaVA-OneVision, SmolVLM and others.
"""

from collections.abc import Sequence
from typing import Any, Final, Literal

from vram_arbiter.schemas.errors import BadRequest, LimitExceeded, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import QueryOp
from vram_arbiter.sidecars.adapters.base import ModelCall, OneNetwork
from vram_arbiter.sidecars.adapters.inputs import processed, to_model
from vram_arbiter.sidecars.checkpoints import load_transformers
from vram_arbiter.sidecars.images import decode_all, of_one_size, within
from vram_arbiter.sidecars.weights import (
    Weights,
    from_pretrained,
    model_options,
    transformers_modules,
)

# limit of one answer, as by max_new_tokens: below the time that counts as stuck
ANSWER_MAX_S: Final = 120.0
# limit of a question with its pictures: the bytes of the cache grow with it, beside the footprint
PROMPT_MAX_TOKENS: Final = 16_384
OPENING, CLOSING = "<think>", "</think>"  # around a thought


class SceneVlmAdapter(OneNetwork):
    """The op `query`: pictures, a video and a question in, the answer out.

    Greedy, so the same question gets the same answer.
    """

    kind: Literal["vlm"] = "vlm"
    ops = frozenset({"query"})

    def __init__(self, manifest: RSkillManifest, weights: Weights) -> None:
        self._manifest = manifest
        self._weights = weights
        self._processor: Any = None

    @property
    def modules(self) -> tuple[str, ...]:
        return transformers_modules(self._weights)

    def prepare(self) -> None:
        from transformers import MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING, AutoConfig, AutoProcessor

        self._processor = from_pretrained(AutoProcessor, self._weights)
        config = from_pretrained(AutoConfig, self._weights)
        # imports the model's code, which saves seconds under the lease
        MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING.get(type(config), None)
        try:
            self._prompt([{"type": "text", "text": "?"}])
        except Exception as error:
            raise ModelError(
                f"{self._weights.source}: its chat template cannot be used: {error}",
                hint="take a checkpoint that was trained on questions (instruct), with its "
                "chat_template",
            ) from error

    def load(self, device: str) -> None:
        from transformers import AutoModelForImageTextToText

        options = model_options(self._manifest, self._weights, device)
        self._model = load_transformers(AutoModelForImageTextToText, self._weights, **options)

    def run(self, call: ModelCall) -> Message:
        assert isinstance(call, QueryOp)
        single = [] if call.image is None else [call.image]
        pictures = [
            within(picture, call.max_side)
            for picture in decode_all([*single, *call.images, *call.video])
        ]
        count = len(pictures) - len(call.video)
        inputs, thinks = self._inputs(
            pictures[:count], of_one_size(pictures[count:]), call.fps, call.question
        )
        ids = self._generate(inputs, call.max_new_tokens)
        return {"ok": True, "answer": self._answer(ids, thinks)}

    def _inputs(
        self, images: Sequence[Any], video: Sequence[Any], fps: float | None, question: str
    ) -> tuple[Any, bool]:
        """Return the model's inputs, and whether the prompt ends in the middle of a thought."""
        processor = self._processor
        self._refuse_unreadable(images, video, question)
        content = [{"type": "image"} for _ in images]
        content += [{"type": "video"}] if video else []
        prompt = self._prompt([*content, {"type": "text", "text": question}])
        given: dict[str, Any] = {"images": [list(images)]} if images else {}  # of one prompt
        if video:
            given |= _video(video, fps)
        inputs = processed(processor, [*images, *video], text=[prompt], **given)
        return to_model(inputs, self._model), prompt.rstrip().endswith(OPENING)

    def _prompt(self, content: Sequence[Message]) -> str:
        """Return the user's turn and the begin of the answer, as the checkpoint's template says."""
        template = self._processor.chat_template
        # thinking would use up the tokens of the answer
        known = {"enable_thinking": False} if "enable_thinking" in str(template) else {}
        return str(
            self._processor.apply_chat_template(
                [{"role": "user", "content": list(content)}],
                add_generation_prompt=True,
                tokenize=False,
                **known,
            )
        )

    def _refuse_unreadable(
        self, images: Sequence[Any], video: Sequence[Any], question: str
    ) -> None:
        """Raise BadRequest for what this model's processor cannot read, or would read wrongly."""
        processor = self._processor
        for name in ("image_token", "video_token"):
            if (token := getattr(processor, name, None)) and token in question:
                raise BadRequest(
                    f"the question has {token}, which stands for a picture in the prompt",
                    hint="ask in plain words; pictures are put before the question",
                )
        if not video:
            return
        if getattr(processor, "video_processor", None) is None:
            raise BadRequest(
                f"{type(processor).__name__} reads no video",
                hint="send the frames as `images`",
            )
        if images and self._model.config.model_type == "smolvlm":  # it would drop the video
            raise BadRequest(
                "SmolVLM reads pictures or a video, not both",
                hint="send all of them as `images`",
            )

    def _answer(self, ids: list[int], thinks: bool) -> str:
        """Decode the answer without its thoughts; `thinks`: the prompt ends in the middle of one.

        A tokenizer that marks thoughts by special tokens drops those from the text, so ids are cut.
        """
        tokens = self._processor.tokenizer.added_tokens_encoder
        opening, closing = tokens.get(OPENING), tokens.get(CLOSING)
        if closing in ids:
            ids, thinks = ids[len(ids) - ids[::-1].index(closing) :], False
        text = str(self._processor.decode(ids, skip_special_tokens=True))
        return after_thinking(OPENING + text if thinks or opening in ids else text)

    def _generate(self, inputs: Any, max_new_tokens: int) -> list[int]:
        """Return the ids of the answer's tokens. Raises LimitExceeded for too long a prompt."""
        import torch

        asked = inputs["input_ids"].shape[1]
        context = getattr(self._model.config.get_text_config(), "max_position_embeddings", None)
        limit = PROMPT_MAX_TOKENS if context is None else context - max_new_tokens
        limit = max(0, min(limit, PROMPT_MAX_TOKENS))
        if asked > limit:
            raise LimitExceeded(
                f"the question and its pictures have {asked} tokens; with an answer of "
                f"{max_new_tokens} this model reads {limit}",
                hint="send fewer pictures, or lower max_side or max_new_tokens",
                details={"limit": "tokens", "tokens": asked, "tokens_max": limit},
            )
        with torch.inference_mode():
            output = self._model.generate(
                **inputs, max_new_tokens=max_new_tokens, do_sample=False, max_time=ANSWER_MAX_S
            )
        ids: list[int] = output[0, asked:].tolist()
        return ids


def _video(frames: Sequence[Any], fps: float | None) -> dict[str, Any]:
    """Return a processor's arguments for a video all of whose frames are looked at."""
    import numpy as np
    from transformers.video_utils import VideoMetadata

    assert fps is not None, "the message's own check"
    count = len(frames)
    metadata = VideoMetadata(
        total_num_frames=count,
        fps=fps,
        width=frames[0].width,
        height=frames[0].height,
        duration=count / fps,
        frames_indices=list(range(count)),
    )
    return {
        "videos": [[np.stack([np.asarray(frame) for frame in frames])]],
        "do_sample_frames": False,
        "video_metadata": [metadata],
    }


def after_thinking(text: str) -> str:
    """Return the answer proper: the text after the last thought.

    Raises: LimitExceeded if the tokens ended in the middle of a thought. There is no answer then,
    and an empty one would be taken for one.
    """
    answer = text.rpartition(CLOSING)[2]
    if OPENING in answer:
        raise LimitExceeded(
            "the model has used all tokens for thinking",
            hint="raise max_new_tokens, or use a checkpoint that does not think",
            details={"limit": "max_new_tokens"},
        )
    return answer.strip()
