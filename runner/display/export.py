"""A recorded dataset as a Rerun recording: states, actions, pictures, violations, by episode.

Reads committed episodes only, also of a dataset that a runner records into. Needs the extras `viz`
and `dataset`, not lerobot.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vram_arbiter.runner.display.stream import RerunStream
from vram_arbiter.runner.recording.reader import EpisodeRows, read_episodes
from vram_arbiter.schemas.errors import ConfigError

EPISODE_GAP_S = 1.0  # between two episodes on the timeline `time`


def export(root: Path, out: Path, episode: int | None = None) -> int:
    """Write the dataset, or one episode of it, to `out`; return the number of frames.

    An older file at `out` stays until the new one is complete.
    Raises ConfigError for a folder or a file that cannot be read, BadRequest for a missing episode.
    """
    episodes = read_episodes(root, episode)
    part = out.with_name(f".{out.stem}.{os.getpid()}.rrd")
    try:
        frames = _write(part, root.name, episodes)
        os.replace(part, out)
    finally:
        part.unlink(missing_ok=True)
    return frames


def _write(out: Path, name: str, episodes: Iterator[EpisodeRows]) -> int:
    stream = RerunStream(str(out), name)
    begins_s, frames = 0.0, 0
    try:
        for rows in episodes:
            frames += _show(stream, rows, begins_s)
            begins_s += rows.rows[-1]["timestamp"] + EPISODE_GAP_S
    finally:
        stream.close()
    return frames


def _show(stream: RerunStream, episode: EpisodeRows, begins_s: float) -> int:
    stream.at(begins_s, episode.rows[0]["index"])
    note = episode.note
    mark = f", marked {note['marked']}" if "marked" in note else ""
    stream.goal(f"episode {episode.index}: {note.get('skill', '')} {note.get('task', '')!r}")
    stream.event(f"episode {episode.index}: {note.get('status', '')}{mark}")
    videos = {camera: _pictures(path) for camera, path in episode.videos.items()}
    for row in episode.rows:
        stream.at(begins_s + row["timestamp"], row["index"])
        stream.numbers("state", episode.named(row, "observation.state"))
        stream.numbers("action", episode.named(row, "action"))
        stream.numbers("base", episode.named(row, "base_pose"))
        stream.numbers("tick", episode.named(row, "tick.timings_ms"))
        withheld = bool(row["tick.violations"]) and not row["tick.action_applied"]
        stream.numbers("tick", {"withheld": float(withheld)})
        if row["tick.violations"]:
            said = row["tick.violations"]
            stream.event(f"withheld: {said}" if withheld else said, "WARN")
        for camera, pictures in videos.items():
            if (rgb := next(pictures, None)) is None:
                raise ConfigError(f"the video of {camera} ends before episode {episode.index}")
            stream.picture(camera, rgb)
    return len(episode.rows)


def _pictures(path: Path) -> Iterator[Any]:
    """Yield a video's pictures as RGB arrays."""
    import av

    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                yield frame.to_ndarray(format="rgb24")
    except (OSError, av.FFmpegError) as error:
        raise ConfigError(f"{path} cannot be read: {error}", hint="restore the file") from error
