"""Free-text queries for objects on a table, and their matches: words only, no model, no images."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Sequence
from typing import Final

SHAPE_WORDS: Final = {
    "cube": ("cube", "block", "box"),
    "ball": ("ball", "sphere", "round ball"),
    "cylinder": ("cylinder", "can", "tin"),
}
OTHER_COLORS: Final = ("white", "black", "pink", "brown", "grey", "cyan", "silver", "golden")
OTHER_THINGS: Final = (
    "mug", "banana", "spoon", "bottle", "apple", "person", "chair", "screwdriver", "plate",
    "book", "phone", "dog", "scissors", "bowl", "pen", "shoe", "lamp", "key", "hammer", "tomato",
    "cone", "ring", "pyramid", "duck",
)  # fmt: skip
# Never trained on: the evaluation uses them to test that unknown words are rejected.
UNTAUGHT_THINGS: Final = ("carrot", "wrench", "teapot", "notebook", "lemon", "kettle")
THING_WORDS: Final = ("object", "thing", "item")
PHRASES: Final = (
    "{}", "{}", "{}", "a {}", "the {}", "one {}", "a photo of a {}", "find the {}", "the {} on the "
                                                                                    "table", "{}.",
    "a small {}", "where is the {}",
)  # fmt: skip


@dataclasses.dataclass(frozen=True, slots=True)
class Query:
    """A text and what it asks for; None means any.

    `known` is False where nothing in the vocabulary can match.
    """

    text: str
    color: str | None
    shape: str | None
    known: bool = True

    def matches(self, name: str) -> bool:
        """Return whether an object of this name, `COLOR SHAPE`, answers the query."""
        color, shape = name.split(" ", 1)
        return self.known and self.color in (None, color) and self.shape in (None, shape)


def every_word(colors: Sequence[str], shapes: Sequence[str]) -> list[str]:
    """Return the words that a tokenizer should know as one piece, sorted."""
    words = {
        *colors,
        *OTHER_COLORS,
        *OTHER_THINGS,
        *THING_WORDS,
        *(s for s in shapes if s not in SHAPE_WORDS),
    }
    words.update(
        word
        for shape in shapes
        for phrase in SHAPE_WORDS.get(shape, (shape,))
        for word in phrase.split()
    )
    words.update(
        word for phrase in PHRASES for word in phrase.replace("{}", " ").replace(".", " ").split()
    )
    return sorted(words)


def sample_queries(
    rng: random.Random, colors: Sequence[str], shapes: Sequence[str], strange: int
) -> list[Query]:
    """Return every (color, shape), every color, every shape in random words, and `strange` ones.

    Nothing can answer a strange query.
    """
    out: list[Query] = []
    for color in colors:
        for shape in shapes:
            out.append(Query(_say(rng, f"{color} {_shape_word(rng, shape)}"), color, shape))
        out.append(Query(_say(rng, f"{color} {rng.choice(THING_WORDS)}"), color, None))
    out += [Query(_say(rng, _shape_word(rng, shape)), None, shape) for shape in shapes]
    for _ in range(strange):
        color = rng.choice(OTHER_COLORS) if rng.random() < 0.5 else rng.choice(colors)
        if color in OTHER_COLORS and rng.random() < 0.6:
            noun = _shape_word(rng, rng.choice(shapes))
        elif rng.random() < 0.4:
            noun = "".join(
                rng.choice("abcdefghijklmnopqrstuvwxyz") for _ in range(rng.randint(3, 8))
            )
        else:
            noun = rng.choice(OTHER_THINGS)
        text = noun if noun in OTHER_THINGS and rng.random() < 0.3 else f"{color} {noun}"
        out.append(Query(_say(rng, text), None, None, known=False))
    return out


def _shape_word(rng: random.Random, shape: str) -> str:
    words = SHAPE_WORDS.get(shape, (shape,))
    return words[0] if rng.random() < 0.6 else rng.choice(words)


def _say(rng: random.Random, what: str) -> str:
    return rng.choice(PHRASES).format(what)
