"""Boxes of a fleet play as local processes do: a fleet in this process, and real raylets."""

import json
import os
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vram_arbiter.clients.ray.mapping import Result, SeedsFailed
from vram_arbiter.clients.results import commit
from vram_arbiter.runner.__main__ import main
from vram_arbiter.runner.benchmark import boxes, folder
from vram_arbiter.runner.benchmark.outcomes import SeedOutcome
from vram_arbiter.schemas.errors import ConfigError, VramError

pytestmark = pytest.mark.heavy


class Actor:
    """An object as an actor, whose methods return futures, and fail where it could not be made."""

    def __init__(self, cls: Any, arguments: Sequence[Any]) -> None:
        self.made, self.error = None, None
        try:
            self.made = cls(*arguments)
        except VramError as error:
            self.error = RuntimeError(
                f"Traceback:\n  in __init__\n{type(error).__name__}: {error}\n"
            )

    def __getattr__(self, method: str) -> Any:
        def remote(*arguments: Any) -> Any:
            future = Future[Any]()
            if self.error is not None:
                future.set_exception(self.error)
            else:
                ready = method == "__ray_ready__"
                future.set_result(ready or getattr(self.made, method)(*arguments))
            return SimpleNamespace(future=lambda: future)

        return SimpleNamespace(remote=remote)


class Here:
    """A fleet of one box in this process, where `failing` seeds have no result."""

    def __init__(self, failing: Sequence[int] = ()) -> None:
        self._failing = failing

    def boxes(self) -> dict[str, str]:
        return {"id": "here"}

    def spread(self, cls: Any, *args: Any, per_node: int, nodes: Sequence[str]) -> list[Any]:
        return [Actor(cls, args) for _ in nodes for _ in range(per_node)]

    def map(
        self,
        actors: Sequence[Any],
        method: str,
        seeds: Iterable[int],
        *,
        out: Path,
        deadline_s: float,
    ) -> Iterator[Result]:
        for seed in seeds:
            if seed not in self._failing:
                value = getattr(actors[seed % len(actors)].made, method)(seed)
                assert commit(out, seed, value)
                yield Result(seed, "id", value)
        if self._failing:
            details = {"failed": {str(seed): "no answer" for seed in self._failing}}
            raise SeedsFailed("seeds have no result", details=details)


def episodes(out: Path) -> list[dict[str, Any]]:
    (cell,) = json.loads((out / "benchmark.json").read_text(encoding="utf-8"))["cells"]
    found: list[dict[str, Any]] = cell["episodes"]
    return found


def test_outcomes_are_told_and_lost_seeds_are_errors(tmp_path: Path, run_async: Any) -> None:
    argv = ["benchmark", "--policy", "random", "--max-steps", "2", "--no-videos"]
    told: list[SeedOutcome] = []
    fleet: Any = Here(failing=[1])
    players = boxes.Boxes(fleet, argv, 2, 60.0)
    run_async(players.play(0, [0, 1, 2], tmp_path, told.append))
    assert [(one.seed, one.success, one.message) for one in told] == [
        (0, False, ""),
        (2, False, ""),
        (1, None, "no answer"),
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "00000.json",
        "00001.json",
        "00002.json",
    ]


def test_without_a_box_that_can_play_seeds_are_errors(tmp_path: Path, run_async: Any) -> None:
    """Without an arbiter a box started its sidecar, whose exit code was the only reason given."""
    argv = ["benchmark", "--skill", "vram-arbiter/so101-navigate", "--no-videos"]
    argv += ["--arbiter", f"ipc://{tmp_path}/none.sock", "--sidecar", "so101-grab"]
    told: list[SeedOutcome] = []
    fleet: Any = Here()
    run_async(boxes.Boxes(fleet, argv, 1, 60.0).play(0, [0, 1], tmp_path / "out", told.append))
    assert [one.success for one in told] == [None, None]
    assert told[0].message.startswith("ArbiterUnreachable: ")


def test_boxes_that_never_begin_are_waited_for_as_long_as_an_episode(
    tmp_path: Path, run_async: Any
) -> None:
    """The command waited for ever where the only box stood still."""

    class Standing:
        def __getattr__(self, method: str) -> Any:
            future = Future[Any]()
            if method == "close":
                future.set_result(None)
            return SimpleNamespace(remote=lambda: SimpleNamespace(future=lambda: future))

    fleet: Any = SimpleNamespace(
        boxes=lambda: {"id": "here"}, spread=lambda *args, **named: [Standing()]
    )
    told: list[SeedOutcome] = []
    run_async(boxes.Boxes(fleet, [], 1, 0.01).play(0, [0], tmp_path, told.append))
    assert told[0].message == "no box could begin within 0.01 s"


