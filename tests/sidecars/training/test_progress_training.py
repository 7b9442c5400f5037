"""The progress trainer's code path in seconds: recorded pictures in, a checkpoint that lerobot's
own factory loads out."""

import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("lerobot")
import numpy as np

from vram_arbiter.sidecars.training.progress import BadProgressData, judge, load, main, split, train

pytestmark = pytest.mark.heavy

COLOURS = {"red cube": (220, 30, 30), "blue ball": (30, 30, 220)}


def write_grabs(folder: Path, episodes: int = 10, length: int = 6) -> None:
    """Grabs in which a coloured square grows: the wider, the farther; in the last picture of every
    other one it is held."""
    rng = np.random.default_rng(0)
    images, info = [], []
    for number in range(episodes):
        name, other = (sorted(COLOURS), sorted(COLOURS, reverse=True))[number % 2]
        progress: dict[str, list[float]] = {name: [], other: [0.0] * length}
        for step in range(length):
            share = step / (length - 1)
            image = rng.integers(50, 70, (36, 48, 3), dtype=np.uint8)
            side = 4 + int(20 * share)
            image[4 : 4 + side, 6 : 6 + side] = COLOURS[name]
            images.append(image)
            progress[name].append(share)
        held = {name: [value == 1.0 for value in progress[name]], other: [False] * length}
        info.append({"length": length, "progress": progress, "held": held})
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "images.npy", np.stack(images))
    (folder / "info.json").write_text(
        json.dumps({"format": "grab-progress/1", "camera": "wrist", "seed": 0, "episodes": info})
    )


def test_it_learns_what_the_pictures_show_and_lerobot_loads_it(tmp_path: Path) -> None:
    write_grabs(tmp_path / "data")
    data = load(tmp_path / "data")
    learn, kept = split(data)
    assert not {data.episode[index] for index in learn} & {data.episode[index] for index in kept}
    short = train(data, tmp_path / "short", steps=2, batch_size=8, seed=0, time_limit_s=600.0)
    longer = train(data, tmp_path / "long", steps=15, batch_size=8, seed=0, time_limit_s=600.0)
    assert longer["progress"] < short["progress"]
    figures = judge(data, tmp_path / "long")
    assert figures["held-out pictures"] == len(kept)
    assert 0.0 <= figures["progress error"] <= 1.0


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_grabs(tmp_path / "data", episodes=4)
    assert (
        main(
            [
                "--data",
                str(tmp_path / "data"),
                "--out",
                str(tmp_path / "out"),
                "--smoke",
                "--threads",
                "1",
            ]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["steps"] == 20
    assert "success is right" in (tmp_path / "out/README.md").read_text()
    assert main(["--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "python -m vram_arbiter.runner.sim.training.progress" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "grab-progress/9"}, "says format"),
        ({"episodes": []}, "labels for 0"),
    ],
)
def test_strange_data_is_refused(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    write_grabs(tmp_path, episodes=2)
    info = json.loads((tmp_path / "info.json").read_text())
    (tmp_path / "info.json").write_text(json.dumps(info | change))
    with pytest.raises(BadProgressData, match=said):
        load(tmp_path)
