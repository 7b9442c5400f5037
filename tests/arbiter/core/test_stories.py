"""The engine answers in each story of `stories/` as its file says."""

from difflib import unified_diff
from pathlib import Path

import pytest

from tests.support.stories import play

STORIES = sorted(Path(__file__).with_name("stories").glob("*.txt"))


@pytest.mark.parametrize("path", STORIES, ids=lambda path: path.stem)
def test_the_engine_answers_as_the_story_says(path: Path) -> None:
    """`make stories` writes the answers anew. What then differs is to be read."""
    told = path.read_text(encoding="utf-8")
    played = play(told)
    if played != told:
        pytest.fail("\n".join(unified_diff(told.splitlines(), played.splitlines(), lineterm="")))
