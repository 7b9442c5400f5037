"""Recording for real: a writer's process, lerobot's files on disk, lerobot's own reader; and what
is left when something is killed.
"""

import io
import json
import logging
import os
import shutil
import signal
import threading
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from tests.runner.recording.ticks import (
    DONE,
    FAILED,
    HEIGHT,
    TRACE,
    WIDTH,
    goal,
    picture,
    span_of,
    tick,
)
from tests.support.waiting import until
from vram_arbiter.runner import __main__ as program
from vram_arbiter.runner.cli.replay import as_text
from vram_arbiter.runner.recording import commit
from vram_arbiter.runner.recording import recorder as recorder_module
from vram_arbiter.runner.recording.columns import features_of, row_of, whole_rate
from vram_arbiter.runner.recording.lerobot_files import LerobotFiles
from vram_arbiter.runner.recording.reader import read_frame
from vram_arbiter.runner.recording.recorder import QUEUE_TICKS, DatasetRecorder
from vram_arbiter.runner.recording.writer import EpisodeWriter
from vram_arbiter.schemas.errors import (
    AlreadyRunning,
    BadRequest,
    BadState,
    ConfigError,
    InternalError,
    VramError,
)
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.world import JointState

pytestmark = [
    pytest.mark.heavy,
    pytest.mark.timeout(600),
    pytest.mark.usefixtures("forked_writers"),
]  # lerobot, torch: seconds to import, a minute on a busy machine

WAIT_S = 280.0
FIRST, SECOND = goal("g1", "grab the cube"), goal("g2", "put it down")


def recorder(root: Path, **options: Any) -> DatasetRecorder:
    given: dict[str, Any] = {"rate_hz": 30.0, "cameras": ("front",), "robot": "bench"}
    return DatasetRecorder(root, **given | options)


def files(root: Path, **options: Any) -> LerobotFiles:
    given: dict[str, Any] = {"fps": 30, "robot": "bench", "lerobot": False}
    (root / commit.FOLDER).mkdir(parents=True, exist_ok=True)
    return LerobotFiles(root, **given | options)


def record_goal(made: DatasetRecorder, of: Any, ended: Any, ticks: int, **options: Any) -> None:
    for index in range(ticks):
        made.tick(tick(index, of=of, **options))
    made.goal_ended(of, ended)


def lerobot_reads(root: Path, monkeypatch: pytest.MonkeyPatch, cache: Path) -> Any:
    """The dataset by lerobot's own class, offline."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets
    from lerobot.datasets import LeRobotDataset

    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", cache)
    return LeRobotDataset("local/recording", root=root, video_backend="pyav")


@dataclass(frozen=True)
class Recorded:
    root: Path
    made: DatasetRecorder
    said: str  # in the log
    blocked: VramError | None  # what it said of a goal whose files could not be written
    misfit: ConfigError  # of a check before a goal of other columns


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Goals that fit, and goals that do not."""
    root = tmp_path_factory.mktemp("recorded") / "set"
    made = recorder(root)
    made.start()
    made.tick(tick(0, of=FIRST, targets={"pan": 0.0}))  # the gripper has no target yet
    record_goal(made, FIRST, DONE, 6)
    record_goal(made, SECOND, FAILED, 4)
    until(lambda: made.counts.episodes == 2)
    said = io.StringIO()
    handler = logging.StreamHandler(said)
    logging.getLogger("vram_arbiter.runner.recording").addHandler(handler)
    small = {"front": picture("front", 1, width=16, height=16, data=bytes(16 * 16 * 3))}
    torn = {"front": picture("front", 1, encoding="jpeg", data=b"no jpeg")}
    try:
        with pytest.raises(AlreadyRunning), commit.locked(root, 0.0):
            pass
        with pytest.raises(ConfigError) as misfit:
            made.check(tick(0, frames=small))
        made.check(tick(0))
        in_the_way = root / "data/chunk-000/file-002.parquet"
        in_the_way.mkdir()
        record_goal(made, goal("blocked"), DONE, 2)
        until(lambda: "file-002.parquet" in str(made.counts.error))
        blocked = made.counts.error
        in_the_way.rmdir()
        record_goal(made, goal("small"), DONE, 3, frames=small)
        record_goal(made, goal("g3"), None, 3)
        record_goal(made, goal("short"), DONE, 1)
        made.tick(tick(0, of=goal("torn"), frames=torn))
        record_goal(made, goal("torn"), DONE, 2)
        made.tick(tick(0, of=goal("bad")))
        assert made.mark("", "discard") == {"goal_id": "bad", "episode": None, "verdict": "discard"}
        record_goal(made, goal("bad"), DONE, 4)
        record_goal(made, goal("worse"), DONE, 2)
        until(lambda: made.counts.episodes == 5)
        assert made.mark("worse", "discard")["episode"] == 4
        with pytest.raises(BadRequest, match="the last one is torn"):
            made.mark("", "success")  # meant for the one that is gone
        assert made.mark("torn", "success")["episode"] == 3
    finally:
        made.close()
        logging.getLogger("vram_arbiter.runner.recording").removeHandler(handler)
    return Recorded(root, made, said.getvalue(), blocked, misfit.value)


