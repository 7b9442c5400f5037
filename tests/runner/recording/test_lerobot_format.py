"""A recording by lerobot's names and units: lerobot's own programs replay it, and merge it with
what `lerobot-record` wrote.
"""

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import pytest

from tests.runner.recording.ticks import HEIGHT, WIDTH, goal, tick
from vram_arbiter.runner.protocols import GoalTick
from vram_arbiter.runner.recording.columns import features_of, frame_of, row_of
from vram_arbiter.runner.recording.lerobot_files import LerobotFiles
from vram_arbiter.runner.recording.reader import read_frame
from vram_arbiter.runner.recording.recorder import LEROBOT_UNITS
from vram_arbiter.runner.robots.so101 import lerobot_units_of, so101
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.world import JointState

pytestmark = [
    pytest.mark.nightly,  # datasets of lerobot's own writers and programs: 45 s of a core
    pytest.mark.heavy,
    pytest.mark.timeout(600),
    pytest.mark.usefixtures("forked_writers"),
]

ARM = so101(simulated=True)
UNITS = lerobot_units_of(ARM)
FRAMES = 4
TO_REALTIME = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"


@pytest.fixture(autouse=True, scope="module")
def ordinary() -> Iterator[None]:
    """The AV1 encoder leaves the thread that uses it at the highest real-time priority if it may,
    with all programs that this thread starts: units that forbid it did not start in later tests.
    """
    yield
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def test_a_writer_may_not_run_before_the_control_loop() -> None:
    """Regression: as root, each of its encoder's 37 threads did."""
    if subprocess.run([sys.executable, "-c", TO_REALTIME], check=False).returncode:
        pytest.skip("this machine allows no program to run in real time")
    started = "from vram_arbiter.runner.recording.writer import stay_ordinary; stay_ordinary(); "
    done = subprocess.run(
        [sys.executable, "-c", started + TO_REALTIME], check=False, capture_output=True, text=True
    )
    assert "PermissionError" in done.stderr


def arm_tick(index: int) -> GoalTick:
    """Tick of an arm whose joints are all at 0.1 rad a tick, and told 0.05 rad more."""
    made = tick(index)
    positions = (0.1 * index,) * len(ARM.joints)
    state = JointState(name=ARM.joint_names, position=positions, stamp_ns=1)
    return replace(
        made,
        world=made.world.model_copy(update={"joint_state": state}),
        targets=dict.fromkeys(ARM.joint_names, 0.1 * index + 0.05),
    )


@pytest.fixture(scope="module")
def recorded_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recorded_set = tmp_path_factory.mktemp("lerobot") / "set"
    recorded_set.mkdir()
    files = LerobotFiles(recorded_set, fps=30, robot=UNITS.robot_type, lerobot=True)
    rows = [row_of(arm_tick(index), ("front",), UNITS) for index in range(FRAMES)]
    features = files.begin(features_of(rows[0]))
    for row in rows:
        files.add(frame_of(row, features))
    files.finish({"goal_id": goal().goal_id, "units": LEROBOT_UNITS, "status": "succeeded"})
    return recorded_set


def offline(monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets

    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", cache)


def test_lerobot_replay_drives_a_robot_with_the_recorded_actions(
    recorded_set: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    offline(monkeypatch, tmp_path)
    from lerobot.robots import Robot, RobotConfig
    from lerobot.scripts import lerobot_replay

    @RobotConfig.register_subclass("listening_arm")
    @dataclass
    class Config(RobotConfig):
        port: str = ""

    sent: list[dict[str, float]] = []

    class Arm(Robot):
        config_class = Config
        name = "listening_arm"
        observation_features: ClassVar = {f"{name}.pos": float for name in ARM.joint_names}
        action_features = observation_features
        is_connected = is_calibrated = True

        def connect(self, calibrate: bool = True) -> None: ...

        def disconnect(self) -> None: ...

        def calibrate(self) -> None: ...

        def configure(self) -> None: ...

        def get_observation(self) -> dict[str, float]:
            return dict.fromkeys(self.action_features, 0.0)

        def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
            sent.append({name: float(value) for name, value in action.items()})
            return action

    monkeypatch.setattr(lerobot_replay, "make_robot_from_config", Arm)
    dataset = lerobot_replay.DatasetReplayConfig("local/recording", episode=0, root=recorded_set)
    lerobot_replay.replay(
        lerobot_replay.ReplayConfig(
            robot=Config(calibration_dir=tmp_path), dataset=dataset, play_sounds=False
        )
    )
    assert len(sent) == FRAMES
    low, high = -0.17453, 1.74533
    for index, action in enumerate(sent):
        told = 0.1 * index + 0.05
        assert action["elbow_flex.pos"] == pytest.approx(math.degrees(told), abs=1e-3)
        assert action["gripper.pos"] == pytest.approx(100 * (told - low) / (high - low), abs=1e-3)
        assert sorted(action) == sorted(f"{name}.pos" for name in ARM.joint_names)


def test_it_merges_with_what_lerobot_recorded(
    recorded_set: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The other dataset is written as `lerobot-record` does: columns from the driver's features."""
    offline(monkeypatch, tmp_path / "cache")
    import numpy as np
    from lerobot.datasets import LeRobotDataset, aggregate_datasets
    from lerobot.utils.feature_utils import hw_to_dataset_features

    joints: dict[str, Any] = {f"{name}.pos": float for name in ARM.joint_names}
    seen = joints | {"front": (HEIGHT, WIDTH, 3)}
    features = hw_to_dataset_features(joints, "action") | hw_to_dataset_features(
        seen, "observation"
    )
    theirs = LeRobotDataset.create(
        "local/theirs", 30, features, root=tmp_path / "theirs", robot_type="so_follower"
    )
    for _ in range(3):
        row = np.zeros(6, dtype=np.float32)
        picture = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        theirs.add_frame(
            {
                "task": "wave",
                "action": row,
                "observation.state": row,
                "observation.images.front": picture,
            }
        )
    theirs.save_episode()
    theirs.finalize()
    aggregate_datasets(
        repo_ids=["local/recording", "local/theirs"],
        roots=[recorded_set, tmp_path / "theirs"],
        aggr_repo_id="local/both",
        aggr_root=tmp_path / "both",
    )
    both = LeRobotDataset("local/both", root=tmp_path / "both", video_backend="pyav")
    assert (both.num_episodes, both.num_frames) == (2, FRAMES + 3)
    assert float(both[1]["observation.state"][0]) == pytest.approx(math.degrees(0.1), abs=1e-3)


def test_it_has_no_ticks_to_replay(recorded_set: Path) -> None:
    with pytest.raises(ConfigError, match="the columns of lerobot only"):
        read_frame(recorded_set, 2)
