"""Seeds over leased actors on real raylets, while nodes, arbiters and processes die or stand still.

Two boxes, each with an arbiter and a simulated GPU that holds one of its two actors' models.
"""

import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from tests.support.boxes import MARKER, Boxes
from tests.support.episodes import Fragile, Player, freed_inside, noted
from tests.support.fakegpu_check import check_log
from tests.support.processes import alive
from tests.support.waiting import until
from vram_arbiter.clients.ray import Fleet, leased
from vram_arbiter.clients.ray.mapping import Result, SeedsFailed, map_results
from vram_arbiter.clients.results import committed
from vram_arbiter.clients.sync import Client
from vram_arbiter.testing.timeline import Timeline

pytestmark = [pytest.mark.heavy, pytest.mark.nightly, pytest.mark.timeout(600)]

SEEDS = 40
EPISODE_S = 0.1


@pytest.fixture
def notes(tmp_path: Path) -> Path:
    made = tmp_path / "notes"
    made.mkdir()
    return made


Start = Callable[[int], list[Any]]


@pytest.fixture
def start_actors(boxes: Boxes, notes: Path) -> Iterator[Start]:
    """`start(per_node)`: actors of each box, in the boxes' order; they move if theirs is gone."""
    import ray

    made = []
    with Fleet() as fleet:

        def start_actors(per_node: int) -> list[Any]:
            for box in boxes.nodes:
                where = {"per_node": per_node, "nodes": [box.node_id]}
                made.extend(fleet.spread(Player, str(notes), EPISODE_S, **where))
            return made

        yield start_actors
    for actor in made:
        ray.kill(actor)


def pid_of(actor: Any) -> int:
    import ray

    call = actor.__ray_call__.options(max_task_retries=-1)
    pid: int = ray.get(call.remote(lambda self: os.getpid()))
    return pid


def play_seeds(
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
    boxes: Boxes, start_actors: Start, notes: Path, tmp_path: Path
) -> None:
    actors = start_actors(2)
    out = tmp_path / "out"
    results = play_seeds(actors, out, {})
    check_each_once(results, out)
    assert set(Counter(one["seed"] for one in noted(notes, "ended")).values()) == {1}
    assert {result.node for result in results} == {box.node_id for box in boxes.nodes}
    check_gpus(boxes, notes)
    assert list(map_results(actors, "episode", range(SEEDS), out, 60.0)) == []


def test_a_daemon_is_restarted_under_actors(
    boxes: Boxes, start_actors: Start, notes: Path, tmp_path: Path
) -> None:
    def restart() -> None:
        boxes.nodes[1].daemon.kill()
        boxes.nodes[1].daemon.start()

    out = tmp_path / "out"
    actors = start_actors(1)
    check_each_once(play_seeds(actors, out, {12: restart}), out)
    assert set(Counter(one["seed"] for one in noted(notes, "begun")).values()) == {1}
    check_gpus(boxes, notes)


def test_a_process_stands_still(
    boxes: Boxes, start_actors: Start, notes: Path, tmp_path: Path
) -> None:
    """Ray gives no error of it: its deadline ends it."""
    actors = start_actors(1)
    pid, out = pid_of(actors[1]), tmp_path / "out"
    with ThreadPoolExecutor(1) as pool:
        frozen = pool.submit(until, lambda: frozen_inside(notes, pid))
        check_each_once(play_seeds(actors, out, {}, deadline_s=5.0), out)
        assert frozen.result()
    until(lambda: not alive(pid))
    check_gpus(boxes, notes)
    assert pid_of(actors[1]) != pid


def frozen_inside(notes: Path, pid: int) -> bool:
    """Stop a process; it goes on if that was not inside an episode."""

    def inside() -> bool:
        return [one["pid"] for what in ("begun", "ended") for one in noted(notes, what)].count(
            pid
        ) % 2 == 1

    if not inside():
        return False
    os.kill(pid, signal.SIGSTOP)
    if not inside():
        os.kill(pid, signal.SIGCONT)
        return False
    return True


def test_a_leased_task_ends_with_its_lease(boxes: Boxes) -> None:
    import ray

    def job() -> int:
        return os.getpid()

    task: Any = leased(vram="5GiB", model="job")(ray.remote(max_calls=1)(job))
    pids = [ray.get(task.options(resources={MARKER: 0.001}).remote()) for _ in range(2)]
    assert pids[0] != pids[1]
    for box in boxes.nodes:
        with Client("test", endpoint=box.daemon.endpoint) as arbiter:
            until(lambda arbiter=arbiter: not arbiter.status().leases)
    granted = [one for box in boxes.nodes for one in Timeline(box.daemon).events("granted")]
    consumers = {one["consumer"] for one in granted}
    assert {f"job-{pid}" for pid in pids} <= consumers


def test_seeds_without_a_result_are_named(boxes: Boxes, tmp_path: Path) -> None:
    results: list[Result] = []
    with Fleet() as fleet:
        played = fleet.map(
            fleet.spread(Fragile), "episode", range(6), out=tmp_path, deadline_s=60.0,
            on_result=results.append,
        )  # fmt: skip
        with pytest.raises(SeedsFailed, match="3 seeds have no result") as failed:
            list(played)
    assert sorted(result.seed for result in results) == [0, 4, 5]
    told = failed.value.details["failed"]
    assert told["1"] == "ValueError: no such scene"
    assert told["2"].startswith("Actor")
    assert told["2"].endswith("(3 times)")
    assert told["3"].startswith("TypeError: ")


def test_a_node_and_its_arbiter_are_killed(
    boxes: Boxes, start_actors: Start, notes: Path, tmp_path: Path
) -> None:
    killed_at: list[float] = []

    def kill() -> None:
        killed_at.append(time.monotonic())
        boxes.kill("n1")

    out = tmp_path / "out"
    actors = start_actors(1)
    check_each_once(play_seeds(actors, out, {12: kill}), out)
    assert time.monotonic() - killed_at[0] < 120.0  # `make bench-fleet` measures it
    check_gpus(boxes, notes)
