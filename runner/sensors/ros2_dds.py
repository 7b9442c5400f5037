"""ROS 2's side of DDS: topic names, domain, readers and writers with their quality of service.
Needs no ROS installation.

Cyclone DDS chooses the network: `CYCLONEDDS_URI` configures it, as for ROS with rmw_cyclonedds.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from vram_arbiter.runner.sensors.ros2_types import dds_type, sample_of, type_hash, write
from vram_arbiter.schemas.errors import ConfigError

DOMAIN_MAX = 232  # the last one whose ports exist
DOMAIN_VARIABLE = "ROS_DOMAIN_ID"
_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*")


def full_topic(name: str) -> str:
    """Return the DDS topic of a ROS name with its leading slash.

    Raises ValueError for a wrong name.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(
            "expected a ROS topic (letters, digits and _ between slashes,"
            " such as /front/image_raw),"
            f" got {name!r}"
        )
    return "/" + name.removeprefix("/")


def dds_topic(name: str) -> str:
    """Return the DDS name of a ROS topic: `rt` for topic, then the full name."""
    return "rt" + full_topic(name)


def domain_of(environment: Mapping[str, str] = os.environ) -> int:
    """Return the domain of the environment; 0 without one. Raises ValueError."""
    text = environment.get(DOMAIN_VARIABLE, "") or "0"
    if not text.isascii() or not text.isdigit() or int(text) > DOMAIN_MAX:
        raise ValueError(f"{DOMAIN_VARIABLE} is {text!r}, not a number from 0 to {DOMAIN_MAX}")
    return int(text)


def reader_of(
    participant: Any, topic: str, kind: str, reliability: str = "reliable", kept: int = 1
) -> Any:
    """Return a reader of a DDS topic; it keeps the newest `kept` samples."""
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    described = Topic(participant, topic, dds_type(kind))
    return DataReader(participant, described, qos=_qos(kind, reliability, kept))


def writer_of(
    participant: Any,
    topic: str,
    kind: str,
    *,
    kept: int = 1,
    wait_s: int = 0,
    latched: bool = False,
) -> Any:
    """Return a reliable writer on a DDS topic; it keeps the newest `kept` samples.

    It waits `wait_s` for a slow reader at most; then it drops. `latched`: readers that come later
    get what was kept; otherwise nothing is.
    """
    from cyclonedds.core import Policy
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    described = Topic(participant, topic, dds_type(kind))
    quality = _qos(
        kind,
        "reliable",
        kept,
        Policy.WriterDataLifecycle(autodispose=False),  # ROS disposes of nothing
        wait_s=wait_s,
        latched=latched,
    )
    return DataWriter(participant, described, qos=quality)


def announce(participant: Any, node: str, readers: Iterable[Any], writers: Iterable[Any]) -> Any:
    """Tell ROS 2 which node has these endpoints, as rmw_dds_common does for `ros2 node list`.

    Return the writer; nodes that start later hear of it as long as it is kept.
    """
    kind = "rmw_dds_common/msg/ParticipantEntitiesInfo"
    told = writer_of(participant, "ros_discovery_info", kind, latched=True)
    entities = {
        "node_namespace": "/",
        "node_name": node,
        "reader_gid_seq": [_gid(reader) for reader in readers],
        "writer_gid_seq": [_gid(writer) for writer in writers],
    }
    info = {"gid": _gid(participant), "node_entities_info_seq": [entities]}
    told.write(sample_of(kind, write(kind, info)))
    return told


def _gid(entity: Any) -> dict[str, bytes]:
    return {"data": entity.guid.bytes}


def _qos(
    kind: str,
    reliability: str,
    kept: int,
    *more: Any,
    wait_s: int = 0,
    latched: bool = False,
) -> Any:
    """Return ROS's quality of service: plain CDR, and the type's hash where rmw_cyclonedds has it
    (`encode_type_hash_for_user_data_qos` of rmw_dds_common)."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    reliable = Policy.Reliability.Reliable(duration(seconds=wait_s))
    return Qos(
        reliable if reliability == "reliable" else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(kept),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash={type_hash(kind)};".encode()),
        *more,
    )


@contextmanager
def dds_problems(domain_id: int) -> Iterator[None]:
    """Turn DDS's errors into ConfigError: no such interface, a broken CYCLONEDDS_URI, no free
    port.
    """
    from cyclonedds.core import DDSException

    try:
        yield
    except DDSException as error:
        raise ConfigError(
            f"DDS could not be started on domain {domain_id}: {error}",
            hint="look at CYCLONEDDS_URI: its interfaces and peers; Cyclone logs details on stderr",
        ) from error
