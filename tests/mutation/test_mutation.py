"""The mutation check itself: a mutant takes its function's place, and what is judged to mean the
same does not count."""

import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.mutation import mutation_run as mutants_run
from vram_arbiter.arbiter.core.model.state import Timers

SOURCE = '''
class Gate:
    def __init__(self, width: int) -> None:
        self.width = width

    @property
    def wide(self) -> bool:
        return self.width > 3

def fits(gate: Gate, size: int) -> bool:
    """Words for people stay."""
    return size <= gate.width
'''


def load_runner(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def gates(tmp_path: Path) -> ModuleType:
    path = tmp_path / "gates.py"
    path.write_text(SOURCE)
    return load_runner(path)


def test_whoever_imported_the_function_has_the_mutant(gates: Any) -> None:
    fits, gate = gates.fits, gates.Gate(4)
    assert mutants_run.swap(gates, SOURCE.replace("<=", "<")) == 1
    assert not fits(gate, 4)
    assert mutants_run.swap(gates, SOURCE.replace("> 3", "> 4")) == 2, (
        "and the other one is as it was"
    )
    assert fits(gate, 4)
    assert not gate.wide


def test_a_change_that_changes_no_bytecode_has_no_effect(gates: Any) -> None:
    assert mutants_run.swap(gates, "\n" + SOURCE) == 0


def test_mutants_have_names_lines_and_diffs(tmp_path: Path) -> None:
    pytest.importorskip("mutmut", reason="make mutation installs it")
    (tmp_path / "gates.py").write_text(SOURCE)
    existing, mutants = mutants_run.choose(0, 0, {}, tmp_path)
    assert existing == len(mutants) == 2, "decorated functions stay as they are"
    found = next(mutant for mutant in mutants if "size < gate.width" in mutant.diff)
    assert found.where == "gates.fits"
    assert 12 in found.lines
    assert not any("XX" in mutant.diff for mutant in mutants)
    _, again = mutants_run.choose(0, 0, {"gates.fits:99": found.diff, "gates.gone:1": ""}, tmp_path)
    assert [mutant.diff for mutant in again] == [found.diff]
    assert mutants_run.choose(2, 5, {}, tmp_path)[1] == mutants_run.choose(2, 5, {}, tmp_path)[1]


def test_only_the_very_change_that_was_judged_counts_as_equivalent() -> None:
    def tried(diff: str, outcome: str) -> Any:
        return mutants_run.Mutant("gates.fits:1", "gates", [12], diff, "", outcome)

    known = [{"where": "gates.fits", "diff": "-a\n+b", "why": "they are the same"}]
    report = mutants_run.summary_of(
        9, [tried("-a\n+b", "survived"), tried("-a\n+c", "survived"), tried("-a", "killed")], known
    )
    assert (report["killed"], report["survived"], report["equivalent"]) == (1, 1, 1)
    assert report["score"] == 0.5
    assert [survivor["diff"] for survivor in report["survivors"]] == ["-a\n+c"]


def test_the_lines_that_a_test_comes_by_are_seen_though_the_engine_is_imported_by_links() -> None:
    """No line was seen since the product is imported from `src`: every mutant ended in an error of
    this tool, which counted as killed, and the score was always 100 %."""
    coverage = mutants_run.Coverage()
    try:
        Timers().set(("ttl", "a"), 1.0)
        coverage.pytest_runtest_logfinish("a test")
    finally:
        sys.monitoring.set_events(sys.monitoring.COVERAGE_ID, 0)
        sys.monitoring.free_tool_id(sys.monitoring.COVERAGE_ID)
    assert any(line.startswith("state:") for line in coverage.tests)


@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")  # it forks on purpose
def test_a_mutant_that_no_test_comes_by_survives(tmp_path: Path) -> None:
    """As above: without tests the trial ended in an error."""
    if not (pid := os.fork()):
        mutants_run.Trials([], 1, tmp_path)._run([], None)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == mutants_run.SURVIVED


@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")  # it forks on purpose
def test_an_exploration_kills_what_no_test_comes_by(tmp_path: Path) -> None:
    """An acquire that waits in no queue is found within the first events of the first world."""
    source = (mutants_run.CORE / "requests/requests.py").read_text()
    mutated = source.replace("core.enqueue(_new_lease(", "id(_new_lease(")
    mutant = mutants_run.Mutant("requests.acquire:1", "requests", [], "", mutated)
    if not (pid := os.fork()):
        mutants_run.Trials([], 1, tmp_path, explore_s=1e6)._run([], mutant)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == mutants_run.KILLED
    assert (tmp_path / str(pid)).read_text().startswith("explore turns: ")
