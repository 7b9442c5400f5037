"""Pages name what exists: paths and functions of the tree, and the targets of relative links."""

import re
from pathlib import Path

import pytest

TREE = Path(__file__).parents[2]
FOLDERS = "arbiter|clients|schemas|sidecars|runner|reasoner|configs|examples|docs|tests|src"
PATH = re.compile(rf"`((?:{FOLDERS})/[\w./-]*|[\w-]+\.(?:md|toml|txt))(?:::(\w+))?`")
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)(?:#([\w-]+))?\)")
PAGES = sorted([*TREE.glob("*.md"), *(TREE / "docs").rglob("*.md")])


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as a Git host makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def defines(path: Path, name: str) -> bool:
    """Return whether a Python file defines a function or class of this name."""
    text = path.read_text(encoding="utf-8")
    return re.search(rf"^ *(?:async def|def|class) {name}\b", text, re.MULTILINE) is not None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(TREE)))
def test_named_paths_exist(page: Path) -> None:
    """The changelog speaks of the past and may name what is gone."""
    if page.name == "CHANGELOG.md":
        pytest.skip("history")
    missing = []
    for name, function in PATH.findall(page.read_text(encoding="utf-8")):
        found = [root / name for root in (TREE, TREE / "tests") if (root / name).exists()]
        if not found or (function and not defines(found[0], function)):
            missing.append(f"{name}::{function}")
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(TREE)))
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for target, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        path = (page.parent / target).resolve()
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path)):
            broken.append(f"{target}#{anchor}")
    assert not broken


def test_the_map_is_short() -> None:
    assert len((TREE / "ARCHITECTURE.md").read_text(encoding="utf-8").splitlines()) <= 200


def test_every_decision_is_listed() -> None:
    listed = (TREE / "docs/adr/README.md").read_text(encoding="utf-8")
    assert [
        path.name for path in (TREE / "docs/adr").glob("0*.md") if path.name not in listed
    ] == []