def test_lerobots_own_reader_finds_every_tick(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    dataset = lerobot_reads(recorded.root, monkeypatch, tmp_path)
    assert (dataset.num_episodes, len(dataset), dataset.fps) == (4, 15, 30)
    assert dataset.meta.robot_type == "bench"
    assert dataset.meta.features["observation.state"]["names"] == ["pan", "grip"]
    rows = [dataset[index] for index in range(15)]
    assert [int(row["episode_index"]) for row in rows] == [0] * 6 + [1] * 4 + [2] * 3 + [3] * 2
    assert [row["task"] for row in rows] == ["grab the cube"] * 6 + ["put it down"] * 4 + [
        "grab the cube"
    ] * 5
    for row, index in zip(rows, [*range(6), *range(4), *range(3), *range(2)], strict=True):
        assert row["observation.state"].tolist() == pytest.approx([0.1 * index, 0.5])
        assert row["action"].tolist() == pytest.approx([0.1 * index + 0.05, 0.4])
        assert (row["trace_id"], row["span_id"], bool(row["trace_sampled"])) == (
            TRACE,
            span_of(index),
            True,
        )
        assert int(row["tick.index"]) == 100 + index
        assert float(row["timestamp"]) == pytest.approx(index / 30)
        seen = row["observation.images.front"]
        assert tuple(seen.shape) == (3, HEIGHT, WIDTH)
        # the picture of this very tick
        assert float(seen.mean()) * 255 == pytest.approx(10 * index, abs=3)
    assert [index for index, row in enumerate(rows) if row["next.done"]] == [5, 9, 12, 14]
    assert "next.success" not in dataset.meta.features, "no world judged"


def test_a_run_says_what_it_recorded_and_what_not(recorded: Recorded) -> None:
    counts = recorded.made.counts
    assert dict(counts.incomplete) == {"joint grip has no target yet": 1}
    assert "1 ticks left out: joint grip has no target yet" in counts.summary()
    assert (counts.episodes, counts.frames, counts.skipped, counts.discarded) == (4, 15, 1, 2)
    assert recorded.made.facts()["error"] == counts.error.message
    notes = commit.notes(recorded.root)
    kept = [(note["goal_id"], note["status"], note["code"], note["incomplete"]) for note in notes]
    assert kept == [
        ("g1", "succeeded", "", 1),
        ("g2", "failed", "model_error", 0),
        ("g3", "taken_back", "", 0),
        ("torn", "succeeded", "", 1),
    ]
    assert not (recorded.root / commit.FOLDER / commit.CACHE).exists()


@pytest.mark.parametrize("runs", [True, False])
def test_a_killed_writer_ends_the_recording_after_the_goal_that_runs(
    tmp_path: Path, runs: bool
) -> None:
    """Regression: the robot went on for the rest of the day, and nothing was recorded; between
    goals the loss was noticed in the next one."""
    root, lost = tmp_path / "set", threading.Event()
    made = recorder(root, on_lost=lost.set)
    made.start()
    record_goal(made, FIRST, DONE, 2)
    until(lambda: made.counts.episodes == 1)
    if runs:
        made.tick(tick(0, of=SECOND))
        until((root / commit.FOLDER / commit.OPEN).exists)
    os.kill(made.pid, signal.SIGKILL)

    def goes_on() -> Any:
        made.tick(tick(1, of=SECOND))
        return made.lost

    until(goes_on if runs else lambda: made.lost is not None, WAIT_S)
    if runs:
        assert not lost.is_set()
        made.tick(tick(2, of=SECOND))  # the robot goes on to the goal's end
        made.goal_ended(SECOND, DONE)
    assert lost.wait(60)
    assert "writer died (status -9)" in str(made.lost)
    with pytest.raises(BadState):
        made.mark("", "success")
    made.close()
    assert "NOT ALL WAS RECORDED" in made.counts.summary()
    assert [note["goal_id"] for note in commit.notes(root)] == ["g1"]
    with commit.locked(root, WAIT_S):
        assert bool(commit.repair(root)) is runs


def test_a_disk_that_takes_nothing_costs_the_goal_and_no_more(recorded: Recorded) -> None:
    assert isinstance(recorded.blocked, InternalError)
    assert "file-002.parquet" in recorded.blocked.message
    # its files have the name that was taken
    assert read_frame(recorded.root, 10).goal["goal_id"] == "g3"


def test_other_columns_are_said_before_a_goal_and_cost_only_it(recorded: Recorded) -> None:
    said = "recorded with other columns: observation.images.front (32 × 24 pixels there, 16 × 16"
    assert said in recorded.misfit.message
    assert isinstance(recorded.made.counts.error, ConfigError)
    assert said in recorded.made.counts.error.message
    assert "goal short is not recorded: 1 rows are no episode" in recorded.said


def test_an_operators_mark_stays_with_its_episode(recorded: Recorded) -> None:
    """A discarded episode leaves nothing, whether it was open or finished."""
    assert [note.get("marked") for note in commit.notes(recorded.root)] == [
        None,
        None,
        None,
        "success",
    ]
    assert read_frame(recorded.root, 14).goal["marked"] == "success"
    assert not list(recorded.root.rglob("file-004*"))
    with pytest.raises(BadState, match="nothing is recorded any more"):
        recorded.made.mark("", "failure")


def test_another_robots_dataset_is_refused_before_anything_moves(recorded: Recorded) -> None:
    """Regression: a second robot was recorded into the dataset of the first."""
    with pytest.raises(ConfigError) as refused:
        files(recorded.root, fps=15, robot="left")
    for said in ("30 frames a second there, 15 here", "robot 'bench' there, 'left' here"):
        assert said in refused.value.message
        assert said in "; ".join(refused.value.details["differences"])
    files(recorded.root)


def test_a_damaged_dataset_is_said_and_not_touched(recorded: Recorded, tmp_path: Path) -> None:
    """A page that cannot be unpacked: the file's end, which is read first, is whole."""
    root = tmp_path / "set"
    shutil.copytree(recorded.root, root)
    (damaged, *_) = sorted((root / "meta/episodes").rglob("*.parquet"))
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:100] + bytes(300) + whole[400:])
    with pytest.raises(ConfigError, match="cannot be read"):
        files(root).totals()
    with pytest.raises(ConfigError, match="cannot be read"):
        read_frame(root, 0)


