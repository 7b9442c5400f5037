"""Tokens and requests of a language model: the tally of a task, and OpenTelemetry's `gen_ai.*`.

One span `chat MODEL` a request, below `reasoner.plan`, with every try of the request in it.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from time import monotonic
from typing import cast
from urllib.parse import urlsplit

from vram_arbiter.reasoner.llm import names
from vram_arbiter.reasoner.llm.answer import Answer
from vram_arbiter.reasoner.llm.config import LlmConfig
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.reasoner import LlmUsage
from vram_arbiter.schemas.runtime.telemetry import meters
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing


@dataclass(slots=True)
class Tally:
    """What a task's decisions cost. Each try counts as a request, and one that was repeated as a
    failed one: a busy server, say.
    """

    requests: int = 0
    failed: int = 0
    rejected: int = 0
    input_tokens: int = 0
    output_tokens: int = 0

    def tried_again(self) -> None:
        self.requests += 1
        self.failed += 1

    def as_result(self, model: str) -> LlmUsage:
        return cast(LlmUsage, {"model": model, **asdict(self)})


@contextmanager
def measured(provider: str, config: LlmConfig, tally: Tally) -> Iterator[Callable[[Answer], None]]:
    """Measure one request, whatever becomes of it. Yields what its answer is told to."""
    labels = {
        telemetry.ATTR_CHAT_OPERATION: "chat",
        telemetry.ATTR_PROVIDER: provider,
        telemetry.ATTR_REQUEST_MODEL: config.model,
    }
    address = urlsplit(config.base_url)
    attributes: dict[str, str | int] = {
        **labels,
        names.ATTR_REQUEST_MAX_TOKENS: config.max_tokens,
        names.ATTR_SERVER: address.hostname or "",
        names.ATTR_SERVER_PORT: address.port or (443 if address.scheme == "https" else 80),
    }
    tally.requests += 1
    began_s = monotonic()
    with tracing.span(f"chat {config.model}", attributes=attributes, client=True):
        try:
            yield lambda answer: _note(answer, tally, labels)
        except VramError as error:
            tally.failed += 1
            labels = labels | {telemetry.ATTR_ERROR_TYPE: error.code}
            raise
        finally:
            meters.measure(names.GEN_AI_DURATION, monotonic() - began_s, labels)


def _note(answer: Answer, tally: Tally, labels: Mapping[str, str]) -> None:
    """Note an answer's tokens and words about itself in tally, span and metrics."""
    tally.input_tokens += answer.input_tokens
    tally.output_tokens += answer.output_tokens
    noted: dict[str, str | int] = {
        names.ATTR_INPUT_TOKENS: answer.input_tokens,
        names.ATTR_OUTPUT_TOKENS: answer.output_tokens,
    }
    if answer.model:
        noted[names.ATTR_RESPONSE_MODEL] = answer.model
    tracing.note(noted)
    if answer.finish_reason:
        tracing.note({names.ATTR_FINISH_REASONS: [answer.finish_reason]})
    for kind, tokens in (("input", answer.input_tokens), ("output", answer.output_tokens)):
        meters.measure(names.GEN_AI_TOKENS, tokens, {**labels, names.ATTR_TOKEN_TYPE: kind})
