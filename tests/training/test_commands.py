"""The command line: every command of the pages, and what is refused before anything is trained."""

import re
import shlex
from pathlib import Path

import pytest

from tests.support.paths import CONFIGS, ROOT
from training.__main__ import main, make_parser

PAGES = [ROOT / "training/README.md", *sorted((CONFIGS / "models").rglob("README.md"))]
COMMAND = re.compile(r"python -m training ([^`\n]*)")


def commands_of_pages() -> list[str]:
    """Commands of README and model cards, in blocks and in sentences."""
    texts = [page.read_text(encoding="utf-8").replace("\\\n", " ") for page in PAGES]
    return [command for text in texts for command in COMMAND.findall(text)]


def test_commands_of_the_pages_are_accepted() -> None:
    parser, whole = make_parser(), 0
    for command in commands_of_pages():
        words = shlex.split(command, comments=True)
        if "--out" in words:
            parser.parse_args(words)
            whole += 1
    assert whole >= 8


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("detector", "labels.jsonl is missing: record with `python -m training record scenes"),
        ("scene-vlm", "labels.jsonl is missing"),
        ("policy", "info.json is missing: record with `python -m training record grabs"),
        ("progress", "info.json is missing"),
        ("detector --start-from x --batch 0", "--batch must be above 0, got 0"),
        ("progress --time-limit-s 0", "--time-limit-s must be above 0, got 0.0"),
    ],
)
def test_what_cannot_be_trained_with_ends_with_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: str, said: str
) -> None:
    folders = ["--data", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*arguments.split(), *folders]) == 2
    assert said in capsys.readouterr().err
    assert main(["record", "progress", "--count", "0", "--out", str(tmp_path)]) == 2
    assert "--count must be above 0, got 0" in capsys.readouterr().err
