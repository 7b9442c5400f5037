"""What a language model answers."""

from dataclasses import dataclass

from vram_arbiter.schemas.plain import JsonMap


@dataclass(frozen=True, slots=True)
class Call:
    """A call as the model wrote it: nothing is checked yet."""

    id: str
    name: str
    arguments: str | JsonMap


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer of a model: words, calls, both or neither. `finish_reason` is the API's word."""

    text: str
    calls: tuple[Call, ...]
    finish_reason: str = ""
    model: str = ""
    input_tokens: int = 0
    output_tokens: int = 0
