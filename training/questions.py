"""Questions about a camera's picture, and the true answers: words only, no images."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any, Final

GRASPED: Final = (
    "Has the robot gripper grasped the {}?",
    "Has the robot gripper grasped the {}?",
    "Has the gripper grasped the {}?",
    "Is the {} grasped?",
    "Did the robot grasp the {}?",
    "Is the robot holding the {}?",
    "Is the gripper holding the {}?",
    "Is the {} in the gripper?",
    "Does the gripper hold a {}?",
    "Is the {} held by the robot?",
)
HOLDING: Final = (
    "What is the gripper holding?",
    "What does the robot hold?",
    "Which object is in the gripper?",
    "What is in the gripper?",
    "What has the robot grasped?",
)
ANYTHING: Final = (
    "Is the gripper holding anything?",
    "Is the gripper holding an object?",
    "Has the robot grasped something?",
)
EMPTY: Final = ("Is the gripper empty?", "Is there nothing in the gripper?")
PRESENT: Final = (
    "Is there a {} in view?",
    "Is there a {} on the table?",
    "Do you see a {}?",
    "Is a {} visible?",
)
LIST: Final = (
    "Which objects are in view?",
    "Which objects are on the table?",
    "What objects do you see?",
    "List the objects.",
)
SYNONYMS: Final = {
    "cube": ("cube", "block"),
    "ball": ("ball", "sphere"),
    "cylinder": ("cylinder", "can"),
}
NOTHING: Final = "nothing"


def as_prompt(processor: Any, question: str) -> str:
    """Return the chat of one picture and a question, ready for the answer."""
    content = [{"type": "image"}, {"type": "text", "text": question}]
    chat = [{"role": "user", "content": content}]
    return str(processor.apply_chat_template(chat, add_generation_prompt=True, tokenize=False))


def alike(held: str | None, names: Sequence[str]) -> list[str]:
    """Return the other names that share color or shape with the held object."""
    words = set((held or "").split(" "))
    return [name for name in names if name != held and set(name.split(" ")) & words]


def with_article(name: str) -> str:
    """Return the name with its article: `a red cube`, `an orange ball`."""
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


def said(rng: random.Random, template: str, name: str) -> str:
    """Return the question about a name, the shape sometimes by a synonym."""
    color, shape = name.split(" ", 1)
    word = shape if rng.random() < 0.85 else rng.choice(SYNONYMS.get(shape, (shape,)))
    text = template.format(f"{color} {word}")
    return text.replace(" a orange", " an orange")


def grasped(
    rng: random.Random, name: str, held: str | None, template: str | None = None
) -> tuple[str, str]:
    """Return (question, answer): is a named object held?"""
    question = said(rng, template or rng.choice(GRASPED), name)
    if held == name:
        return question, f"Yes, the gripper holds the {held}."
    return question, f"No, {_state(held)}"


def holding(rng: random.Random, held: str | None) -> tuple[str, str]:
    """Return (question, answer): which object, if any, is held?"""
    kind = rng.random()
    if kind < 0.6:
        return rng.choice(HOLDING), _state(held).capitalize()
    if kind < 0.8:
        return rng.choice(ANYTHING), f"{'No' if held is None else 'Yes'}, {_state(held)}"
    return rng.choice(EMPTY), f"{'Yes' if held is None else 'No'}, {_state(held)}"


def present(rng: random.Random, name: str, seen: Sequence[str]) -> tuple[str, str]:
    """Return (question, answer): is a named object in view?"""
    question = said(rng, rng.choice(PRESENT), name)
    if name in seen:
        return question, f"Yes, I see {with_article(name)}."
    return question, f"No, I see no {name}."


def listing(rng: random.Random, seen: Sequence[str]) -> tuple[str, str]:
    """Return (question, answer) naming all objects in view, in the order given."""
    text = ", ".join(with_article(name) for name in seen)
    return rng.choice(LIST), f"{text[0].upper()}{text[1:]}." if text else "No objects."


def _state(held: str | None) -> str:
    return "the gripper is empty." if held is None else f"the gripper holds the {held}."


def corpus(names: Sequence[str]) -> list[str]:
    """Return every text that questions and answers are made of, for the tokenizer."""
    rng = random.Random("corpus")
    texts = [*HOLDING, *ANYTHING, *EMPTY, *LIST, "user assistant system", "No objects."]
    for name in names:
        for template in (*GRASPED, *PRESENT):
            texts.append(template.format(name))
            color, shape = name.split(" ", 1)
            texts += [f"{color} {word}" for word in SYNONYMS.get(shape, (shape,))]
        texts += [grasped(rng, name, held)[1] for held in (name, None)]
        texts += [present(rng, name, seen)[1] for seen in ([name], [])]
        texts += [listing(rng, [name])[1], listing(rng, [name, name])[1], f"an {name}"]
    return texts
