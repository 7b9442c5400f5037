"""docs/explanation/neighbours.md names tests: each exists, every complaint has one, and every
test that carries a complaint's number is there or has a sibling."""

import ast
import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
PAGE = TESTS.parent / "docs/explanation/neighbours.md"
COMPLAINTS = 22


def rows() -> list[tuple[str, list[str]]]:
    """(first cell, tests) of every row that names tests."""
    found = []
    for line in PAGE.read_text().splitlines():
        if line.startswith("| ") and "::" in line:
            found.append((line.split("|")[1].strip(), re.findall(r"`([^`]+::[^`]+)`", line)))
    return found


def functions(path: Path) -> set[str]:
    tree = ast.parse(path.read_text())
    return {
        node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }


def test_every_test_that_the_page_names_exists() -> None:
    named = [name for _, names in rows() for name in names]
    assert len(named) > 80
    known: dict[str, set[str]] = {}
    missing = []
    for name in named:
        file, _, function = name.partition("::")
        if file not in known:
            path = TESTS / file
            known[file] = functions(path) if path.is_file() else set()
        if function not in known[file]:
            missing.append(name)
    assert not missing


def test_every_complaint_has_a_row_and_its_tests_carry_its_number() -> None:
    numbered = {int(first): True for first, _ in rows() if first.isdigit()}
    assert sorted(numbered) == list(range(1, COMPLAINTS + 1))
    for first, names in rows():
        for name in names:
            carried = re.search(r"::test_(\d+)_", name)
            assert carried is None or not first.isdigit() or carried[1] == first, name


@pytest.mark.parametrize(
    "path", sorted(TESTS.glob("**/test_neighbours*.py")), ids=lambda path: path.name
)
def test_every_test_of_a_complaint_is_on_the_page_or_beside_one_that_is(path: Path) -> None:
    named = {name for _, names in rows() for name in names}
    numbers = {number[1] for name in named if (number := re.search(r"::test_(\d+)_", name))}
    for function in functions(path):
        if carried := re.match(r"test_(\d+)_", function):
            assert carried[1] in numbers, f"{path.name}::{function}: its complaint has no row"


def test_the_pages_links_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)#]+)", PAGE.read_text()):
        assert (PAGE.parent / target).exists(), target
