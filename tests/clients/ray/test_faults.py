"""Seeds over leased actors on real raylets, while nodes, arbiters and processes die or stand still.

Two boxes, each with an arbiter and a simulated GPU that holds one of its two actors' models.
"""

import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.boxes import MARKER, Box, Boxes
from tests.support.episodes import Player, freed_inside, noted
from tests.support.fakegpu_check import check_log
from vram_arbiter.clients.ray.mapping import Result, map_results
from vram_arbiter.clients.results import committed

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(600)]

SEEDS = 40
EPISODE_S = 0.1


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Boxes]:
    with Boxes(tmp_path_factory.mktemp("b"), nodes=2) as boxes:
        boxes.connect()
        yield boxes


@pytest.fixture
def notes(tmp_path: Path) -> Path:
    made = tmp_path / "notes"
    made.mkdir()
    return made


Make = Callable[[Box], Any]


@pytest.fixture
def player(notes: Path) -> Iterator[Make]:
    """`player(box)`: an actor on a box, which moves if the box is gone."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    made = []

    def make(box: Box) -> Any:
        where = NodeAffinitySchedulingStrategy(box.node_id, soft=True)
        actor = ray.remote(Player).options(  # type: ignore[attr-defined]
            num_cpus=0, resources={MARKER: 0.001}, scheduling_strategy=where,
            max_restarts=-1, max_task_retries=-1,
        ).remote(str(notes), EPISODE_S)  # fmt: skip
        made.append(actor)
        return actor

    yield make
    for actor in made:
        ray.kill(actor)


def pid_of(actor: Any) -> int:
    import ray

    pid: int = ray.get(actor.__ray_call__.remote(lambda self: os.getpid()))
    return pid


def play(
    actors: list[Any], out: Path, at: dict[int, Callable[[], object]], deadline_s: float = 60.0
) -> list[Result]:
    """Play all seeds; `at` says what happens when so many have results."""
    results: list[Result] = []

    def count(result: Result) -> None:
        results.append(result)
        at.get(len(results), lambda: None)()

    yielded = list(map_results(actors, "episode", range(SEEDS), out, deadline_s, count))
    assert yielded == results
    return results


def check_each_once(results: list[Result], out: Path) -> None:
    assert sorted(result.seed for result in results) == list(range(SEEDS))
    assert committed(out) == {
        result.seed: result.value for result in sorted(results, key=lambda one: one.seed)
    }


def check_gpus(boxes: Boxes, notes: Path) -> None:
    """No GPU was over its capacity, refused bytes, or was freed inside an episode."""
    folders = [box.gpu_folder for box in boxes.nodes]
    for folder in folders:
        report = check_log((folder / "log.jsonl").read_text())
        assert (report.problems, report.oom_events) == ([], 0)
    assert freed_inside(notes, folders) == []


def test_each_seed_once_and_models_take_turns_between_calls(
    boxes: Boxes, player: Make, notes: Path, tmp_path: Path
) -> None:
    actors = [player(box) for box in boxes.nodes for _ in range(2)]
    out = tmp_path / "out"
    results = play(actors, out, {})
    check_each_once(results, out)
    assert set(Counter(one["seed"] for one in noted(notes, "ended")).values()) == {1}
    assert {result.node for result in results} == {box.node_id for box in boxes.nodes}
    check_gpus(boxes, notes)
    assert list(map_results(actors, "episode", range(SEEDS), out, 60.0)) == []


def test_a_daemon_is_restarted_under_actors(
    boxes: Boxes, player: Make, notes: Path, tmp_path: Path
) -> None:
    def restart() -> None:
        boxes.nodes[1].daemon.kill()
        boxes.nodes[1].daemon.start()

    out = tmp_path / "out"
    actors = [player(box) for box in boxes.nodes]
    check_each_once(play(actors, out, {12: restart}), out)
    assert set(Counter(one["seed"] for one in noted(notes, "begun")).values()) == {1}
    check_gpus(boxes, notes)


def test_a_process_stands_still(boxes: Boxes, player: Make, notes: Path, tmp_path: Path) -> None:
    """Ray gives no error of it: its deadline ends it."""
    actors = [player(box) for box in boxes.nodes]
    pids = [pid_of(actor) for actor in actors]
    out = tmp_path / "out"
    stop = {12: lambda: os.kill(pids[1], signal.SIGSTOP)}
    check_each_once(play(actors, out, stop, deadline_s=5.0), out)
    check_gpus(boxes, notes)
    assert pid_of(actors[1]) != pids[1]


def test_a_node_and_its_arbiter_are_killed(
    boxes: Boxes, player: Make, notes: Path, tmp_path: Path
) -> None:
    killed_at: list[float] = []

    def kill() -> None:
        killed_at.append(time.monotonic())
        boxes.kill("n1")

    out = tmp_path / "out"
    actors = [player(box) for box in boxes.nodes]
    check_each_once(play(actors, out, {12: kill}), out)
    assert time.monotonic() - killed_at[0] < 120.0  # `make bench-fleet` measures it
    check_gpus(boxes, notes)
