"""Commits of a dataset's folder after every episode, and recovery after a crash.

Parquet and MP4 files are worthless until they are closed, so every episode gets files of its own,
which never change again. `begin` writes down what there is: the names of all files, and the three
small files that do change. While that record is `.runner/open.json`, an episode is being written; a
program that finds it when it opens the folder follows a crash and returns to the record. `commit`
renames it to `undo.json`, which `undo` returns to. Must not know lerobot or the runner.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final, TypedDict

from pydantic import TypeAdapter, ValidationError

from vram_arbiter.schemas.errors import AlreadyRunning, BadRequest, BadState, ConfigError

FOLDER = ".runner"
OPEN = "open.json"
UNDO = "undo.json"
EPISODES = "episodes.jsonl"
LOCK = "lock"
CACHE = "cache"  # of the libraries that write; worthless afterwards
MUTABLE = ("meta/info.json", "meta/stats.json", "meta/tasks.parquet")
DATA = ("data", "videos", "images", "meta/episodes")  # where files are only ever added
SCRATCH = "tmp*"  # folders in which lerobot encodes videos
LOCK_WAIT_S = 30.0  # a runner that was killed leaves a writer that still finishes its episode
LOCK_POLL_S = 0.1


class Record(TypedDict):
    """The folder before an episode."""

    files: list[str]
    meta: dict[str, str]  # the files that do change, base64
    notes_bytes: int


class GoalNote(TypedDict, total=False):
    """A goal, and how it ended."""

    goal_id: str
    skill: str
    status: str
    code: str
    message: str
    dropped: int
    incomplete: int
    marked: str  # by the operator: success or failure


class EpisodeNote(GoalNote, total=False):
    """What is known of an episode before it has a number."""

    frames: int
    task: str
    trace_id: str
    units: str
    reasons: dict[str, int]


class CommittedNote(EpisodeNote):
    """What is noted of one episode, one line of JSON."""

    episode: int


_NOTE: Final = TypeAdapter(CommittedNote)


def check_folder(root: Path) -> None:
    """Raise ConfigError for a folder that cannot be recorded into: foreign, or not writable."""
    there = root if root.exists() else next(p for p in root.absolute().parents if p.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise ConfigError(f"nothing can be recorded into {root}: {there} cannot be written")
    if root.exists() and not is_ours(root) and any(root.iterdir()):
        raise ConfigError(
            f"{root} is not empty, and no dataset that this program recorded",
            hint="name a new folder, or one of an earlier recording to add to it",
        )


def is_ours(root: Path) -> bool:
    """Return whether this program has recorded into a folder."""
    return (root / FOLDER).is_dir()


@contextlib.contextmanager
def locked(root: Path, wait_s: float = LOCK_WAIT_S) -> Iterator[None]:
    """Lock the dataset against other writers.

    Raises AlreadyRunning when it is still locked after `wait_s`.
    """
    from filelock import FileLock, Timeout

    (root / FOLDER).mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(root / FOLDER / LOCK, timeout=wait_s, poll_interval=LOCK_POLL_S):
            yield
    except Timeout:
        raise AlreadyRunning(
            f"another process records into {root}", hint="wait until it has finished, or stop it"
        ) from None


def begin(root: Path) -> None:
    """Write down what there is; until `commit` a crash returns to it."""
    notes = root / FOLDER / EPISODES
    record: Record = {
        "files": _files(root),
        "meta": {
            name: base64.b64encode((root / name).read_bytes()).decode()
            for name in MUTABLE
            if (root / name).exists()
        },
        "notes_bytes": notes.stat().st_size if notes.exists() else 0,
    }
    _write(root / FOLDER / OPEN, json.dumps(record).encode())


def commit(root: Path, episode: CommittedNote) -> None:
    """Commit the episode that is open; on disk before this returns."""
    before = opened(root)
    if before is None:
        raise BadState("no episode is open")
    for name in (*set(_files(root)).difference(before["files"]), *MUTABLE):
        _flush(root / name)
    _note(root, episode)
    os.replace(root / FOLDER / OPEN, root / FOLDER / UNDO)
    _flush(root / FOLDER)


def mark(root: Path, episode: int, verdict: str) -> None:
    """Note the operator's verdict on a committed episode."""
    if episode not in {note["episode"] for note in notes(root)}:
        raise BadRequest(f"unknown episode {episode} of {root}")
    _note(root, {"episode": episode, "marked": verdict})
    if (record := opened(root)) is not None:
        record["notes_bytes"] = (root / FOLDER / EPISODES).stat().st_size
        _write(root / FOLDER / OPEN, json.dumps(record).encode())


