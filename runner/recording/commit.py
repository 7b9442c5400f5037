"""Commits of a dataset's folder after every episode, and recovery after a crash.

Parquet and MP4 files are worthless until they are closed, so every episode gets files of its own,
which never change again, and is committed by one rename: `.runner/commit.json` lists them with
their sizes and keeps the three small files that do change. While an episode is being written
`.runner/open` exists; a program that finds it when it opens the folder follows a crash, removes
what no commit lists, and logs it. Must not know lerobot or the runner.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TypedDict

from vram_arbiter.schemas.errors import AlreadyRunning, BadRequest, BadState, ConfigError

FOLDER = ".runner"
COMMIT = "commit.json"
PREVIOUS = "previous.json"  # the commit before, which `undo` returns to
OPEN = "open"
EPISODES = "episodes.jsonl"
LOCK = "lock"
CACHE = "cache"  # of the libraries that write; worthless afterwards
MUTABLE = ("meta/info.json", "meta/stats.json", "meta/tasks.parquet")
TICKS = f"{FOLDER}/ticks"  # columns that a dataset of lerobot's does not have
DATA = ("data", "videos", "images", "meta/episodes", TICKS)  # where files are only ever added
SCRATCH = "tmp*"  # folders in which lerobot encodes videos
LOCK_WAIT_S = 30.0  # a runner that was killed leaves a writer that still finishes its episode
LOCK_POLL_S = 0.1


class Commit(TypedDict):
    """The file `commit.json`: everything that is finished."""

    version: int
    episodes: int
    files: dict[str, int]  # bytes by path
    notes_bytes: int
    meta: dict[str, str]  # the files that do change, base64


class EpisodeNote(TypedDict, total=False):
    """What is noted of one episode, one line of JSON."""

    episode: int
    frames: int
    goal_id: str
    skill: str
    task: str
    trace_id: str
    units: str
    judged: bool | None
    status: str
    code: str
    message: str
    dropped: int
    incomplete: int
    reasons: dict[str, int]
    marked: str  # by the operator: success or failure


def check_folder(root: Path) -> None:
    """Raise ConfigError for a folder that cannot be recorded into: foreign, or not writable."""
    if (root / FOLDER).is_dir() or not root.exists():
        parent = (
            root
            if root.exists()
            else next(path for path in root.absolute().parents if path.exists())
        )
        if not parent.is_dir() or not os.access(parent, os.W_OK):
            raise ConfigError(f"nothing can be recorded into {root}: {parent} cannot be written")
        return
    if not root.is_dir() or any(root.iterdir()):
        raise ConfigError(
            f"{root} is not empty, and no dataset that this program recorded",
            hint="name a new folder, or one of an earlier recording to add to it",
        )
    if not os.access(root, os.W_OK):
        raise ConfigError(f"nothing can be recorded into {root}: it cannot be written")


@contextlib.contextmanager
def locked(root: Path, wait_s: float = LOCK_WAIT_S) -> Iterator[None]:
    """Lock the dataset against other writers.

    Raises AlreadyRunning when it is still locked after `wait_s`.
    """
    from filelock import FileLock, Timeout

    (root / FOLDER).mkdir(parents=True, exist_ok=True)
    lock = FileLock(root / FOLDER / LOCK, timeout=wait_s, poll_interval=LOCK_POLL_S)
    try:
        lock.acquire()
    except Timeout:
        raise AlreadyRunning(
            f"another process records into {root}", hint="wait until it has finished, or stop it"
        ) from None
    try:
        yield
    finally:
        lock.release()


def last(root: Path) -> Commit | None:
    """Return the last commit; None before the first. Raises ConfigError when it cannot be read."""
    try:
        commit: Commit = json.loads((root / FOLDER / COMMIT).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{root / FOLDER / COMMIT} cannot be read: {error}",
            hint="restore it, or record into a new folder",
        ) from error
    return commit


def begin(root: Path) -> None:
    """Mark that files change; until the next commit a crash would leave them unfinished."""
    _write(root / FOLDER / OPEN, b"")


def commit(root: Path, episode: EpisodeNote | None) -> None:
    """Commit what is there, with an episode if given; on disk before this returns."""
    before = last(root) or Commit(version=1, episodes=0, files={}, notes_bytes=0, meta={})
    files = _files(root)
    for name in files.keys() - before["files"].keys():
        _flush(root / name)
    notes_bytes = before["notes_bytes"]
    if episode is not None:
        line = json.dumps(episode, ensure_ascii=False).encode() + b"\n"
        _note(root / FOLDER / EPISODES, notes_bytes, line)
        notes_bytes += len(line)
    record = Commit(
        version=1,
        episodes=before["episodes"] + (episode is not None),
        files=files,
        notes_bytes=notes_bytes,
        meta={
            name: base64.b64encode((root / name).read_bytes()).decode()
            for name in MUTABLE
            if (root / name).exists()
        },
    )
    if episode is not None:
        _write(root / FOLDER / PREVIOUS, json.dumps(before).encode())
    _write(root / FOLDER / COMMIT, json.dumps(record).encode())
    (root / FOLDER / OPEN).unlink(missing_ok=True)


def mark(root: Path, episode: int, verdict: str) -> None:
    """Note the operator's verdict on a committed episode."""
    record = last(root)
    if record is None or not 0 <= episode < record["episodes"]:
        raise BadRequest(f"unknown episode {episode} of {root}")
    line = json.dumps({"episode": episode, "marked": verdict}).encode() + b"\n"
    _note(root / FOLDER / EPISODES, record["notes_bytes"], line)
    grown = Commit(**{**record, "notes_bytes": record["notes_bytes"] + len(line)})
    _write(root / FOLDER / COMMIT, json.dumps(grown).encode())


