"""The labels that the progress model learns from are the simulator's truth: they rise with a grab,
and only for the thing it grabs.
"""

import json
from pathlib import Path

import pytest

pytest.importorskip("mujoco")
import numpy as np

from vram_arbiter.runner.sim.training.progress import LIFTED_FROM, REACHED, SIZE_PX, main

pytestmark = pytest.mark.heavy


def test_progress_is_told_by_the_truth(tmp_path: Path) -> None:
    assert main(["--out", str(tmp_path), "--episodes", "4", "--seed", "3"]) == 0
    info = json.loads((tmp_path / "info.json").read_text())
    images = np.load(tmp_path / "images.npy")
    width, height = SIZE_PX
    assert images.shape == (sum(one["length"] for one in info["episodes"]), height, width, 3)
    ends = []
    for one in info["episodes"]:
        for name, values in one["progress"].items():
            assert all(0.0 <= value <= 1.0 for value in values)
            assert values[0] < REACHED, "a grab begins away from everything"
            assert [value >= LIFTED_FROM for value in values] == one["held"][name]
        ends.append(max(values[-1] for values in one["progress"].values()))
        for row in zip(*one["held"].values(), strict=True):
            assert sum(row) <= 1, "one gripper, one thing"
    assert any(end >= LIFTED_FROM for end in ends), "some grabs succeed"
