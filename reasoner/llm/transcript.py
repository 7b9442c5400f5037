"""Transcript of a language model: every request, answer and rejection as a line of JSON.

Holds what was said to the model and what it said, without the key, which travels in a header;
pictures are left out.
"""

import base64
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from vram_arbiter.reasoner.json_lines import JsonLines
from vram_arbiter.schemas.reasoner import TranscriptLine

PICTURE_MIN_CHARS = 1024  # a shorter text does not hold a picture


class Transcript(JsonLines):
    """Lines are appended to the file until it is closed. None: nothing is written.

    Raises ConfigError for a file that cannot be written.
    """

    def __init__(self, path: Path | None) -> None:
        super().__init__(path, "--transcript")

    def tell(self, kind: Literal["answered", "failed", "rejected"], **fields: Any) -> None:
        """Write a line: `request` with the API's `answer`, or with the `problem` where it gave
        none; of an answer that was not taken, the `problem` alone."""
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = TranscriptLine(at=at, kind=kind, **fields)
        shown = line.model_copy(update={"request": without_pictures(line.request)})
        self.add(shown, without_none=True)


def without_pictures(value: object) -> object:
    """Return the same JSON with the length of each picture in its place."""
    match value:
        case dict():
            return {key: without_pictures(item) for key, item in value.items()}
        case list():
            return [without_pictures(item) for item in value]
        case str() if len(value) >= PICTURE_MIN_CHARS and _is_picture(value):
            return f"… {len(value)} characters of a picture"
        case _:
            return value


def _is_picture(text: str) -> bool:
    encoded = text.rpartition(";base64,")[2]
    try:
        return bool(base64.b64decode(encoded, validate=True))
    except ValueError:
        return False