def test_a_box_without_the_runs_folders_says_so(tmp_path: Path) -> None:
    argv = ["benchmark", "--policy", "random", "--out", str(tmp_path)]
    with pytest.raises(ConfigError, match="is not on this box"):
        boxes.Worker(argv, 0, str(tmp_path / "none"))
    with pytest.raises(ConfigError, match=r"of this box is another folder \(start it in a folder"):
        boxes.Worker(argv, 0, os.getcwd())
    assert not (tmp_path / folder.RUN).exists()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--record", "set"], "one local worker"),
        (["--workers", "2", "--sidecar", "so101-grab"], "does not start the sidecar"),
    ],
)
def test_what_boxes_cannot_do_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], said: str
) -> None:
    argv = ["benchmark", "--policy", "random", "--ray", "auto", "--out", str(tmp_path), *flags]
    assert main(argv) == 2
    assert said in capsys.readouterr().err


@pytest.mark.nightly
@pytest.mark.timeout(600)
@pytest.mark.usefixtures("forked_workers")
def test_raylets_play_what_local_processes_do_and_a_dead_box_costs_no_seed(
    short_folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from tests.support.boxes import Boxes
    from tests.support.waiting import until

    local, away = tmp_path / "local", tmp_path / "away"
    flags = ["benchmark", "--policy", "expert", "--max-steps", "45", "--episodes", "6"]
    assert main([*flags, "--out", str(local)]) == 0
    table = capfd.readouterr().out.replace(str(local), "")
    with Boxes(short_folder, nodes=2) as fleet:

        def kill() -> None:
            until(lambda: any(away.glob("results/*/*.json")), deadline_s=300)
            fleet.kill(fleet.nodes[1].name)

        killing = threading.Thread(target=kill)
        killing.start()
        try:
            assert main([*flags, "--ray", fleet.address, "--out", str(away)]) == 0
        finally:
            killing.join()
    assert capfd.readouterr().out.replace(str(away), "") == table
    assert [(e["seed"], e["success"], e["steps"]) for e in episodes(away)] == [
        (e["seed"], e["success"], e["steps"]) for e in episodes(local)
    ]
    assert all((away / e["video"]).stat().st_size for e in episodes(away))


@pytest.mark.nightly
@pytest.mark.timeout(600)
def test_without_a_box_that_can_play_the_seeds_say_why(short_folder: Path, tmp_path: Path) -> None:
    from tests.support.boxes import Boxes

    skill = ["--skill", "vram-arbiter/so101-navigate", "--arbiter", f"ipc://{tmp_path}/none.sock"]
    with Boxes(short_folder, nodes=1) as fleet:
        argv = ["benchmark", *skill, "--ray", fleet.address, "--out", str(tmp_path / "out")]
        assert main(argv) == 1
    assert "ArbiterUnreachable" in episodes(tmp_path / "out")[0]["message"]


@pytest.mark.nightly
@pytest.mark.timeout(600)
@pytest.mark.usefixtures("forked_workers")
def test_each_box_starts_the_sidecar_and_its_model_gives_the_same_table(
    short_folder: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from tests.support.boxes import Boxes
    from tests.support.waiting import until
    from vram_arbiter.clients.sync import Client
    from vram_arbiter.testing.timeline import Timeline

    local, away = tmp_path / "local", tmp_path / "away"
    flags = ["benchmark", "--skill", "vram-arbiter/so101-grab", "--sidecar", "so101-grab"]
    flags += ["--max-steps", "60", "--episodes", "4", "--no-videos"]
    with Boxes(short_folder, nodes=2) as fleet:
        assert main([*flags, "--ray", fleet.address, "--out", str(away)]) == 0
        table = capfd.readouterr().out.replace(str(away), "")
        for box in fleet.nodes:
            granted = [one["consumer"] for one in Timeline(box.daemon).events("granted")]
            assert "grab" in granted
            assert Timeline(box.daemon).events("use_began")
            with Client("test", endpoint=box.daemon.endpoint) as arbiter:
                until(lambda arbiter=arbiter: not arbiter.status().leases)
        for name, value in fleet.nodes[0].environ.items():
            monkeypatch.setenv(name, value)
        assert main([*flags, "--out", str(local)]) == 0
    assert capfd.readouterr().out.replace(str(local), "") == table
    assert [(e["seed"], e["success"], e["steps"]) for e in episodes(away)] == [
        (e["seed"], e["success"], e["steps"]) for e in episodes(local)
    ]
