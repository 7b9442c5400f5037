"""The engine's effects carry codes and values, never sentences.

Digests of the event log hash these effects: if a sentence were among them, rewording it would make
every earlier recording differ at its replay.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum

import pytest

from tests.support.busy import PROBE_FAILURE, busy_driver

NAMELESS = re.compile(r"pid \d+")
"""How a process without a name is named."""


def texts(value: object, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield (path, text) of each plain string inside an effect."""
    if isinstance(value, Enum):
        return
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from texts(item, f"{path}[{key}]")
    elif is_dataclass(value):
        for field in fields(value):
            yield from texts(getattr(value, field.name), f"{path}.{field.name}")
    elif isinstance(value, list | tuple | set | frozenset):
        for item in value:
            yield from texts(item, path)


@pytest.mark.parametrize("seed", range(4))
def test_sentences_in_effects_are_quoted_from_events(seed: int) -> None:
    """The probe's own failure text is an input; everything else is a code, a name or a number."""
    found = {
        f"{type(effect).__name__}{path}: {text}"
        for effect in busy_driver(seed).effects
        for path, text in texts(effect)
        if " " in text and text != PROBE_FAILURE and not NAMELESS.fullmatch(text)
    }
    assert not found


def test_the_search_finds_a_sentence() -> None:
    assert list(texts({"reason": ("a", "it fits now")})) == [
        ("[reason]", "a"),
        ("[reason]", "it fits now"),
    ]