# -- replay
def test_a_frame_leads_back_to_its_tick_and_trace(recorded: Recorded) -> None:
    found = read_frame(recorded.root, 8)
    assert (found.episode, found.frame_in_episode, found.task) == (1, 2, "put it down")
    assert (found.trace_id, found.span_id, found.trace_sampled) == (TRACE, span_of(2), True)
    assert dict(found.state) == pytest.approx({"pan": 0.2, "grip": 0.5})
    assert dict(found.action) == pytest.approx({"pan": 0.25, "grip": 0.4})
    assert found.timings_ms["inference"] == 3.0
    assert found.goal["status"] == "failed"
    assert Path(found.pictures["front"]["path"]).is_file()
    assert found.complete
    assert read_frame(recorded.root, 2, episode=1) == found


# -- rosbag
def read_bag(bag: Path) -> dict[str, list[tuple[int, str, Any]]]:
    """Log time, type and message by topic, as another implementation of MCAP and of ROS's messages
    reads them."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found = defaultdict(list)
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as opened:
        reader = make_reader(opened, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            found[channel.topic].append((message.log_time, schema.name, decoded))
    return dict(found)


def export(root: Path, episode: int, out: Path) -> int:
    words = ["--dataset", str(root), "--episode", str(episode), "--out", str(out)]
    return program.main(["rosbag", *words])


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def test_an_independent_reader_finds_an_episode_in_a_bag(
    recorded: Recorded, tmp_path: Path
) -> None:
    import cv2
    import numpy as np

    assert export(recorded.root, 1, tmp_path / "bag") == 0
    found = read_bag(tmp_path / "bag")
    ticks = [tick(index) for index in range(4)]
    joints = "sensor_msgs/msg/JointState"
    assert {topic: {kind for _, kind, _ in sent} for topic, sent in found.items()} == {
        "/joint_states": {joints},
        "/joint_commands": {joints},
        "/front/image/compressed": {"sensor_msgs/msg/CompressedImage"},
    }
    for topic, sent in found.items():
        assert [at for at, _, _ in sent] == [made.result.stamp_ns for made in ticks], topic
    for (at, _, told), made in zip(found["/joint_states"], ticks, strict=True):
        assert (stamp_ns(told), tuple(told.name)) == (at, made.world.joint_state.name)
        assert list(told.position) == pytest.approx(list(made.world.joint_state.position))
    for (at, _, told), made in zip(found["/joint_commands"], ticks, strict=True):
        assert stamp_ns(told) == at
        assert dict(zip(told.name, told.position, strict=True)) == pytest.approx(made.targets)
    for index, (at, _, told) in enumerate(found["/front/image/compressed"]):
        assert (told.format, told.header.frame_id) == ("jpeg", "front")
        assert at - stamp_ns(told) == pytest.approx(2_000_000, abs=1000), "its age"
        colors = cv2.imdecode(np.frombuffer(bytes(told.data), np.uint8), cv2.IMREAD_COLOR)
        assert colors.shape == (HEIGHT, WIDTH, 3)
        assert abs(float(colors.mean()) - 10 * index) < 3, "that tick's picture"


def test_an_episode_that_is_not_there_leaves_no_bag(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(recorded.root, 9, tmp_path / "bag") == 1
    assert "unknown episode 9" in capsys.readouterr().err
    assert export(tmp_path, 0, tmp_path / "bag") == 2
    assert not (tmp_path / "bag").exists()
    assert export(recorded.root, 0, tmp_path) == 2
    assert "name a folder that is new" in capsys.readouterr().err


def record_verdicts(root: Path, *verdicts: bool | None) -> list[JsonObject]:
    """An episode of two ticks for each word of a world; what the writer answered."""
    writer, answers = EpisodeWriter(files(root), "rad"), []
    for said in verdicts:
        for index in range(2):
            writer.row(row_of(tick(index, of=goal(str(said)), frames={}, success=said), ()))
        try:
            answers.append(writer.end({"goal_id": str(said), "status": "succeeded"}))
        except VramError as error:
            answers.append({"error": error.to_wire()})
    return answers


def test_success_is_what_the_world_says_and_no_skill(tmp_path: Path) -> None:
    """Regression: a live grab that lifted nothing was recorded with `next.success` true, because
    its skill said that it was done. Policies are trained on this column."""
    record_verdicts(tmp_path / "judged", False, True)
    said = [read_frame(tmp_path / "judged", 1, episode).tick["success"] for episode in range(2)]
    assert said == [False, True]

    record_verdicts(tmp_path / "live", None, True)
    assert [read_frame(tmp_path / "live", 1, episode).tick["success"] for episode in range(2)] == [
        None
    ] * 2
    assert (
        "next.success" not in json.loads((tmp_path / "live/meta/info.json").read_text())["features"]
    )


def test_what_no_world_judges_does_not_go_into_a_dataset_of_verdicts(tmp_path: Path) -> None:
    """Its episodes would stand there as failures, or as successes."""
    *_, answer = record_verdicts(tmp_path, True, None)
    assert "next.success" in answer["error"]["message"]
    assert "new folder" in answer["error"]["hint"]
    assert len(commit.notes(tmp_path)) == 1


def test_a_state_or_an_action_of_one_number_is_replayed(tmp_path: Path) -> None:
    """lerobot makes a column of plain numbers of it, not of lists."""
    one = JointState(name=("pan",), position=(0.5,), stamp_ns=1_002_000_000)
    made = tick(0, frames={})
    made = replace(made, world=made.world.model_copy(update={"joint_state": one}))
    writer = EpisodeWriter(files(tmp_path), "rad")
    for _ in range(2):
        writer.row(row_of(made, ()))
    writer.end({"goal_id": "g1", "status": "succeeded"})
    found = read_frame(tmp_path, 1)
    assert (dict(found.state), dict(found.action)) == ({"pan": 0.5}, pytest.approx({"pan": 0.05}))
    assert "joint    pan: at +0.5000 rad, told +0.0500" in as_text(found, None)


@pytest.mark.parametrize(
    ("frame", "episode", "said"),
    [
        (15, None, "unknown frame 15 .0 to 14"),
        (4, 1, "episode 1 has no frame 4 .0 to 3"),
        (0, 4, "unknown episode 4 .there are 4"),
    ],
)
def test_a_frame_that_is_not_there_is_said(
    recorded: Recorded, frame: int, episode: int | None, said: str
) -> None:
    with pytest.raises(BadRequest, match=said):
        read_frame(recorded.root, frame, episode)


def test_the_command_prints_the_frame_and_opens_its_trace(
    recorded: Recorded, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    root = str(recorded.root)
    url = "http://localhost:16686/trace/{trace_id}?uiFind={span_id}"
    assert program.main(["replay", "--dataset", root, "--frame", "9", "--trace-url", url]) == 0
    out = capsys.readouterr().out
    assert f"http://localhost:16686/trace/{TRACE}?uiFind={span_of(3)}" in out
    assert "goal     g2: test/grab@abc failed: lost the cube" in out
    assert "joint    grip: at +0.5000 rad, told +0.4000" in out
    assert "last of its episode" in out
    assert program.main(["replay", "--dataset", root, "--frame", "99"]) == 1
    assert program.main(["replay", "--dataset", str(tmp_path), "--frame", "0"]) == 2
    assert (
        program.main(["replay", "--dataset", root, "--frame", "0", "--trace-url", "http://x"]) == 2
    )
    assert "is not a dataset that this program recorded" in capsys.readouterr().err


def test_two_cameras_of_one_column_are_refused() -> None:
    """A column has no `/`: the pictures of the one would have been the other's."""
    frames = {name: picture(name, 10) for name in ("arm/top", "arm_top")}
    with pytest.raises(
        ConfigError, match=r"two cameras would have the column observation\.images\.arm_top"
    ):
        features_of(row_of(tick(0, frames=frames), tuple(frames)))


