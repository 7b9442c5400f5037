"""Open-vocabulary grounding by a model that brings its own code, as NVIDIA's LocateAnything does.

transformers has no class of it: the checkpoint's Python files are run. That takes the manifest's
consent, and for a repository of the hub one commit, so that the files cannot change later.
"""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

from vram_arbiter.clients.sidecar.field import NORM, grounded
from vram_arbiter.schemas.errors import BadRequest, ConfigError, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import DetectOp
from vram_arbiter.sidecars.adapters.base import ModelCall, OneNetwork
from vram_arbiter.sidecars.adapters.detector import split_query
from vram_arbiter.sidecars.adapters.inputs import picture_of, processed, to_model
from vram_arbiter.sidecars.checkpoints import load_transformers
from vram_arbiter.sidecars.weights import CONFIG_FILE, Weights, from_pretrained, model_options

LOADER: Final = "transformers.AutoModel"
"""`quantization.extra.loader` of a manifest whose model this adapter runs."""
CONSENT: Final = "trust_remote_code"
"""Key of `quantization.extra` that lets the checkpoint's code run."""
REPETITION_PENALTY: Final = 1.1  # the field's; without it a greedy answer repeats its last box
# files whose `auto_map` names code
_MAPS: Final = (
    CONFIG_FILE,
    "processor_config.json",
    "preprocessor_config.json",
    "tokenizer_config.json",
)
_COMMIT = re.compile(r"[0-9a-f]{40}")


class LocateAnythingAdapter(OneNetwork):
    """The op `detect`: texts and a picture in, boxes in the picture's pixels out.

    Greedy, so the same question gets the same answer. Every box has the score 1.0.
    """

    kind: Literal["detector"] = "detector"
    ops = frozenset({"detect"})

    def __init__(self, manifest: RSkillManifest, weights: Weights) -> None:
        assert manifest.detector is not None, "the kind requires the block"
        self._manifest = manifest
        self._contract = manifest.detector
        self._weights = with_own_code(manifest, weights)
        self._processor: Any = None

    @property
    def modules(self) -> tuple[str, ...]:
        return ("torch", "transformers", "PIL.Image")

    def prepare(self) -> None:
        from transformers import AutoProcessor

        _refuse_code_of_others(self._weights)
        self._processor = from_pretrained(AutoProcessor, self._weights)
        for name in ("py_apply_chat_template", "process_vision_info", "tokenizer"):
            if not hasattr(self._processor, name):
                raise ModelError(
                    f"{self._weights.source}: its {type(self._processor).__name__} has no {name}",
                    hint="this loader runs models with the interface of LocateAnything",
                )

    def load(self, device: Literal["cpu", "meta"]) -> None:
        from transformers import AutoModel

        options = model_options(self._manifest, self._weights, device) | {CONSENT: True}
        self._model = load_transformers(AutoModel, self._weights, **options)

    def run(self, call: ModelCall) -> Message:
        assert isinstance(call, DetectOp)
        labels = split_query(call.query)
        if any(sign in label for label in labels for sign in "<>"):
            raise BadRequest(
                "a query with < or >, which mark the model's own tokens",
                hint="describe the object in words",
            )
        picture, shrunk = picture_of(call, self._contract)
        width, height = picture.size
        answer = self._answer(shrunk, labels, call.mode, call.max_new_tokens)
        return {
            "ok": True,
            "answer": answer,
            "norm": NORM,
            "detections": grounded(answer, NORM, (width, height), ", ".join(labels)),
        }

    def _answer(self, picture: Any, labels: list[str], mode: str, max_new_tokens: int) -> str:
        import torch

        question = (
            "Locate all the instances that matches the following description: "
            f"{'</c>'.join(labels)}."
        )
        content = [{"type": "image", "image": picture}, {"type": "text", "text": question}]
        messages = [{"role": "user", "content": content}]
        prompt = self._processor.py_apply_chat_template(
            messages, tokenize=False, add_generation_prompt=True
        )
        images, videos = self._processor.process_vision_info(messages)
        inputs = processed(self._processor, [picture], text=[prompt], images=images, videos=videos)
        with torch.inference_mode():
            answer = self._model.generate(
                **to_model(inputs, self._model),
                tokenizer=self._processor.tokenizer,
                max_new_tokens=max_new_tokens,
                use_cache=True,
                generation_mode=mode,
                do_sample=False,
                temperature=0.0,
                repetition_penalty=REPETITION_PENALTY,
            )
        text = answer[0] if isinstance(answer, tuple) else answer
        if not isinstance(text, str):
            raise ModelError(
                f"the model answered with {type(text).__name__} instead of text",
                hint="this loader runs models with the interface of LocateAnything",
            )
        return text


def with_own_code(manifest: RSkillManifest, weights: Weights) -> Weights:
    """Return the weights with leave to run the code beside them.

    Raises: ConfigError, which says what the manifest has to say for that.
    """
    if manifest.quantization.extra.get(CONSENT) is not True:
        raise ConfigError(
            f"{manifest.name} would run Python code of its checkpoint",
            hint=f"read that code, then write quantization.extra.{CONSENT}: true",
        )
    uri = manifest.weights_uri or ""
    if uri.startswith("hf://") and not _COMMIT.fullmatch(manifest.weights_revision):
        raise ConfigError(
            f"{manifest.name} would run whatever code {uri} has at the time",
            hint=f"write weights_uri: {uri.partition('@')[0]}@COMMIT, with the 40 hex digits of "
            "the commit whose code was read",
        )
    return replace(weights, own_code=True)


def _refuse_code_of_others(weights: Weights) -> None:
    """Raise ConfigError if the checkpoint names code of another repository: no commit pins it."""
    from transformers.utils import cached_file

    for name in _MAPS:
        path = cached_file(
            weights.source,
            name,
            revision=weights.revision,
            local_files_only=weights.local,
            _raise_exceptions_for_missing_entries=False,
            _raise_exceptions_for_connection_errors=False,  # what is cached is all that is loaded
        )
        named = {} if path is None else json.loads(Path(path).read_text(encoding="utf-8"))
        if found := re.search(r'"([^"]*--[^"]*)"', json.dumps(named.get("auto_map"))):
            raise ConfigError(
                f"{weights.source}: {name} names code of another repository: {found[1]}",
                hint="put the code beside the weights, and its name without the repository's",
            )
