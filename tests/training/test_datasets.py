"""Data on disk: frames are read or refused by line, scenes are never parted, tries are whole."""

import json
from pathlib import Path
from typing import Any

import pytest

from training import datasets
from training.common import BadInput

FRAME = {
    "file": "a.png", "camera": "front", "seed": 4, "stage": "start", "held": None,
    "objects": [
        {"name": "red cube", "box": [9, 0, 30, 20], "pixels": 400},
        {"name": "blue ball", "box": [0, 0, 5, 5], "pixels": 25},
        {"name": "red ball", "box": None, "pixels": 0},
    ],
}  # fmt: skip


def test_a_frame_says_what_is_clear_what_is_hidden_and_what_is_there(tmp_path: Path) -> None:
    (tmp_path / datasets.LABELS).write_text(json.dumps(FRAME) + "\n")
    (frame,) = datasets.read_frames([tmp_path], "front")
    assert (frame.visible, frame.hidden) == (["red cube"], {"blue ball"})
    names, words = datasets.vocabulary([frame])
    assert names == ["blue ball", "red ball", "red cube"]
    assert words == (["blue", "red"], ["ball", "cube"])
    assert len(datasets.read_frames([tmp_path, tmp_path], "front")) == 2
    with pytest.raises(BadInput, match="no frame of the camera wrist"):
        datasets.read_frames([tmp_path], "wrist")


@pytest.mark.parametrize(
    ("text", "message"),
    [("{", r"labels.jsonl:1: JSON"), ('{"file": "a.png"}', "labels.jsonl:1: KeyError")],
)
def test_bad_labels_are_named_by_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / datasets.LABELS).write_text(text)
    with pytest.raises(BadInput, match=message):
        datasets.read_frames([tmp_path], "front")


def test_scenes_are_never_parted_by_the_split() -> None:
    frames = [
        datasets.Frame(Path(f"{n}.png"), "front", str(n // 3), "start", (), (), None)
        for n in range(30)
    ]
    learn, kept = datasets.split_by_scene(frames, 0.2, seed=3)
    assert len(learn) + len(kept) == 30
    assert {f.scene for f in learn}.isdisjoint({f.scene for f in kept})
    with pytest.raises(BadInput, match="two scenes"):
        datasets.split_by_scene(frames[:3], 0.2, seed=3)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "grabs"}, "is of kind 'grabs', expected 'progress'"),
        ({"lengths": [4, 4]}, "images.npy has 5 steps, the tries of info.json sum to 8"),
        ({"labels": []}, "a label for each picture"),
        ({"lengths": [5]}, "two tries or more"),
    ],
)
def test_strange_tries_are_refused(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    import numpy as np

    from training import progress

    labels = [{"progress": {"red cube": 0.1}, "held": None}] * 5
    columns = {"images": np.zeros((5, 4, 4, 3), np.uint8)}
    datasets.write_tries(
        tmp_path, "progress", [2, 3], columns, seed=0, camera="wrist", labels=labels
    )
    assert progress.load([tmp_path, tmp_path]).grab == [0, 0, 1, 1, 1, 2, 2, 3, 3, 3]
    info = json.loads((tmp_path / datasets.INFO).read_text())
    (tmp_path / datasets.INFO).write_text(json.dumps(info | change))
    with pytest.raises(BadInput, match=said):
        progress.load([tmp_path])
