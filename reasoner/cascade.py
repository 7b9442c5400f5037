"""The episode as a conversation for any language model: calls, outcomes, messages from outside.

The answers of `locate_in_view` and `query_scene` are prompts in their own right: they go back to
the planner with their source and their meaning, so that *not seen*, *evicted*, *no frame* and
*error* stay four different things. Text from a model or from the scene is data inside a JSON text,
cut to `ANSWER_MAX_CHARS`; only an operator's text is passed as a message. Must not know an API.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.planner import Episode, Note, Outcome, Sight, Status, Step
from vram_arbiter.schemas.plain import JsonMap, JsonObject
from vram_arbiter.schemas.tools import (
    ExecuteRskill,
    LocateInView,
    Look,
    QueryScene,
    QueryTaskProgress,
    ToolCall,
    skill_tool_name,
)

ANSWER_MAX_CHARS = (
    2000  # of the words; of the data, which are lists of numbers mostly, twice as many
)
ITEMS_MAX = 64

MEANING: dict[Status, str] = {
    "found": "the detector looked and sees it",
    "not_seen": "the detector looked and does not see it in this picture",
    "answered": "the model looked and answered; its words are an opinion about the pictures",
    "succeeded": "the goal was reached",
    "shown": "the camera's present picture is attached; no model has looked at it",
    "failed": "the goal ended without success",
    "canceled": "the goal was called off before its end",
    "done": "it was done",
    "evicted": "nothing was looked at: the model had to leave the GPU."
    " This says nothing about the scene; try again",
    "no_frame": "nothing was looked at: no picture is fresh enough."
    " This says nothing about the scene",
    "refused": "this call is not allowed or not understood; nothing was done",
    "error": "it could not be done. This says nothing about the scene",
}


RAN = "the policy ran to its end; whether it reached its aim was not judged: look, or ask"
SEEN = "what continuous detectors see in their cameras now; they know only what they look for"
BLIND = "no detector has looked through these cameras: this says nothing about the scene"
NOT_SHOWN = "the picture is not shown any more; look again"

SOURCE: dict[type[ToolCall], str] = {
    LocateInView: "detector",
    QueryScene: "scene_vlm",
    QueryTaskProgress: "reward_model",
    ExecuteRskill: "runner",
    Look: "camera",
}
PICTURES_MAX = 2  # shown at once, the newest; each costs as many tokens as a long episode


@dataclass(frozen=True, slots=True)
class Words:
    """Said to the model: the task, an operator, a nudge."""

    text: str


@dataclass(frozen=True, slots=True)
class Called:
    """A call of the model's, as it was read; `arguments` is a JSON object."""

    id: str
    name: str
    arguments: JsonObject


@dataclass(frozen=True, slots=True)
class Answered:
    """What came of the call with this id. `picture` is a JPEG, or empty."""

    id: str
    text: str
    is_error: bool = False
    picture: bytes = b""


@dataclass(frozen=True, slots=True)
class Thought:
    """Words of the model's own, without a call."""

    text: str


Turn = Words | Called | Answered | Thought


def conversation(episode: Episode, palette: Palette) -> list[Turn]:
    """Return task, steps and notes in order; a running goal comes last, without an outcome yet,
    and then what continuous detectors see.
    """
    turns: list[Turn] = [Words(episode.task)]
    notes = list(episode.notes)
    pictures = [n for n, step in enumerate(episode.steps) if step.outcome.picture]
    for number, step in enumerate(episode.steps):
        turns += _notes(notes, number)
        turns += _step(number, step, palette, shown=number in pictures[-PICTURES_MAX:])
    if episode.running is None:
        return turns + _notes(notes, len(episode.steps)) + _sight(episode.sight)
    number = len(episode.steps)
    runs = json.dumps({"status": "running", "meaning": "the goal runs; it is not over"})
    turns += [_called(number, episode.running, palette), Answered(_id(number), runs)]
    return turns + _notes(notes, number) + _sight(episode.sight)


