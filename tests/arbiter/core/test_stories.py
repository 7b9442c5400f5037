"""The engine answers in each story of `stories/` as its file says."""

from difflib import unified_diff
from pathlib import Path

import pytest

from tests.support.stories import retold

FOLDER = Path(__file__).with_name("stories")
STORIES = {path.stem: path.read_text(encoding="utf-8") for path in sorted(FOLDER.glob("*.txt"))}


@pytest.mark.parametrize("name", STORIES)
def test_the_engine_answers_as_the_story_says(name: str) -> None:
    """`make stories` writes the answers anew. What then differs is to be read."""
    told = STORIES[name]
    played = retold(told)
    if played != told:
        pytest.fail("\n".join(unified_diff(told.splitlines(), played.splitlines(), lineterm="")))
