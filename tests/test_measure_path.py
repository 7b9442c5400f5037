"""`tests/measure_path.py` measures one acquire with one eviction in real processes."""

from pathlib import Path

import pytest

from tests import measure_path

pytestmark = [pytest.mark.e2e, pytest.mark.nightly]


@pytest.fixture(scope="module")
def steps(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[measure_path.Step]]:
    folder: Path = tmp_path_factory.mktemp("path")
    return measure_path.record(folder)


def test_every_figure_is_measured(steps: dict[str, list[measure_path.Step]]) -> None:
    told = measure_path.figures(steps)
    assert told.keys() == {"daemon", "holder", "waiter", "path"}
    assert told["path"].keys() == measure_path.TARGETS.keys()
    assert all(count > 0 for counts in told.values() for count in counts.values())


def test_the_path_passes_the_engine_and_the_client(
    steps: dict[str, list[measure_path.Step]],
) -> None:
    assert any(name == "Arbiter.handle" for _, name, _ in steps["daemon"])
    assert any(file.startswith("clients/") for file, _, _ in steps["waiter"])
    assert all(not file.startswith(("arbiter/", "tests/")) for file, _, _ in steps["waiter"])


def test_the_figures_of_the_files_add_up(steps: dict[str, list[measure_path.Step]]) -> None:
    rows = measure_path.per_file(steps["daemon"])
    figures = measure_path.figures(steps)["daemon"]
    assert len(rows) == figures["files"]
    assert sum(functions for _, functions, _ in rows) == figures["functions"]
    assert sum(entries for _, _, entries in rows) == figures["switches"] + 1


def test_generator_expressions_and_lambdas_are_lines_of_their_function() -> None:
    path = [
        ("a.py", "f", 1),
        ("a.py", "f.<locals>.<genexpr>", 2),
        ("b.py", "g.<locals>.<lambda>", 9),
    ]
    figures = measure_path.figures({"waiter": path, "daemon": [], "holder": []})
    assert figures["path"]["functions"] == 1
    assert figures["path"]["switches"] == 1


def test_first_use_work_is_not_on_the_path(steps: dict[str, list[measure_path.Step]]) -> None:
    names = {name for side in steps.values() for _, name, _ in side}
    assert not [name for name in names if name == "<module>"]


def test_the_daemons_side_ends_with_the_event_of_the_grant() -> None:
    """Readings of the load that follows were counted too, as many as fitted."""
    event = [("arbiter/core/arbiter.py", "Arbiter.handle", 1), (*measure_path.GRANT, 2)]
    loop = (*measure_path.LOOP, 3)
    assert measure_path.until_granted([loop, *event, loop, *event, loop]) == [loop, *event]
    assert measure_path.until_granted([loop, *event]) == [loop, *event]