def _sight(sight: Sight | None) -> list[Turn]:
    """Return what is seen now, and nothing of what was seen before."""
    if sight is None:
        return []
    seen = [
        {
            "label": _short(one.label),
            "camera": _short(one.camera),
            "confidence": round(one.confidence, 2),
            "age_s": round(one.age_s, 1),
        }
        for one in sight.seen[:ITEMS_MAX]
    ]
    fields: JsonObject = {"detected_objects": seen, "meaning": SEEN}
    if sight.blind:
        fields |= {"not_looking": list(sight.blind), "meaning_of_not_looking": BLIND}
    return [Words(f"world state: {json.dumps(fields, ensure_ascii=False, allow_nan=False)}")]


def _notes(notes: list[Note], after: int) -> list[Turn]:
    due = [note for note in notes if note.after <= after]
    del notes[: len(due)]
    return [Words(f"{note.source}: {_short(note.text)}") for note in due]


def _step(number: int, step: Step, palette: Palette, *, shown: bool) -> list[Turn]:
    fields = told(step.call, step.outcome, palette.manipulation)
    if step.outcome.picture and not shown:
        fields["meaning"] = NOT_SHOWN
    text = json.dumps(fields, ensure_ascii=False, allow_nan=False)
    picture = step.outcome.picture if shown else b""
    is_error = step.outcome.status in ("refused", "error")
    return [_called(number, step.call, palette), Answered(_id(number), text, is_error, picture)]


def told(call: ToolCall, outcome: Outcome, policies: frozenset[str] = frozenset()) -> JsonObject:
    """Return an outcome for a model: status, its meaning, source, text, numbers.

    `policies` are the learned skills: of them "succeeded" says less.
    """
    source = SOURCE.get(type(call), "reasoner")
    learned = isinstance(call, ExecuteRskill) and call.rskill_id in policies
    fields = {
        "status": outcome.status,
        "meaning": RAN if learned and outcome.status == "succeeded" else MEANING[outcome.status],
        "source": source,
        "text": _short(outcome.text),
    }
    if outcome.code:
        fields["code"] = outcome.code
    return fields | ({"data": _told_data(outcome.data)} if outcome.data else {})


def _told_data(data: JsonMap) -> JsonObject:
    """Return data of a skill or model as JSON within the limit of an answer; mark what is left
    out.
    """
    fields: JsonObject = {}
    left = 2 * ANSWER_MAX_CHARS
    for key, value in _sayable(data).items():
        length = len(json.dumps(value, ensure_ascii=False))
        fields[key] = value if length <= left else f"… left out: {length} characters"
        left -= min(length, left)
    return fields


def _sayable(value: Any) -> Any:
    match value:
        case None | bool() | int():
            return value
        case float():
            return value if math.isfinite(value) else str(value)
        case list() | tuple():
            more = [f"… and {len(value) - ITEMS_MAX} more"] if len(value) > ITEMS_MAX else []
            return [_sayable(item) for item in value[:ITEMS_MAX]] + more
        case Mapping():
            return {_short(str(key)): _sayable(value[key]) for key in list(value)[:ITEMS_MAX]}
        case bytes():
            return f"{len(value)} bytes"
        case _:
            return _short(str(value))


def _called(number: int, call: ToolCall, palette: Palette) -> Called:
    fields = call.model_dump(mode="json", exclude={"tool"}, exclude_defaults=True)
    if not isinstance(call, ExecuteRskill) or call.rskill_id not in {
        skill.id for skill in palette.skills
    }:
        return Called(_id(number), call.tool, fields)
    del fields["rskill_id"]
    fields.pop("goal_params_json", None)
    if call.goal_params:
        fields["goal_params"] = call.goal_params
    return Called(_id(number), skill_tool_name(call.rskill_id), fields)


def _id(number: int) -> str:
    return f"call-{number}"


def _short(text: str) -> str:
    text = "".join(letter if letter.isprintable() else " " for letter in text)
    return text if len(text) <= ANSWER_MAX_CHARS else text[: ANSWER_MAX_CHARS - 1] + "…"