def undo(root: Path) -> None:
    """Remove the episode that was committed last. Only once: the one before stays.

    Raises BadState where there is none to remove.
    """
    try:
        os.replace(root / FOLDER / UNDO, root / FOLDER / OPEN)
    except FileNotFoundError:
        raise BadState(
            "the last episode cannot be removed any more",
            hint="lerobot-edit-dataset removes any episode",
        ) from None
    repair(root)


def opened(root: Path) -> Record | None:
    """Return the record of the episode that is being written or was cut off; None without one.

    Raises ConfigError when it cannot be read.
    """
    path = root / FOLDER / OPEN
    try:
        record: Record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path} cannot be read: {error}", hint="restore it, or record into a new folder"
        ) from error
    return record


def repair(root: Path) -> list[str]:
    """Return to the last finished episode if one was cut off. Returns what was done."""
    if (record := opened(root)) is None:
        return []
    said = ["an episode was being written; it is lost"]
    for name in sorted(set(_files(root)).difference(record["files"])):
        (root / name).unlink()
        said.append(f"{name} was not finished: removed")
    for path in (*root.glob(SCRATCH), root / "images"):
        if path.is_dir():
            shutil.rmtree(path)
            said.append(f"{path.name} was not finished: removed")
    for name in MUTABLE:
        if name in record["meta"]:
            _write(root / name, base64.b64decode(record["meta"][name]))
        else:
            (root / name).unlink(missing_ok=True)
    if (root / FOLDER / EPISODES).exists():
        os.truncate(root / FOLDER / EPISODES, record["notes_bytes"])
    (root / FOLDER / OPEN).unlink()
    return said


def notes(root: Path) -> list[CommittedNote]:
    """Return the notes of the committed episodes, in order, with the operator's marks.

    Raises ConfigError for a line that is not a note.
    """
    path, record = root / FOLDER / EPISODES, opened(root)
    if not path.exists():
        return []
    text = path.read_bytes()[: None if record is None else record["notes_bytes"]].decode()
    found: dict[int, CommittedNote] = {}
    for number, line in enumerate(text.splitlines(), 1):
        try:
            note = _NOTE.validate_json(line)
        except ValidationError as error:
            wrong = error.errors()[0]
            where = ".".join(map(str, wrong["loc"])) or "JSON"
            raise ConfigError(
                f"{path}, line {number}: {where}: {wrong['msg']}", hint="restore the file"
            ) from None
        episode = note["episode"]
        found[episode] = {**found[episode], **note} if episode in found else note
    return list(found.values())


def finished_files(root: Path, folder: str) -> list[Path]:
    """Return the files below `folder` that are finished."""
    record = opened(root)
    names = _files(root) if record is None else record["files"]
    return [root / name for name in sorted(names) if name.startswith(f"{folder}/")]


def _files(root: Path) -> list[str]:
    return [
        path.relative_to(root).as_posix()
        for folder in DATA
        for path in (root / folder).rglob("*")
        if path.is_file()
    ]


def _note(root: Path, note: CommittedNote) -> None:
    with (root / FOLDER / EPISODES).open("ab") as file:
        file.write(json.dumps(note, ensure_ascii=False).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def _write(path: Path, data: bytes) -> None:
    """Write a file atomically and sync it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.new")
    beside.write_bytes(data)
    _flush(beside)
    os.replace(beside, path)
    _flush(path.parent)


def _flush(path: Path) -> None:
    """Sync to the disk: a file's bytes and its name in the folder, or a folder's names."""
    for each in (path, path.parent) if path.is_file() else (path,):
        handle = os.open(each, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
