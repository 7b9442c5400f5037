"""The folder after a crash: exactly what the last commit had, never half an episode."""

import subprocess
import sys
from pathlib import Path

import pytest

from vram_arbiter.runner.recording import commit
from vram_arbiter.schemas.errors import AlreadyRunning, BadRequest, BadState, ConfigError


def write(root: Path, name: str, text: str) -> None:
    (root / name).parent.mkdir(parents=True, exist_ok=True)
    (root / name).write_text(text)


def tree(root: Path) -> dict[str, bytes]:
    """All files that belong to the dataset, with the notes."""
    own = (commit.OPEN, commit.UNDO, commit.LOCK)
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
    write(root, "meta/stats.json", "none")
    write(root, "meta/tasks.parquet", "none")
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
]


@pytest.mark.parametrize("steps", range(len(STEPS) + 1))
def test_a_crash_after_any_step_leaves_the_last_commit(dataset: Path, steps: int) -> None:
    before = tree(dataset)
    commit.begin(dataset)
    for name, text in STEPS[:steps]:
        write(dataset, name, text)
    said = commit.repair(dataset)
    after = tree(dataset)
    assert after == before
    assert said[0] == "an episode was being written; it is lost"
    assert commit.repair(dataset) == []  # and it is over
    commit.begin(dataset)
    episode(dataset, 2)
    commit.commit(dataset, {"episode": 2})
    assert [note["episode"] for note in commit.notes(dataset)] == [0, 1, 2]


@pytest.mark.parametrize(
    ("line", "wrong"), [('{"episode": "one"}', "episode: Input"), ('{"epi', "JSON: Invalid JSON")]
)
def test_a_line_that_is_no_note_is_named(dataset: Path, line: str, wrong: str) -> None:
    write(dataset, ".runner/episodes.jsonl", f'{{"episode": 0}}\n{line}\n')
    with pytest.raises(ConfigError, match=f"episodes.jsonl, line 2: {wrong}"):
        commit.notes(dataset)


def test_the_last_episode_is_taken_back_once(dataset: Path) -> None:
    before = tree(dataset)
    commit.begin(dataset)
    episode(dataset, 2)
    commit.commit(dataset, {"episode": 2})
    commit.mark(dataset, 2, "success")
    assert commit.notes(dataset)[-1] == {"episode": 2, "marked": "success"}
    commit.undo(dataset)
    assert tree(dataset) == before
    with pytest.raises(BadState, match="cannot be removed any more"):
        commit.undo(dataset)


def test_a_mark_outlives_the_episode_that_is_cut_off_after_it(dataset: Path) -> None:
    commit.begin(dataset)
    commit.mark(dataset, 1, "failure")
    assert commit.repair(dataset)
    assert commit.notes(dataset)[1] == {"episode": 1, "marked": "failure"}
    with pytest.raises(BadRequest, match="unknown episode 2"):
        commit.mark(dataset, 2, "failure")


def test_only_finished_files_are_read_while_an_episode_is_written(dataset: Path) -> None:
    commit.begin(dataset)
    episode(dataset, 2)
    read = [path.name for path in commit.finished_files(dataset, "data")]
    assert read == ["file-000.parquet", "file-001.parquet"]


def test_a_broken_record_is_said(dataset: Path) -> None:
    (dataset / commit.FOLDER / commit.OPEN).write_text("{")
    with pytest.raises(ConfigError, match="cannot be read"):
        commit.repair(dataset)


# -- whose folder
def test_only_ones_own_or_an_empty_folder_is_recorded_into(dataset: Path, tmp_path: Path) -> None:
    commit.check_folder(dataset)
    commit.check_folder(tmp_path / "new" / "deep")
    (tmp_path / "empty").mkdir()
    commit.check_folder(tmp_path / "empty")
    write(tmp_path, "theirs/meta/info.json", "{}")
    with pytest.raises(ConfigError, match=r"not empty|cannot be written"):
        commit.check_folder(tmp_path / "theirs")
    with pytest.raises(ConfigError, match=r"not empty|cannot be written"):
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
