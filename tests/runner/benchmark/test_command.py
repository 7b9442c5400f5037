"""`vram-runner benchmark`: contestants and seeds, recordings, mistakes, and a report whatever
happens; each seed counts once, whatever dies, with any number of workers.
"""

import argparse
import json
import os
import signal
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.support import prepared
from tests.support.waiting import until
from vram_arbiter.runner.__main__ import main
from vram_arbiter.runner.benchmark.entries import entries_of
from vram_arbiter.runner.benchmark.outcomes import SeedOutcome
from vram_arbiter.runner.benchmark.processes import Processes
from vram_arbiter.runner.cli.benchmark import add_parser
from vram_arbiter.runner.recording.reader import read_frame
from vram_arbiter.runner.sim.config import SceneConfig
from vram_arbiter.schemas.errors import UnknownSkill

ROOT = Path(__file__).parents[3]
FATED = f"scripted:{Path(__file__).parent}/fated.py"
LOST = f"scripted:{Path(__file__).parents[1]}/lost.py"

pytestmark = pytest.mark.usefixtures("forked_workers")


def report(out: Path) -> Any:
    return json.loads((out / "benchmark.json").read_text(encoding="utf-8"))


@pytest.mark.heavy
def test_contestants_and_seeds_make_a_report_a_table_and_videos(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import imageio_ffmpeg

    flags = ["--episodes", "2", "--seed", "12", "--max-steps", "9", "--out", str(tmp_path)]
    assert main(["benchmark", "--policy", "random", "--policy", LOST, *flags]) == 0
    cells = report(tmp_path)["cells"]
    assert [(c["world"], c["contestant"], c["successes"], c["judged"]) for c in cells] == [
        ("so101", "random", 0, 2),
        ("so101", LOST, 0, 2),
    ]
    assert [e["error"] for e in cells[1]["episodes"]] == ["", "model_error"]
    episodes = cells[0]["episodes"]
    assert [played["steps"] for played in episodes] == [9, 9]
    frames = [
        imageio_ffmpeg.count_frames_and_secs(tmp_path / played["video"])[0] for played in episodes
    ]
    assert frames == [3, 3], "every third tick"
    assert "0/2 = 0%  0% to 66%" in capsys.readouterr().out


@pytest.mark.heavy
@pytest.mark.timeout(600)
@pytest.mark.usefixtures("forked_writers")
def test_the_expert_in_our_own_scene_is_recorded(tmp_path: Path) -> None:
    common = ["benchmark", "--no-arbiter", "--no-videos", "--out", str(tmp_path)]
    grabs = ["--policy", "expert", "--episodes", "1", "--max-steps", "150"]
    assert main([*common, *grabs, "--record", str(tmp_path / "set")]) == 0
    (cell,) = report(tmp_path)["cells"]
    assert (cell["task"], cell["success_rate"], cell["complete"]) == ("grab", 1.0, True)
    (played,) = cell["episodes"]
    last = read_frame(tmp_path / "set", played["steps"] - 1)
    assert (last.tick["success"], last.goal["skill"]) == (True, "expert")
    assert last.task.startswith("grab the ")
    assert main([*common, *grabs, "--policy", "random", "--record", str(tmp_path / "set")]) == 2


@pytest.mark.heavy
@pytest.mark.timeout(600)
@pytest.mark.usefixtures("forked_writers")
def test_a_benchmark_ends_with_the_first_episode_that_is_not_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Regression: all episodes were played for a dataset that took none of them."""
    scene, larger = tmp_path / "scene.yaml", SceneConfig().model_dump(mode="json")
    larger["cameras"]["wrist"]["width_px"] = 161  # no video has it
    scene.write_text(json.dumps(larger), encoding="utf-8")
    flags = ["--scene", str(scene), "--max-steps", "2", "--episodes", "1000000", "--no-videos"]
    recorded = ["--record", str(tmp_path / "set"), "--out", str(tmp_path)]
    assert main(["benchmark", "--policy", "random", *flags, *recorded]) == 2
    assert "a video needs even numbers" in capsys.readouterr().err


@pytest.mark.heavy
def test_a_skill_in_our_own_scene(tmp_path: Path) -> None:
    common = ["benchmark", "--no-arbiter", "--no-videos", "--out", str(tmp_path)]
    assert main([*common, "--skill", "vram-arbiter/so101-navigate", "--episodes", "2"]) == 0
    (cell,) = report(tmp_path)["cells"]
    told = (cell["world"], cell["task"], cell["successes"], cell["judged"])
    assert told == ("so101", "navigate", 2, 2)
    assert cell["revision"]
    assert all(played["steps"] > 10 and played["video"] is None for played in cell["episodes"])


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ([], "expected --skill RSKILL or --policy NAME"),
        (["--policy", "clever"], "clever"),
        (["--policy", "scripted:none.py"], "none.py"),
        (["--policy", f"scripted:{ROOT}/tests/support/waiting.py"], "make(env, seed)"),
        (["--skill", "nobody/nothing"], "nobody/nothing"),
        (["--skill", "vram-arbiter/so101-detector"], "cannot be executed"),
        (["--policy", "random", "--task", "cook"], "cook"),
        (["--policy", "expert", "--task", "navigate"], "expert"),
        (["--policy", "random", "--env", "pusht"], "give --skill"),
        (["--skill", "vram-arbiter/so101-navigate", "--env", "pusht"], "no policy of that name"),
        pytest.param(
            ["--skill", "vram-arbiter/so101-grab", "--env", "libero"],
            "in an environment of its own",
            marks=pytest.mark.skipif(find_spec("libero") is not None, reason="LIBERO is here"),
        ),
    ],
)
def test_mistakes_are_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], said: str
) -> None:
    assert main(["benchmark", "--no-arbiter", "--out", str(tmp_path), *flags]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told
    assert len(told.splitlines()) == 1


@pytest.mark.heavy
@pytest.mark.parametrize(
    "argv",
    [
        ["sim", "--rate", "0", "--no-arbiter", "--timings", "{}/t.jsonl"],
        ["sim", "--rate", "0", "--no-arbiter", "--video", "{}/v.mp4"],
        ["benchmark", "--episodes", "1", "--max-steps", "1", "--policy", "random", "--out", "{}"],
    ],
)
def test_a_file_that_cannot_be_written_is_said_in_one_line_before_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], argv: list[str]
) -> None:
    """Regression: output paths were checked when they were written, after hours of running."""
    (tmp_path / "file").write_text("no folder", encoding="utf-8")
    words = [word.format(tmp_path / "file") for word in argv]
    there = ["--endpoint", f"ipc://{tmp_path}/r.sock"] if argv[0] == "sim" else []
    assert main([*words, *there]) in (1, 2)
    out, said = capsys.readouterr()
    assert out == ""
    assert "cannot be written" in said
    assert "Traceback" not in said


@pytest.mark.heavy
def test_a_skill_needs_a_license_that_allows_commercial_use(tmp_path: Path) -> None:
    """Regression: `benchmark` ran what `deploy` refuses."""
    grab = (ROOT / "configs/rskills/so101-grab/rskill.yaml").read_text(encoding="utf-8")
    closed = grab.replace("apache-2.0", "nvidia_non_commercial")
    assert closed != grab
    (tmp_path / "rskill.yaml").write_text(closed, encoding="utf-8")
    parser = argparse.ArgumentParser()
    parser = add_parser(parser.add_subparsers())
    flags = ["--skills", str(tmp_path), "--skill", "vram-arbiter/so101-grab", "--no-videos"]
    with pytest.raises(UnknownSkill, match=r"license \(nvidia_non_commercial\)"):
        entries_of(parser.parse_args(flags), None)
    (entry,) = entries_of(parser.parse_args([*flags, "--allow-noncommercial"]), None)
    assert entry.name == "vram-arbiter/so101-grab"


@pytest.mark.heavy
def test_two_cells_of_one_name_do_not_overwrite_each_others_videos(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Regression: scenes of one file name in different folders shared their videos and their
    row.
    """
    scenes = [tmp_path / folder / "table.yaml" for folder in ("near", "far")]
    for scene in scenes:
        scene.parent.mkdir()
        scene.write_text("{}\n", encoding="utf-8")
    flags = [word for scene in scenes for word in ("--scene", str(scene))]
    out = tmp_path / "out"
    argv = ["benchmark", "--no-arbiter", "--policy", "random", *flags, "--out", str(out)]
    assert main(argv) == 2
    assert "would have one name" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.heavy
@pytest.mark.e2e
def test_a_signal_ends_it_with_a_report_of_what_was_played(tmp_path: Path) -> None:
    argv = [
        *("benchmark", "--policy", "random", "--no-videos", "--max-steps", "2"),
        *("--episodes", "1000000", "--out", str(tmp_path)),
    ]
    said, says = os.pipe()
    with (tmp_path / "printed").open("wb") as printed:
        process = prepared.start("vram-runner", argv, os.environ, printed.fileno(), says, cwd=ROOT)
    os.close(says)
    try:
        with open(said) as errors:
            while "seed 3:" not in (line := errors.readline()):
                assert line, "it ended by itself"
            process.terminate()
            errors.read()
        assert process.wait(60) == 1
    finally:
        process.kill()
    assert "not complete: stopped" in (tmp_path / "printed").read_text()
    written = report(tmp_path)
    assert (written["complete"], written["cells"][0]["complete"]) == (False, False)
    assert written["cells"][0]["played"] >= 4


# -- workers that die, and runs that go on
@pytest.fixture
def notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """File of the seeds that the policy `fated` began."""
    monkeypatch.setenv("NOTES", str(tmp_path / "notes"))
    return tmp_path / "notes"


def begun(notes: Path) -> list[int]:
    return sorted(map(int, notes.read_text(encoding="utf-8").split()))


def fated(out: Path, episodes: int, *more: str) -> list[str]:
    return [
        *("benchmark", "--policy", FATED, "--episodes", str(episodes)),
        *("--max-steps", "1000000", "--no-videos", "--out", str(out), *more),
    ]


@pytest.mark.heavy
def test_a_killed_worker_costs_no_seed(
    tmp_path: Path, notes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FATES", json.dumps({3: (signal.SIGKILL, 1)}))
    assert main(fated(tmp_path / "out", 6, "--workers", "2")) == 0
    assert begun(notes) == [0, 1, 2, 3, 3, 4, 5]
    (cell,) = report(tmp_path / "out")["cells"]
    assert [e["seed"] for e in cell["episodes"]] == list(range(6))
    assert (cell["judged"], cell["errors"]) == (6, 0)


@pytest.mark.heavy
def test_a_seed_that_kills_its_workers_is_an_error_and_alone_is_played_again(
    tmp_path: Path,
    notes: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """What a lack of memory does to one seed: it is never left out silently."""
    monkeypatch.setenv("FATES", json.dumps({1: (signal.SIGKILL, 3)}))
    command = fated(tmp_path / "out", 3)
    assert main(command) == 1
    (cell,) = report(tmp_path / "out")["cells"]
    assert (cell["judged"], cell["errors"], cell["complete"]) == (2, 1, True)
    assert cell["episodes"][1]["message"] == "its worker ended with -9 (3 times)"
    assert "its worker ended with -9" in (tmp_path / "out/report.html").read_text(encoding="utf-8")
    assert main(command) == 0
    assert begun(notes) == [0, 1, 1, 1, 1, 2]
    assert main(command) == 0
    assert begun(notes) == [0, 1, 1, 1, 1, 2]
    capsys.readouterr()
    assert main(fated(tmp_path / "out", 4)) == 2
    assert "--episodes 3, not 4" in capsys.readouterr().err


@pytest.mark.heavy
@pytest.mark.e2e
def test_a_killed_run_goes_on_with_what_is_missing(
    tmp_path: Path, notes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = fated(tmp_path / "out", 6)
    monkeypatch.setenv("FATES", json.dumps({4: (0, 1)}))
    said, says = os.pipe()
    with open(said) as errors:
        with (tmp_path / "printed").open("wb") as printed:
            process = prepared.start(
                "vram-runner", command, os.environ, printed.fileno(), says, cwd=ROOT
            )
        os.close(says)
        try:
            until(lambda: notes.exists() and 4 in begun(notes), deadline_s=60)
        finally:
            process.kill()
        errors.read()  # its worker ends, too
    assert main(command) == 0
    assert begun(notes) == [0, 1, 2, 3, 4, 4, 5]
    assert [e["seed"] for e in report(tmp_path / "out")["cells"][0]["episodes"]] == list(range(6))


@pytest.mark.heavy
def test_a_worker_that_stands_still_is_killed_at_its_deadline(
    tmp_path: Path, notes: Path, monkeypatch: pytest.MonkeyPatch, run_async: Callable[[Any], Any]
) -> None:
    monkeypatch.setenv("FATES", json.dumps({1: (signal.SIGSTOP, 1)}))
    told: list[SeedOutcome] = []
    players = Processes(fated(tmp_path / "out", 2), 1, 8.0)
    run_async(players.play(0, [0, 1], tmp_path / "results", told.append))
    assert [(one.seed, one.success) for one in told] == [(0, False), (1, False)]
    assert begun(notes) == [0, 1, 1]


@pytest.mark.heavy
def test_any_number_of_workers_plays_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    printed, played = [], []
    for count in (1, 2):
        out = tmp_path / str(count)
        flags = ["--episodes", "3", "--seed", "20", "--max-steps", "45", "--no-videos"]
        told = ["--policy", "expert", "--policy", "random", "--workers", str(count)]
        assert main(["benchmark", *told, *flags, "--out", str(out)]) == 0
        printed.append(capsys.readouterr().out.replace(str(out), ""))
        played.append(
            [
                (e["seed"], e["success"], e["steps"])
                for cell in report(out)["cells"]
                for e in cell["episodes"]
            ]
        )
    assert printed[0] == printed[1]
    assert played[0] == played[1]
    assert len({steps for _, _, steps in played[0]}) > 1
