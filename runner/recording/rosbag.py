"""One recorded episode as a rosbag2 (MCAP): measured joints, their targets, and cameras as JPEG.

Stamps are the recording's: the runner's monotonic clock at the end of each tick, minus a picture's
age in that picture's header.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vram_arbiter.runner.recording.reader import Recorded, RecordedPicture, read_episode
from vram_arbiter.runner.sensors.pictures import encode
from vram_arbiter.runner.sensors.ros2_messages import COMPRESSED, stamp_of
from vram_arbiter.runner.sensors.ros2_types import RosMessage, typestore, write
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.extras import need

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

JOINTS: Final = "sensor_msgs/msg/JointState"
STATE_TOPIC: Final = "/joint_states"
ACTION_TOPIC: Final = "/joint_commands"


def export(root: Path, episode: int, out: Path) -> int:
    """Write an episode into the new folder `out`; return its number of messages.

    Raises ConfigError for a folder that exists or cannot be written, and what `read_episode`
    raises.
    """
    need("rosbag2", "rosbags", "av", "cv2", extra="ros2,dataset,runner")
    from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

    rows, count = read_episode(root, episode), 0
    try:
        with Writer(out, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
            opened: dict[str, Connection] = {}
            for stamp_ns, topic, kind, message in _messages(rows):
                if topic not in opened:
                    opened[topic] = bag.add_connection(topic, kind, typestore=typestore())
                bag.write(opened[topic], stamp_ns, write(kind, message))
                count += 1
    except (OSError, WriterError) as error:
        raise ConfigError(f"--out {out}: {error}", hint="name a folder that is new") from error
    return count


def _messages(rows: list[Recorded]) -> Iterator[tuple[int, str, str, RosMessage]]:
    """Yield stamp (ns), topic, type and message of all that was recorded, in its order."""
    videos = {name: _colors(where) for name, where in rows[0].pictures.items()}
    for row in rows:
        stamp_ns = row.tick["stamp_ns"]
        yield stamp_ns, STATE_TOPIC, JOINTS, _joints(stamp_ns, row.state)
        yield stamp_ns, ACTION_TOPIC, JOINTS, _joints(stamp_ns, row.action)
        for name, colors in videos.items():
            taken_ns = max(0, stamp_ns - int(row.pictures[name]["age_ms"] * 1e6))
            header = {"stamp": stamp_of(taken_ns), "frame_id": name}
            data = encode(next(colors), "jpeg")
            picture = {"header": header, "format": "jpeg", "data": data}
            yield stamp_ns, f"/{name}/image/compressed", COMPRESSED, picture


def _joints(stamp_ns: int, positions: Mapping[str, float]) -> RosMessage:
    """Return `sensor_msgs/JointState` of positions (rad)."""
    header = {"stamp": stamp_of(stamp_ns)}
    return {"header": header, "name": list(positions), "position": list(positions.values())}


def _colors(first: RecordedPicture) -> Iterator[Any]:
    """Yield the pictures of a video (RGB, uint8), from that of the episode's first row on."""
    import av

    with av.open(first["path"]) as video:
        stream = video.streams.video[0]
        half_s = 0.5 / float(stream.average_rate)
        for picture in video.decode(stream):
            if picture.time > first["at_s"] - half_s:
                yield picture.to_ndarray(format="rgb24")
