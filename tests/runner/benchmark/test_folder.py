"""Folder of a run: of one run's flags, and of what was played."""

import argparse
import json
from pathlib import Path

import pytest

from vram_arbiter.clients.results import commit
from vram_arbiter.runner.benchmark import folder
from vram_arbiter.runner.benchmark.outcomes import Cell, SeedOutcome, unplayed
from vram_arbiter.schemas.errors import ConfigError


def args(**other: object) -> argparse.Namespace:
    flags: dict[str, object] = {
        "skill": [], "policy": ["random"], "scene": [], "task": None, "seed": 0, "episodes": 10,
        "max_steps": 600, "latency_steps": None, "real_time": False, "record": None,
    }  # fmt: skip
    return argparse.Namespace(**flags | other)


def cell() -> Cell:
    return Cell("so101", "random", "grab")


def test_a_folder_with_results_is_of_one_runs_flags(tmp_path: Path) -> None:
    flags = folder.flags_of(args(), [])
    folder.claim(tmp_path, flags)
    commit(tmp_path / folder.RESULTS / cell().name, 0, {})
    folder.claim(tmp_path, flags)
    others = folder.flags_of(args(episodes=20, seed=5), [])
    with pytest.raises(
        ConfigError, match="results of another run: --seed 0, not 5; --episodes 10, not 20"
    ):
        folder.claim(tmp_path, others)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["results", "run.json"]


def test_a_folder_without_results_is_anyones(tmp_path: Path) -> None:
    folder.claim(tmp_path, folder.flags_of(args(), []))
    folder.claim(tmp_path, folder.flags_of(args(episodes=20), []))
    assert json.loads((tmp_path / folder.RUN).read_text())["--episodes"] == 20


@pytest.mark.parametrize("text", ["", "[]"])
def test_a_file_that_is_not_of_a_run_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / folder.RUN).write_text(text)
    commit(tmp_path / folder.RESULTS / cell().name, 0, {})
    with pytest.raises(ConfigError, match="is not of a run"):
        folder.claim(tmp_path, folder.flags_of(args(), []))


def test_a_changed_scene_or_script_is_another_run(tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text("{}")
    given = args(scene=[scene], policy=[f"scripted:{scene}"])
    before = folder.flags_of(given, [])
    scene.write_text("{} # changed")
    after = folder.flags_of(given, [])
    assert {name for name in after if after[name] != before[name]} == {"--scene", "--policy"}


def test_what_has_no_verdict_is_played_again(tmp_path: Path) -> None:
    one = cell()
    for played in (SeedOutcome(7, True), unplayed(8, "no sidecar"), SeedOutcome(9, False)):
        folder.keep(folder.results(tmp_path, one), played)
    folder.keep(folder.results(tmp_path, one), SeedOutcome(9, True))  # it has a result already
    assert folder.take_up(tmp_path, one, range(7, 11)) == [8, 10]
    folder.keep(folder.results(tmp_path, one), SeedOutcome(8, True))
    folder.read(tmp_path, one)
    assert [(e.seed, e.success) for e in one.episodes] == [(7, True), (8, True), (9, False)]


def test_a_result_of_something_else_is_named(tmp_path: Path) -> None:
    commit(folder.results(tmp_path, cell()), 1, {"color": "red"})
    with pytest.raises(ConfigError, match="results of another version"):
        folder.take_up(tmp_path, cell(), [])
