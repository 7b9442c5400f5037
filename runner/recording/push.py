"""Upload of a recorded dataset to the Hugging Face hub, by lerobot's own method."""

from __future__ import annotations

from pathlib import Path

from vram_arbiter.runner.recording import commit
from vram_arbiter.schemas.errors import ConfigError

PUSHED = (
    "README.md", "data/**", "meta/**", "videos/**",
    f"{commit.FOLDER}/{commit.EPISODES}", f"{commit.TICKS}/**",
)  # fmt: skip


def push(root: Path, repo_id: str, *, private: bool) -> int:
    """Upload the committed episodes and return their number. Blocks.

    Raises ConfigError when there is nothing to upload, or the hub refuses it or is not reachable;
    the dataset stays as it is.
    """
    with commit.locked(root):
        commit.repair(root)
        record = commit.last(root)
        if record is None or not record["episodes"]:
            raise ConfigError(f"{root} has no episode to push", hint="record one first")
        from lerobot.datasets import LeRobotDataset

        try:
            dataset = LeRobotDataset(repo_id, root=root, video_backend="pyav")
            dataset.push_to_hub(private=private, license=None, allow_patterns=list(PUSHED))
        except Exception as error:  # of the hub's client, of httpx, of the dataset's files
            raise ConfigError(
                f"{root} could not be pushed to {repo_id}: {type(error).__name__}: {error}",
                hint=f"it is complete on disk: hf upload {repo_id} {root} --repo-type dataset",
            ) from error
        return record["episodes"]
