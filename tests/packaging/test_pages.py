"""Pages name what exists: paths and functions of the tree, and the targets of relative links."""

import re
from collections.abc import Iterator
from pathlib import Path

from tests.support.paths import ROOT

FOLDERS = (
    "arbiter|clients|schemas|sidecars|runner|reasoner|testing|configs|examples|docs|"
    "tests|training|src"
)
PATH = re.compile(rf"`((?:{FOLDERS}|\.ci)/[\w./-]*|[\w-]+\.(?:md|toml|txt))(?:::(\w+))?`")
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)(?:#([\w-]+))?\)")
PLACES = ("docs", "training", "configs/models")
CODE = {".conf", ".example", ".py", ".service", ".sh", ".toml", ".yaml", ".yml"}
PAGES = sorted(
    [*ROOT.glob("*.md"), *(page for top in PLACES for page in (ROOT / top).rglob("*.md"))]
)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as a Git host makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def defines(path: Path, name: str) -> bool:
    """Return whether a Python file defines a function or class of this name."""
    text = path.read_text(encoding="utf-8")
    return re.search(rf"^ *(?:async def|def|class) {name}\b", text, re.MULTILINE) is not None


def named(pattern: re.Pattern[str]) -> Iterator[tuple[Path, str, str]]:
    """Yield what the pages name: page, path and what is named in it."""
    for page in PAGES:
        for name, part in pattern.findall(page.read_text(encoding="utf-8")):
            yield page, name, part


def test_named_paths_exist() -> None:
    """The changelog speaks of the past and may name what is gone."""
    missing = []
    for page, name, function in named(PATH):
        found = [root / name for root in (ROOT, ROOT / "tests") if (root / name).exists()]
        if not found or (function and not defines(found[0], function)):
            missing.append(f"{page}: {name}::{function}")
    assert [line for line in missing if "CHANGELOG.md: " not in line] == []


def test_links_lead_somewhere() -> None:
    broken = []
    for page, target, anchor in named(LINK):
        path = (page.parent / target).resolve()
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path)):
            broken.append(f"{page}: {target}#{anchor}")
    assert broken == []


def test_pages_that_code_names_exist() -> None:
    """Error texts, comments and configuration files name pages, which move."""
    missing = []
    for folder in FOLDERS.split("|"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in CODE and path.is_file() and not path.is_symlink():
                named = re.findall(r"(?<![\w/])docs/[\w/-]+\.md", path.read_text(encoding="utf-8"))
                missing += [f"{path}: {name}" for name in named if not (ROOT / name).exists()]
    assert missing == []


def test_the_map_is_short() -> None:
    assert len((ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").splitlines()) <= 200


def test_decisions_are_titled_by_their_numbers() -> None:
    """Their list is made of the titles."""
    wrong = []
    for path in (ROOT / "docs/explanation/adr").glob("0*.md"):
        title = path.read_text(encoding="utf-8").partition("\n")[0]
        if not re.fullmatch(rf"# {int(path.name[:3])}\. .+", title):
            wrong.append(path.name)
    assert wrong == []


def test_every_sentence_of_the_design_records_has_one_place() -> None:
    """Code and its test, which `test_named_paths_exist` finds; a decision where it is missing."""
    text = (ROOT / "docs/explanation/records.md").read_text(encoding="utf-8")
    rows = re.findall(r"^- \*\*([EVRC][\w–, -]+)\*\* (.+(?:\n  .+)*)$", text, re.MULTILINE)
    found: list[str] = []
    for sentences, place in rows:
        for letter, first, last in re.findall(r"([EVR])(\d+)(?:–\1(\d+))?", sentences):
            found += [f"{letter}{number}" for number in range(int(first), int(last or first) + 1)]
        of_test = [path.startswith("tests/") for path, _ in PATH.findall(place)]
        assert set(of_test) == {False, True} or "(adr/" in place, sentences
    expected = {"E": 37, "V": 40, "R": 78}
    assert sorted(found) == sorted(f"{x}{n + 1}" for x in expected for n in range(expected[x]))


def test_every_page_is_on_the_site() -> None:
    """A page that mkdocs.yml does not name fails `make docs`; decisions are listed by their own
    page."""
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:\n")[1]
    named = set(re.findall(r"[\w/.-]+\.md", nav))
    pages = {
        page.relative_to(ROOT / "docs").as_posix()
        for page in PAGES
        if page.is_relative_to(ROOT / "docs")
    }
    decisions = {page for page in pages if re.search(r"adr/\d", page)}
    assert pages - decisions - named == set()
