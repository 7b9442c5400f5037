"""A runner's joints, base and fixed cameras as ROS 2 topics: `/joint_states`, `/tf`, `/tf_static`.

A plain client of the runner's goal socket, on the runner's machine: its monotonic stamps become
wall time here. A state is published once, and never one that is stale: whoever reads the topics
sees them fall silent instead.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.sensors.ros2_dds import announce, dds_problems, dds_topic, writer_of
from vram_arbiter.runner.sensors.ros2_messages import stamp_of
from vram_arbiter.runner.sensors.ros2_types import RosMessage, sample_of, write
from vram_arbiter.runner.sensors.world_state import JOINT_STATE
from vram_arbiter.runner.skills import rotations
from vram_arbiter.schemas.errors import FrameStale, VramError
from vram_arbiter.schemas.manifest.vocabulary import Rotation
from vram_arbiter.schemas.plain import Message

if TYPE_CHECKING:
    from cyclonedds.pub import DataWriter

log = logging.getLogger(__name__)

FRESH_NS: Final = 1_000_000_000  # an older state is not published
KEPT: Final = 10
NODE: Final = "vram_runner_state"
BASE_FRAME: Final = "base_link"  # REP 105's name of what the base's pose is the pose of
KINDS: Final = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}


class StateTopics:
    """`await StateTopics(client, 0, rate_hz=20).run()`. Raises ConfigError if DDS cannot start."""

    def __init__(self, client: RunnerClient, domain: int, rate_hz: float) -> None:
        from cyclonedds.domain import DomainParticipant

        self._client, self._period_s = client, 1 / rate_hz
        self._published_ns = 0
        self._seen: set[str] = set()  # cameras
        self._fixed: list[RosMessage] = []
        self._silent = False
        with dds_problems(domain):
            participant = DomainParticipant(domain)
            self._writers: dict[str, DataWriter] = {
                name: writer_of(
                    participant, dds_topic(name), kind, kept=KEPT, latched=name == "/tf_static"
                )
                for name, kind in KINDS.items()
            }
            self._node = announce(participant, NODE, (), self._writers.values())

    async def run(self) -> None:
        """Publish until canceled. A runner that does not answer is asked again."""
        while True:
            try:
                await self.publish()
                self._silent = False
            except VramError as error:
                if not self._silent:
                    log.warning("no state is published: %s", error)
                self._silent = True
            await asyncio.sleep(self._period_s)

    async def publish(self) -> None:
        """Publish what is new and fresh. Raises what the client raises."""
        state = await self._client.state()
        world = state["world"]
        if world is None:
            return
        joints, age_ns = world["joint_state"], time.monotonic_ns() - _stamp_ns(world)
        if _stamp_ns(world) == self._published_ns or not _is_fresh(world, age_ns):
            return
        self._published_ns = _stamp_ns(world)
        stamp = stamp_of(time.time_ns() - max(0, age_ns))
        told = {name: joints[name] for name in ("name", "position", "velocity", "effort")}
        self._write("/joint_states", {"header": {"stamp": stamp}, **told})
        if (pose := world["base_pose"]) is not None:
            header = {"stamp": stamp, "frame_id": pose["frame_id"]}
            place = _transform(header, BASE_FRAME, pose["xyz"], pose["quat_xyzw"])
            self._write("/tf", {"transforms": [place]})
        await self._tell_cameras(sorted({*state["cameras"]} - self._seen), stamp)

    async def _tell_cameras(self, cameras: Sequence[str], stamp: RosMessage) -> None:
        """Publish where fixed cameras stand, once each has shown a picture."""
        for camera in cameras:
            try:
                model = (await self._client.frame(camera)).get("camera_model")
            except FrameStale:
                continue  # at the next turn
            self._seen.add(camera)
            if model is None or not model["fixed"]:
                continue
            header = {"stamp": stamp, "frame_id": BASE_FRAME}
            self._fixed.append(_camera_transform(header, camera, model["T_base_camera"]))
            self._write("/tf_static", {"transforms": self._fixed})

    def _write(self, topic: str, message: RosMessage) -> None:
        from cyclonedds.core import DDSException

        kind = KINDS[topic]
        try:
            self._writers[topic].write(sample_of(kind, write(kind, message)))
        except DDSException as error:
            log.warning("nothing on %s this time: %s", topic, error)


def _stamp_ns(world: Message) -> int:
    stamp: int = world["joint_state"]["stamp_ns"]
    return stamp


def _is_fresh(world: Message, age_ns: int) -> bool:
    return age_ns < FRESH_NS and world["diagnostics"].get(JOINT_STATE, "ok") == "ok"


def _transform(
    header: RosMessage, child: str, xyz: Sequence[float], xyzw: Sequence[float]
) -> RosMessage:
    """Return the `geometry_msgs/TransformStamped` of `child` in the header's frame (m)."""
    moved = {
        "translation": dict(zip("xyz", xyz, strict=True)),
        "rotation": dict(zip("xyzw", xyzw, strict=True)),
    }
    return {"header": header, "child_frame_id": child, "transform": moved}


def _camera_transform(
    header: RosMessage, camera: str, rows: Sequence[Sequence[float]]
) -> RosMessage:
    """Return it for a 4 × 4 pose (x right, y down, z forward: ROS's optical frame), named like the
    pictures' `frame_id`."""
    import numpy as np

    pose = np.array(rows)
    turned = rotations.numbers(pose[:3, :3], Rotation.QUAT_XYZW)
    return _transform(header, camera, pose[:3, 3].tolist(), turned)
