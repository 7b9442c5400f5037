"""A recorded data set as lerobot's own class reads it, in a process that has imported lerobot."""

import json
import os
import sys
import tempfile


def main() -> int:
    """Print what the folder `sys.argv[1]` holds."""
    import datasets
    from lerobot.datasets import LeRobotDataset

    with tempfile.TemporaryDirectory() as cache:
        os.environ["HF_HUB_OFFLINE"] = "1"
        datasets.config.HF_DATASETS_CACHE = cache
        read = LeRobotDataset("local/read", root=sys.argv[1], video_backend="pyav")
        first, last = read[0], read[len(read) - 1]
        cameras = {key: first[key].mean(dim=(1, 2)).tolist() for key in read.meta.camera_keys}
        found = {
            "episodes": read.num_episodes,
            "frames": read.num_frames,
            "task": first["task"],
            "cameras": cameras,  # red, green and blue of the first picture, 0 to 1
            "moved": float((last["observation.state"] - first["observation.state"]).abs().max()),
        }
    print(json.dumps(found))
    return 0
