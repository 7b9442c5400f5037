"""A recording by lerobot's names and units: lerobot's own programs replay it, merge it with what
`lerobot-record` wrote, and push it.
"""

import base64
import json
import math
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import pytest

from tests.runner.recording.ticks import HEIGHT, TRACE, WIDTH, goal, span_of, tick
from tests.support.rerun_files import rows_of
from vram_arbiter.runner.__main__ import main
from vram_arbiter.runner.protocols import GoalTick
from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording.columns import features_of, frame_of
from vram_arbiter.runner.recording.lerobot_files import LerobotFiles
from vram_arbiter.runner.recording.push import push
from vram_arbiter.runner.recording.reader import read_frame
from vram_arbiter.runner.recording.rows import LEROBOT, row_of
from vram_arbiter.runner.robots.so101 import lerobot_units_of, so101
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.world import JointState

pytestmark = [
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
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("lerobot") / "set"
    root.mkdir()
    assert UNITS is not None
    files = LerobotFiles(root, fps=30, robot=UNITS.robot_type, columns="lerobot")
    rows = [row_of(arm_tick(index), ("front",), UNITS) for index in range(FRAMES)]
    features = files.begin(features_of(rows[0][0]))
    for row, pictures in rows:
        files.add(frame_of(row, pictures, features))
    files.finish({"goal_id": goal().goal_id, "units": LEROBOT, "status": "succeeded"})
    return root


def offline(monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets

    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", cache)


def test_lerobot_replay_drives_a_robot_with_the_recorded_actions(
    root: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
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
    dataset = lerobot_replay.DatasetReplayConfig("local/recording", episode=0, root=root)
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
    root: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
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
        roots=[root, tmp_path / "theirs"],
        aggr_repo_id="local/both",
        aggr_root=tmp_path / "both",
    )
    both = LeRobotDataset("local/both", root=tmp_path / "both", video_backend="pyav")
    assert (both.num_episodes, both.num_frames) == (2, FRAMES + 3)
    assert float(both[1]["observation.state"][0]) == pytest.approx(math.degrees(0.1), abs=1e-3)


def test_ticks_and_traces_are_kept_beside_it(root: Path) -> None:
    found = read_frame(root, 2)
    assert (found.trace_id, found.span_id, found.units) == (TRACE, span_of(2), LEROBOT)
    assert (found.tick["index"], found.goal["goal_id"]) == (102, "g1")
    assert found.base["pose"]["x_m"] == 1.0
    assert found.action["elbow_flex.pos"] == pytest.approx(math.degrees(0.25), abs=1e-3)


class _Hub(BaseHTTPRequestHandler):
    """As much of the hub as an upload asks of it; files are taken within the commit."""

    taken: dict[str, bytes]

    def do_GET(self) -> None:
        self._answer({"type": "user", "name": "me", "orgs": []})

    def do_DELETE(self) -> None:
        self.send_response(404)
        self.send_header("X-Error-Code", "RevisionNotFound")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if "/preupload/" in self.path:
            files = [
                {"path": file["path"], "uploadMode": "regular", "shouldIgnore": False}
                for file in json.loads(body)["files"]
            ]
            self._answer({"files": files})
        elif "/commit/" in self.path:
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    value = line["value"]
                    self.taken[value["path"]] = base64.b64decode(value["content"])
            url = "http://127.0.0.1/datasets/me/set/commit/abc"
            self._answer({"commitUrl": url, "commitOid": "a" * 40, "pullRequestUrl": None})
        else:
            self._answer({"url": "http://127.0.0.1/datasets/me/set", "errors": [], "warnings": []})

    def _answer(self, said: dict[str, Any]) -> None:
        data = json.dumps(said).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None: ...


@contextmanager
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, bytes]]:
    from huggingface_hub import RepoCard, constants, hf_api

    taken: dict[str, bytes] = {}
    with ThreadingHTTPServer(("127.0.0.1", 0), type("Hub", (_Hub,), {"taken": taken})) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        monkeypatch.setattr(constants, "ENDPOINT", address)
        monkeypatch.setattr(hf_api.api, "endpoint", address)
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        # the card is validated at an address that nothing configures
        monkeypatch.setattr(RepoCard, "validate", lambda *_, **__: None)
        monkeypatch.setenv("HF_TOKEN", "hf_of_the_test")
        yield taken
        server.shutdown()


def test_the_committed_dataset_is_pushed_whole(
    root: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    offline(monkeypatch, tmp_path)
    with hub(monkeypatch) as taken:
        assert push(root, "me/set", private=True) == 1
    committed = commit.last(root)
    assert committed is not None
    wanted = {*committed["files"], "meta/info.json", "meta/stats.json", "meta/tasks.parquet"}
    assert wanted <= taken.keys()
    assert taken["meta/info.json"] == (root / "meta/info.json").read_bytes()
    assert ".runner/commit.json" not in taken
    with pytest.raises(ConfigError, match="could not be pushed to me/set: "):
        push(root, "me/set", private=True)  # the hub is gone
    with pytest.raises(ConfigError, match="has no episode to push"):
        push(tmp_path / "none", "me/set", private=True)


def test_a_recording_is_exported_for_the_rerun_viewer(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A wrong dataset or episode overwrote an older export with an empty one."""
    pytest.importorskip("rerun", reason="needs the viz extra")
    out = tmp_path / "set.rrd"
    assert main(["export", "--dataset", str(root), "--out", str(out)]) == 0
    assert f"{FRAMES} frames in {out}" in capsys.readouterr().out
    rows = rows_of(out)
    wanted = ("/camera/front", "/state/elbow_flex.pos", "/action/gripper.pos", "/tick/withheld")
    assert [rows[name] for name in wanted] == [FRAMES] * 4
    assert main(["export", "--dataset", str(root), "--out", str(out), "--episode", "7"]) == 1
    assert "there is no episode 7" in capsys.readouterr().err
    assert main(["export", "--dataset", str(tmp_path / "none"), "--out", str(out)]) == 2
    assert (rows_of(out), list(tmp_path.iterdir())) == (rows, [out])