# -- what cannot be recorded
@pytest.mark.parametrize("rate_hz", [0.0, 12.5, 0.5])
def test_only_whole_rates_are_recorded(rate_hz: float) -> None:
    with pytest.raises(ConfigError, match="a whole number of ticks a second"):
        whole_rate(rate_hz)


def test_a_slow_writer_costs_ticks_never_time(tmp_path: Path) -> None:
    """Nobody takes from the queue: what does not fit is dropped and counted, and the control thread
    goes on.
    """
    made = recorder(tmp_path / "set")
    for index in range(QUEUE_TICKS + 5):
        made.tick(tick(index))
    assert made.counts.dropped == 5
    assert "5 ticks were dropped" in made.counts.summary()


def test_the_queue_counts_the_bytes_of_each_tick(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: the first tick's bytes were taken for those of all others; after a first tick
    without pictures the queue took any number of bytes.
    """
    monkeypatch.setattr(recorder_module, "QUEUE_BYTES", 5 * WIDTH * HEIGHT * 3)
    made = recorder(tmp_path / "set")
    made.tick(tick(0, frames={}))
    for index in range(1, 9):
        made.tick(tick(index))
    assert made.counts.dropped == 3


def test_a_strict_recording_ends_with_its_first_loss(tmp_path: Path) -> None:
    """Regression: a benchmark played all of its episodes for a dataset that took none."""
    lost = threading.Event()
    made = recorder(tmp_path / "set", strict=True, on_lost=lost.set)
    made.start()
    odd = {"front": picture("front", 1, width=15, height=15, data=bytes(15 * 15 * 3))}
    record_goal(made, FIRST, DONE, 2, frames=odd)
    assert lost.wait(WAIT_S)
    made.close()
    assert "a video needs even numbers" in str(made.counts.error)


def test_an_episode_that_cannot_be_ended_at_the_close_is_a_loss(tmp_path: Path) -> None:
    """Regression: the writer logged it, and the runner called the recording complete."""
    made = recorder(tmp_path / "set", cameras=())
    made.start()
    (tmp_path / "set/data/chunk-000/file-000.parquet").mkdir(parents=True)
    for index in range(2):
        made.tick(tick(index, frames={}))
    made.close()
    assert "(status 1)" in str(made.counts.error)