def undo(root: Path) -> None:
    """Remove the episode that was committed last. Only once: the one before stays.

    Raises BadState where there is none to remove.
    """
    record, previous = last(root), root / FOLDER / PREVIOUS
    before: Commit | None = json.loads(previous.read_bytes()) if previous.exists() else None
    if record is None or before is None or before["episodes"] != record["episodes"] - 1:
        raise BadState(
            "the last episode cannot be removed any more",
            hint="lerobot-edit-dataset removes any episode",
        )
    begin(root)
    _write(root / FOLDER / COMMIT, json.dumps(before).encode())
    repair(root)
    previous.unlink()


def repair(root: Path) -> list[str]:
    """Restore the last commit if a crash left the folder in between. Returns what was done.

    Raises ConfigError when a file of the commit is missing or cut: then nothing is touched.
    """
    record = last(root)
    if record is None:
        return _clear(root)
    _verify(root, record)
    if not (root / FOLDER / OPEN).exists():
        return []
    said = ["an episode was being written; it is lost"]
    for name in sorted(_files(root).keys() - record["files"].keys()):
        (root / name).unlink()
        said.append(f"{name} was not finished: removed")
    for path in (*root.glob(SCRATCH), root / "images"):
        if path.is_dir():
            shutil.rmtree(path)
            said.append(f"{path.name} was not finished: removed")
    for name in MUTABLE:
        said += _restore(root / name, record["meta"].get(name), name)
    notes = root / FOLDER / EPISODES
    if notes.exists() and notes.stat().st_size > record["notes_bytes"]:
        os.truncate(notes, record["notes_bytes"])
    (root / FOLDER / OPEN).unlink()
    return said


def notes(root: Path) -> list[EpisodeNote]:
    """Return the notes of the committed episodes, in order, with the operator's marks."""
    record = last(root)
    if record is None or not (root / FOLDER / EPISODES).exists():
        return []
    text = (root / FOLDER / EPISODES).read_bytes()[: record["notes_bytes"]].decode()
    found: dict[int, EpisodeNote] = {}
    for line in text.splitlines():
        note: EpisodeNote = json.loads(line)
        found[note["episode"]] = {**found.get(note["episode"], {}), **note}
    return list(found.values())


def _clear(root: Path) -> list[str]:
    """Remove an unfinished beginning: before the first commit there are no episodes."""
    said = []
    for path in (root / "meta", root / FOLDER / "creating"):
        if path.exists():
            shutil.rmtree(path)
            said.append(f"{path.name} was not finished: removed")
    return said


def _verify(root: Path, record: Commit) -> None:
    for name, size in record["files"].items():
        path = root / name
        if not path.is_file() or path.stat().st_size != size:
            raise ConfigError(
                f"{path} is missing or not as it was recorded ({size} bytes)",
                hint="restore it, or record into a new folder",
            )


def _restore(path: Path, kept: str | None, name: str) -> list[str]:
    try:
        wanted = None if kept is None else base64.b64decode(kept, validate=True)
    except binascii.Error as error:
        raise ConfigError(f"the commit's copy of {name} is broken: {error}") from error
    there = path.read_bytes() if path.exists() else None
    if there == wanted:
        return []
    if wanted is None:
        path.unlink()
    else:
        _write(path, wanted)
    return [f"{name} is as it was after the last finished episode"]


def _files(root: Path) -> dict[str, int]:
    return {
        path.relative_to(root).as_posix(): path.stat().st_size
        for folder in DATA
        for path in (root / folder).rglob("*")
        if path.is_file()
    }


def _note(path: Path, at: int, line: bytes) -> None:
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        os.ftruncate(handle, at)
        os.pwrite(handle, line, at)
        os.fsync(handle)
    finally:
        os.close(handle)


def _write(path: Path, data: bytes) -> None:
    """Write a file atomically and sync it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.new")
    with open(beside, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
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
