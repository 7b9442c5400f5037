"""The scripted expert grabs every shape, misses show as misses, and the data set writers write what
they say.
"""

import json
import math
import random
import tempfile
from pathlib import Path

import pytest

pytest.importorskip("mujoco")
import cv2
import numpy as np

from vram_arbiter.runner.sim.config import REST_POSE, SceneConfig
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.expert import CLOSED_RAD, GrabExpert, RestController, run_expert
from vram_arbiter.runner.sim.kinematics import ArmKinematics
from vram_arbiter.runner.sim.tasks import stand_before
from vram_arbiter.runner.sim.training.dataset import VIEWS, main, write_grab
from vram_arbiter.runner.sim.training.evaluate import attempt
from vram_arbiter.runner.sim.training.learned import LoadedPolicy

pytestmark = pytest.mark.heavy

CHECKPOINT = Path(__file__).parents[3] / "configs" / "models" / "so101-grab"


@pytest.fixture(scope="module")
def kinematics() -> ArmKinematics:
    return ArmKinematics(SceneConfig())


@pytest.mark.parametrize("shape", ["cube", "ball", "cylinder"])
def test_expert_grabs_after_imperfect_navigation(
    sim_env: SimEnv, kinematics: ArmKinematics, shape: str
) -> None:
    for seed in range(8):
        sim_env.reset(seed, names=(f"red {shape}", "blue ball", "green cube"))
        stand_before(sim_env, f"red {shape}", random.Random(seed))
        assert run_expert(sim_env, GrabExpert(sim_env, kinematics, f"red {shape}"))
        truth = sim_env.ground_truth()
        assert truth.held == f"red {shape}"
        assert sim_env.is_held_above_table(f"red {shape}")
        assert not sim_env.is_held_above_table("blue ball")
        assert truth.objects[f"red {shape}"].lift_m > 0.05


def test_a_held_thing_stays_held_while_driving(sim_env: SimEnv, kinematics: ArmKinematics) -> None:
    sim_env.reset(1)
    stand_before(sim_env, sim_env.target, random.Random(1))
    run_expert(sim_env, GrabExpert(sim_env, kinematics, sim_env.target))
    for _ in range(30):
        sim_env.step(None, (-0.2, 0.0, 0.2))
    assert sim_env.held_object() == sim_env.target


def test_a_miss_holds_nothing(sim_env: SimEnv, kinematics: ArmKinematics) -> None:
    sim_env.reset(2)
    stand_before(sim_env, sim_env.target, random.Random(2), error_m=0.0)
    expert = GrabExpert(sim_env, kinematics, sim_env.target, offset_m=(0.0, 0.05), retry=False)
    assert not run_expert(sim_env, expert)
    assert sim_env.held_object() is None


def test_opening_the_gripper_lets_go_and_rest_is_reached(
    sim_env: SimEnv, kinematics: ArmKinematics
) -> None:
    sim_env.reset(1)
    stand_before(sim_env, sim_env.target, random.Random(1))
    run_expert(sim_env, GrabExpert(sim_env, kinematics, sim_env.target))
    rest = RestController(sim_env.joint_state())
    for _ in range(120):
        sim_env.step(rest.act())
    assert rest.done
    assert sim_env.held_object() is None
    assert list(sim_env.joint_state().values()) == pytest.approx(list(REST_POSE), abs=0.02)


def test_inverse_kinematics_reaches_the_grasp_zone(kinematics: ArmKinematics) -> None:
    spot = SceneConfig().grasp_spot_in_base_m
    for dx in (-0.04, 0.0, 0.04):
        for dy in (-0.04, 0.0, 0.04):
            point = (spot[0] + dx, spot[1] + dy, 0.215)
            joints, error = kinematics.solve(point, REST_POSE)
            assert error < 0.002
            assert math.dist(kinematics.grasp_point(joints), point) == pytest.approx(
                error, abs=1e-4
            )


def test_scene_data_set_labels_what_the_pictures_show(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scenes", "--count", "20", "--out", str(tmp_path), "--seed", "4"]) == 0
    lines = [json.loads(line) for line in (tmp_path / "labels.jsonl").read_text().splitlines()]
    assert len(lines) == 20
    assert {line["camera"] for line in lines} == {"front", "wrist"}
    for line in lines:
        image = cv2.imread(str(tmp_path / line["file"]))
        height, width = image.shape[:2]
        for item in line["objects"]:
            assert (item["box"] is not None) == item["visible"]
            if item["visible"]:
                x0, y0, x1, y1 = item["box"]
                assert 0 <= x0 < x1 <= width
                assert 0 <= y0 < y1 <= height
        assert line["held"] in [None, *(o["name"] for o in line["objects"])]
    assert json.loads(capsys.readouterr().out)["out"] == str(tmp_path)


def test_grab_data_set_holds_whole_episodes(tmp_path: Path) -> None:
    assert main(["grab", "--episodes", "2", "--out", str(tmp_path), "--seed", "4"]) == 0
    lengths = np.load(tmp_path / "episode_length.npy")
    action, state = np.load(tmp_path / "action.npy"), np.load(tmp_path / "state.npy")
    assert len(lengths) == 2
    assert len(action) == len(state) == lengths.sum()
    for camera, (_, (width, height)) in VIEWS.items():
        assert np.load(tmp_path / f"{camera}.npy").shape == (lengths.sum(), height, width, 3)
    assert action[lengths[0] - 1, 5] == pytest.approx(CLOSED_RAD)
    assert json.loads((tmp_path / "info.json").read_text())["units"] == "rad"


def test_the_shipped_policy_grabs_and_can_drive_a_second_round(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("lerobot")
    import torch

    torch.set_num_threads(1)  # a second thread of so small a network only waits
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # lerobot leaves a file there
    policy = LoadedPolicy(CHECKPOINT)
    with SimEnv() as sim_env:
        done = [attempt(sim_env, policy, 700 + n, tries=2, error_m=0.015) for n in range(3)]
    assert sum(one.held == one.name for one in done) >= 2
    assert write_grab(tmp_path, 1, 5, policy)["episodes"] == 1
