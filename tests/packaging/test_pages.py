"""Pages name what exists: paths of the tree in the text, and the targets of relative links."""

import re
from pathlib import Path

import pytest

TREE = Path(__file__).parents[2]
FOLDERS = "arbiter|clients|schemas|sidecars|runner|reasoner|configs|examples|docs|tests|src"
PATH = re.compile(rf"`((?:{FOLDERS})/[\w./-]*|[\w-]+\.(?:md|toml|txt))(?:::\w+)?`")
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)(?:#([\w-]+))?\)")
PAGES = sorted([*TREE.glob("*.md"), *(TREE / "docs").rglob("*.md")])


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as a Git host makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(TREE)))
def test_named_paths_exist(page: Path) -> None:
    """The changelog speaks of the past and may name what is gone."""
    if page.name == "CHANGELOG.md":
        pytest.skip("history")
    text = page.read_text(encoding="utf-8")
    roots = (TREE, TREE / "tests")
    missing = [
        name for name in PATH.findall(text) if not any((root / name).exists() for root in roots)
    ]
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
