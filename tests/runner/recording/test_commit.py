"""The folder after a crash: exactly what the last commit had, or a refusal; never half an
episode.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from vram_arbiter.runner.recording import commit
from vram_arbiter.schemas.errors import AlreadyRunning, ConfigError


def write(root: Path, name: str, text: str) -> None:
    (root / name).parent.mkdir(parents=True, exist_ok=True)
    (root / name).write_text(text)


def tree(root: Path) -> dict[str, bytes]:
    """All files that belong to the dataset, with the commit itself."""
    own = (commit.OPEN, commit.LOCK)
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in root.rglob("*")
        if path.is_file() and not (path.parent.name == commit.FOLDER and path.name in own)
    }


def episode(root: Path, index: int) -> None:
    """What writing one episode does, as far as files go."""
    write(root, f"data/chunk-000/file-{index:03}.parquet", f"rows {index}")
    write(root, f"videos/front/chunk-000/file-{index:03}.mp4", f"video {index}")
    write(root, f"meta/episodes/chunk-000/file-{index:03}.parquet", f"about {index}")
    write(root, "meta/info.json", f"{index + 1} episodes")
    write(root, "meta/stats.json", f"stats of {index}")


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Two committed episodes."""
    root = tmp_path / "set"
    write(root, "meta/info.json", "0 episodes")
    commit.commit(root, None)
    for index in range(2):
        commit.begin(root)
        episode(root, index)
        commit.commit(root, {"episode": index})
    return root


def test_a_finished_dataset_is_left_alone(dataset: Path) -> None:
    before = tree(dataset)
    assert commit.repair(dataset) == []
    assert tree(dataset) == before
    assert commit.notes(dataset) == [{"episode": 0}, {"episode": 1}]


def test_what_people_change_between_recordings_stays(dataset: Path) -> None:
    write(dataset, "meta/info.json", "2 episodes, and a note")
    write(dataset, "README.md", "ours")
    assert commit.repair(dataset) == []
    assert (dataset / "meta/info.json").read_text() == "2 episodes, and a note"


STEPS = [
    ("data/chunk-000/file-002.parquet", "half"),
    ("tmpabc/front_streaming.mp4", "half"),
    ("images/front/episode-000002/frame-000000.png", "png"),
    ("videos/front/chunk-000/file-002.mp4", "whole"),
    ("meta/episodes/chunk-000/file-002.parquet", ""),
    ("meta/tasks.parquet", "new"),
    ("meta/info.json", "{"),
    ("meta/stats.json", ""),
    (".runner/episodes.jsonl", '{"episode": 0}\n{"episode": 1}\n{"epi'),
    (".runner/.commit.json.new", "half"),
]


@pytest.mark.parametrize("steps", range(len(STEPS) + 1))
def test_a_crash_after_any_step_leaves_the_last_commit(dataset: Path, steps: int) -> None:
    before = tree(dataset)
    commit.begin(dataset)
    for name, text in STEPS[:steps]:
        write(dataset, name, text)
    said = commit.repair(dataset)
    after = tree(dataset)
    after.pop(".runner/.commit.json.new", None)  # never read, written over by the next commit
    assert after == before
    assert said[0] == "an episode was being written; it is lost"
    assert commit.repair(dataset) == []  # and it is over
    commit.begin(dataset)
    episode(dataset, 2)
    commit.commit(dataset, {"episode": 2})
    assert [note["episode"] for note in commit.notes(dataset)] == [0, 1, 2]


def test_a_beginning_that_was_cut_off_is_begun_again(tmp_path: Path) -> None:
    write(tmp_path, "meta/info.json", "{")
    write(tmp_path, ".runner/creating/meta/info.json", "")
    assert commit.repair(tmp_path)
    assert tree(tmp_path) == {}


@pytest.mark.parametrize("harm", ["gone", "cut"])
def test_a_damaged_episode_is_said_and_nothing_is_touched(dataset: Path, harm: str) -> None:
    path = dataset / "data/chunk-000/file-000.parquet"
    path.unlink() if harm == "gone" else os.truncate(path, 2)
    commit.begin(dataset)
    write(dataset, "data/chunk-000/file-002.parquet", "half")
    before = tree(dataset)
    with pytest.raises(
        ConfigError, match=r"file-000\.parquet is missing or not as it was recorded"
    ):
        commit.repair(dataset)
    assert tree(dataset) == before


def test_a_broken_commit_is_said(dataset: Path) -> None:
    (dataset / ".runner/commit.json").write_text("{")
    with pytest.raises(ConfigError, match="cannot be read"):
        commit.repair(dataset)


# -- whose folder
def test_only_ones_own_or_an_empty_folder_is_recorded_into(dataset: Path, tmp_path: Path) -> None:
    commit.check_folder(dataset)
    commit.check_folder(tmp_path / "new" / "deep")
    (tmp_path / "empty").mkdir()
    commit.check_folder(tmp_path / "empty")
    write(tmp_path, "theirs/meta/info.json", "{}")
    with pytest.raises(ConfigError, match="not empty"):
        commit.check_folder(tmp_path / "theirs")
    with pytest.raises(ConfigError, match="not empty"):
        commit.check_folder(tmp_path / "theirs/meta/info.json")


HOLDER = """
import sys
from pathlib import Path
from vram_arbiter.runner.recording import commit
with commit.locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_one_dataset_has_one_writer(tmp_path: Path) -> None:
    pytest.importorskip("filelock", reason="needs the dataset extra")
    other = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert other.stdin is not None
    assert other.stdout is not None
    with other:
        assert other.stdout.readline() == b"held\n"
        with (
            pytest.raises(AlreadyRunning, match="another process records"),
            commit.locked(tmp_path, 0.0),
        ):
            pass
        other.stdin.close()
        with commit.locked(tmp_path, 60.0):  # as soon as the other one is done
            pass
